"""Controllers that know the nominal model, on finite elements of plants that differ from it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

GOALS, SEED = 30, 7

PLANTS: dict[str, dict[str, Any]] = {
    "nominal": {},
    "20 % stiffer": {"stiffness": 1.2},
    "cable friction 0.85": {"cable_friction": 0.85},
    "50 ms delay": {"delay": 1},
    "1 % sensor noise": {"noise": 0.01},
    "all together": {"stiffness": 1.2, "cable_friction": 0.85, "delay": 1, "noise": 0.01},
}
"""Plants by name; a control step lasts 50 ms. Robots without cables leave out their friction."""

CONTROLLERS = ("inverse QP, open loop", "inverse QP with PI", "policy")

POLICIES = {
    "finger": "finger_reach",
    "diamond": "diamond_reach_designs",
    "trunk": "trunk_reach_designs_analytic",
}
"""Shipped policies, trained on the nominal surrogate without randomisation."""


def robustness(robot: str) -> dict[str, object]:
    """Goals that a controller reaches on FEM, on plants unlike its model: share, and mean final distance."""
    from softgym_envs.agents.evaluation import evaluate, sample_goals
    from softgym_envs.agents.policy import Policy

    policy = Policy(POLICIES[robot])
    nominal = policy.environment.model_copy(update={"sample_design": False})
    goals = sample_goals(nominal, GOALS, SEED)
    agents = dict(zip(CONTROLLERS, ("qp_model", "qp_pi", POLICIES[robot]), strict=True))
    pneumatic = robot == "trunk"
    result: dict[str, object] = {}
    for plant, given in PLANTS.items():
        option = {key: value for key, value in given.items() if not (pneumatic and key == "cable_friction")}
        if given and not option:
            continue
        environment = nominal.on("fem").model_copy(update={"plant": option})
        for name, agent in agents.items():
            found = evaluate(agent, environment, goals, seed=SEED)
            result[f"{name}, {plant}: goals reached [%]"] = 100.0 * float(np.mean(found.successes))
            result[f"{name}, {plant}: mean distance [mm]"] = 1e3 * found.mean_distance
    return result


def _benchmark(robot: str) -> Callable[[], dict[str, object]]:
    run = partial(robustness, robot)
    run.__doc__ = f"Success of controllers of the {robot} on FEM, on plants unlike their model."
    return run


BENCHMARKS = {f"robustness_{robot}": _benchmark(robot) for robot in POLICIES}
"""Benchmarks by name."""
