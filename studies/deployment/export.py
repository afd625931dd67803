"""Speed of exported models on one thread: the compiled C header, the ONNX graph, and embedded control on them."""

from __future__ import annotations

import ctypes
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.speed import median_seconds
from softgym_envs.mechanics.condensation import CondensedModel

if TYPE_CHECKING:
    from softgym_envs.control.inverse_qp import InverseQP

FLAGS = {
    "-O2": ["-O2"],
    "-O3 -march=native": ["-O3", "-march=native"],
    "-O3 -march=native -fno-math-errno": ["-O3", "-march=native", "-fno-math-errno"],
}
"""Options of the compiler by label; the last one is that of the control loops."""

# Times of many calls, and of the whole loop (thesis, algorithm 2).
_SOURCE = r"""
#define _POSIX_C_SOURCE 199309L
#include <time.h>
#include "controller.h"
enum { N = SOFTGYM_ACTUATORS, E = SOFTGYM_COORDINATES, S = SOFTGYM_ACTUATORS + SOFTGYM_COORDINATES };

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

int condensed(const float *q, float *f, float *x, float *W) { return softgym_condensed(q, f, x, W); }

double time_state(int calls, const float *q, float *sum)
{
    float f[N], x[E];
    double start = now();
    for (int k = 0; k < calls; ++k) {
        softgym_state(q + k * N, f, x);
        *sum += f[0] + x[0];
    }
    return now() - start;
}

double time_condensed(int calls, const float *q, float *sum)
{
    float f[N], x[E], W[S * S];
    double start = now();
    for (int k = 0; k < calls; ++k) {
        softgym_condensed(q + k * N, f, x, W);
        *sum += W[S * S - 1];
    }
    return now() - start;
}

/* From rest along goals (calls, E); commands (calls, N). Returns seconds, or -1. */
double follow(int calls, const double *goals, double *commands)
{
    softgym_controller controller;
    double start = now();
    if (softgym_controller_start(&controller))
        return -1.0;
    for (int k = 0; k < calls; ++k)
        if (softgym_controller_step(&controller, goals + k * E, 0, commands + k * N))
            return -1.0;
    return now() - start;
}
"""


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _compiled(model: Any, controller: InverseQP, flags: list[str], folder: Path) -> ctypes.CDLL:
    """The controller of a baseline body with `_SOURCE`, as a shared library."""
    from softgym_envs.control.export.c import export_controller_c

    compiler = shutil.which("cc") or shutil.which("gcc") or "cc"
    export_controller_c(model, None, folder, controller=controller)
    (folder / "model.c").write_text(_SOURCE)
    library = Path(tempfile.mkdtemp(dir=folder)) / "model.so"
    sources = ["-std=c99", *flags, "-shared", "-fPIC", str(folder / "model.c"), "-o", str(library), "-lm"]
    subprocess.run([compiler, *sources], check=True)
    loaded = ctypes.CDLL(str(library))
    for name in ("time_state", "time_condensed", "follow"):
        getattr(loaded, name).restype = ctypes.c_double
    return loaded


class _CondensedInC:
    """The condensed model at displacements (n_a,), one call into the compiled header each."""

    def __init__(self, library: ctypes.CDLL, model: Any) -> None:
        n, e = model.count, model.effectors
        self.displacement = np.zeros(n, dtype=np.float32)
        self.effort, self.effector = np.zeros(n, dtype=np.float32), np.zeros(e, dtype=np.float32)
        self.W = np.zeros((n + e, n + e), dtype=np.float32)
        self.roles = model.roles
        arrays = (self.displacement, self.effort, self.effector, self.W)
        self._call = partial(library.condensed, *map(_pointer, arrays))

    def __call__(self, displacement: np.ndarray) -> CondensedModel:
        self.displacement[:] = displacement
        if self._call():
            raise ValueError(f"no condensed model at {displacement.tolist()}")
        W = self.W.astype(float)
        effort = np.concatenate([self.effort, np.zeros(len(self.effector))])
        delta = np.concatenate([displacement, self.effector])
        return CondensedModel(W, delta - W @ effort, effort, self.roles)


def _goals(model: Any, context: Any, count: int) -> np.ndarray:
    """A closed path of the effector [m], shape (count, e): published, or all actuators in and out together."""
    robot = model.robot
    try:
        return robot.reference_path(count)
    except ValueError:
        share = 0.3 * (1.0 - np.cos(np.linspace(0.0, 2.0 * np.pi, count)))
        displacement = robot.lower + share[:, None] * (robot.upper - robot.lower)
        return model.state(context.shared(context, count), displacement)[1]


