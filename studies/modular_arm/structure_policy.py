"""A shared policy for all structures of the modular arm: unseen structures, finite elements, and its order of bodies.

    softgym codesign --config configs/codesign/modular_reach_policy.yaml --folder F

Then ``python -m benchmarks.structure_policy F`` compares the shipped policy with the inverse QP on structures that were
not in its training, on superelements and for some on quadratic finite elements of the whole body, and compares the
order in which both put the bodies of the study. It writes ``benchmarks/data/structure_policy.json``.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import kendalltau

from benchmarks.tables import markdown
from softgym_envs.agents.evaluation import evaluate, evaluation_set
from softgym_envs.agents.policy import Policy
from softgym_envs.config import provenance
from softgym_envs.errors import DataError
from softgym_envs.storage import write_json
from softgym_envs.wording import decimal

KEPT = Path(__file__).parent / "data" / "structure_policy.json"
POLICY = "modular_reach_structures"
AGENTS = {"policy": POLICY, "inverse QP": "qp"}
UNSEEN, SOLID, SEED = 100, 3, 77
REACHABLE = 0.002
"""A goal counts as within reach of a body if the inverse QP ends this near [m]."""


def compare(folder: Path) -> dict[str, Any]:
    """Return final distances [mm] of both agents on unseen structures, and the values of a study by both."""
    from softgym_envs.codesign.snapshot import load_study

    environment = Policy(POLICY).environment
    designs, goals = evaluation_set(environment, UNSEEN, SEED)
    assert designs is not None
    found: dict[str, Any] = {"superelements": {}, "solid": {}}
    for name, agent in AGENTS.items():
        distances = evaluate(agent, environment, goals, design=designs).distances
        found["superelements"][name] = (1e3 * distances).tolist()
        print(name, np.mean(distances < REACHABLE), np.mean(distances), file=sys.stderr, flush=True)
    reached = np.array(found["superelements"]["inverse QP"]) < 1e3 * REACHABLE
    some = np.flatnonzero(reached)[:SOLID]
    solid = environment.model_copy(update={"robot_options": {**environment.robot_options, "body": "solid"}})
    outcome = evaluate(POLICY, solid, goals[some], design=[designs[k] for k in some])
    found["solid"] = {"bodies": some.tolist(), "policy": (1e3 * outcome.distances).tolist()}
    trials = [trial for trial in load_study(folder).trials if trial.values and trial.qp_value is not None]
    both = [(1e3 * trial.values["mean_distance"], 1e3 * trial.qp_value) for trial in trials]
    return {**found, "study: policy, inverse QP [mm]": both}


def table() -> str:
    """Goals reached and mean distances of the policy and of the inverse QP."""
    if not KEPT.is_file():
        raise DataError(f"'{KEPT}' does not exist; make it with 'python -m benchmarks.structure_policy FOLDER'")
    found = json.loads(KEPT.read_text())
    near = np.array(found["superelements"]["inverse QP"]) < 1e3 * REACHABLE
    rows = []
    for name in AGENTS:
        distances = np.array(found["superelements"][name])
        inside = distances[near]
        rows.append(
            [
                name,
                f"{100.0 * np.mean(distances < 1e3 * REACHABLE):.0f} %",
                f"{100.0 * np.mean(inside < 1e3 * REACHABLE):.0f} %",
                f"{decimal(float(np.mean(inside)), 2)} mm",
                f"{decimal(float(np.median(inside)), 2)} mm",
            ]
        )
    solid, some = np.array(found["solid"]["policy"]), found["solid"]["bodies"]
    apart = np.abs(solid - np.array(found["superelements"]["policy"])[some]).max()
    both = np.array(found["study: policy, inverse QP [mm]"])
    tau = kendalltau(*both.T)
    rows += [
        [f"policy, {len(solid)} bodies on solid finite elements", "", f"{int((solid < 1e3 * REACHABLE).sum())} of "
         f"{len(solid)}", f"{decimal(solid.mean(), 2)} mm", f"at most {decimal(apart, 2)} mm from superelements"],
        [f"order of {len(both)} bodies of a study: Kendall's tau", f"{tau.statistic:.2f}", "", "", ""],
    ]  # fmt: skip
    head = ["", f"all {len(near)} goals reached", f"of {int(near.sum())} within reach", "mean distance", "median"]
    return markdown(head, rows, "lrrrr")


TABLES = {"structure_policy": table}
"""Tables of pages by name."""

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of the finished study")
    write_json(KEPT, {**compare(parser.parse_args().folder), "provenance": provenance()})
