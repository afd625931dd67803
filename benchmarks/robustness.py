"""Controllers that know the nominal model, on finite elements of plants that differ from it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.recorded import figure, records, results
from benchmarks.tables import markdown
from softgym_envs.config import load_config

if TYPE_CHECKING:
    from softgym_envs.agents.config import EnvironmentConfig

CONFIGS = Path(__file__).parent.parent / "configs" / "agents"
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


SENSED = {"inverse QP, open loop": "qp_model", "inverse QP with estimator": "qp_estimated"}
"""Controllers of SensorizedFingerReach, which hides the tip, that need no training."""

TRAINED = {
    "policy with memory": "sensorized_finger_reach_recurrent",
    "SAC": "sensorized_finger_reach_sac",
    "SAC, randomised": "sensorized_finger_reach_randomised",
}
"""Configurations of its policies, trained with noise on the learned model, the last on plants that differ from it."""

TRAINED_SEEDS = (0, 1, 2)


def _sensed(names: Mapping[str, str | Path], environment: EnvironmentConfig) -> dict[str, object]:
    """Evaluate agents by the name of their results, on every plant."""
    from softgym_envs.agents.evaluation import evaluate, sample_goals

    environment = environment.on("fem")
    goals = sample_goals(environment, GOALS, SEED)
    result: dict[str, object] = {}
    for plant, option in PLANTS.items():
        changed = environment.model_copy(update={"plant": option})
        for name, agent in names.items():
            found = evaluate(agent, changed, goals, seed=SEED)
            result[f"{name}, {plant}: goals reached [%]"] = 100.0 * float(np.mean(found.successes))
            result[f"{name}, {plant}: mean distance [mm]"] = 1e3 * found.mean_distance
    return result


def sensed() -> dict[str, object]:
    """Success of controllers that see sensors in place of the tip, on FEM, on plants unlike their model."""
    from softgym_envs.agents.config import EnvironmentConfig

    return _sensed(SENSED, EnvironmentConfig(id="SoftGym/SensorizedFingerReach-v0"))


def sensed_policies() -> dict[str, object]:
    """Success of policies that see sensors in place of the tip, trained here, on FEM, on plants unlike their model."""
    from softgym_envs.agents.config import TrainConfig
    from softgym_envs.agents.training import train

    result: dict[str, object] = {}
    with TemporaryDirectory() as folder:
        for name, file in TRAINED.items():
            config = load_config(CONFIGS / f"{file}.yaml", TrainConfig)
            seeds = {
                f"{name}, seed {seed}": train(config.model_copy(update={"seed": seed}), Path(folder) / f"{file}_{seed}")
                for seed in TRAINED_SEEDS
            }
            result |= _sensed(seeds, config.environment)
    return result


BENCHMARKS = {f"robustness_{robot}": _benchmark(robot) for robot in POLICIES} | {
    "robustness_sensors": sensed,
    "robustness_sensors_policies": sensed_policies,
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
    """Controllers that see sensors in place of the tip, on plants unlike their model; policies by their three seeds."""
    rows = _on_plants("robustness_sensors", SENSED)
    for row in rows:
        for name in TRAINED:
            reached, distance = (
                [
                    figure("robustness_sensors_policies", f"{name}, seed {seed}, {row[0]}: {what}")
                    for seed in TRAINED_SEEDS
                ]
                for what in ("goals reached [%]", "mean distance [mm]")
            )
            shares = ", ".join(f"{float(value):.0f}" for value in reached)
            row.append(f"{shares} %, {np.mean([float(value) for value in distance]):.2f} mm")
    names = [*SENSED, *TRAINED]
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
