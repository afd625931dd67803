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
from typing import Any

import numpy as np

from benchmarks.speed import median_seconds
from softgym_envs.mechanics.condensation import CondensedModel

FLAGS = {
    "-O2": ["-O2"],
    "-O3 -march=native": ["-O3", "-march=native"],
    "-O3 -march=native -fno-math-errno": ["-O3", "-march=native", "-fno-math-errno"],
}
"""Options of the compiler by label; the last one is that of the control loops."""

EFFORT_WEIGHT, STEP_WEIGHT = 1e-5, 1e-3

# Times of many calls, and the whole loop (thesis, algorithm 2): the quadratic program has only bounds and rates of
# efforts and is solved by an active-set method, with the objective of `softgym_envs.control.InverseQP`.
_SOURCE = r"""
#define _POSIX_C_SOURCE 199309L
#include <time.h>
#include "model.h"
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

/* Minimise c^T H c / 2 + g^T c within bounds from a feasible c: primal active set. `typical` scales tolerances. */
static void minimise(double H[N][N], const double *g, const double *low, const double *high, const double *typical,
                     double *c)
{
    double L[N][N], d[N], slope[N];
    int fixed[N] = {0};
    for (int round = 0; round < 50; ++round) {
        /* Newton step of the free variables: a fixed one has a unit row. */
        for (int i = 0; i < N; ++i) {
            slope[i] = g[i];
            for (int j = 0; j < N; ++j)
                slope[i] += H[i][j] * c[j];
        }
        for (int i = 0; i < N; ++i) {
            d[i] = fixed[i] ? 0.0 : -slope[i];
            for (int j = 0; j <= i; ++j) {
                double value = fixed[i] || fixed[j] ? (i == j) : H[i][j];
                for (int k = 0; k < j; ++k)
                    value -= L[i][k] * L[j][k];
                L[i][j] = i == j ? sqrt(value) : value / L[j][j];
            }
            for (int k = 0; k < i; ++k)
                d[i] -= L[i][k] * d[k];
            d[i] /= L[i][i];
        }
        for (int i = N - 1; i >= 0; --i) {
            for (int k = i + 1; k < N; ++k)
                d[i] -= L[k][i] * d[k];
            d[i] /= L[i][i];
        }
        /* Step to the first bound; without one, free the fixed variable that is pulled inwards most. */
        double length = 1.0, pull = 0.0;
        int change = -1;
        for (int i = 0; i < N; ++i) {
            double room = (d[i] > 0.0 ? high[i] : low[i]) - c[i];
            if (!fixed[i] && fabs(d[i]) * length > fabs(room)) {
                length = room / d[i];
                change = i;
            }
        }
        for (int i = 0; i < N; ++i)
            c[i] += length * d[i];
        if (change >= 0) {
            c[change] = d[change] > 0.0 ? high[change] : low[change];
            fixed[change] = 1;
            continue;
        }
        for (int i = 0; i < N; ++i) {
            if (!fixed[i] || high[i] <= low[i])
                continue;
            slope[i] = g[i];
            for (int j = 0; j < N; ++j)
                slope[i] += H[i][j] * c[j];
            double inwards = (c[i] >= high[i] ? slope[i] : -slope[i]) / (H[i][i] * typical[i]);
            if (inwards > pull + 1e-9) {
                pull = inwards;
                change = i;
            }
        }
        if (change < 0)
            return;
        fixed[change] = 0;
    }
}

/* One call of the controller: the displacement q and the efforts move on; predicts the effector. */
static int step(const double *goal, const double *most, const double *rate, double effort_weight, double step_weight,
                float *q, double *effort, double *predicted)
{
    float f[N], x[E], W[S * S];
    double H[N][N], g[N], c[N], low[N], high[N], error[E], sum, gain = 0.0, flexible = 0.0;
    if (softgym_condensed(q, f, x, W))
        return 1;
    for (int k = 0; k < E; ++k)
        error[k] = x[k] - goal[k];
    for (int i = 0; i < N; ++i)
        for (int j = 0; j < N; ++j) {
            sum = 0.0;
            for (int k = N; k < S; ++k)
                sum += (double)W[k * S + i] * W[k * S + j];
            H[i][j] = sum;
            gain += sum * sum;
            flexible += (double)W[i * S + j] * W[i * S + j];
        }
    gain = sqrt(gain / flexible);
    for (int i = 0; i < N; ++i) {
        g[i] = 0.0;
        for (int k = 0; k < E; ++k)
            g[i] += W[(N + k) * S + i] * error[k];
        for (int j = 0; j < N; ++j) {
            g[i] += effort_weight * gain * W[i * S + j] * f[j];
            H[i][j] += (effort_weight + step_weight) * gain * W[i * S + j];
        }
        low[i] = fmin(fmax(effort[i] - rate[i], 0.0), most[i]) - f[i];
        high[i] = fmin(fmax(effort[i] + rate[i], 0.0), most[i]) - f[i];
        c[i] = fmin(fmax(effort[i] - f[i], low[i]), high[i]);
    }
    minimise(H, g, low, high, most, c);
    for (int i = 0; i < N; ++i) {
        effort[i] = f[i] + c[i];
        for (int j = 0; j < N; ++j)
            q[i] += (float)(W[i * S + j] * c[j]);
    }
    for (int k = 0; k < E; ++k) {
        predicted[k] = x[k];
        for (int j = 0; j < N; ++j)
            predicted[k] += W[(N + k) * S + j] * c[j];
    }
    return 0;
}

/* From rest along goals (calls, E); efforts (calls, N). Returns seconds, or -1. */
double follow(int calls, const double *goals, const double *most, const double *rate, double effort_weight,
              double step_weight, double *efforts)
{
    float q[N] = {0.0f}, f[N], x[E], W[S * S];
    double effort[N] = {0.0}, predicted[E];
    double start = now();
    if (softgym_condensed(q, f, x, W))
        return -1.0;
    for (int i = 0; i < N; ++i)
        for (int j = 0; j < N; ++j)
            q[i] -= W[i * S + j] * f[j];
    for (int k = 0; k < calls; ++k) {
        if (step(goals + k * E, most, rate, effort_weight, step_weight, q, effort, predicted))
            return -1.0;
        for (int i = 0; i < N; ++i)
            efforts[k * N + i] = effort[i];
    }
    return now() - start;
}
"""


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _compiled(model: Any, flags: list[str], folder: Path) -> ctypes.CDLL:
    """The header of a baseline body with `_SOURCE`, as a shared library."""
    from softgym_envs.surrogate.export.c import export_c

    compiler = shutil.which("cc") or shutil.which("gcc") or "cc"
    export_c(model, None, folder / "model.h")
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


