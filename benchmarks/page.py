"""``python -m benchmarks.page``: write the recorded results into the README and the documentation.

A marked place in a Markdown file is rewritten from the results, so that no number is typed twice::

    <!-- bench: headlines -->a table of `benchmarks.tables`<!-- /bench -->
    <!-- bench: shared_finger :: cube, mean [mm] :: .2f -->0.23<!-- /bench -->

The second form names a benchmark, one of its results, and how to write it:

* a result may be a pattern with ``*``; then ``min`` or ``max`` in front of the format says which match to take;
* ``[1]`` in front of the format takes an item of a list;
* an empty format writes the value as it stands.

Results come from ``benchmarks/results.json`` (written by ``softgym bench``) and, for runs that no benchmark repeats,
from ``benchmarks/data/recorded.json``. A test compares all pages with both files.
"""

from __future__ import annotations

import json
import re
import sys
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from softgym_envs.errors import DataError

ROOT = Path(__file__).resolve().parents[1]
SOURCES = (ROOT / "benchmarks" / "data" / "recorded.json", ROOT / "benchmarks" / "results.json")
"""Later files win: a benchmark that has been run replaces a recorded result."""

DERIVED = ("networks", "strategies")
"""Benchmarks that evaluate a data file of their own, in a second."""

MARKER = re.compile(r"(<!-- bench: (?P<key>.+?) -->)(?P<text>.*?)(<!-- /bench -->)", re.DOTALL)
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


def figure(benchmark: str, name: str, form: str = "") -> str:
    """Return one result as text.

    Args:
        benchmark: its name in the results.
        name: of the result, or a pattern with ``*``.
        form: see the head of this module.

    Raises:
        DataError: if no result, or more than one, has this name.
    """
    found = results(benchmark)
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


def fill(text: str) -> str:
    """Return a Markdown page with every marked place rewritten from the results."""
    from benchmarks.tables import TABLES

    def replace(match: re.Match[str]) -> str:
        name, *rest = (part.strip() for part in match["key"].split("::"))
        if rest:
            content = figure(name, *rest)
        elif name in TABLES:
            content = f"\n\n{TABLES[name]()}\n\n"
        else:
            raise DataError(f"no table '{name}'; allowed: {', '.join(TABLES)}")
        return f"{match[1]}{content}{match[4]}"

    return MARKER.sub(replace, text)


def pages() -> list[Path]:
    """Markdown files that may hold marked places."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def main() -> int:
    """Rewrite all pages; return how many changed."""
    changed = 0
    for path in pages():
        text = path.read_text()
        try:
            filled = fill(text)
        except DataError as error:
            raise SystemExit(f"{path.relative_to(ROOT)}: {error}") from None
        if filled != text:
            path.write_text(filled)
            print(f"wrote {path.relative_to(ROOT)}")
            changed += 1
    return changed


if __name__ == "__main__":
    main()
    sys.exit(0)
