"""What surrogates say about their own errors: coverage in every stratum, and a search for the worst trusted states."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from pathlib import Path

#: The calibration uses seed 11.
SEED = 12


def trust(folder: str | Path = "results/trust") -> dict[str, object]:
    """Errors, coverage and trust under given commands by stratum, on FEM states that the calibration has not seen.

    ``adversarial`` is another search for trusted states with large errors, with the limit of trust as it is. As many
    states as the calibration of the weights used; those of a robot are kept in the folder. Weights that have not been
    calibrated are left out.
    """
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.surrogate.calibration import attack, judged_states, report
    from softgym_envs.surrogate.data.strata import JudgedStates
    from softgym_envs.surrogate.pretrained import pretrained_model, shipped_robots

    result: dict[str, object] = {}
    for variant, (name, options) in shipped_robots().items():
        robot = make_robot(name, **options)
        model = pretrained_model(robot)
        if "calibration" not in model.card:
            continue
        sizes, start = model.card["calibration"], time.process_time()
        states = judged_states(model, sizes["bodies"], sizes["states"], SEED, Path(folder) / variant)
        path = Path(folder) / variant / f"adversarial_{sizes['attacks']}_{SEED}.npz"
        if path.exists():
            attacked = JudgedStates.load(path)
        else:
            attacked = attack(model, sizes["attacks"], sizes["states"], SEED)
            attacked.save(path)
        result[f"{variant}: goal tolerance [mm]"] = 1e3 * robot.goal_tolerance
        result[f"{variant}: trusted below an uncertainty of [mm]"] = 1e3 * model.domain.limit
        for stratum, row in report(model, JudgedStates.join([states, attacked])).items():
            lengths = {k: 1e3 * getattr(row, k) for k in ("mean", "worst", "worst_trusted")}
            shares = {k: 100 * getattr(row, k) for k in ("coverage", "trusted")}
            result[f"{variant}: {stratum}"] = asdict(replace(row, **lengths, **shares))
        result[f"{variant}: CPU [min]"] = (time.process_time() - start) / 60
    return result
