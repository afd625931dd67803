"""Rollouts, shown state by state to what draws or writes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import gymnasium
import numpy as np

from softgym_envs.registry import Table

if TYPE_CHECKING:
    from softgym_envs.backends.backend import State
    from softgym_envs.envs.env import SoftRobotEnv

Agent = Callable[[np.ndarray, "SoftRobotEnv"], np.ndarray]
"""Maps an observation and the environment, unwrapped, to an action."""


@dataclass(frozen=True)
class Moment:
    """One state of a rollout.

    Attributes:
        step: control step.
        design: the body.
        state: its state; a state without nodes is drawn in the shape of a finite-element model.
        goal: the current goal [m], shape (3,).
        path: all goals of the episode [m], shape (p, 3).
        reward: reward of the step to this state; None after a reset.
        distance: distance to the goal as the task measures it [m]; default: Euclidean.
    """

    step: int
    design: Mapping[str, float]
    state: State
    goal: np.ndarray
    path: np.ndarray | None = None
    reward: float | None = None
    distance: float | None = None


@dataclass(frozen=True)
class EpisodeWriter:
    """An option of ``softgym rollout`` that writes the episode to a file or folder.

    Attributes:
        place: ``"module:class"`` of a `Watcher` and context manager that takes the `SoftRobotEnv` and the path.
        help: of the option.
        suffixes: with which files end; none for a folder.
        hint: what to do with what was written at ``{path}``.
        draws: whether it takes pictures: the environment is made with ``render_mode="rgb_array"``.
    """

    place: str
    help: str
    suffixes: tuple[str, ...] = ()
    hint: str = ""
    draws: bool = False


WRITERS = Table("writer of episodes", {}, group="softgym_envs.writers")
"""`EpisodeWriter` of installed packages, by the name of the option."""


class Watcher(Protocol):
    """Takes the states of a rollout, one after the other."""

    def log(self, moment: Moment, /) -> None:
        """Draw or write one state."""


def watch_rollout(
    env: gymnasium.Env,
    agent: Agent,
    watchers: Sequence[Watcher],
    *,
    seed: int | None = 0,
    options: Mapping[str, Any] | None = None,
    steps: int | None = None,
) -> dict[str, Any]:
    """Run one episode, show each of its states to all watchers and return its result.

    Args:
        env: a `SoftRobotEnv`, wrapped or not. It is reset first and not closed.
        agent: maps an observation and ``env.unwrapped`` to an action.
        watchers: what draws or writes the states.
        seed: seed of the reset.
        options: options of the reset.
        steps: largest number of steps; default: the time limit of the environment.

    Returns:
        ``return`` (sum of rewards), ``final_distance`` (as `Task.distance` returns it: [m] for positions), ``success``
        at the last step, ``steps``, and ``distrust_codes``, the ``info["distrust"]`` of each state.

    Raises:
        ValueError: if the environment has no time limit while ``steps`` is None.
    """
    steps = env.spec.max_episode_steps if steps is None and env.spec is not None else steps
    if steps is None:
        raise ValueError("the environment has no time limit; pass the largest number of steps as 'steps'")
    body: SoftRobotEnv = env.unwrapped  # type: ignore[assignment]
    observation, info = env.reset(seed=seed, options=None if options is None else dict(options))

    def log(step: int, reward: float | None) -> None:
        path, goal = body.task.drawn_goals(body.state, body.path, body.goal)
        moment = Moment(step, body.design, body.state, goal, path, reward, float(info["distance"]))
        for watcher in watchers:
            watcher.log(moment)

    log(0, None)
    total, step, over, distrust_codes = 0.0, 0, False, [int(info["distrust"])]
    while step < steps and not over:
        observation, reward, terminated, truncated, info = env.step(agent(observation, body))
        step, total, over = step + 1, total + float(reward), terminated or truncated
        distrust_codes.append(int(info["distrust"]))
        log(step, float(reward))
    return {
        "return": total,
        "final_distance": float(info["distance"]),
        "success": bool(info["is_success"]),
        "steps": step,
        "distrust_codes": distrust_codes,
    }