def _onnx_speed(model: Any, displacement: np.ndarray, folder: Path) -> dict[str, object]:
    """Microseconds per state of the graph; it always computes W too."""
    from softgym_envs.surrogate.export.onnx import export_onnx

    try:
        import onnxruntime
    except ImportError:
        return {"ONNX": "onnxruntime is not installed"}
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    path = export_onnx(model, folder / "model.onnx")
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    design = model.robot.design_space.baseline.array[None].astype(np.float32)
    result: dict[str, object] = {}
    for count in (1, 256):
        feed = {"design": np.repeat(design, count, axis=0), "displacement": displacement[:count]}
        session.run(None, feed)
        seconds = median_seconds(partial(session.run, None, feed), 400 // count + 100)
        result[f"ONNX, W included, batch {count} [us per state]"] = 1e6 * seconds / count
    return result


def _control_speed(model: Any, context: Any, library: ctypes.CDLL, controller: InverseQP) -> dict[str, object]:
    """Rates of thesis, algorithm 2 along a path: controller in Python on either model, and all of it in C."""
    from softgym_envs.control.embedded import EmbeddedLoop

    count = model.count
    goals = _goals(model, context, 600)
    rest = model.state(context, np.zeros((1, count)))[1][0]
    goals = np.ascontiguousarray(np.vstack([np.linspace(rest, goals[0], 101)[1:], goals]))

    def in_python(asked: Callable[[np.ndarray], CondensedModel]) -> tuple[float, np.ndarray, float]:
        """Seconds per call, the efforts (calls, n_a), and the mean distance [m] of predictions to the goals."""
        loop, times, answers, distances = EmbeddedLoop(asked, controller), [], [], []
        for goal in goals:
            start = time.perf_counter()
            answers.append(loop.step(goal))
            times.append(time.perf_counter() - start)
            distances.append(np.linalg.norm(loop.predicted - goal))
        return statistics.median(times), np.array(answers), float(np.mean(distances))

    def by_kernel(displacement: np.ndarray) -> CondensedModel:
        found = model.condensed(context, displacement[None])
        return CondensedModel(found.compliance[0], found.free[0], found.effort[0], model.roles)

    in_c = np.empty((len(goals), count))
    arguments = (len(goals), _pointer(goals), _pointer(in_c))
    seconds = statistics.median(library.follow(*arguments) for _ in range(21)) / len(goals)
    asked = _CondensedInC(library, model)
    reference, expected, distance = in_python(by_kernel)
    mixed, answers, _ = in_python(asked)
    here = np.zeros(count)
    return {
        "Algorithm 2 on the Python model [Hz]": 1.0 / reference,
        "mean distance of its predictions to the goals [mm]": 1e3 * distance,
        "Algorithm 2 on the C model, controller in Python [Hz]": 1.0 / mixed,
        "of it the model, called from Python [us]": 1e6 * median_seconds(partial(asked, here), 300),
        "largest difference of efforts to the Python model [%]": 100.0
        * float(np.abs(answers - expected).max() / controller.max_effort[0]),
        "Algorithm 2 in C as a whole [Hz]": 1.0 / seconds if seconds > 0.0 else float("nan"),
        "largest difference of its efforts [%]": 100.0
        * float(np.abs(in_c - expected).max() / controller.max_effort[0]),
    }


def _measure(model: Any) -> dict[str, object]:
    """All numbers of one model, at random states of the baseline body."""
    calls = 512
    from softgym_envs.control.inverse_qp import InverseQP

    robot = model.robot
    context = model.context(robot.design_space.baseline.array[None])
    rng = np.random.default_rng(0)
    displacement = rng.uniform(robot.lower, robot.upper, (calls, model.count)).astype(np.float32)
    result: dict[str, object] = {}
    efforts = model.state(context.shared(context, calls), displacement.astype(float))[0]
    most = 1.5 * float(np.abs(efforts).max())
    pulls = np.ones(model.count, dtype=bool)
    controller = InverseQP.by_efforts(robot, most, 0.05 * most, unilateral=pulls, goal_weights=None)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for label, flags in FLAGS.items():
            library = _compiled(model, controller, flags, folder)
            total = np.zeros(1, dtype=np.float32)
            for name in ("state", "condensed"):
                measure = partial(getattr(library, f"time_{name}"), calls, _pointer(displacement), _pointer(total))
                seconds = statistics.median(measure() for _ in range(31)) / calls
                result[f"C {name}, {label} [us]"] = 1e6 * seconds
        result["size of the header's constants [kB]"] = _constant_bytes(folder / "controller.h") / 1e3
        one = displacement[:1].astype(float)
        for name, work in (("state", model.state), ("condensed", model.condensed)):
            work(context, one)  # the first call compiles
            result[f"Python {name}, batch 1 [us]"] = 1e6 * median_seconds(partial(work, context, one), 500)
        result |= _onnx_speed(model, displacement, folder)
        result |= _control_speed(model, context, library, controller)
    return result


def _constant_bytes(header: Path) -> int:
    """Return the bytes of constants that the header states."""
    line = next(line for line in header.read_text().splitlines() if "bytes of constants" in line)
    return int(line.split()[2])


def deployed() -> dict[str, object]:
    """Exported models on one thread: microseconds per call of C and ONNX, and rates of embedded control."""
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.surrogate.pretrained import pretrained_model

    result: dict[str, object] = {}
    for name in ("finger", "trunk"):
        model: Any = pretrained_model(make_robot(name))
        found = _measure(model)
        result |= {f"{name}, {model.members} member(s): {key}": value for key, value in found.items()}
    return result
