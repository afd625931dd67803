"""Speed: medians on one thread."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

_BEAM = Path(__file__).resolve().parent.parent / "tests" / "data"


def median_seconds(work: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def _random_walk(env, steps: int, seed: int) -> Callable[[], None]:
    env.action_space.seed(seed)
    actions = [env.action_space.sample() for _ in range(steps)]

    def walk() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return walk


def fem_step() -> dict[str, object]:
    """FEM environment steps per second, random cable increments up to 1 mm about a half-pulled finger, W included."""
    import gymnasium

    import softgym_envs  # noqa: F401 - registers the IDs

    result: dict[str, object] = {}
    for cables in (1, 2):
        env = gymnasium.make("SoftGym/FingerReach-v0", backend="fem", robot_options={"cables": cables})
        env.reset(seed=0)
        repeats = []
        for repeat in range(5):
            env.reset(seed=repeat)
            for _ in range(12):
                env.step(np.ones(cables, dtype=np.float32))
            repeats.append(median_seconds(_random_walk(env, 30, repeat), 1) / 30)
        seconds = statistics.median(repeats)
        unwrapped: Any = env.unwrapped
        model = unwrapped.backend.model
        label = f"{cables} cable(s), {len(model.nodes)} nodes, {len(model.blocks[0].connectivity)} tetrahedra"
        result[f"{label}: steps per second"] = 1.0 / seconds
    return result


class _Shares:
    """Adds up the seconds spent in the parts of finite-element steps while it is entered as a context.

    The time of a nested part counts for the outer part.
    """

    def __init__(self) -> None:
        from softgym_envs.mechanics.assembly import Assembly
        from softgym_envs.mechanics.solvers.linear import CholmodSolver, SuperLUSolver
        from softgym_envs.mechanics.warping import Warping

        solvers = (CholmodSolver, SuperLUSolver)
        self.parts: list[tuple[Any, str, str]] = [
            (Assembly, "evaluate", "assembly"),
            (Warping, "displacement", "warping"),
            *((solver, "factorise", "factorisation") for solver in solvers),
            *((solver, verb, "solves") for solver in solvers for verb in ("solve", "condense", "expand")),
        ]
        self.seconds = dict.fromkeys(("assembly", "factorisation", "solves", "warping"), 0.0)
        self.counting = True
        self._inside = False

    def _timed(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            if self._inside or not self.counting:
                return function(*arguments, **options)
            self._inside = True
            start = time.perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                self.seconds[part] += time.perf_counter() - start
                self._inside = False

        return call

    def __enter__(self) -> _Shares:
        self._kept = [(owner, name, getattr(owner, name)) for owner, name, _ in self.parts]
        for (owner, name, part), (_, _, function) in zip(self.parts, self._kept, strict=True):
            setattr(owner, name, self._timed(function, part))
        return self

    def __exit__(self, *_: object) -> None:
        for owner, name, function in self._kept:
            setattr(owner, name, function)


def fem_profile() -> dict[str, object]:
    """How the time of a FEM step is spent (milliseconds per step, default finger, increments up to 1 mm)."""
    from softgym_envs.mechanics.solvers.statics import Statics
    from softgym_envs.robots.registry import make_robot

    robot = make_robot("finger")
    statics = Statics(robot.build())
    rng = np.random.default_rng(0)
    commands = np.cumsum(rng.uniform(-1e-3, 1e-3, (200, 2)), axis=0) + 5e-3
    commands = np.clip(commands, 0.0, 0.02)
    statics.solve(commands[0])
    with _Shares() as shares:
        start = time.perf_counter()
        iterations = sum(statics.solve(command).iterations for command in commands)
        total = time.perf_counter() - start
    spent = shares.seconds
    result: dict[str, object] = {f"{name} [ms]": 1e3 * value / len(commands) for name, value in spent.items()}
    result["rest: Python and small algebra [ms]"] = 1e3 * (total - sum(spent.values())) / len(commands)
    result["total [ms]"] = 1e3 * total / len(commands)
    result["Newton iterations per step"] = iterations / len(commands)
    return result


def _finer(robot: Any) -> dict[str, object]:
    """Options that give a robot a mesh of elements of a tenth of the volume, empty if it has none."""
    if hasattr(robot, "mesh_size"):
        return {"mesh_size": robot.mesh_size / 10.0 ** (1.0 / 3.0)}
    if hasattr(robot, "elements"):
        return {"elements": 10 * robot.elements}
    return {}


def _environment_speed(identifier: str, options: dict[str, object], steps: int, repeats: int) -> dict[str, object]:
    """Steps per second, milliseconds per reset, size and shares of an environment on FEM, under random actions."""
    import gymnasium

    env = gymnasium.make(identifier, backend="fem", robot_options=options, disable_env_checker=True)
    env.action_space.seed(0)
    per_step, resets = [], []

    def reset(seed: int | None = None) -> None:
        start = time.perf_counter()
        env.reset(seed=seed)
        resets.append(time.perf_counter() - start)
        for _ in range(8):  # away from rest, where half of the actuators would be slack
            env.step(np.full(env.action_space.shape or 1, 0.3, dtype=np.float32))

    reset(0)  # the first call compiles
    resets.clear()
    with _Shares() as shares:
        for repeat in range(repeats):
            shares.counting = False
            reset(repeat)
            seconds = 0.0
            for _ in range(steps):
                action = env.action_space.sample()
                shares.counting = True
                start = time.perf_counter()
                _, _, terminated, truncated, _ = env.step(action)
                seconds += time.perf_counter() - start
                shares.counting = False
                if terminated or truncated:
                    reset()
            per_step.append(seconds / steps)
    unwrapped: Any = env.unwrapped
    model = unwrapped.backend.model
    env.close()
    elements = sum(len(getattr(block, "connectivity", getattr(block, "rows", ()))) for block in model.blocks)
    total = steps * sum(per_step)
    spent = {**shares.seconds, "Python and small algebra": total - sum(shares.seconds.values())}
    return {
        "steps per second": 1.0 / statistics.median(per_step),
        "reset [ms]": 1e3 * statistics.median(resets),
        # A frame has four rows.
        "nodes, elements, equations": f"{len(model.nodes) - 3 * len(model.frames)}, {elements}, {model.equations}",
        "shares": ", ".join(f"{name} {100.0 * value / total:.0f} %" for name, value in spent.items()),
    }


COARSE = {name: {"mesh_size": 0.020} for name in ("SoftGym/FingerGrasp-v0", "SoftGym/GripperLift-v0")}


def fem_speed() -> dict[str, object]:
    """Every environment on FEM under random actions, W included: on its own mesh and on a finer one.

    The finer mesh has elements of a tenth of the volume, or ten times as many where a robot option sets their number.
    Contact-aided fingers have a coarse mesh here: on their own one a step of random actions takes many seconds.
    """
    import softgym_envs  # noqa: F401 - registers the IDs
    from softgym_envs.envs.registration import ENVIRONMENTS
    from softgym_envs.robots.registry import make_robot

    result: dict[str, object] = {}
    for identifier, row in ENVIRONMENTS.items():
        own = {**row.robot_options, **COARSE.get(identifier, {})}
        finer = _finer(make_robot(row.robot, **own))
        cases = [("", {}, 20, 5), *([(", fine", finer, 5, 3)] if finer else [])]
        for label, more, steps, repeats in cases:
            found = _environment_speed(identifier, {**own, **more}, steps, repeats)
            result |= {f"{identifier.removeprefix('SoftGym/')}{label}: {key}": value for key, value in found.items()}
    return result


def notched_beam() -> dict[str, object]:
    """CPU time of the notched reference beam for a 10 mm pull, in one increment and through the levels of SOFA.

    Each with ``W`` at every equilibrium, and without. SOFA's published times are those of its steps to 1e-6 mm through
    the same seven levels on the same mesh, without ``W`` and the exact tangent: 91 steps of 4.8 ms with rotations from
    the elements' edges (``large``, another energy), 207 of 3.1 ms with those of the polar decomposition
    (``fast_polar``, the same energy).
    """
    from softgym_envs.mechanics.model import MechanicalModel
    from softgym_envs.mechanics.solvers.statics import Statics

    data = np.load(_BEAM / "notched_lc6_mesh.npz")
    model = MechanicalModel.from_mesh(
        data["nodes"] * 1e-3, data["tets"], fixed=data["fixed"], young_modulus=3e6, poisson_ratio=0.3
    )
    model.add_cable("cable", data["cable_points"] * 1e-3, data["pull_point"] * 1e-3, unilateral=False)

    def milliseconds(levels: tuple[float, ...], *, with_compliance: bool = True) -> float:
        statics, times = Statics(model, exact_compliance=with_compliance), []
        for _ in range(22):
            start = time.process_time()
            statics.reset()
            for level in levels:
                statics.solve([level])
            times.append(time.process_time() - start)
        return 1e3 * statistics.median(times[1:])

    path = (0.0, 0.001, 0.002, 0.004, 0.006, 0.008, 0.01)
    return {
        "one increment [ms]": milliseconds((0.01,)),
        "seven levels [ms]": milliseconds(path),
        "one increment, without W [ms]": milliseconds((0.01,), with_compliance=False),
        "seven levels, without W [ms]": milliseconds(path, with_compliance=False),
        "seven levels with SOFA v25.06, other rotations [ms]": 440.0,
        "seven levels with SOFA v25.06, same energy [ms]": 640.0,
    }


def surrogate_ids() -> list[str]:
    """Return the IDs whose default backend is the surrogate."""
    from softgym_envs.envs.registration import ENVIRONMENTS

    return [identifier for identifier, row in ENVIRONMENTS.items() if row.backend == "surrogate"]


_BATCHED = """
import json, sys, time
import gymnasium, softgym_envs
count, actions = int(sys.argv[2]), 60
batch = gymnasium.make_vec(sys.argv[1], num_envs=count)
batch.reset(seed=0)
batch.action_space.seed(0)
drawn = [batch.action_space.sample() for _ in range(actions)]
for action in drawn:
    batch.step(action)
