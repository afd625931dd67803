"""Recorded results of the benchmarks, and their values as text."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from softgym_envs.errors import DataError

HERE = Path(__file__).resolve().parent
SOURCES = (HERE / "data" / "recorded.json", HERE / "results.json")
"""Later files take precedence: a benchmark that has been run replaces a recorded result."""

DERIVED = ("design_networks", "grasp_codesign", "learners", "networks", "strategies")
"""Benchmarks that evaluate a data file of their own, in a second."""

FORMAT = re.compile(r"(?P<pick>min|max)? *(?:\[(?P<item>\d+)\])? *(?P<form>.*)")


@cache
def records() -> dict[str, dict[str, Any]]:
    """Entry of each benchmark: its results, and the commit and command that made them."""
    return {name: entry for path in SOURCES for name, entry in json.loads(path.read_text()).items()}


@cache
def results(benchmark: str) -> dict[str, Any]:
    """Results of one benchmark, by name.

    Raises:
        DataError: if the benchmark has no recorded results.
    """
    if benchmark in DERIVED:
        return getattr(import_module(f"benchmarks.{benchmark}"), benchmark)()
    try:
        return records()[benchmark]["results"]
    except KeyError:
        known = ", ".join(sorted(records()))
        raise DataError(f"no results of benchmark '{benchmark}'; recorded: {known}") from None


def number(value: Any, form: str) -> str:
    """Format a value; exponents are written without leading zeros: ``1.8e-4``."""
    if not form:
        return str(value)
    text = "infinite" if value == float("inf") else format(value, form)
    return re.sub(r"e([+-])0*(\d)", lambda m: f"e{m[1].strip('+')}{m[2]}", text)


def _named(values: dict[str, Any], group: str = "") -> Iterator[tuple[str, Any]]:
    """Yield results and groups of results by name, those inside a group as ``"group: name"``."""
    for name, value in values.items():
        yield group + name, value
        if isinstance(value, dict):
            yield from _named(value, f"{group}{name}: ")


def figure(benchmark: str, name: str, form: str = "") -> str:
    """Return one result as text.

    Args:
        benchmark: its name in the results.
        name: of the result, or a pattern with ``*``; ``"group: name"`` for one in a group of results.
        form: see `benchmarks.page`.

    Raises:
        DataError: if no result, or more than one, has this name.
    """
    found = dict(_named(results(benchmark)))
    how = FORMAT.fullmatch(form.strip())
    assert how is not None
    pattern = re.compile(re.escape(name).replace(r"\*", ".*"))
    values = [found[name]] if name in found else [value for key, value in found.items() if pattern.fullmatch(key)]
    if how["item"]:
        values = [value[int(how["item"])] for value in values]
    if not values or (len(values) > 1 and not how["pick"]):
        raise DataError(f"benchmark '{benchmark}' has {len(values)} results named '{name}', not one")
    value = {"min": min, "max": max}.get(how["pick"], min)(values)
    return number(value, how["form"])
