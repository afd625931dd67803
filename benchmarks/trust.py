"""What surrogates say about their own errors: coverage in every stratum, and a search for the worst trusted states."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from pathlib import Path

#: The calibration uses seed 11.
SEED = 12


def trust(folder: str | Path = "results/trust") -> dict[str, object]:
    """Errors, coverage and trust under given commands by stratum, on FEM states that the calibration has not seen.

    As many states as the calibration of the weights used; those of a robot are kept in the folder. States of an
    accurate mesh take many seconds, so there the states of the calibration serve again, if the folder has them: those
    of each body are judged by factors and a limit of trust from all others. ``adversarial`` is a search for trusted
    states with large errors; a new one, with the limit of trust as it is, for the others. Weights that have not been
    calibrated are left out.
    """
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.surrogate.calibration import (
        attack,
        calibration_states,
        cross_validated,
        judged_states,
        report,
    )
    from softgym_envs.surrogate.pretrained import pretrained_model, shipped_robots

    result: dict[str, object] = {}
    for variant, (name, options) in shipped_robots().items():
        robot = make_robot(name, **options)
        model = pretrained_model(robot)
        if "calibration" not in model.card:
            continue
        sizes, start, kept = model.card["calibration"], time.process_time(), Path(folder) / variant
        if expensive := "mesh" in robot.mechanics_key:
            rows = cross_validated(model, calibration_states(model, kept))
        else:
            states = judged_states(model, sizes["bodies"], sizes["states"], SEED, kept)
            attacked = attack(model, sizes["attacks"], sizes["states"], SEED, kept)
            rows = report(model, states) | {"adversarial": report(model, attacked)["adversarial"]}
        result[f"{variant}: goal tolerance [mm]"] = 1e3 * robot.goal_tolerance
        result[f"{variant}: trusted below an uncertainty of [mm]"] = 1e3 * model.domain.limit
        result[f"{variant}: bodies"] = "of the calibration, each left out of it" if expensive else "new ones"
        for stratum, row in rows.items():
            lengths = {k: 1e3 * getattr(row, k) for k in ("mean", "worst", "worst_trusted")}
            shares = {k: 100 * getattr(row, k) for k in ("coverage", "trusted")}
            result[f"{variant}: {stratum}"] = asdict(replace(row, **lengths, **shares))
        result[f"{variant}: CPU [min]"] = (time.process_time() - start) / 60
    return result
