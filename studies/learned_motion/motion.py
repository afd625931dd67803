"""Motion on the surrogate against finite elements: bodies and commands that no model has seen, one second in open loop.

Bodies are drawn from the whole design box, softness included, and commands change by up to five times the rate of the
environments, which excites what can swing. The learned energy with the learned inertia, which has seen no trajectory,
stands beside models that learn from 64 of them:

* an LSTM, as in chapter 5 of the thesis, which sees design and commands; and one that learns what a surrogate in
  equilibrium misses;
* a linear model in lifted coordinates (Bruder et al. 2021, doi 10.1109/TRO.2020.3038693): monomials of the last two
  positions, the command and the design.

``python -m benchmarks.motion`` computes and keeps the trajectories in ``results/motion``; a second call reads them.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.recorded import results
from benchmarks.tables import markdown
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.executors import parallel_map
from softgym_envs.robots.base import Robot
from softgym_envs.storage import atomic_write

FOLDER = Path("results/motion")
TRAINING, TEST, STEPS = 64, 12, 20
"""Trajectories, and control steps of 0.05 s in each."""
VIOLENCE = 5.0
"""Largest change of a command in a control step [rates of the environment]."""
ROBOTS = ("finger", "diamond")
EPOCHS = 1500
HELD_OUT = TRAINING // 8
"""Training trajectories that only choose the epoch of an LSTM and the ridge of the lifted model."""


@dataclass(frozen=True)
class Trajectories:
    """Trajectories of N bodies on finite elements, from rest.

    Attributes:
        design: shape (N, number of design variables).
        command: of each control step, shape (N, STEPS, n_a).
        effector: after each control step, and at rest before the first [m], shape (N, STEPS + 1, n_e).
        seconds: median CPU time of a control step in each, shape (N,).
    """

    design: np.ndarray
    command: np.ndarray
    effector: np.ndarray
    seconds: np.ndarray

    def rows(self, first: int, last: int) -> Trajectories:
        """Return some of the trajectories."""
        return Trajectories(*(value[first:last] for value in vars(self).values()))


def draw_commands(robot: Robot, rng: np.random.Generator) -> np.ndarray:
    """Return commands (STEPS, n_a): a random walk within the actuators' ranges."""
    commands, present = [], np.clip(np.zeros(len(robot.actuators)), robot.lower, robot.upper)
    for _ in range(STEPS):
        change = rng.uniform(-VIOLENCE, VIOLENCE, len(present)) * robot.rates
        present = np.clip(present + change, robot.lower, robot.upper)
        commands.append(present)
    return np.array(commands)


def run_fem(robot: Robot, seed: int, path: Path) -> Path:
    """Compute a trajectory on finite elements and keep it, unless it is there."""
    from softgym_envs.backends.fem import FEMBackend

    if path.is_file():
        return path
    rng = np.random.default_rng([7, seed])
    while True:
        try:
            backend = FEMBackend(robot, robot.design_space.sample(rng), dynamics=True)
            commands = draw_commands(robot, rng)
            places, seconds = [backend.state.effector.ravel()], []
            for command in commands:
                began = time.process_time()
                places.append(backend.step(command).effector.ravel())
                seconds.append(time.process_time() - began)
        except (InfeasibleDesign, ConvergenceError):
            continue
        design = backend.design.array
        with atomic_write(path) as stream:
            np.savez(stream, design=design, command=commands, effector=places, seconds=np.median(seconds))
        return path


