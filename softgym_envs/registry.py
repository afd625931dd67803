"""Registries: tables from a name to ``module:class``, imported when used."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from importlib import import_module
from typing import Any

__all__ = ["make_registered"]


def make_registered(kind: str, table: Mapping[str, str], name: str, *arguments: object, **options: object) -> Any:
    """Return an object of the class that ``table`` has under ``name``.

    Args:
        kind: what the table holds, for messages: ``"robot"``, ...
        table: the registry.
        name: a key of it.
        *arguments: positional arguments of the class.
        **options: keyword arguments of the class.

    Raises:
        ValueError: for an unknown name, an option that the class does not take, or one of the wrong type.
    """
    if name not in table:
        raise ValueError(f"unknown {kind} '{name}'; allowed: {', '.join(table)}")
    module, _, name_of_class = table[name].partition(":")
    cls = getattr(import_module(module), name_of_class)
    try:
        inspect.signature(cls).bind(*arguments, **options)
    except TypeError as error:
        raise ValueError(f"{kind} '{name}': {error}") from None
    try:
        return cls(*arguments, **options)
    except TypeError as error:  # an option of the wrong type, somewhere inside
        raise ValueError(f"{kind} '{name}' cannot be made with {options}: {error}") from error
