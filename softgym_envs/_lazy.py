"""Lazy exports of packages: a public name is imported from its module when it is first used."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module

from softgym_envs.errors import MissingLibrary
from softgym_envs.extras import explain

Exports = Mapping[str, Sequence[str]]
"""Module of the package -> the public names that it defines."""


def lazy_exports(package: str, exports: Exports) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package.

    The package also lists the same imports under ``if TYPE_CHECKING``, for type checkers and editors; a test checks
    that both agree.

    Args:
        package: its ``__name__``.
        exports: modules, relative to the package, and their public names.
    """
    module_of = {name: module for module, names in exports.items() for name in names}
    public = sorted(module_of)

    def __getattr__(name: str) -> object:
        if name not in module_of:
            raise AttributeError(f"module '{package}' has no attribute '{name}'; public names: {', '.join(public)}")
        module = module_of[name]
        try:
            value = getattr(import_module(f".{module}", package), name)
        except ImportError as error:
            line = explain(error)
            if line is None:
                raise
            raise MissingLibrary(f"{package}.{name}: {line}") from error
        setattr(sys.modules[package], name, value)
        return value

    def __dir__() -> list[str]:
        return sorted({*vars(sys.modules[package]), *public})

    return __getattr__, __dir__, public
