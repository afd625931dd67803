"""The controller in C: its quadratic program against ProxQP, its commands against `EmbeddedLoop` on the same model."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from functools import partial

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.surrogate import SurrogateBackend, solve_displacements
from softgym_envs.control import InverseQP, PICorrection
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.deployment import EmbeddedLoop
from softgym_envs.extensions.deployment.controller_c import export_controller_c
from softgym_envs.extensions.deployment.embedded import settle
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.surrogate.pretrained import pretrained_model, shipped_robots

CC = shutil.which("cc") or shutil.which("gcc")
pytestmark = pytest.mark.skipif(CC is None, reason="no C compiler")

WRAPPER = """#include "controller.h"
int condensed(const float *q, float *f, float *x, float *W) { return bot_condensed(q, f, x, W); }
int start(bot_controller *c) { return bot_controller_start(c); }
int step(bot_controller *c, const double *goal, const double *measured, double *command)
{
    return bot_controller_step(c, goal, measured, command);
}
int size(void) { return (int)sizeof(bot_controller); }
int qp(double *H, const double *g, const double *low, const double *high, double *R, double *x)
{
    return bot_qp((double (*)[BOT_ACTUATORS])H, g, low, high, (double (*)[BOT_ACTUATORS])R, x);
}
"""
FLAGS = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O2"]
ROBOTS = {k: make_robot(name, **options) for k, (name, options) in shipped_robots().items()}
CONVEX = {k: v for k, v in shipped_robots().items() if ROBOTS[k].learning.convex and not ROBOTS[k].sensing}


def pointers(*arrays):
    return [ctypes.c_void_p(None if array is None else array.ctypes.data) for array in arrays]


class Compiled:
    """The header of a robot's controller as a shared library."""

    def __init__(self, model, folder, **options):
        self.model = model
        header, _ = export_controller_c(model, None, folder, name="bot", **options)
        (folder / "wrapper.c").write_text(WRAPPER)
        library = folder / "controller.so"
        command = [CC, *FLAGS, "-shared", "-fPIC", str(folder / "wrapper.c"), "-o", str(library), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        self.library = ctypes.CDLL(str(library))
        self.text = header.read_text()
        self.struct = ctypes.create_string_buffer(self.library.size())
        assert self.library.start(self.struct) == 0

    def set_state(self, struct, command, displacement, correction):
        n, e = self.model.count, self.model.effectors
        values = np.frombuffer(struct, dtype=float, count=3 * n + 2 * e).copy()
        values[: 2 * n], values[3 * n + e :] = np.concatenate([command, displacement]), correction
        ctypes.memmove(struct, values.ctypes.data, values.nbytes)

    def step(self, goal, measured=None, struct=None):
        command = np.full(self.model.count, np.nan)
        goal = np.ascontiguousarray(goal, dtype=float)
        seen = None if measured is None else np.ascontiguousarray(measured, dtype=float)
        status = self.library.step(struct or self.struct, *pointers(goal, seen, command))
        return status, command

    def condensed(self, displacement):
        n, e = self.model.count, self.model.effectors
        q = np.asarray(displacement, dtype=np.float32)
        effort, effector, W = np.empty(n, np.float32), np.empty(e, np.float32), np.empty((n + e, n + e), np.float32)
        assert self.library.condensed(*pointers(q, effort, effector, W)) == 0
        W = W.astype(float)
        full = np.concatenate([effort, np.zeros(e)])
        return CondensedModel(W, np.concatenate([displacement, effector]) - W @ full, full, self.model.roles)


class Tight(InverseQP):
    """With 1e-11, ProxQP is inaccurate by 1e-5 of the ranges for eight cables on one effector."""

    def _make_qp(self):
        qp = super()._make_qp()
        qp.settings.eps_abs = 1e-13
        return qp


def drives(robot):
    """The controllers of a robot by displacement and by effort."""
    count = len(robot.actuators)
    most = 0.5 * robot.effort_scale
    by_effort = {
        "rates": np.full(count, np.inf),
        "max_effort": most,
        "effort_rates": 0.05 * most,
        "mode": "effort",
    }
    return {
        "displacement": partial(Tight.for_robot, robot),
        "effort": partial(Tight.for_robot, robot, **by_effort),
    }


def random_path(model, rng, goals=6):
    """Effectors of random commands of half the range: some of their cables are slack."""
    robot = model.robot
    context = model.context(robot.design_space.baseline.array[None])
    commands = robot.lower + rng.uniform(0.0, 0.5, (goals, model.count)) * (robot.upper - robot.lower)
    found = solve_displacements(
        model, context.shared(context, goals), commands, np.zeros_like(commands), robot.unilateral
    )
    assert found.converged.all()
    return found.effector


@pytest.fixture(scope="module", params=list(CONVEX))
def compiled(request, tmp_path_factory):
    """A shipped model with its controllers by displacement and by effort, compiled."""
    name, options = CONVEX[request.param]
    model = pretrained_model(make_robot(name, **options), members=1)
    return {
        drive: (Compiled(model, tmp_path_factory.mktemp(drive), controller=make(), members=1), make)
        for drive, make in drives(model.robot).items()
    }


@pytest.mark.parametrize("drive", ["displacement", "effort"])
@pytest.mark.parametrize("closed", [False, True], ids=["open", "closed"])
def test_the_commands_are_those_of_the_python_loop(compiled, drive, closed):
    """On the same model, step by step from the same state, and along the whole path.

    The model rounds displacements to single precision, so differences of 1e-16 can grow to 1e-7 of the range in a step.
    """
    machine, make = compiled[drive]
    assert machine.library.start(machine.struct) == 0
    single = ctypes.create_string_buffer(machine.library.size())
    assert machine.library.start(single) == 0
    loop, rng = EmbeddedLoop(machine.condensed, make(), PICorrection()), np.random.default_rng(3)
    unit = machine.model.robot.effort_scale if drive == "effort" else machine.model.robot.upper
    along, alone, slacks = [], [], 0
    for goal in random_path(machine.model, rng):
        for _ in range(15):
            # In the closed loop the measurement has a noise of 1 mm.
            measured = loop.predicted + rng.normal(0.0, 1e-3, goal.shape) if closed else None
            correction = np.zeros(3) + loop.correction.correction
            machine.set_state(single, loop.command, loop.displacement, correction)
            expected = loop.step(goal, measured)
            for struct, differences in ((machine.struct, along), (single, alone)):
                status, command = machine.step(goal, measured, struct)
                assert status == 0
                differences.append(float(np.abs((command - expected) / unit).max()))
            slacks += bool((loop.displacement > loop.command + 1e-2 * machine.model.robot.rates).any())
    print(
        f"largest difference of a step {max(alone):.1e} of the range, along the path {max(along):.1e}; {slacks} slack"
    )
    assert max(alone) < 1e-6
    assert max(along) < 3e-5
    assert np.abs(command).max() > 1e-2 * unit.max()


def test_slack_cables_are_found_from_random_commands(compiled):
    """One step from each random command, against the loop in Python, whose slack cables are those of the backend."""
    machine, make = compiled["displacement"]
    model, rng = machine.model, np.random.default_rng(7)
    robot, backend = model.robot, SurrogateBackend(model.robot, members=1)
    loop, struct, slack = EmbeddedLoop(machine.condensed, make()), ctypes.create_string_buffer(1000), 0
    goal = random_path(model, rng, 1)[0]
    for _ in range(20):
        assert machine.library.start(struct) == 0
        commanded = robot.lower + 0.4 * rng.uniform(size=model.count) * (robot.upper - robot.lower)
        state = backend.step(commanded)
        condensed, loose = settle(machine.condensed, loop.controller, commanded, commanded)
        assert (loose == state.slack).all()
        assert np.abs(condensed.delta.a - state.displacement).max() < 5e-3 * robot.rates.max()
        loop.command = loop.displacement = commanded
        machine.set_state(struct, commanded, commanded, np.zeros(3))
        try:
            expected = loop.step(goal)
        except ConvergenceError:
            assert machine.step(goal, None, struct)[0] == 3
            continue
        status, command = machine.step(goal, None, struct)
        assert status == 0
        assert np.abs((command - expected) / robot.upper).max() < 1e-6
        slack += bool(loose.any())
    assert slack > 5 or model.count == 1 or not robot.unilateral.any()


def test_the_commands_lead_the_python_model_to_the_goal(compiled):
    """End to end in single precision: the loop in C against the surrogate backend under its commands."""
    machine, _ = compiled["displacement"]
    assert machine.library.start(machine.struct) == 0
    model = machine.model
    plant = SurrogateBackend(model.robot, members=1)
    weights = np.ones(model.effectors) if len(model.robot.effectors) > 1 else np.asarray(model.robot.goal_axes)
    goal = random_path(model, np.random.default_rng(5), 1)[0]
    for _ in range(40):
        status, command = machine.step(goal, plant.state.effector.ravel())
        assert status == 0
        plant.step(command)
    assert np.linalg.norm(weights * (plant.state.effector.ravel() - goal)) < 2e-4


def proxqp(H, g, R, low, high):
    """Solution of ProxQP."""
    from proxsuite import proxqp as solver

    n = len(g)
    qp = solver.dense.QP(n, 0, n, True)
    qp.settings.eps_abs, qp.settings.eps_rel, qp.settings.max_iter = 1e-13, 0.0, 5000
    qp.init(H, g, None, None, R, low[n:], high[n:], low[:n], high[:n])
    qp.solve()
    assert qp.results.info.status == solver.QPSolverOutput.PROXQP_SOLVED
    return qp.results.x


@pytest.mark.parametrize("case", ["finger_2cables", "diamond", "cable_trunk"])
def test_the_quadratic_program_agrees_with_other_solvers(case, tmp_path):
    """Random problems of order one, with condition numbers up to 1e2, in which up to n constraints are active.

    ProxQP does not solve those with a fixed variable, and differs from DAQP by up to 2e-8 in some of the others.
    """
    import daqp

    name, options = CONVEX[case]
    machine = Compiled(pretrained_model(make_robot(name, **options), members=1), tmp_path, members=1)
    n, rng = machine.model.count, np.random.default_rng(1)
    differences, active = {"DAQP": [], "ProxQP": []}, []
    for problem in range(300):
        modes = np.linalg.qr(rng.normal(size=(n, n)))[0]
        H = (modes * 10.0 ** rng.uniform(-2.0, 0.0, n)) @ modes.T
        H = 0.5 * (H + H.T) / np.trace(H)
        g, R = rng.normal(size=n) * 10.0 ** rng.uniform(-3, 0), rng.normal(size=(n, n))
        inside = rng.uniform(-0.5, 0.5, n)
        middle = np.concatenate([inside, R @ inside])
        low, high = middle - rng.uniform(0.0, 1.0, 2 * n), middle + rng.uniform(0.0, 1.0, 2 * n)
        fixed = problem % 5 == 0
        if fixed:
            low[0] = high[0] = middle[0]
        x = np.full(n, np.nan)
        assert machine.library.qp(*pointers(H.copy(), g, low, high, R.copy(), x)) == 0
        values = np.concatenate([x, R @ x])
        assert (values > low - 2e-11).all() and (values < high + 2e-11).all()
        active.append(int(((values < low + 1e-9) | (values > high - 1e-9)).sum()))
        sense = np.zeros(2 * n, dtype=np.int32)
        z, _, status, _ = daqp.solve(H, g, R, high, low, sense, primal_tol=1e-12, dual_tol=1e-12)
        assert status == 1
        differences["DAQP"].append(np.abs(x - z).max())
        if not fixed:
            differences["ProxQP"].append(np.abs(x - proxqp(H, g, R, low, high)).max())
    print(n, {key: f"{max(found):.1e}" for key, found in differences.items()}, f"{min(active)} to {max(active)} active")
    assert min(active) < n <= max(active)
    assert max(differences["DAQP"]) < 1e-9
    assert np.quantile(differences["ProxQP"], 0.95) < 1e-8
    assert max(differences["ProxQP"]) < 1e-7


def test_a_program_without_a_solution_is_reported(tmp_path):
    machine = Compiled(pretrained_model(make_robot("finger"), members=1), tmp_path, members=1)
    R = np.array([[1.0, 1.0], [1.0, -1.0]])
    low, high = np.array([0.0, 0.0, -3.0, -1.0]), np.array([1.0, 1.0, -2.0, 1.0])
    x = np.zeros(2)
    assert machine.library.qp(*pointers(np.eye(2), np.zeros(2), low, high, R, x)) == 1
    assert machine.library.qp(*pointers(-np.eye(2), np.zeros(2), low, high, R, x)) == 2
    # Measurements that are not finite leave the command alone.
    status, command = machine.step([0.0, 0.0, -0.1], [np.nan, 0.0, 0.0])
    assert status == 1 and np.isnan(command).all()


def test_the_example_runs_and_reaches_its_goal(tmp_path, softgym):
    """As its first comment says, written by the command line."""
    status, out, _ = softgym("deploy", "finger", "--controller", tmp_path / "out", "--members", 1)
    assert status == 0 and "main.c" in out
    text = (tmp_path / "out" / "main.c").read_text()
    line = re.search(r"cc (-std=c99 .*main -lm) &&", text)
    assert line is not None
    subprocess.run([CC, "-Wall", "-Wextra", "-Werror", *line[1].split()], cwd=tmp_path / "out", check=True)
    done = subprocess.run(["./main"], cwd=tmp_path / "out", capture_output=True, text=True, check=True).stdout
    found = re.match(r"status 0, ([0-9.]+) mm from the goal", done)
    assert found is not None and float(found[1]) < 0.01
