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
    accurate mesh take many seconds, so there the states of the calibration serve again: those of each body are judged
    by the calibration of all others. ``adversarial`` is a new search for trusted states with large errors, with the
    limit of trust as it is. Weights that have not been calibrated are left out.
    """
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.surrogate.calibration import attack, cross_validated, judged_states, report
    from softgym_envs.surrogate.pretrained import pretrained_model, shipped_robots

    result: dict[str, object] = {}
    for variant, (name, options) in shipped_robots().items():
        robot = make_robot(name, **options)
        model = pretrained_model(robot)
        if "calibration" not in model.card:
            continue
        sizes, start, kept = model.card["calibration"], time.process_time(), Path(folder) / variant
        expensive = "mesh" in robot.mechanics_key
        seed = sizes["seed"] if expensive else SEED
        kept_only = expensive and sizes.get("kept_only", False)
        states = judged_states(model, sizes["bodies"], sizes["states"], seed, kept, kept_only)
        attacked = attack(model, sizes["attacks"], sizes["states"], SEED, kept)
        rows = cross_validated(model, states) if expensive else report(model, states)
        rows["adversarial"] = report(model, attacked)["adversarial"]
        result[f"{variant}: goal tolerance [mm]"] = 1e3 * robot.goal_tolerance
        result[f"{variant}: trusted below an uncertainty of [mm]"] = 1e3 * model.domain.limit
        result[f"{variant}: bodies"] = "of the calibration, each left out of it" if expensive else "new ones"
        for stratum, row in rows.items():
            lengths = {k: 1e3 * getattr(row, k) for k in ("mean", "worst", "worst_trusted")}
            shares = {k: 100 * getattr(row, k) for k in ("coverage", "trusted")}
            result[f"{variant}: {stratum}"] = asdict(replace(row, **lengths, **shares))
        result[f"{variant}: CPU [min]"] = (time.process_time() - start) / 60
    return result
