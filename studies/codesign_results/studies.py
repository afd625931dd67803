"""Record what studies found: baseline and winner of each on the test goals, by finite elements.

    softgym codesign --config NAME --folder F
    python studies/codesign_results/studies.py F [F ...]

copies the comparison of each finished study into ``results.json`` beside this file, with its commit and command.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from softgym_envs.agents.learners import LEARNERS
from softgym_envs.codesign.config import StudyConfig
from softgym_envs.config import load_config
from softgym_envs.errors import DataError
from softgym_envs.storage import write_json
from softgym_envs.wording import decimal

RECORDED = Path(__file__).with_name("results.json")

TITLES = {
    "finger_reach": "Soft Finger",
    "diamond_reach": "Diamond",
    "trunk_reach": "Stiff-Flop trunk",
    "gripper_pinch": "Two-finger gripper",
    "cable_trunk_reach": "Cable trunk",
    "tetrapod_reach": "Tetrapod",
    "finger_press": "Press finger",
    "gripper_manipulate": "Three-finger hand",
    "tetrapod_carry": "Tetrapod with 1 kg",
    "tetrapod_carry_wide": "Tetrapod with 1 kg, servos that turn by 160°",
}
"""Studies of the tables in their order, and the readable names of their robots."""

COMMANDS = {
    "finger_reach": "make demo",
    "tetrapod_carry_wide": "softgym codesign --config tetrapod_carry_wide trials=11",
}
"""Commands that run a study, where it is not ``softgym codesign --config NAME``.

