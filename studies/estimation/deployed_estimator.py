"""The estimator of a touch in C against the one in Python: rates, memory, and how far their estimates differ."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.recorded import results
from benchmarks.tables import markdown
from softgym_envs.backends.backend import PointForce
from softgym_envs.backends.surrogate import SurrogateBackend
from softgym_envs.estimation import Noise, Readings, Touch, finger_grid
from softgym_envs.estimation.export.c import export_estimator_c
from softgym_envs.estimation.learned import LearnedEstimator
from softgym_envs.estimation.loads import Cell
from softgym_envs.robots.registry import make_robot

TOUCHES, READINGS, FORCE = 60, 10, 1.0
REALS = ("double", "float")
FLAGS = ("-std=c99", "-O3", "-march=native", "-fno-math-errno")

# The deepest use of the stack is that of a painted one; a thread that does nothing tells what belongs to threads.
_SOURCE = r"""
#define _DEFAULT_SOURCE
#include <pthread.h>
#include <string.h>
#include "estimator.h"
enum { BYTES = 1 << 18 };
static unsigned char stack[BYTES] __attribute__((aligned(64)));
struct call { softgym_estimator *estimator; const double *command, *volumes; softgym_estimator_result *result; };
int size(void) { return (int)sizeof(softgym_estimator); }
void start(softgym_estimator *e, double noise) { softgym_estimator_start(e); e->volume_noise = noise; }
int touch(softgym_estimator *e, const int *cell) { return softgym_estimator_touch(e, cell); }
int update(softgym_estimator *e, const double *command, const double *volumes, softgym_estimator_result *result)
{
    return softgym_estimator_update(e, command, volumes, result);
}
static void *run(void *given)
{
    struct call *call = given;
    if (call->estimator)
        softgym_estimator_update(call->estimator, call->command, call->volumes, call->result);
    return NULL;
}
int stack_bytes(softgym_estimator *e, const double *command, const double *volumes, softgym_estimator_result *result)
{
    struct call call = {e, command, volumes, result};
    pthread_attr_t attributes;
    pthread_t thread;
    int k = 0;
    memset(stack, 0xa5, BYTES);
    pthread_attr_init(&attributes);
    if (pthread_attr_setstack(&attributes, stack, BYTES) || pthread_create(&thread, &attributes, run, &call))
        return -1;
    pthread_join(thread, NULL);
    while (k < BYTES && stack[k] == 0xa5)
        ++k;
    return BYTES - k;
}
"""


class Result(ctypes.Structure):
    """The result of one reading, for one cable and one effector."""

    _fields_ = [
        ("displacement", ctypes.c_double),
        ("load", ctypes.c_double * 3),
        ("load_covariance", ctypes.c_double * 9),
        ("effector", ctypes.c_double * 3),
        ("effector_covariance", ctypes.c_double * 9),
        ("misfit", ctypes.c_double),
        ("slack", ctypes.c_int),
    ]


class CompiledEstimator:
    """The estimator of the sensorized finger as a user compiles it.

    Args:
        folder: of the header.
        real: type of its distributions, of `REALS`.
        noise: of a volume [m3].
    """

    def __init__(self, folder: Path, real: str, noise: float) -> None:
        (folder / "wrapper.c").write_text(_SOURCE)
        compiler, library = shutil.which("cc") or shutil.which("gcc") or "cc", folder / f"{real}.so"
        sources = [f"-DSOFTGYM_ESTIMATOR_REAL={real}", "-pthread", "-shared", "-fPIC", str(folder / "wrapper.c")]
        subprocess.run([compiler, *FLAGS, *sources, "-o", str(library), "-lm"], check=True)
        self._library = ctypes.CDLL(str(library))
        self.state = self._library.size()
        self._struct = ctypes.create_string_buffer(self.state)
        self._noise = noise
        self._start()

    def _start(self) -> None:
        self._library.start(self._struct, ctypes.c_double(self._noise))

    def touch(self, cell: Cell) -> None:
        """Start anew, with a touched cell."""
        self._start()
        if self._library.touch(self._struct, (ctypes.c_int * 2)(*cell)):
            raise RuntimeError(f"the compiled estimator does not have cell {cell}")

    def update(self, command: np.ndarray, volumes: np.ndarray) -> tuple[Result, float]:
        """Return the estimate after one more reading, and its CPU time [s]."""
        result = Result()
        arguments = [ctypes.c_void_p(np.ascontiguousarray(array).ctypes.data) for array in (command, volumes)]
        began = time.process_time()
        status = self._library.update(self._struct, *arguments, ctypes.byref(result))
        spent = time.process_time() - began
        if status:
            raise RuntimeError(f"the compiled estimator returned {status}")
        return result, spent

    def stack(self, command: np.ndarray, volumes: np.ndarray) -> int:
        """Return the bytes of stack that one more reading takes."""
        arguments = [ctypes.c_void_p(array.ctypes.data) for array in (command, volumes)]
        nothing = self._library.stack_bytes(None, *arguments, None)
        return self._library.stack_bytes(self._struct, *arguments, ctypes.byref(Result())) - nothing


def touches(estimator: LearnedEstimator) -> Iterator[tuple[Cell, np.ndarray, np.ndarray]]:
    """Yield touched cell, command and volumes without noise, of random touches on the learned model."""
    rng, grid, robot = np.random.default_rng(3), finger_grid(), estimator.robot
    plant = SurrogateBackend(robot)
    for _ in range(TOUCHES):
        cell = (int(rng.integers(grid.cells[0])), int(rng.integers(grid.cells[1])))
        point = grid.inside(cell, rng.uniform(-1.0, 1.0, (1, 2)))[0]
        plant.touch(PointForce(point, np.array([0.0, rng.uniform(0.2, 2.0), 0.0])))
        command = np.array([rng.uniform(0.001, 0.01)])
        state = plant.step(command + estimator.noise.displacement * rng.standard_normal(1))
        yield cell, command, estimator.rest_volumes + state.condensed.delta.s


def deployed_estimator() -> dict[str, object]:
    """Readings per CPU second of the estimator in C and in Python, memory, and the largest differences."""
    noise, grid = Noise(displacement=1e-4, volume=5.7e-10), finger_grid()
    robot = make_robot("sensorized_finger")
    estimator = LearnedEstimator(robot, noise=noise)
    result: dict[str, object] = {}
    rng = np.random.default_rng(4)
    times: dict[str, list[float]] = {f"{who}, {when}": [] for who in ("Python", *REALS) for when in ("first", "later")}
    differences: dict[str, list[float]] = {real: [] for real in REALS}
    stacks = dict.fromkeys(REALS, 0)
    with tempfile.TemporaryDirectory() as scratch:
        header, _ = export_estimator_c(estimator, grid, scratch, expected_force=FORCE)
        constants = re.search(r"(\d+) bytes of constants", header.read_text())
        assert constants is not None
        machines = {real: CompiledEstimator(Path(scratch), real, noise.volume) for real in REALS}
        for number, (cell, command, volumes) in enumerate(touches(estimator)):
            python = LearnedEstimator(
                robot, noise=noise, model=estimator.model, load=Touch(grid, cell, FORCE)
            )  # the error of the cable is unknown again
            for machine in machines.values():
                machine.touch(cell)
            for reading in range(READINGS):
                measured, when = volumes + noise.volume * rng.standard_normal(len(volumes)), "later"
                began = time.process_time()
                expected = python.update(Readings(command, measured))
                spent = time.process_time() - began
                if not reading:
                    when = "first"
                if number:  # the first one compiles
                    times[f"Python, {when}"].append(spent)
                loads = np.sqrt(np.diag(expected.load_covariance))
                tip = float(np.sqrt(np.trace(expected.effector_covariance)))
                for real, machine in machines.items():
                    found, spent = machine.update(command, measured)
                    times[f"{real}, {when}"].append(spent)
                    differences[real] += [
                        float((np.abs(np.array(found.load) - expected.load) / loads).max()),
                        float(np.abs(np.array(found.effector) - expected.effector).max() / tip),
                    ]
            for real, machine in machines.items():
                stacks[real] = max(stacks[real], machine.stack(command * (1.0 + 1e-3), volumes + 50e-9))
    for name, values in times.items():
        who, when = name.split(", ")
        who = who if who == "Python" else f"C, {who}"
        result[f"{who}: {when} readings of a touch [1/CPU s]"] = 1.0 / float(np.mean(values))
    for real, machine in machines.items():
        result[f"C, {real}: largest difference from Python [standard deviations]"] = max(differences[real])
        result[f"C, {real}: 99 % of the differences are below [standard deviations]"] = float(
            np.percentile(differences[real], 99)
        )
        result[f"C, {real}: state [bytes]"] = machine.state
        result[f"C, {real}: stack [bytes]"] = stacks[real]
    result["constants [kB]"] = int(constants[1]) / 1e3
    return result


def estimators_table() -> str:
    """Rates, memory and differences of the estimator in C with both types, and in Python."""
    found = results("deployed_estimator")
    columns = ("Python", *(f"C, {real}" for real in REALS))
    rows = []
    for name, form in (
        ("first readings of a touch [1/CPU s]", ".0f"),
        ("later readings of a touch [1/CPU s]", ".0f"),
        ("largest difference from Python [standard deviations]", ".1e"),
        ("99 % of the differences are below [standard deviations]", ".1e"),
        ("state [bytes]", ".0f"),
        ("stack [bytes]", ".0f"),
    ):
        values = (found.get(f"{column}: {name}") for column in columns)
        rows.append([name, *("" if value is None else f"{value:{form}}" for value in values)])
    rows.append(["constants [kB]", "", *(f"{found['constants [kB]']:.0f}" for _ in REALS)])
    return markdown(["", *columns], rows, "lrrr")


TABLES = {"deployed_estimators": estimators_table}
"""Tables of pages by name."""