def trajectories(robot: Robot, folder: Path, workers: int = 2) -> Trajectories:
    """Return all trajectories of a robot: those for training, then those for the test."""
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [(robot, seed, folder / f"{seed}.npz") for seed in range(TRAINING + TEST)]
    for done, _ in enumerate(parallel_map(run_fem, jobs, workers), start=1):
        print(f"\r{robot.name}: {done} of {len(jobs)} trajectories", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    parts = [np.load(path) for _, _, path in jobs]
    return Trajectories(*(np.stack([part[name] for part in parts]) for name in Trajectories.__dataclass_fields__))


def on_surrogate(robot: Robot, data: Trajectories, *, dynamics: bool) -> tuple[np.ndarray, float]:
    """Return the effectors (N, STEPS + 1, n_e) of the surrogate, and the median CPU time of a control step alone."""
    from softgym_envs.backends.surrogate import SurrogateBackend

    found, seconds = [], []
    backend = SurrogateBackend(robot, dynamics=dynamics)
    names = robot.design_space.names
    for design, commands in zip(data.design, data.command, strict=True):
        places = [backend.reset(dict(zip(names, design.tolist(), strict=True))).effector.ravel()]
        for command in commands:
            began = time.process_time()
            places.append(backend.step(command).effector.ravel())
            seconds.append(time.process_time() - began)
        found.append(places)
    return np.array(found), float(np.median(seconds))


def _inputs(robot: Robot, data: Trajectories) -> np.ndarray:
    """Return scaled design, present and last command of each step, shape (N, STEPS, inputs)."""
    design = robot.design_space
    unit = np.array([2.0 * design.to_unit(dict(zip(design.names, d, strict=True))) - 1.0 for d in data.design.tolist()])
    span = robot.upper - robot.lower
    command = data.command / span
    last = np.concatenate([np.zeros_like(command[:, :1]), command[:, :-1]], axis=1)
    return np.concatenate([np.repeat(unit[:, None], STEPS, axis=1), command, last], axis=2)


def lstm(
    robot: Robot, train: Trajectories, test: Trajectories, base: tuple[np.ndarray, np.ndarray] | None = None
) -> np.ndarray:
    """Return the effectors (N, STEPS + 1, n_e) of an LSTM with 64 units, after its epoch of smallest validation error.

    Args:
        robot: the robot.
        train: trajectories to learn from.
        test: trajectories to predict.
        base: effectors to which it learns what to add, of both; default those at rest, which it is told.
    """
    import torch

    torch.manual_seed(0)
    rest = [np.repeat(d.effector[:, :1], STEPS + 1, axis=1) for d in (train, test)]
    bases = rest if base is None else list(base)
    moved = [d.effector - r for d, r in zip((train, test), rest, strict=True)]
    scale = moved[0].std()
    inputs = [_inputs(robot, d) for d in (train, test)]
    if base is not None:
        seen = [(b - r)[:, 1:] / scale for b, r in zip(bases, rest, strict=True)]
        inputs = [np.concatenate(pair, axis=2) for pair in zip(inputs, seen, strict=True)]
    wanted = torch.tensor((train.effector - bases[0])[:, 1:] / scale, dtype=torch.float32)
    x, unseen = (torch.tensor(array, dtype=torch.float32) for array in inputs)
    recurrent, last = torch.nn.LSTM(x.shape[2], 64, batch_first=True), torch.nn.Linear(64, wanted.shape[2])
    optimiser = torch.optim.Adam([*recurrent.parameters(), *last.parameters()], lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, EPOCHS)
    best, added = np.inf, np.zeros(0)
    for _ in range(EPOCHS):
        optimiser.zero_grad()
        loss = ((last(recurrent(x[HELD_OUT:])[0]) - wanted[HELD_OUT:]) ** 2).mean()
        loss.backward()
        optimiser.step()
        schedule.step()
        with torch.no_grad():
            validation = float(((last(recurrent(x[:HELD_OUT])[0]) - wanted[:HELD_OUT]) ** 2).mean())
            if validation < best:
                best, added = validation, last(recurrent(unseen)[0]).numpy() * scale
    found = bases[1].copy()
    found[:, 1:] += added
    return found


def lifted(robot: Robot, train: Trajectories, test: Trajectories) -> np.ndarray:
    """Return the effectors (N, STEPS + 1, n_e) of the linear model in lifted coordinates.

    Its ridge is that with the smallest error of the trajectories that are left out.
    """
    from softgym_envs.surrogate.inertia import Polynomials

    states, inputs = 2 * train.effector.shape[2], _inputs(robot, train).shape[2]
    monomials = Polynomials(states + inputs, 2)

    def lift(data: Trajectories, now: np.ndarray, before: np.ndarray, step: int) -> np.ndarray:
        start = data.effector[:, 0]
        state = np.concatenate([(now - start) / robot.size, (before - start) / robot.size], axis=1)
        return monomials(np.concatenate([state, _inputs(robot, data)[:, step]], axis=1))

    def fit(data: Trajectories, ridge: float) -> np.ndarray:
        pairs = [(lift(data, data.effector[:, k], data.effector[:, max(k - 1, 0)], k), k) for k in range(STEPS)]
        moved = [data.effector[:, k + 1] - data.effector[:, k] for _, k in pairs]
        x, y = np.concatenate([x for x, _ in pairs]), np.concatenate(moved) / robot.size
        return np.linalg.solve(x.T @ x + ridge * np.eye(monomials.count), x.T @ y)

    def roll(model: np.ndarray, data: Trajectories) -> np.ndarray:
        places = [data.effector[:, 0]]
        for k in range(STEPS):
            step = lift(data, places[-1], places[max(k - 1, 0)], k) @ model * robot.size
            # A model that diverges is shown as far off, not as infinite.
            places.append(np.clip(places[-1] + step, -5.0 * robot.size, 5.0 * robot.size))
        return np.stack(places, axis=1)

    few, rest = train.rows(0, HELD_OUT), train.rows(HELD_OUT, TRAINING)
    ridges = 10.0 ** np.arange(-6.0, 4.0)
    best = min(ridges, key=lambda ridge: errors(few, roll(fit(rest, ridge), few)).mean())
    return roll(fit(train, best), test)


def errors(data: Trajectories, found: np.ndarray) -> np.ndarray:
    """Return the error of each trajectory: root mean square error over that of the motion about its mean, (N,)."""
    wanted, found = data.effector[:, 1:], found[:, 1:]
    about = wanted - wanted.mean(axis=1, keepdims=True)
    return np.sqrt(((found - wanted) ** 2).sum(axis=2).mean(axis=1) / (about**2).sum(axis=2).mean(axis=1))


def batched(name: str, count: int = 256, steps: int = 20) -> float:
    """Return environment steps per second of ``count`` different bodies in motion, in one process."""
    import gymnasium

    import softgym_envs  # noqa: F401  registers the environments

    envs = gymnasium.make_vec(
        f"SoftGym/{name.capitalize()}Reach-v0", count, backend_options={"dynamics": True}, sample_design=True
    )
    envs.reset(seed=0)
    envs.step(envs.action_space.sample())
    began = time.process_time()
    for _ in range(steps):
        envs.step(envs.action_space.sample())
    return count * steps / (time.process_time() - began)


def motion() -> dict[str, object]:
    """Errors of learned motion in open loop, of learned baselines, and CPU times."""
    from softgym_envs.robots.registry import make_robot

    result: dict[str, object] = {}
    for name in ROBOTS:
        robot = make_robot(name)
        data = trajectories(robot, FOLDER / name)
        train, test = data.rows(0, TRAINING), data.rows(TRAINING, TRAINING + TEST)
        learned, alone = on_surrogate(robot, test, dynamics=True)
        still = [on_surrogate(robot, part, dynamics=False)[0] for part in (train, test)]
        found = {
            "learned inertia": learned,
            "surrogate in equilibrium": still[1],
            "LSTM": lstm(robot, train, test),
            "LSTM on the surrogate": lstm(robot, train, test, (still[0], still[1])),
            "lifted linear model": lifted(robot, train, test),
        }
        for model, places in found.items():
            error = 100.0 * errors(test, places)
            result[f"{name}: {model}: error, mean [%]"] = float(error.mean())
            result[f"{name}: {model}: error, largest [%]"] = float(error.max())
        result[f"{name}: finite elements: control step [ms]"] = 1e3 * float(np.median(test.seconds))
        result[f"{name}: learned inertia: control step [ms]"] = 1e3 * alone
        result[f"{name}: learned inertia: batched [steps/s]"] = batched(name)
    return result


MODELS = ("learned inertia", "surrogate in equilibrium", "LSTM", "LSTM on the surrogate", "lifted linear model")


def motion_table() -> str:
    """Mean and largest error of each model for each robot."""
    found, columns = results("motion"), [(name, kind) for name in ROBOTS for kind in ("mean", "largest")]
    rows = [
        [model, *(f"{found[f'{name}: {model}: error, {kind} [%]']:.1f}" for name, kind in columns)] for model in MODELS
    ]
    return markdown(["error in open loop [%]", *(f"{name}, {kind}" for name, kind in columns)], rows, "lrrrr")


TABLES = {"motion": motion_table}
"""Tables of pages by name."""

if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    json.dump(motion(), sys.stdout, indent=2)
