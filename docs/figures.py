"""``python docs/figures.py``: write recorded results into the README and the guides, so that no number is typed twice.

A marked place in a Markdown file is rewritten::

    <!-- figure: headlines -->the table of the README<!-- /figure -->
    <!-- figure: trust -->the table of what shipped weights say about their errors<!-- /figure -->
    <!-- figure: shared_finger :: cube, mean [mm] :: .2f -->0.23<!-- /figure -->

The last form names a record, one of its results, and how to write it:

* a result inside a group is named ``group: name``;
* a result may be a pattern with ``*``; then ``min`` or ``max`` in front of the format says which match to take;
* ``[1]`` in front of the format takes an item of a list;
* an empty format writes the value as it stands.

Records stand in ``studies/*/results.json`` and, for speed, in ``benchmarks/results.json``; trust stands in the cards of
weights. A test compares all pages with them. Pages of studies are frozen and have no marked places.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

from softgym_envs.codesign.config import StudyConfig
from softgym_envs.config import load_config
from softgym_envs.errors import DataError
from softgym_envs.robots.registry import make_robot
from softgym_envs.surrogate.pretrained import pretrained_folder, shipped_robots
from softgym_envs.units import display, effort_unit
from softgym_envs.wording import decimal

ROOT = Path(__file__).resolve().parents[1]
MARKER = re.compile(r"(<!-- figure: (?P<key>.+?) -->)(?P<text>.*?)(<!-- /figure -->)", re.DOTALL)
FORMAT = re.compile(r"(?P<pick>min|max)? *(?:\[(?P<item>\d+)\])? *(?P<form>.*)")
HEADLINES = ("finger_reach", "diamond_reach", "trunk_reach", "cable_trunk_reach", "tetrapod_reach")


def pages() -> list[Path]:
    """Return the pages with marked places: the README and the guides."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@cache
def records() -> dict[str, dict[str, Any]]:
    """Return every record by its name: its results, and the commit and command that made them.

    Raises:
        DataError: if two files hold a record of the same name.
    """
    found: dict[str, dict[str, Any]] = {}
    for path in (ROOT / "benchmarks" / "results.json", *sorted((ROOT / "studies").glob("*/results.json"))):
        entries = json.loads(path.read_text())
        if twice := found.keys() & entries.keys():
            raise DataError(f"'{path.relative_to(ROOT)}' repeats the records {', '.join(sorted(twice))}")
        found |= entries
    return found


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


def figure(record: str, name: str, form: str = "") -> str:
    """Return one result as text.

    Args:
        record: its name.
        name: of the result, or a pattern with ``*``; ``"group: name"`` for one in a group of results.
        form: see the head of this file.

    Raises:
        DataError: if there is no such record, or if no result, or more than one, has this name.
    """
    if record not in records():
        raise DataError(f"no record '{record}'; allowed: {', '.join(sorted(records()))}")
    named = dict(_named(records()[record]["results"]))
    how = FORMAT.fullmatch(form.strip())
    assert how is not None
    pattern = re.compile(re.escape(name).replace(r"\*", ".*"))
    values = [named[name]] if name in named else [value for key, value in named.items() if pattern.fullmatch(key)]
    if how["item"]:
        values = [value[int(how["item"])] for value in values]
    if not values or (len(values) > 1 and not how["pick"]):
        raise DataError(f"record '{record}' has {len(values)} results named '{name}', not one")
    return number({"min": min, "max": max}.get(how["pick"], min)(values), how["form"])


def drives(study: str) -> str:
    """Return how far the drives of a study's robot go, the limits of the study, and whether the robot has weight."""
    config = load_config(ROOT / "configs" / "codesign" / f"{study}.yaml", StudyConfig)
    robot, words = config.robot, {"largest_effort": "", "largest_strain": " strain", "self_force": " self-contact"}
    shown = [(actuator, display(actuator.unit)) for actuator in robot.actuators]
    ends = dict.fromkeys(f"{actuator.high * factor:g} {name}" for actuator, (name, factor, _) in shown)
    limits = ""
    for name in filter(config.constraints.get, words):
        factor, unit = config.objectives[name].scale, config.objectives[name].display.unit
        limits += f", {config.constraints[name] * factor:g} {unit}{words[name]}"
    return f"drives to {' and '.join(ends)}{limits}{'' if any(robot.gravity) else ', no weight'}".replace(" ", "\u00a0")


