"""What surrogates say about their own errors: coverage in every stratum, and a search for the worst trusted states."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from softgym_envs.robots.registry import make_robot
from softgym_envs.surrogate.calibration import attack, calibration_states, cross_validated, judged_states, report
from softgym_envs.surrogate.pretrained import pretrained_folder, pretrained_model, shipped_robots

#: The calibration uses seed 11.
SEED = 12

BODIES, ATTACKS = 16, 2000
"""Most bodies of a stratum, and states of the search. Rows recorded earlier have up to 32 bodies."""


def trust(variant: str, folder: str | Path = "results/trust") -> dict[str, object]:
    """Errors, coverage and trust of weights by stratum, on FEM states that their calibration has not seen.

    As many states as the calibration used, but at most those of `BODIES` bodies, and `ATTACKS` of a new search for
    trusted states with large errors (``adversarial``), with the limit of trust as it is. States of an accurate mesh
    take many seconds, so there the states of the calibration serve again, if the folder has them: those of each body
    are judged by factors and a limit of trust from all others, and ``adversarial`` is the search of the calibration.

    Args:
        variant: name of shipped weights that have been calibrated.
        folder: where the states of the weights are kept, in a folder of that name.
    """
    name, options = shipped_robots()[variant]
    robot = make_robot(name, **options)
    model = pretrained_model(robot)
    sizes, start, kept = model.card["calibration"], time.process_time(), Path(folder) / variant
    if expensive := "mesh" in robot.mechanics_key:
        rows = cross_validated(model, calibration_states(model, kept))
    else:
        attacked = attack(model, ATTACKS, sizes["states"], SEED, kept)
        states = judged_states(model, min(sizes["bodies"], BODIES), sizes["states"], SEED, kept)
        rows = report(model, states) | {"adversarial": report(model, attacked)["adversarial"]}
    result: dict[str, object] = {
        "goal tolerance [mm]": 1e3 * robot.goal_tolerance,
        "trusted below an uncertainty of [mm]": 1e3 * model.domain.limit,
        "bodies": "of the calibration, each left out of it" if expensive else "new ones",
    }
    for stratum, row in rows.items():
        lengths = {k: 1e3 * getattr(row, k) for k in ("mean", "worst", "worst_trusted")}
        shares = {k: 100 * getattr(row, k) for k in ("coverage", "trusted")}
        result[stratum] = asdict(replace(row, **lengths, **shares))
    return {**result, "CPU [min]": (time.process_time() - start) / 60}


def calibrated() -> list[str]:
    """Names of the shipped weights that have been calibrated by strata."""
    names = []
    for variant, (name, options) in shipped_robots().items():
        card = json.loads((pretrained_folder(make_robot(name, **options)) / "model.json").read_text())
        if "calibration" in card:
            names.append(variant)
    return names


def _of(variant: str) -> Callable[[], dict[str, object]]:
    run = partial(trust, variant)
    run.__doc__ = f"Coverage and trust of the weights '{variant}' on states that their calibration has not seen."
    return run


BENCHMARKS = {f"trust_{variant}": _of(variant) for variant in calibrated()}
"""Benchmarks by name."""
