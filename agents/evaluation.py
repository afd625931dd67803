"""Evaluation of agents on given goals, the same way on every backend."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from agents.config import EnvironmentConfig
from agents.policy import Policy
from softgym_envs.errors import ConvergenceError

__all__ = ["AGENTS", "Evaluation", "evaluate", "make_agent", "sample_goals"]

Agent = Callable[[np.ndarray, Any], np.ndarray]
"""``agent(observation, env.unwrapped) -> action``."""

AGENTS = ("qp", "qp_static", "random")
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


def make_agent(agent: str | Path, seed: int = 0) -> Agent:
    """Return ``agent(observation, env.unwrapped) -> action``.

    Args:
        agent: ``"random"``; ``"qp"``, the inverse QP on the condensed model of the present state, which in dynamics is
            that of the next time step; ``"qp_static"``, the inverse QP on the static equilibrium under the present
            command, which knows no momentum; or a policy file.
        seed: of the random agent.
    """
    if agent == "random":
        rng = np.random.default_rng(seed)
        return lambda observation, env: rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
    if agent in ("qp", "qp_static"):
        from softgym_envs.control import InverseQP

        controllers: WeakKeyDictionary[Any, InverseQP] = WeakKeyDictionary()

        def control(observation: np.ndarray, env: Any) -> np.ndarray:
            state = env.state
            model, slack = state.condensed, state.slack
            if agent == "qp_static" and env.backend.moving:
                try:
                    still = env.backend.probe(state.command)
                except ConvergenceError:  # no equilibrium there: wait for the next
                    return env.interface.action(state.command, state.command)
                model, slack = still.condensed, still.slack
            if env not in controllers or not state.command.any():  # a fresh one for each episode
                body = env.robot
                unilateral = np.array([actuator.unilateral for actuator in body.actuators])
                weights = np.resize(env.task.axes, 3 * len(body.effectors))
                # Only the first effector has a goal.
                weights[3:] = 0.0
                controllers[env] = InverseQP(
                    body.lower,
                    body.upper,
                    body.rates,
                    unilateral,
                    goal_weights=None if weights.all() else weights,
                )
            try:
                command = controllers[env].solve(model, env.goal, state.command, slack)
            except ConvergenceError:  # a QP that fails holds still
                command = state.command
            return env.interface.action(command, state.command)

        return control
    policy = Policy(agent)
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
        agent: ``"qp"``, ``"random"`` or the path of a policy.
        environment: where; its ``backend`` decides the physics.
        goals: goals or paths of goals [m], shape (n, 3) or (n, p, 3).
        design: the body, or one for each goal (default: the environment's).
        seed: seed of the random agent and of the environment.
    """
    goals = np.asarray(goals, dtype=float)
    goals = goals[:, None, :] if goals.ndim == 2 else goals
    if agent not in AGENTS and environment.backend == "surrogate":
        return _evaluate_batch(Policy(agent), environment, goals, design, seed)
    env = environment.make(sample_design=False)
    act = make_agent(agent, seed)
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
    try:
        observation, _ = env.reset(seed=seed, options={"design": design, "goal": goals})
        returns, efforts, distances = np.zeros(count), np.zeros(count), np.zeros(count)
        length = 0
        while True:
            observation, reward, _, truncated, info = env.step(policy(observation))
            length += 1
            final = info.get("final_info", info)
            returns += reward
            efforts += np.abs(final["effort"]).mean(axis=1)
            distances += final["distance"]
            if truncated.all():
                return Evaluation(
                    final["distance"].copy(),
                    distances / length,
                    returns,
                    final["is_success"].copy(),
                    efforts / length,
                    count * length,
                )
    finally:
        env.close()
