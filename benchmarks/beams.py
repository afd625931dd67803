"""Compiled solvers of bodies of beams: speed in CPU time, and the same results as those of the general ones."""

from __future__ import annotations

import statistics
import time
from typing import Any

import gymnasium
import numpy as np

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.extensions.beams.fem_batch import FEMBatch

CASES = {"Tetrapod": "SoftGym/TetrapodReach-v0", "Stiff-Flop": "SoftGym/TrunkReach-v0"}
STEPS, BLOCKS = 20, 6
"""Environment steps of a timed block, and how many blocks each solver has; blocks of both take turns."""
PERIOD, ROWS = 10, 16
"""Control steps of a period of a gait, and bodies of a batch that walks."""


def environment(identifier: str, *, compiled: bool, design: dict[str, float] | None = None) -> Any:
    """Return an environment on FEM, on its compiled solver or on the general one alone."""
    env: Any = gymnasium.make(identifier, backend="fem", disable_env_checker=True, max_episode_steps=10**6).unwrapped
    env.reset(seed=0, options={"design": design} if design else None)
    if not compiled:
        use_general_solver(env.backend)
        env.reset(seed=0)
    return env


def use_general_solver(backend: Any) -> None:
    """Switch compiled solvers off for the present body."""
    for solver in (backend._statics, backend._dynamics):
        if solver is not None:
            solver._compiled = False


def beams() -> dict[str, object]:
    """Environment steps per CPU second, W included, and the largest differences between both solvers."""
    result: dict[str, object] = {}
    for name, identifier in CASES.items():
        fast, general = environment(identifier, compiled=True), environment(identifier, compiled=False)
        rng = np.random.default_rng(0)
        actions = rng.uniform(-1.0, 1.0, (BLOCKS, STEPS, *fast.action_space.shape)).astype(np.float32)
        for env in (fast, general):
            env.step(actions[0, 0])  # the first call compiles
        speeds: dict[str, list[float]] = {"compiled": [], "general": []}
        apart, off = 0.0, 0.0
        for block in actions:
            for label, env in (("compiled", fast), ("general", general)):
                start = time.process_time()
                for action in block:
                    env.step(action)
                speeds[label].append(STEPS / (time.process_time() - start))
            states = fast.state, general.state
            apart = max(apart, float(np.abs(states[0].effector - states[1].effector).max()))
            W = [state.condensed.compliance for state in states]
            scale = np.sqrt(np.diag(W[1]))
            off = max(off, float(np.abs((W[0] - W[1]) / np.outer(scale, scale)).max()))
        speeds["compiled, 32 at once"] = batch_speeds(identifier)
        for label, values in speeds.items():
            result[f"{name}: steps per CPU second, {label}"] = statistics.median(values)
        result[f"{name}: largest difference of the effector [m]"] = apart
        result[f"{name}: largest difference of W, scaled"] = off
        result[f"{name}: share of compiled steps over random bodies"] = compiled_share(identifier)
    return result


def batch_speeds(identifier: str, count: int = 32) -> list[float]:
    """Return environment steps per CPU second of a batch under the actions of the single environments, in blocks."""
    env = gymnasium.make_vec(identifier, count, backend="fem", max_episode_steps=10**6)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    speeds = []
    for block in range(BLOCKS + 1):
        actions = rng.uniform(-1.0, 1.0, (STEPS, *env.action_space.shape)).astype(np.float32)  # type: ignore[misc]
        start = time.process_time()
        for action in actions:
            env.step(action)
        if block:  # the first one compiles
            speeds.append(count * STEPS / (time.process_time() - start))
    return speeds


def compiled_share(identifier: str, bodies: int = 10, steps: int = 20) -> float:
    """Return the share of environment steps of random bodies in which the general solver is not needed."""
    env = environment(identifier, compiled=True)
    rng = np.random.default_rng(1)
    calls = 0
    for _ in range(bodies):
        env.reset(options={"design": env.design_space.sample(rng)})
        solver = env.backend._dynamics or env.backend._statics
        newton = solver._newton

        def counted(*arguments: Any, newton: Any = newton) -> int:
            nonlocal needed
            needed = True
            return newton(*arguments)

        solver._newton = counted
        for _ in range(steps):
            needed = False
            env.step(rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32))
            calls += needed
    return 1.0 - calls / (bodies * steps)


def walking() -> dict[str, object]:
    """Control steps per second of a quadruped that walks, W and contact included: one body, and many in two threads.

    They are five time steps each, of the reference gait from its second period on. Threads are told by pairs of blocks,
    with one thread and with two, which share what else the machine does.
    """
    robot = make_robot("quadruped")
    gait, body = robot.reference_gait(), robot.design_space.baseline.array
    single = FEMBackend(robot, dynamics=True)
    speeds: list[float] = []
    for block in range(BLOCKS + 1):
        start = time.process_time()
        for k in range(2 * PERIOD):
            single.step(gait[k % PERIOD])
        if block:  # the first one compiles
            speeds.append(2 * PERIOD / (time.process_time() - start))
    batches = {threads: FEMBatch(robot, np.tile(body, (ROWS, 1)), threads=threads, dynamics=True) for threads in (1, 2)}
    seconds: dict[int, list[tuple[float, float]]] = {1: [], 2: []}
    for block in range(BLOCKS + 1):
        for threads, batch in batches.items():
            started = time.process_time(), time.perf_counter()
            for k in range(PERIOD):
                batch.step(gait[(k + np.arange(ROWS)) % PERIOD])
            if block:
                seconds[threads].append((time.process_time() - started[0], time.perf_counter() - started[1]))
    one, two = np.array(seconds[1]), np.array(seconds[2])
    return {
        "one body: steps per CPU second": statistics.median(speeds),
        f"{ROWS} bodies: steps per CPU second": ROWS * PERIOD / float(np.median(one[:, 0])),
        "two threads: CPU seconds, times those of one": float(np.median(two[:, 0] / one[:, 0])),
        "two threads: times as fast as one by the clock": float(np.median(one[:, 1] / two[:, 1])),
    }
