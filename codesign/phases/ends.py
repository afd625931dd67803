"""Tests where episodes end, for meshes on which whole episodes would take too long.

In statics without friction the equilibrium under a command does not depend on how it was reached, except where there
are several. So an episode runs on the surrogate, and finite elements go on from the command at which it ends.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.evaluation import Evaluation, drive_strains, make_agent, self_force
from softgym_envs.agents.policy import Policy
from softgym_envs.backends.backend import drive_sizes
from softgym_envs.control.settling import nearest_next, settle
from softgym_envs.errors import ConfigError, ConvergenceError
from softgym_envs.mechanics.solvers.statics import Statics


@dataclass(frozen=True)
class FinalStates:
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
    if Policy(policy).remembers:
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
    names: Sequence[str] | None = None,
) -> FinalStates:
    """Return where an agent ends on finite elements: the inverse QP settled, a policy after its last steps.

    Args:
        agent: ``"qp"`` or a policy file.
        environment: the environment on finite elements.
        goals: positions [m], shape (k, 1, 3).
        design: complete body [SI].
        start: the same environment on the surrogate.
        last_steps: control steps of a policy on finite elements.
        names: of the goals, for messages; default their numbers.

    Raises:
        InfeasibleDesign: if the body cannot exist.
        ConvergenceError: with the name of the goal, if a command has no equilibrium.
    """
    began, cpu = time.perf_counter(), time.process_time()
    points = np.asarray(goals, dtype=float)[:, -1]
    commands = final_commands(agent, start, points, design)
    robot = environment.make_robot()
    order = nearest_next(commands / (robot.upper - robot.lower))
    names = names or [f"goal {k + 1} of {len(points)}" for k in range(len(points))]
    found = _PendingGoals(environment, points, commands, order, dict(design), names)
    ended, unknowns = _settle(found) if agent == "qp" else _follow(found, agent, last_steps)
    columns = {name: np.array([getattr(ended[k], name) for k in range(len(points))]) for name in _COLUMNS}
    motions = [each.motion for each in ended.values() if each.motion is not None]
    unknown = np.full(len(points), np.nan)
    evaluation = Evaluation(
        distances=columns["distance"],
        tracking_distances=unknown,
        returns=unknown,
        successes=columns["success"],
        efforts=columns["effort"],
        ends=columns["effector"],
        largest_efforts=columns["largest"],
        largest_strains=columns["strain"],
        self_forces=columns["self_force"],
        steps=sum(each.equilibria for each in ended.values()),
        seconds=time.perf_counter() - began,
        cpu_seconds=time.process_time() - cpu,
    )
    return FinalStates(evaluation, unknowns, max(motions, default=None))


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
        environment = environment.uncorrected
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


@dataclass(frozen=True)
class _PendingGoals:
    """Goals (k, 3) [m] on finite elements, the commands (k, n_a) to start from, and in which order to take them."""

    environment: EnvironmentConfig
    points: np.ndarray
    commands: np.ndarray
    order: list[int]
    design: dict[str, float]
    names: Sequence[str]

    def lost(self, goal: int, error: ConvergenceError) -> ConvergenceError:
        return ConvergenceError(f"{self.names[goal]}: {error}", fraction=error.fraction)


@dataclass(frozen=True)
class _End:
    """Where one episode ends; see `FinalStates` for units. Efforts are those of `Robot.effort_sizes`."""

    distance: float
    success: bool
    efforts: np.ndarray
    effector: np.ndarray
    strain: float
    self_force: float
    equilibria: int
    motion: float | None = None

    @property
    def effort(self) -> float:
        """Mean effort of the actuators."""
        return float(self.efforts.mean())

    @property
    def largest(self) -> float:
        """Largest effort of an actuator."""
        return float(self.efforts.max())


_COLUMNS = ("distance", "success", "effort", "largest", "effector", "strain", "self_force")


def _settle(asked: _PendingGoals) -> tuple[dict[int, _End], int]:
    """Return where the inverse QP ends by goal, and the number of unknowns."""
    robot = asked.environment.make_robot()
    success = asked.environment.make_task(robot).success_distance
    statics, ends = Statics(robot.build(asked.design)), {}
    rest = drive_sizes(statics.model)
    for k in asked.order:
        point, command = asked.points[k], asked.commands[k]
        try:
            try:  # on from the last goal
                found = settle(statics, robot, point, command)
            except ConvergenceError:  # again from rest
                statics = Statics(statics.model)
                found = settle(statics, robot, point, command)
        except ConvergenceError as error:
            raise asked.lost(k, error) from None
        sizes = robot.effort_sizes(found.effort)
        strain = float(drive_strains(found.displacement, rest))
        reached, where = found.distance < success, found.effector
        ends[k] = _End(found.distance, reached, sizes, where, strain, found.self_force, found.equilibria)
    return ends, statics.model.equations


def _follow(asked: _PendingGoals, agent: str | Path, last_steps: int) -> tuple[dict[int, _End], int]:
    """Return where a policy ends in closed loop by goal, and the number of unknowns."""
    act, env = make_agent(agent), asked.environment.make(sample_design=False)
    inner: Any = env.unwrapped
    ends, last = {}, None
    try:
        for k in asked.order:
            command = asked.commands[k]
            env.reset(seed=0, options={"design": asked.design, "goal": asked.points[k]})
            try:
                try:  # on from the last goal
                    inner.backend.resume(last or inner.backend.snapshot())
                    inner.backend.step(command)
                except ConvergenceError:  # again from rest
                    inner.backend.reset()
                    inner.backend.step(command)
                observation, info = inner.set_state(inner.get_state())  # observed anew
                for _ in range(last_steps):
                    before = info["effector"]
                    observation, _, _, _, info = env.step(act(observation, inner))
                    if not info["converged"]:
                        raise ConvergenceError("no equilibrium under the command of the policy")
            except ConvergenceError as error:
                raise asked.lost(k, error) from None
            last = inner.backend.snapshot()
            motion = float(np.linalg.norm(info["effector"] - before))
            distance, success = float(info["distance"]), bool(info["is_success"])
            sizes = inner.robot.effort_sizes(info["effort"])
            strain = float(drive_strains(info["displacement"], inner.backend.rest_sizes))
            pressing = self_force(inner.state)
            ends[k] = _End(distance, success, sizes, info["effector"], strain, pressing, 1 + last_steps, motion)
        return ends, inner.backend.model.equations
    finally:
        env.close()
