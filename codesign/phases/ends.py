"""Tests where episodes end, for meshes on which whole episodes would take too long.

In statics without friction the equilibrium under a command does not depend on how it was reached, except where there
are several. So an episode runs on the surrogate, and finite elements go on from the command at which it ends.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.evaluation import Evaluation, make_agent
from softgym_envs.agents.policy import Policy
from softgym_envs.control.settling import settle
from softgym_envs.errors import ConfigError, ConvergenceError
from softgym_envs.mechanics.solvers.statics import Statics


@dataclass(frozen=True)
class Ends:
    """Where the episodes of one body end.

    Attributes:
        evaluation: outcome for each goal. Distances, successes and ends mean what they mean in whole episodes; efforts
            are those at the end [N, ...], means over the steps and returns are NaN, and ``steps`` counts equilibria.
        unknowns: number of unknowns of the mesh.
        last_motion: how far the last step of a policy moved the effector, at the worst goal [m]; small if the policies
            have settled. None for the inverse QP, which takes no step that leads away from the goal.
    """

    evaluation: Evaluation
    unknowns: int
    last_motion: float | None


def check_policy(policy: str | Path) -> None:
    """Raise ConfigError for a policy whose actions depend on more than the present observation."""
    if Policy(policy).memory is not None:
        raise ConfigError(
            f"finalists.test = ends needs actions that follow from the last observation, but policy '{policy}' has a "
            "memory; allowed: episodes"
        )


def run_ends(
    agent: str | Path,
    environment: EnvironmentConfig,
    goals: np.ndarray,
    design: Mapping[str, float],
    *,
    start: EnvironmentConfig,
    last_steps: int,
) -> Ends:
    """Return where an agent ends on finite elements: the inverse QP settled, a policy after its last steps.

    Args:
        agent: ``"qp"`` or a policy file.
        environment: the environment on finite elements.
        goals: positions [m], shape (k, 1, 3).
        design: complete body [SI].
        start: the same environment on the surrogate.
        last_steps: control steps of a policy on finite elements.

    Raises:
        InfeasibleDesign: if the body cannot exist.
        ConvergenceError: with the number of the goal, if a command has no equilibrium.
    """
    began, cpu = time.perf_counter(), time.process_time()
    points = np.asarray(goals, dtype=float)[:, -1]
    commands = final_commands(agent, start, points, design)
    make = _settled if agent == "qp" else _followed
    columns, equilibria, unknowns, motion = make(agent, environment, points, design, commands, last_steps)
    unknown = np.full(len(points), np.nan)
    evaluation = Evaluation(
        distances=columns["distance"],
        mean_distances=unknown,
        returns=unknown,
        successes=columns["success"].astype(bool),
        efforts=columns["effort"],
        ends=columns["end"],
        steps=equilibria,
        seconds=time.perf_counter() - began,
        cpu_seconds=time.process_time() - cpu,
    )
    return Ends(evaluation, unknowns, motion)


def final_commands(
    agent: str | Path, start: EnvironmentConfig, points: np.ndarray, design: Mapping[str, float]
) -> np.ndarray:
    """Return the commands (k, n_a) at which episodes end for goals (k, 3) [m]."""
    return np.array([commands[-1] for commands in episode_commands(agent, start, points, design)])


def episode_commands(
    agent: str | Path, environment: EnvironmentConfig, points: np.ndarray, design: Mapping[str, float]
) -> list[np.ndarray]:
    """Return the commands of the states of one episode for each goal (k, 3) [m], each of shape (steps + 1, n_a)."""
    if agent == "qp":  # alone, not on top of another one
        environment = environment.model_copy(update={"residual_scale": 0.0})
    act, env = make_agent(agent), environment.make(sample_design=False)
    inner: Any = env.unwrapped
    found = []
    try:
        for point in points:
            observation, _ = env.reset(seed=0, options={"design": dict(design), "goal": point})
            commands, ended = [inner.command.copy()], False
            while not ended:
                observation, _, terminated, truncated, _ = env.step(act(observation, inner))
                commands.append(inner.command.copy())
                ended = terminated or truncated
            found.append(np.array(commands))
    finally:
        env.close()
    return found


_Found = tuple[dict[str, np.ndarray], int, int, float | None]
"""Columns of an evaluation by name, numbers of equilibria and of unknowns, last motion."""


def _settled(
    agent: str | Path,
    environment: EnvironmentConfig,
    points: np.ndarray,
    design: Mapping[str, float],
    commands: np.ndarray,
    last_steps: int,
) -> _Found:
    """Return where the inverse QP ends."""
    robot = environment.make_robot()
    success = environment.make_task(robot).success_distance
    statics, rows, equilibria = Statics(robot.build(design)), [], 0
    for k, (point, command) in enumerate(zip(points, commands, strict=True)):
        try:
            found = settle(statics, robot, point, command)
        except ConvergenceError as error:
            raise _lost(k, len(points), error) from None
        equilibria += found.equilibria
        effort = float(np.abs(found.effort).mean())
        rows.append((found.distance, found.distance < success, effort, found.effector))
    return _columns(rows), equilibria, statics.model.equations, None


def _followed(
    agent: str | Path,
    environment: EnvironmentConfig,
    points: np.ndarray,
    design: Mapping[str, float],
    commands: np.ndarray,
    last_steps: int,
) -> _Found:
    """Return where a policy ends in closed loop."""
    act, env = make_agent(agent), environment.make(sample_design=False)
    inner: Any = env.unwrapped
    rows, motion = [], 0.0
    try:
        for k, (point, command) in enumerate(zip(points, commands, strict=True)):
            env.reset(seed=0, options={"design": dict(design), "goal": point})
            try:
                inner.backend.step(command)
            except ConvergenceError as error:
                raise _lost(k, len(points), error) from None
            observation, info = inner.set_state(inner.get_state())  # observed anew
            for _ in range(last_steps):
                before = info["effector"]
                observation, _, _, _, info = env.step(act(observation, inner))
                if not info["converged"]:
                    raise _lost(k, len(points), ConvergenceError("no equilibrium under the command of the policy"))
            motion = max(motion, float(np.linalg.norm(info["effector"] - before)))
            effort = float(np.abs(info["effort"]).mean())
            rows.append((float(info["distance"]), bool(info["is_success"]), effort, info["effector"]))
        unknowns = inner.backend.model.equations
    finally:
        env.close()
    return _columns(rows), len(points) * (1 + last_steps), unknowns, motion


def _columns(rows: list[tuple[float, bool, float, np.ndarray]]) -> dict[str, np.ndarray]:
    names = ("distance", "success", "effort", "end")
    return {name: np.array(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)}


def _lost(goal: int, count: int, error: ConvergenceError) -> ConvergenceError:
    return ConvergenceError(f"goal {goal + 1} of {count}: {error}", fraction=error.fraction)