The one with ``trials=11`` was begun with the 16 trials of its configuration and ended early.
"""

JUDGES = {"fem": "finite elements", "refined": "finite elements, finer mesh", "surrogate": "surrogate"}
"""Names of the physics that judge finalists."""

SHOWN = {"m": (1e3, "mm"), "1/m": (1.0, "1/m"), "Pa": (1e-6, "MPa"), "1": (1.0, "")}
"""Scale and unit of a design variable in text, by its SI unit."""


def study(folder: Path) -> tuple[str, dict[str, Any]]:
    """Return the name of a study and its entry in the recorded results.

    Raises:
        DataError: if the folder has no finished study, its commit is not clean, or it was judged on no finite elements.
    """
    file = folder / "results.json"
    if not file.exists():
        raise DataError(f"{file}: no such file; a study writes it when it has finished")
    found = json.loads(file.read_text())
    commit = found["provenance"]["commit"]
    if not commit or commit.endswith("-dirty"):
        raise DataError(f"{file}: commit is {commit!r}; results are recorded from clean commits only")
    config = load_config(folder / "config.yaml", StudyConfig)
    seconds = found["cost"]["cpu_seconds"]
    lengths = config.objective == "mean_return"  # tables hold lengths
    measured, kind = ("mean_distance", "distance") if lengths else ("objective", "objective")
    rows = [
        {
            "controller": _controller(config, found, compared["agent"]),
            "baseline [mm]": 1e3 * compared["baseline"][measured],
            "winner [mm]": 1e3 * compared["winner"][measured],
            "change, 95% interval [mm]": _interval(compared, f"{kind}_change_interval"),
            "goals reached by the baseline [%]": 100.0 * compared["baseline"]["success_rate"],
            "goals reached by the winner [%]": 100.0 * compared["winner"]["success_rate"],
            "test goals": compared["goals"],
        }
        for compared in found["comparison"]
        if compared["backend"] == "fem"
    ]
    if not rows:
        raise DataError(f"{file}: neither baseline nor winner was tested by finite elements")
    mesh = next((row[f"{kind}_mesh"] for row in found["comparison"] if row.get(f"{kind}_mesh")), None)
    if mesh is not None and mesh["interval"] is not None:  # a single path has none
        rows[0]["change with the mesh, 95% interval [mm]"] = [1e3 * end for end in mesh["interval"]]
    rows[0]["CPU with FEM check [min]"] = sum(seconds.values()) / 60.0
    rows[0]["winner's body"] = _body(found)
    command = COMMANDS.get(found["name"], f"softgym codesign --config {found['name']}")
    title = TITLES.get(found["name"], found["title"])
    entry = {"title": title, "command": command, "commit": commit, "trials": found["trials"]["complete"], "rows": rows}
    if mesh is not None:
        entry["meshes"] = _meshes(found, mesh, (measured, kind), config.finalists.test == "episodes")
    return found["name"], entry


def _meshes(found: dict[str, Any], mesh: dict[str, Any], names: tuple[str, str], whole: bool) -> list[dict[str, Any]]:
    """What each physics says of baseline and winner with their own controller, a finer mesh included.

    Args:
        found: results of the study.
        mesh: what is left of the mesh's error in the change.
        names: of the value of a body in the tables, and of its change.
        whole: whether finite elements ran whole episodes, so that mean efforts of all physics mean the same.
    """
    (measured, kind), agent = names, found["comparison"][0]["agent"]
    unknowns = {test["backend"]: test.get("unknowns") for test in found["tests"] if "error" not in test}
    rows = []
    for compared in (row for row in found["comparison"] if row["agent"] == agent):
        row = {"judge": JUDGES[compared["backend"]], "goals": compared["goals"]}
        row["unknowns"] = unknowns.get(compared["backend"])
        for who in ("baseline", "winner"):
            row[f"{who} [mm]"] = 1e3 * compared[who][measured]
            if whole or compared["backend"] != "surrogate":
                row[f"{who}, mean effort [N]"] = compared[who]["mean_effort"]
        row["change [mm]"] = 1e3 * compared[f"{kind}_change"]
        if compared["backend"] == "refined":  # on the other mesh, at the same goals
            row["change before [mm]"] = 1e3 * mesh["before"]
        row["interval [mm]"] = _interval(compared, f"{kind}_change_interval")
        if (part := compared.get(f"{kind}_mesh")) and part["interval"]:
            row["with the mesh [mm]"] = [1e3 * end for end in part["interval"]]
        rows.append(row)
    return rows


def _controller(config: StudyConfig, found: dict[str, Any], agent: str) -> str:
    if agent == "qp":
        return "inverse QP"
    seeds = len({training["seed"] for training in found["trainings"]})
    trainings = f", {seeds} trainings" if seeds > 1 else ""
    return f"{LEARNERS[config.training.learner].title}, a policy for each body{trainings}"


def _interval(compared: dict[str, Any], name: str) -> list[float] | None:
    """Interval of a change [mm]; None for a single goal, which has none."""
    interval = compared[name]
    return [1e3 * end for end in interval] if interval and compared["goals"] > 1 else None


def _body(found: dict[str, Any]) -> str:
    """Dimensions of the winner; those at an end of their range are said to be."""
    if found["winner"] is None or found["winner"]["role"] == "baseline":
        return f"the baseline: none of {found['trials']['complete']} bodies is better"
    parts = []
    for variable in found["variables"]:
        if variable["optimised"]:
            scale, unit = SHOWN[variable["unit"]]
            ends = f"{scale * variable['baseline']:.4g} → {scale * variable['winner']:.4g} {unit}".strip()
            limit = f" ({variable['at_limit']} bound)" if variable["at_limit"] else ""
            parts.append(f"{variable['name'].replace('_', ' ')} {ends}{limit}")
    return ", ".join(parts)


def main(folders: Sequence[str]) -> None:
    """Copy the studies of some folders into the recorded results."""
    recorded = json.loads(RECORDED.read_text())
    kept = recorded["codesign"]["results"]
    for folder in folders:
        try:
            name, entry = study(Path(folder))
        except DataError as error:
            raise SystemExit(f"nothing recorded: {error}") from None
        kept[name] = entry
        print(
            f"{name}: {' -> '.join(decimal(entry['rows'][0][f'{who} [mm]'], 2) for who in ('baseline', 'winner'))} mm"
        )
    recorded["codesign"]["results"] = {name: kept[name] for name in (*TITLES, *kept) if name in kept}
    write_json(RECORDED, recorded)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", metavar="FOLDER", nargs="+", help="of a finished study")
    main(parser.parse_args().folders)
