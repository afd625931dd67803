"""Controllers that know the nominal model, on finite elements of plants that differ from it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np

from benchmarks.recorded import figure, records, results
from benchmarks.tables import markdown

GOALS, SENSED_GOALS, SEED = 30, 10, 7

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


SENSED = {
    "robustness_sensors": {
        "inverse QP, open loop": "qp_model",
        "inverse QP with estimator": "qp_estimated",
        "policy with memory": "sensorized_finger_reach_recurrent",
    },
    "robustness_sensors_sac": {
        "SAC": "sensorized_finger_reach_sac",
        "SAC, randomised": "sensorized_finger_reach_randomised",
    },
}
"""Controllers of SensorizedFingerReach, which hides the tip, by the benchmark that measures them; policies were trained
with noise, the last one on plants that differ from the model. SAC sees the last four readings."""


def _sensed(group: str) -> dict[str, object]:
    from softgym_envs.agents.config import EnvironmentConfig
    from softgym_envs.agents.evaluation import evaluate, sample_goals

    task_options = {"history": 4} if group == "robustness_sensors_sac" else {}
    nominal = EnvironmentConfig(id="SoftGym/SensorizedFingerReach-v0", backend="fem", task_options=task_options)
    goals = sample_goals(nominal, SENSED_GOALS, SEED)
    result: dict[str, object] = {}
    for plant, option in PLANTS.items():
        environment = nominal.model_copy(update={"plant": option})
        for name, agent in SENSED[group].items():
            found = evaluate(agent, environment, goals, seed=SEED)
            result[f"{name}, {plant}: goals reached [%]"] = 100.0 * float(np.mean(found.successes))
            result[f"{name}, {plant}: mean distance [mm]"] = 1e3 * found.mean_distance
    return result


def sensed() -> dict[str, object]:
    """Success of controllers that see sensors in place of the tip, on FEM, on plants unlike their model."""
    return _sensed("robustness_sensors")


def sensed_sac() -> dict[str, object]:
    """Success of SAC, which sees sensors in place of the tip, on FEM, on plants unlike its model."""
    return _sensed("robustness_sensors_sac")


BENCHMARKS = {f"robustness_{robot}": _benchmark(robot) for robot in POLICIES} | {
    "robustness_sensors": sensed,
    "robustness_sensors_sac": sensed_sac,
}
"""Benchmarks by name."""


def robustness_table() -> str:
    """Controllers on plants unlike their model, of every robot that was run: goals reached and mean final distance."""
    groups = (f"robustness_{robot}" for robot in POLICIES)
    rows = [
        [group.removeprefix("robustness_").capitalize(), *row]
        for group in groups
        if group in records()
        for row in _on_plants(group, CONTROLLERS)
    ]
    return markdown(["robot", "plant", *CONTROLLERS], rows, "llrrr")


def sensed_table() -> str:
    """Controllers that see sensors in place of the tip, on plants unlike their model."""
    groups = [_on_plants(group, controllers) for group, controllers in SENSED.items()]
    rows = [[parts[0][0], *(cell for part in parts for cell in part[1:])] for parts in zip(*groups, strict=True)]
    names = [name for controllers in SENSED.values() for name in controllers]
    return markdown(["plant", *names], rows, "l" + "r" * len(names))


def _on_plants(group: str, controllers: Iterable[str]) -> list[list[str]]:
    """Return plant, and for each controller goals reached and mean distance."""
    rows = []
    for plant in PLANTS:
        keys = [f"{name}, {plant}" for name in controllers]
        if f"{keys[0]}: goals reached [%]" in results(group):
            cells = [
                figure(group, f"{key}: goals reached [%]", ".0f")
                + " %, "
                + figure(group, f"{key}: mean distance [mm]", ".2f")
                + " mm"
                for key in keys
            ]
            rows.append([plant, *cells])
    return rows


TABLES = {"robustness": robustness_table, "robustness_sensors": sensed_table}
"""Tables of pages by name."""