def _control_speed(model: Any, context: Any, library: ctypes.CDLL, efforts: np.ndarray) -> dict[str, object]:
    """Rates of thesis, algorithm 2 along a path: controller in Python on either model, and all of it in C."""
    from softgym_envs.control.embedded import EmbeddedLoop
    from softgym_envs.control.inverse_qp import InverseQP

    count = model.count
    most = np.full(count, 1.5 * np.abs(efforts).max())
    rate = 0.05 * most
    goals = _goals(model, context, 600)
    rest = model.state(context, np.zeros((1, count)))[1][0]
    goals = np.ascontiguousarray(np.vstack([np.linspace(rest, goals[0], 101)[1:], goals]))
    unbounded = np.full(count, np.inf)

    def in_python(asked: Callable[[np.ndarray], CondensedModel]) -> tuple[float, np.ndarray, float]:
        """Seconds per call, the efforts (calls, n_a), and the mean distance [m] of predictions to the goals."""
        controller = InverseQP(
            -unbounded,
            unbounded,
            unbounded,
            np.ones(count, dtype=bool),
            max_effort=most,
            effort_rates=rate,
            effort_weight=EFFORT_WEIGHT,
            step_weight=STEP_WEIGHT,
            mode="effort",
        )
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
    arguments = (len(goals), _pointer(goals), _pointer(most), _pointer(rate))
    weights = (ctypes.c_double(EFFORT_WEIGHT), ctypes.c_double(STEP_WEIGHT))
    seconds = statistics.median(library.follow(*arguments, *weights, _pointer(in_c)) for _ in range(21)) / len(goals)
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
        * float(np.abs(answers - expected).max() / most[0]),
        "Algorithm 2 in C as a whole [Hz]": 1.0 / seconds if seconds > 0.0 else float("nan"),
        "largest difference of its efforts [%]": 100.0 * float(np.abs(in_c - expected).max() / most[0]),
    }


def _measure(model: Any) -> dict[str, object]:
    """All numbers of one model, at random states of the baseline body."""
    calls = 512
    robot = model.robot
    context = model.context(robot.design_space.baseline.array[None])
    rng = np.random.default_rng(0)
    displacement = rng.uniform(robot.lower, robot.upper, (calls, model.count)).astype(np.float32)
    result: dict[str, object] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for label, flags in FLAGS.items():
            library = _compiled(model, flags, folder)
            total = np.zeros(1, dtype=np.float32)
            for name in ("state", "condensed"):
                measure = partial(getattr(library, f"time_{name}"), calls, _pointer(displacement), _pointer(total))
                seconds = statistics.median(measure() for _ in range(31)) / calls
                result[f"C {name}, {label} [us]"] = 1e6 * seconds
        result["size of the header's constants [kB]"] = _constant_bytes(folder / "model.h") / 1e3
        one = displacement[:1].astype(float)
        for name, work in (("state", model.state), ("condensed", model.condensed)):
            work(context, one)  # the first call compiles
            result[f"Python {name}, batch 1 [us]"] = 1e6 * median_seconds(partial(work, context, one), 500)
        result |= _onnx_speed(model, displacement, folder)
        efforts = model.state(context.shared(context, calls), displacement.astype(float))[0]
        result |= _control_speed(model, context, library, efforts)
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
