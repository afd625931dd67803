"""What baseline and winner do at one test goal, computed with finite elements."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.agents.evaluation import make_agent
from softgym_envs.backends.backend import State
from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.phases.ends import episode_commands
from softgym_envs.codesign.phases.finalists import finalist_environment, policy_file
from softgym_envs.codesign.records import Finalist
from softgym_envs.codesign.results import StudyResults
from softgym_envs.codesign.snapshot import StudySnapshot
from softgym_envs.envs.tasks.base import Task
from softgym_envs.executors import parallel_map
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.base import Robot
from softgym_envs.units import display

MOMENTS = 6
"""Most states of an episode that are computed by finite elements, if these test only where episodes end."""


@dataclass(frozen=True)
class Episode:
    """One episode of one body.

    Attributes:
        role: ``"baseline"`` or ``"winner"``.
        robot: its family of bodies.
        design: the body [SI].
        model: its mechanical model.
        task: what the robot does.
        path: the goals, shape (p, 3), in the unit of the task.
        states: mechanical states, that of the reset first.
        goals: goal of each state, in the unit of the task.
        distances: distance to the goal in each state, as the task measures it.
        rewards: reward of each step to a state; None after the reset, and if a study tests only ends.
    """

    role: str
    robot: Robot
    design: dict[str, float]
    model: MechanicalModel
    task: Task
    path: np.ndarray
    states: list[State]
    goals: list[np.ndarray]
    distances: list[float]
    rewards: list[float | None]

    @property
    def has_places(self) -> bool:
        """Whether goals are positions that a picture can show."""
        return self.task.distance_scale.goal_unit == "m"

    @property
    def goal_text(self) -> str:
        """The last goal, as people read it: ``"(0.0, 30.0, -80.0) mm"``."""
        unit, factor, _ = display(self.task.distance_scale.goal_unit)
        return f"({', '.join(f'{factor * value:.{1 if factor > 1.0 else 2}f}' for value in self.path[-1])}) {unit}"

    def distance_text(self, index: int) -> str:
        """Return the distance to the goal in a state, as people read it."""
        return self.task.distance_scale.text(self.distances[index])

    def drawn_goal(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Return path (p, 3) and goal (3,) for a picture of a state [m]; see `Task.drawn_goals`."""
        return self.task.drawn_goals(self.states[index], self.path, self.goals[index])

    def pick(self, count: int) -> list[int]:
        """Return indices of at most ``count`` states, evenly over the episode, its first and last included."""
        return list(dict.fromkeys(np.linspace(0, len(self.states) - 1, count).round().astype(int).tolist()))


def typical_goal(snapshot: StudySnapshot, results: StudyResults) -> int:
    """Return the index of the unseen goal with the median gain of those that the baseline misses, or else of all."""
    tests = {group.key: group.mean for group in snapshot.unseen_tests}
    if not results.comparison or results.baseline is None or results.winner is None:
        return 0
    row = results.comparison[0]
    before, after = (tests[body.trial, row.agent, row.backend] for body in (results.baseline, results.winner))
    missed = np.flatnonzero(before.successes < 0.5)
    goals = missed if len(missed) else np.arange(len(before.successes))
    gains = np.subtract(before.distances, after.distances)[goals]
    return int(goals[np.argsort(gains, kind="stable")[len(goals) // 2]])


def run_episodes(snapshot: StudySnapshot, results: StudyResults) -> list[Episode]:
    """Return the episodes of baseline and winner at `typical_goal`; none without a winner."""
    if results.winner is None:
        return []
    path = snapshot.folder.goals["unseen"][typical_goal(snapshot, results)]
    bodies = {
        body.trial: (role, body) for role, body in (("baseline", results.baseline), ("winner", results.winner)) if body
    }
    jobs = [(snapshot.config, role, body, policy_file(snapshot, body), path) for role, body in bodies.values()]
    found = {episode.role: episode for episode in parallel_map(_run, jobs, snapshot.config.workers)}
    return [found[role] for role, _ in bodies.values()]


def moments(commands: np.ndarray) -> list[int]:
    """Return indices of at most `MOMENTS` commands (k, n_a) after the first, evenly along their way, the last included.

    Most of an episode often stands still, so equal parts of the way show more than equal times.
    """
    lengths = np.linalg.norm(np.diff(commands, axis=0), axis=1).cumsum()
    if not len(lengths) or lengths[-1] == 0.0:
        return [len(commands) - 1]
    parts = lengths[-1] * np.arange(1, MOMENTS + 1) / MOMENTS
    found = np.searchsorted(lengths, parts * (1.0 - 1e-9)) + 1
    return list(dict.fromkeys([*found[:-1].tolist(), len(commands) - 1]))


def _run(config: StudyConfig, role: str, body: Finalist, policy: Path | None, path: np.ndarray) -> Episode:
    environment = finalist_environment(config, "fem", body.options)
    if policy is None:  # the QP alone, not on top of another one
        environment = environment.uncorrected
    controller = "qp" if policy is None else policy
    commands = None
    if config.finalists.test == "ends":
        start = finalist_environment(config, "surrogate", body.options)
        commands = episode_commands(controller, start, path, body.design)[0]
    agent, env = make_agent(controller), environment.make(sample_design=False)
    inner: Any = env.unwrapped

    def add(info: dict[str, Any], reward: float | None) -> None:
        episode.states.append(inner.state)
        episode.goals.append(inner.goal)
        episode.distances.append(float(info["distance"]))
        episode.rewards.append(reward)

    try:
        observation, info = env.reset(seed=0, options={"design": body.design, "goal": path})
        episode = Episode(
            role,
            inner.robot,
            dict(inner.design),
            inner.backend.model,
            inner.task,
            inner.path,
            [inner.state],
            [inner.goal],
            [float(info["distance"])],
            [None],
        )
        if commands is not None:  # a step takes seconds
            for index in moments(commands):
                inner.backend.step(commands[index])
                add(inner.set_state(inner.get_state())[1], None)
            return episode
        ended = False
        while not ended:
            observation, reward, terminated, truncated, info = env.step(agent(observation, inner))
            add(info, float(reward))
            ended = terminated or truncated
        return episode
    finally:
        env.close()
