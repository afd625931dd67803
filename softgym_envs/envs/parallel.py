"""Environments in processes of their own, and the choice of a batched environment."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar
from weakref import WeakSet

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, VectorEnv
from gymnasium.vector.async_vector_env import AsyncState
from gymnasium.wrappers import TimeLimit

from softgym_envs.envs.env import SoftRobotEnv
from softgym_envs.envs.options import (
    EnvironmentOptions,
    check_autoreset,
    check_counts,
    check_design_option,
    check_seeds,
    set_up,
    take_reset_mask,
)

if TYPE_CHECKING:
    from softgym_envs.envs.registration import RobotSource, TaskSource


def make_batch(
    robot: RobotSource | None = None,
    task: TaskSource = "reach",
    num_envs: int = 1,
    *,
    backend: str | None = None,
    **options: Any,
) -> VectorEnv:
    """Return many environments at once: `SoftRobotVectorEnv` where it can step them, else `ParallelVectorEnv`.

    Args:
        robot: as for `SoftRobotEnv`.
        task: as for `SoftRobotEnv`.
        num_envs: number of sub-environments.
        backend: as for `SoftRobotEnv`.
        **options: those of the environment.
    """
    own = {name: value for name, value in options.items() if name in EnvironmentOptions.__dataclass_fields__}
    setup = set_up(robot, task, backend, EnvironmentOptions.check(own))
    if setup.batched:
        from softgym_envs.envs.vector_env import SoftRobotVectorEnv

        return SoftRobotVectorEnv(robot, task, num_envs, backend=backend, **options)
    return ParallelVectorEnv(robot, task, num_envs, backend=backend, **options)


class ParallelVectorEnv(AsyncVectorEnv):
    """``num_envs`` copies of a `SoftRobotEnv`, each in a process of its own that computes with one thread.

    The environment is made once; where the operating system can fork, the processes share its meshes, its body and the
    compiled code. An error in a process is raised here with its own type and message, and closes the environment. The
    processes end with this one, whatever ends it.

    Args:
        robot: as for `SoftRobotEnv`.
        task: as for `SoftRobotEnv`.
        num_envs: number of sub-environments.
        max_episode_steps: time limit; default none.
        autoreset_mode: as for `SoftRobotVectorEnv`.
        wrap: returns an environment with wrappers, which each process then steps; default none.
        **options: those of `SoftRobotEnv`.

    Raises:
        ValueError: for a wrong option.
        DesignError: for a malformed design.
    """

    _open: ClassVar[WeakSet[ParallelVectorEnv]] = WeakSet()
    _closed_seconds: ClassVar[float] = 0.0

    def __init__(
        self,
        robot: RobotSource | None = None,
        task: TaskSource = "reach",
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        wrap: Callable[[gymnasium.Env], gymnasium.Env] | None = None,
        **options: Any,
    ) -> None:
        check_counts(num_envs, max_episode_steps)
        mode = check_autoreset(autoreset_mode)
        env = SoftRobotEnv(robot, task, **options)
        self.robot, self.task, self.spaces, self.design_space = env.robot, env.task, env.spaces, env.design_space
        limited: gymnasium.Env = env if max_episode_steps is None else TimeLimit(env, max_episode_steps)
        limited = limited if wrap is None else wrap(limited)
        super().__init__(
            [_Worker(limited, index) for index in range(num_envs)],
            context="fork" if "fork" in multiprocessing.get_all_start_methods() else None,
            autoreset_mode=mode,
        )
        self._open.add(self)

    @classmethod
    def seconds_of_all(cls) -> float:
        """Return the CPU time [s] of the processes of all environments of this process, open and closed."""
        return cls._closed_seconds + sum(env._seconds() for env in list(cls._open))

    def _seconds(self) -> float:
        """Return the CPU time of the processes so far [s]; 0 while one owes an answer, as after Ctrl-C."""
        return sum(self.call("process_seconds")) if self._state is AsyncState.DEFAULT else 0.0

    def close_extras(self, timeout: int | float | None = None, terminate: bool = False) -> None:
        """Close the processes. The time of those that are terminated is not known."""
        if not terminate:
            ParallelVectorEnv._closed_seconds += self._seconds()
        self._open.discard(self)
        super().close_extras(timeout, terminate)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in every sub-environment; arguments as for `SoftRobotVectorEnv.reset`.

        Sub-environments draw their own random numbers: those of row i follow from ``seed + i``.

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if a body cannot exist.
            ValueError: for an unknown option, a malformed seed or goal, or another number of seeds, bodies or goals.
        """
        given = dict(options or {})
        check_design_option(given.get("design"), self.num_envs)
        for name in _options_by_row(given):
            if len(given[name]) != self.num_envs:
                raise ValueError(f"{name} must be one for all or {self.num_envs}, got {len(given[name])}")
        if "reset_mask" in given:
            rows, _ = take_reset_mask(given, self.num_envs)
            given["reset_mask"] = np.isin(np.arange(self.num_envs), rows)
        return super().reset(seed=check_seeds(seed, self.num_envs), options=given)

    def _raise_if_errors(self, successes: Iterable[bool]) -> None:
        # In place of Gymnasium's, which shows all tracebacks as warnings and leaves the other processes running.
        failed = [self.error_queue.get() for ok in successes if not ok]
        if failed:
            self._state = AsyncState.DEFAULT
            self.close(terminate=True)
            index, _, error, trace = failed[0]
            error.add_note(f"in the process of sub-environment {index}:\n{trace}")
            raise error


def cpu_seconds() -> float:
    """Return the CPU time [s] of this process so far, with that of its environments in processes of their own."""
    return time.process_time() + ParallelVectorEnv.seconds_of_all()


def _options_by_row(options: Mapping[str, Any]) -> list[str]:
    """Return the names of options of `reset` that hold a value for each sub-environment."""
    design, goal = options.get("design"), options.get("goal")
    lists = {
        "design": design is not None and not isinstance(design, Mapping),
        "goal": goal is not None and np.ndim(goal) == 3,
    }
    return [name for name, given in lists.items() if given]


class _OwnOptions(gymnasium.Wrapper):
    """Takes the body and the goals of one sub-environment from the options of all, and knows its process's time."""

    def __init__(self, env: gymnasium.Env, index: int) -> None:
        super().__init__(env)
        self._index = index

    def process_seconds(self) -> float:
        """Return the CPU time of this process so far [s]."""
        return time.process_time()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        own = dict(options or {})
        for name in _options_by_row(own):
            own[name] = own[name][self._index]
        return self.env.reset(seed=seed, options=own)


class _Worker:
    """Returns one sub-environment: a forked process uses the environment of its parent, another one its pickle."""

    def __init__(self, env: gymnasium.Env, index: int) -> None:
        self._env, self._index, self._parent = env, index, os.getpid()

    def __call__(self) -> gymnasium.Env:
        if os.getpid() != self._parent:
            from threadpoolctl import threadpool_limits

            threadpool_limits(1)
            # Ctrl-C reaches every process of a terminal, but only the parent decides what ends.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        return _OwnOptions(self._env, self._index)
