"""Closed loop of the Stiff-Flop to single points: the deployed controller in C against simulation in the loop."""

from __future__ import annotations

import ctypes
import re
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from softgym_envs.backends.backend import Backend

TARGETS = {"A": (57.0, -5.0, -70.0), "B": (106.0, 26.0, 32.5), "C": (92.5, -58.5, 9.0)}
"""Points of the thesis (fig. 4.11) [mm]."""

LARGEST_PRESSURE, PRESSURE_RATE = 200e3, 5e3
TOLERANCE, HELD = 0.5e-3, 2.4
"""A target counts as reached when the error stays below the tolerance [m] for this time [s]."""

PERIOD = 0.01
"""Time between two measurements of the tip, and between two corrections [s]."""

PUBLISHED_PERIOD = 0.24
"""Time of a step of the published simulation [s]."""

MAX_CORRECTIONS = 6000
STIFFER = 1.2
"""The plant's moduli over those of the model."""

_SOURCE = r"""
#include "controller.h"
int start(softgym_controller *c) { return softgym_controller_start(c); }
int step(softgym_controller *c, const double *goal, const double *measured, double *command)
{
    return softgym_controller_step(c, goal, measured, command);
}
int size(void) { return (int)sizeof(softgym_controller); }
"""

Step = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Maps goal and measured effector [m] (3,) to the next command (n_a,)."""


class CompiledController:
    """The controller of the trunk as a user compiles it.

    Args:
        folder: of the header, the program and the library.
    """

    def __init__(self, folder: Path) -> None:
        from softgym_envs.control import InverseQP, PICorrection, export_controller_c
        from softgym_envs.robots.registry import make_robot
        from softgym_envs.surrogate.pretrained import pretrained_model

        robot = make_robot("trunk")
        controller = InverseQP.by_efforts(robot, LARGEST_PRESSURE, PRESSURE_RATE)
        model = pretrained_model(robot)
        header, _ = export_controller_c(model, None, folder, controller=controller, correction=PICorrection())
        self.constants = int(re.search(r"(\d+) bytes of constants", header.read_text())[1])  # type: ignore[index]
        (folder / "wrapper.c").write_text(_SOURCE)
        compiler = shutil.which("cc") or shutil.which("gcc") or "cc"
        library, sources = folder / "controller.so", ["-shared", "-fPIC", str(folder / "wrapper.c")]
        flags = ["-std=c99", "-O3", "-march=native", "-fno-math-errno"]
        subprocess.run([compiler, *flags, *sources, "-o", str(library), "-lm"], check=True)
        self._library = ctypes.CDLL(str(library))
        self.memory = self._library.size()
        self._struct = ctypes.create_string_buffer(self.memory)
        self._command = np.zeros(len(robot.actuators))

    def reset(self) -> None:
        """Start from rest."""
        if self._library.start(self._struct):
            raise RuntimeError("the compiled controller does not start")

    def __call__(self, goal: np.ndarray, measured: np.ndarray) -> np.ndarray:
        """Return the next pressures [Pa], shape (n_a,)."""
        arrays = [ctypes.c_void_p(np.ascontiguousarray(x).ctypes.data) for x in (goal, measured, self._command)]
        if self._library.step(self._struct, *arrays):
            raise RuntimeError("the compiled controller found no command")
        return self._command.copy()


def converge(step: Step, plant: Backend, goal: np.ndarray) -> tuple[int | None, float, float]:
    """Drive a plant from rest to a goal.

    Args:
        step: the controller.
        plant: of the trunk.
        goal: [m], shape (3,).

    Returns:
        Corrections until the tolerance is kept (None if it never is), last error [m], median time of a correction [s].
    """
    state, times, inside = plant.reset(), [], 0
    for k in range(MAX_CORRECTIONS):
        measured = state.effector[0]
        began = time.process_time()
        command = step(goal, measured)
        times.append(time.process_time() - began)
        state = plant.step(command, "effort")
        error = float(np.linalg.norm(state.effector[0] - goal))
        inside = inside + 1 if error < TOLERANCE else 0
        if inside * PERIOD >= HELD:
            return k + 1 - inside, error, statistics.median(times)
    return None, error, statistics.median(times)


def deployed_loop() -> dict[str, object]:
    """Targets of fig. 4.11: corrections and time to within 0.5 mm for 2.4 s, the C header against simulation."""
    from softgym_envs.backends.fem import FEMBackend
    from softgym_envs.control import EmbeddedLoop, InverseQP, PICorrection
    from softgym_envs.robots.registry import make_robot

    robot = make_robot("trunk")
    baseline = robot.design_space.baseline
    plant = FEMBackend(robot, {name: STIFFER * baseline[name] for name in ("base_modulus", "tip_modulus")})
    model = FEMBackend(robot)
    controller = InverseQP.by_efforts(robot, LARGEST_PRESSURE, PRESSURE_RATE)
    simulated = EmbeddedLoop(model, controller, PICorrection())
    result: dict[str, object] = {}
    with tempfile.TemporaryDirectory() as scratch:
        learned = CompiledController(Path(scratch))
        result["learned model in C: constants [kB]"] = learned.constants / 1e3
        result["learned model in C: state of the controller [bytes]"] = learned.memory
        for target, place in TARGETS.items():
            goal = 1e-3 * np.array(place)
            for name, begin, step in (
                ("learned model in C", learned.reset, learned),
                ("simulation in the loop", simulated.reset, simulated.step),
            ):
                begin()
                count, error, seconds = converge(step, plant, goal)
                label = f"target {target}, {name}"
                result[f"{label}: corrections"] = count
                result[f"{label}: last error [mm]"] = 1e3 * error
                result[f"{label}: CPU time of a correction [ms]"] = 1e3 * seconds
                if count is not None:
                    result[f"{label}: time, a correction every {1e3 * PERIOD:g} ms [s]"] = count * PERIOD
            if count is not None:
                slow = f"time, a correction every {1e3 * PUBLISHED_PERIOD:g} ms [s]"
                result[f"{label}: {slow}"] = count * PUBLISHED_PERIOD
    return result