laps = []
for _ in range(5):
    start = time.perf_counter()
    for action in drawn:
        batch.step(action)
    laps.append(time.perf_counter() - start)
print(json.dumps(count * actions / sorted(laps)[2]))
"""


def surrogate_step() -> dict[str, object]:
    """Surrogate environment steps per second, random increments, resets included; batches in one and two processes."""
    import gymnasium

    import softgym_envs  # noqa: F401 - registers the IDs

    result: dict[str, object] = {}
    for identifier in surrogate_ids():
        name = identifier.removeprefix("SoftGym/").removesuffix("-v0")
        env = gymnasium.make(identifier)
        env.reset(seed=0)
        walk = _random_walk(env, 1000, 0)
        walk()
        result[f"{name}, single: steps per second"] = 1000 / median_seconds(walk, 5)
        for processes in (1, 2):
            running = [
                subprocess.Popen([sys.executable, "-c", _BATCHED, identifier, "1024"], stdout=subprocess.PIPE)
                for _ in range(processes)
            ]
            rates = [json.loads(process.communicate()[0]) for process in running]
            label = f"{name}, 1024 at once in {processes} process(es): steps per second"
            result[label] = float(sum(rates))
    return result


def inference() -> dict[str, object]:
    """Microseconds per call of the shipped networks: state, condensed model, and the torch model for comparison."""
    import torch

    from softgym_envs.extensions.fitting.torch_potential import TorchModel
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.surrogate.pretrained import pretrained_model, shipped_robots

    torch.set_num_threads(1)
    result: dict[str, object] = {}
    for variant, (robot, options) in shipped_robots().items():
        body = make_robot(robot, **options)
        model = pretrained_model(body)
        rng = np.random.default_rng(0)
        designs = np.array([body.design_space.sample(rng).array for _ in range(256)])
        displacement = rng.uniform(body.lower, body.upper, (256, model.count))
        contexts = {count: model.context(designs[:count]) for count in (1, 256)}
        net = TorchModel(model)
        tensors = torch.as_tensor(designs[:1]), torch.as_tensor(displacement[:1])
        candidates: dict[str, tuple[Callable[[], object], int]] = {
            "state, one": (partial(model.state, contexts[1], displacement[:1]), 1),
            "state, each of 256": (partial(model.state, contexts[256], displacement), 256),
            "condensed model, one": (partial(model.condensed, contexts[1], displacement[:1]), 1),
            "condensed model, each of 256": (partial(model.condensed, contexts[256], displacement), 256),
            "in torch, one": (partial(net, *tensors), 1),
        }
        for name, (work, count) in candidates.items():
            work()
            result[f"{variant}: {name} [us]"] = 1e6 * median_seconds(work, 2000 // count + 10) / count
    return result


def memory() -> dict[str, object]:
    """Peak resident memory of a fresh process with one environment after 60 random steps [MB]."""
    program = (
        "import gymnasium, softgym_envs, json, sys\n"
        "env = gymnasium.make('SoftGym/FingerReach-v0', backend=sys.argv[1])\n"
        "env.reset(seed=0)\n"
        "for _ in range(60):\n"
        "    if env.step(env.action_space.sample())[3]: env.reset()\n"
        # A child process inherits ru_maxrss from its parent, so read its own peak.
        "peak = next(line for line in open('/proc/self/status') if line.startswith('VmHWM'))\n"
        "print(json.dumps(int(peak.split()[1]) / 1024))\n"
    )
    result: dict[str, object] = {}
    for backend in ("fem", "surrogate"):
        done = subprocess.run([sys.executable, "-c", program, backend], capture_output=True, text=True, check=True)
        result[f"{backend} [MB]"] = float(json.loads(done.stdout.splitlines()[-1]))
    return result
