"""Evaluation of agents on given goals, the same way on every backend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.baselines import BASELINES, Agent, make_baseline
from agents.config import EnvironmentConfig
from agents.policy import Policy

__all__ = ["AGENTS", "Evaluation", "evaluate", "evaluation_set", "make_agent", "sample_goals"]

AGENTS = BASELINES
"""Names of agents that need no training."""


@dataclass(frozen=True)
class Evaluation:
    """Outcome of one episode per goal.

    Attributes:
        distances: effector to goal at the end of each episode [m], shape (n,).
        mean_distances: mean of that over the steps of each episode [m], shape (n,); the tracking error of a path.
        returns: sum of rewards, shape (n,).
        successes: ended within the task's success distance, shape (n,).
        efforts: mean actuator effort over the episode [N, ...], shape (n,).
        steps: environment steps spent.
    """

    distances: np.ndarray
    mean_distances: np.ndarray
    returns: np.ndarray
    successes: np.ndarray
    efforts: np.ndarray
    steps: int

    @property
    def success_rate(self) -> float:
        """Share of goals reached."""
        return float(self.successes.mean())

    @property
    def mean_distance(self) -> float:
        """Mean final distance [m]."""
        return float(self.distances.mean())

    @property
    def worst_distance(self) -> float:
        """Largest final distance [m]."""
        return float(self.distances.max())

    @property
    def mean_return(self) -> float:
        """Mean sum of rewards."""
        return float(self.returns.mean())

    def to_json(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "success_rate": self.success_rate,
            "mean_distance": self.mean_distance,
            "worst_distance": self.worst_distance,
            "mean_return": self.mean_return,
            "mean_effort": float(self.efforts.mean()),
            "mean_tracking_distance": float(self.mean_distances.mean()),
            "steps": self.steps,
            "distances": self.distances.tolist(),
            "returns": self.returns.tolist(),
            "successes": self.successes.astype(bool).tolist(),
        }


def sample_goals(
    environment: EnvironmentConfig, count: int, seed: int, design: dict[str, float] | None = None
) -> np.ndarray:
    """Draw goals (count, p, 3) [m] as the task of an environment does, for a body (default: the environment's)."""
    env = environment.make()
    try:
        paths = []
        for i in range(count):
            env.reset(seed=seed if i == 0 else None, options={"design": design})
            paths.append(env.unwrapped.path.copy())  # type: ignore[attr-defined]
        return np.stack(paths)
    finally:
        env.close()


def evaluation_set(
    environment: EnvironmentConfig, count: int, seed: int
) -> tuple[list[dict[str, float]] | None, np.ndarray]:
    """Draw ``count`` bodies and goals [m] (count, p, 3) as an environment does; no bodies where it has but one."""
    if not environment.sample_design:
        return None, sample_goals(environment, count, seed)
    env = environment.make()
    designs, goals = [], []
    for i in range(count):
        env.reset(seed=seed if i == 0 else None)
        designs.append(env.unwrapped.design)  # type: ignore[attr-defined]
        goals.append(env.unwrapped.path.copy())  # type: ignore[attr-defined]
    env.close()
    return designs, np.stack(goals)


def make_agent(agent: str | Path, seed: int = 0) -> Agent:
    """Return ``agent(observation, env.unwrapped) -> action``.

    Args:
        agent: one of `AGENTS`, see `agents.baselines.make_baseline`, or a policy file or the name of a shipped one.
        seed: of the random agent.
    """
    if agent in AGENTS:
        return make_baseline(str(agent), seed)
    return _acting(Policy(agent))


def _acting(policy: Policy) -> Agent:
    return lambda observation, env: policy(observation)


def evaluate(
    agent: str | Path,
    environment: EnvironmentConfig,
    goals: np.ndarray,
    *,
    design: dict[str, float] | Sequence[dict[str, float]] | None = None,
    seed: int = 0,
) -> Evaluation:
    """Run one episode per goal.

    Args:
        agent: one of `AGENTS`, or the path of a policy.
        environment: where; its ``backend`` decides the physics. Its ``residual_scale`` counts for policies only.
        goals: goals or paths of goals [m], shape (n, 3) or (n, p, 3).
        design: the body, or one for each goal (default: the environment's).
        seed: seed of the random agent and of the environment.

    Raises:
        ConfigError: if the policy was trained for another environment, see `Policy.check_environment`.
        WeightsError: if the policy cannot be read.
    """
    goals = np.asarray(goals, dtype=float)
    goals = goals[:, None, :] if goals.ndim == 2 else goals
    if agent in AGENTS:
        act = make_baseline(str(agent), seed)
        environment = environment.model_copy(update={"residual_scale": 0.0})
    else:
        policy = Policy(agent)
        policy.check_environment(environment)
        if environment.backend == "surrogate":
            return _evaluate_batch(policy, environment, goals, design, seed)
        act = _acting(policy)
    env = environment.make(sample_design=False)
    rows = []
    steps = 0
    try:
        for index, path in enumerate(goals):
            body = design if design is None or isinstance(design, dict) else design[index]
            observation, info = env.reset(seed=seed, options={"design": body, "goal": path})
            total, effort, distance, count, ended = 0.0, 0.0, 0.0, 0, False
            while not ended:
                action = act(observation, env.unwrapped)
                observation, reward, terminated, truncated, info = env.step(action)
                total += float(reward)
                effort += float(np.abs(info["effort"]).mean())
                distance += info["distance"]
                count += 1
                ended = terminated or truncated
            steps += count
            rows.append(
                (info["distance"], distance / count, total, info["is_success"] and info["converged"], effort / count)
            )
    finally:
        env.close()
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Evaluation(columns[0], columns[1], columns[2], columns[3].astype(bool), columns[4], steps)


def _evaluate_batch(
    policy: Policy,
    environment: EnvironmentConfig,
    goals: np.ndarray,
    design: dict[str, float] | Sequence[dict[str, float]] | None,
    seed: int,
) -> Evaluation:
    """All episodes at once on the batched surrogate environment."""
    count = len(goals)
    env = environment.make_vec(count, sample_design=False)
    columns = {name: np.zeros(count) for name in ("distance", "mean", "return", "success", "effort", "length")}
    running = np.ones(count, dtype=bool)
    try:
        observation, _ = env.reset(seed=seed, options={"design": design, "goal": goals})
        while running.any():
            observation, reward, terminated, truncated, info = env.step(policy(observation))
            last = info.get("final_info", info)
            columns["distance"] = np.where(running, last["distance"], columns["distance"])
            columns["success"] = np.where(running, last["is_success"] & last["converged"], columns["success"])
            columns["mean"] += running * last["distance"]
            columns["return"] += running * reward
            columns["effort"] += running * np.abs(last["effort"]).mean(axis=1)
            columns["length"] += running
            running &= ~(terminated | truncated)
    finally:
        env.close()
    length = columns["length"]
    return Evaluation(
        columns["distance"],
        columns["mean"] / length,
        columns["return"],
        columns["success"].astype(bool),
        columns["effort"] / length,
        int(length.sum()),
    )
