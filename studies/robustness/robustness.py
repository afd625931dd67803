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
from softgym_envs.wording import decimal

if TYPE_CHECKING:
    from softgym_envs.agents.config import EnvironmentConfig

CONFIGS = Path(__file__).parent.parent / "configs" / "agents"
GOALS, SEED = 30, 7

PULL_STEP = 2.0
"""Largest step of a pull [mm]."""

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


def reachable() -> dict[str, object]:
    """Goals of the finger that any pull of its cables holds on FEM, with and without friction.

    Commands are fitted to each goal by least squares; cables are pulled from rest in proportion, without going back.
    """
    import gymnasium
    from scipy.optimize import least_squares

    import softgym_envs  # noqa: F401
    from softgym_envs.agents.evaluation import sample_goals
    from softgym_envs.agents.policy import Policy

    nominal = Policy(POLICIES["finger"]).environment.model_copy(update={"sample_design": False})
    goals = sample_goals(nominal, GOALS, SEED)
    result: dict[str, object] = {}
    for friction in (0.0, PLANTS["cable friction 0.85"]["cable_friction"]):
        env: Any = gymnasium.make(nominal.id, backend="fem", plant={"cable_friction": friction}).unwrapped
        env.reset(seed=SEED)
        backend, actuators = env.backend, env.robot.actuators
        bounds = 1e3 * np.array([[each.low for each in actuators], [each.high for each in actuators]])

        def missed(pull: np.ndarray, goal: np.ndarray, backend: Any = backend) -> np.ndarray:
            backend.reset()
            for share in np.linspace(0.0, 1.0, int(np.ceil(pull.max() / PULL_STEP)) + 1)[1:]:
                state = backend.step(1e-3 * share * pull)
            return 1e3 * (state.effector.ravel() - goal)

        fits = [
            least_squares(missed, bounds.mean(axis=0), bounds=bounds, diff_step=1e-3, xtol=1e-4, args=(goal.ravel(),))
            for goal in goals
        ]
        distances = np.linalg.norm([fit.fun for fit in fits], axis=1)
        label = f"friction {friction:g}"
        result[f"{label}: goals in reach [%]"] = 100.0 * float(np.mean(distances <= 1e3 * env.task.success_distance))
        result[f"{label}: mean closest distance [mm]"] = float(distances.mean())
        result[f"{label}: farthest goal [mm]"] = float(distances.max())
        result[f"{label}: largest pull [mm]"] = float(max(fit.x.max() for fit in fits))
        env.close()
    return result


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
                f"{name}, seed {seed}": train(
                    config.model_copy(update={"seed": seed}), Path(folder) / f"{file}_{seed}", progress=False
                )
                for seed in TRAINED_SEEDS
            }
            result |= _sensed(seeds, config.environment)
    return result


BENCHMARKS = {f"robustness_{robot}": _benchmark(robot) for robot in POLICIES} | {
    "robustness_reachable": reachable,
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
            row.append(f"{shares} %, {decimal(float(np.mean([float(value) for value in distance])), 2)} mm")
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
                + decimal(float(figure(group, f"{key}: mean distance [mm]")), 2)
                + " mm"
                for key in keys
            ]
            rows.append([plant, *cells])
    return rows


TABLES = {"robustness": robustness_table, "robustness_sensors": sensed_table}
"""Tables of pages by name."""