def efforts(study: str, row: dict[str, Any]) -> str:
    """Return the mean efforts of baseline and winner, in the unit of the drives of a study's robot."""
    robot = load_config(ROOT / "configs" / "codesign" / f"{study}.yaml", StudyConfig).robot
    shown = display(effort_unit(robot.actuators[0].unit))
    values = (shown.factor * row[f"{who}, mean effort [N]"] for who in ("baseline", "winner"))  # in SI units, not all N
    return f"{' → '.join(format(value, '.2g') for value in values)} {shown.unit}".replace(" ", "\u00a0")


def headlines() -> str:
    """Studies: mean distance to the test goals on FEM, from the baseline to the winner, and on a finer mesh."""
    lines = [
        "| robot; controller; drives | baseline | winner | change, 95% | study's → finer mesh "
        "| mean effort | command |",
        "| --- | --: | --: | --: | --: | --: | --- |",
    ]
    for key in HEADLINES:
        study = records()["codesign"]["results"][key]
        row = study["rows"][0]
        judged = {judge["judge"]: judge for judge in study["meshes"]}
        finer = judged.get("finite elements, finer mesh")
        # No-break spaces keep numbers and units together.
        ends = [decimal(row[f"{who} [mm]"], 2) for who in ("baseline", "winner")]
        low, high = row.get("change with the mesh, 95% interval [mm]") or row["change, 95% interval [mm]"]
        checked = ""
        if finer is not None:
            checked = "\u00a0→\u00a0".join(decimal(finer[f"change{when} [mm]"], 2) for when in (" before", ""))
            checked += "\u00a0mm"
        cells = [
            f"{study['title']}; {row['controller'].partition(',')[0]}; {drives(key)}",
            f"{ends[0]}\u00a0mm",
            f"→\u00a0{ends[1]}\u00a0mm",
            f"{low:.1f}\u00a0to\u00a0{high:.1f}\u00a0mm",
            checked,
            efforts(key, judged["finite elements"]),
            f"`{study['command']}`",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def trust() -> str:
    """Shipped weights: errors, and what those that were calibrated by strata say about them, from their cards."""
    lines = [
        "| weights | goal tolerance | same displacements: mean, worst | same commands, inside: mean, worst "
        "| at corners | trusted inside, at corners [%] | worst trusted | covered inside, at corners [%] |",
        "| --- | --: | --: | --: | --: | --: | --: | --: |",
    ]

    def lengths(*values: float) -> str:
        return ", ".join(f"{1e3 * value:.2g}" for value in values)

    for name, (robot, options) in shipped_robots().items():
        body = make_robot(robot, **options)
        card = json.loads((pretrained_folder(body) / "model.json").read_text())
        whole = make_robot(card["calibration"]["within"]) if "within" in card.get("calibration", {}) else body
        cells = [f"`{name}`", f"{1e3 * whole.goal_tolerance:.3g}"]
        cells.append(lengths(card["test"]["effector_mean"], card["test"]["effector_worst"]))
        if strata := card.get("calibration", {}).get("strata"):
            ends = strata["inside"], strata["corners"]
            cells += [lengths(row["mean"], row["worst"]) for row in ends]
            cells.append(", ".join(f"{100 * row['trusted']:.0f}" for row in ends))
            cells.append(lengths(max(row["worst_trusted"] for row in strata.values())))
            cells.append(", ".join(f"{100 * row['coverage']:.0f}" for row in ends))
        else:
            cells += [""] * 5
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


TABLES: dict[str, Callable[[], str]] = {"headlines": headlines, "trust": trust}
"""Whole tables by the name of their marked place."""


def fill(text: str) -> str:
    """Return a Markdown page with every marked place rewritten from the records."""

    def replace(match: re.Match[str]) -> str:
        name, *rest = (part.strip() for part in match["key"].split("::"))
        if rest:
            content = figure(name, *rest)
        elif name in TABLES:
            content = f"\n\n{TABLES[name]()}\n\n"
        else:
            raise DataError(f"'{name}' is no table; allowed: {', '.join(TABLES)}")
        return f"{match[1]}{content}{match[4]}"

    return MARKER.sub(replace, text)


def main() -> None:
    """Rewrite the pages and name those that changed."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for path in pages():
        text = path.read_text()
        if (filled := fill(text)) != text:
            path.write_text(filled)
            sys.stdout.write(f"{path.relative_to(ROOT)}\n")


if __name__ == "__main__":
    main()
