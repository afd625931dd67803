"""Inverse control with contact: random problems against enumeration, and closed loops on finite elements."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.control import InverseQP
from softgym_envs.control.inverse_qp import UNBOUNDED
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.grasping import ContactControl, ContactQP, ForceGoal
from softgym_envs.extensions.grasping.control.qpcc import ComplementarityQP
from softgym_envs.mechanics import CondensedModel
from softgym_envs.mechanics.condensation import Row, point_rows
from softgym_envs.mechanics.contact.obstacles import Cylinder, Plane


@dataclass(frozen=True)
class Problem:
    """One random step of a controller.

    Attributes:
        controller: with limits of displacements and efforts.
        model: condensed model at a state where every contact is either closed or open.
        goal: of the effector [m].
        command: of the actuators [m].
        forces: goals of contact forces.
    """

    controller: ContactQP
    model: CondensedModel
    goal: np.ndarray
    command: np.ndarray
    forces: tuple[ForceGoal, ...]


def random_problem(rng: np.random.Generator, contacts: int, actuators: int | None = None) -> Problem:
    """Return a problem of the size of a real finger: compliances of 1 mm/N, gaps of millimetres, forces of newtons.

    Args:
        rng: random numbers.
        contacts: number of contacts.
        actuators: number of actuators; 1 to 4 by default.
    """
    a = int(rng.integers(1, 5)) if actuators is None else actuators
    size = a + 3 + contacts
    half = rng.normal(size=(size, size + 2))
    W = 1e-3 * half @ half.T / size
    closed = rng.random(contacts) < 0.5
    pressing = np.where(closed, rng.uniform(0.0, 2.0, contacts), 0.0)
    effort = np.concatenate([rng.uniform(0.0, 3.0, a), np.zeros(3), pressing])
    opening = np.where(closed, 0.0, rng.uniform(0.0, 3e-3, contacts))
    command = rng.uniform(0.0, 0.02, a)
    delta = np.concatenate([command, rng.normal(scale=0.02, size=3), opening])
    rows = [Row(f"actuator {k + 1}", "m", "N") for k in range(a)] + point_rows("tip")
    rows += [Row(f"contact {k + 1}", "m", "N") for k in range(contacts)]
    roles = (("a", a), ("e", 3), ("c", contacts))
    model = CondensedModel(W, delta - W @ effort, effort, roles, tuple(rows))
    controller = ContactQP(
        np.zeros(a), np.full(a, 0.02), np.full(a, 5e-3), rng.random(a) < 0.5, max_effort=np.full(a, 10.0)
    )
    forces = ()
    if contacts and rng.random() < 0.5:
        name = rows[-int(rng.integers(1, contacts + 1))].name
        forces = (ForceGoal({name: 1.0}, float(rng.uniform(0.0, 3.0))),)
    return Problem(controller, model, delta[a : a + 3] + rng.normal(scale=4e-3, size=3), command, forces)


def enumerated_optimum(problem: ComplementarityQP, sets: Iterable[Sequence[bool]] | None = None) -> float:
    """Return the smallest objective over sets of closed pairs, by another method; inf if no set is feasible.

    Each set leaves a strictly convex program. Without its equations it is a least-distance problem, which Lawson and
    Hanson (Solving Least Squares Problems, 1974, ch. 23) solve by non-negative least squares.

    Args:
        problem: the problem.
        sets: closed pairs (k,) of each set; default all sets.
    """
    n, k = len(problem.gradient), len(problem.pairs)
    force = np.eye(n)[problem.pairs]
    values = [np.inf]
    for closed in itertools.product((False, True), repeat=k) if sets is None else sets:
        zero = np.array(closed, dtype=bool)
        fixed, tied = problem.lower == problem.upper, problem.rows_lower == problem.rows_upper
        equal = [np.where(zero[:, None], problem.pair_rows, force), np.eye(n)[fixed], problem.rows[tied]]
        to = [np.where(zero, -problem.pair_offset, 0.0), problem.lower[fixed], problem.rows_lower[tied]]
        other = np.where(zero[:, None], force, problem.pair_rows)
        sides = [problem.rows[~tied], -problem.rows[~tied], np.eye(n)[~fixed], -np.eye(n)[~fixed], other]
        ends = [problem.rows_lower[~tied], -problem.rows_upper[~tied], problem.lower[~fixed], -problem.upper[~fixed]]
        ends.append(np.where(zero, 0.0, -problem.pair_offset))
        least = np.concatenate(ends)
        real = least > -0.5 * UNBOUNDED
        found = _least(problem, np.concatenate(equal), np.concatenate(to), np.concatenate(sides)[real], least[real])
        if found is not None:
            values.append(problem.value(found))
    return min(values)


def _least(
    problem: ComplementarityQP, equal: np.ndarray, to: np.ndarray, sides: np.ndarray, least: np.ndarray
) -> np.ndarray | None:
    """Return the optimum with ``equal z = to`` and ``sides z >= least``; None if no point is feasible."""
    _, sizes, vectors = np.linalg.svd(equal)
    free = vectors[int((sizes > 1e-10 * sizes[0]).sum()) :].T
    point = np.linalg.lstsq(equal, to, rcond=1e-10)[0]
    if np.abs(equal @ point - to).max() > 1e-8:
        return None
    slopes, least = sides @ free, least - sides @ point
    some = np.linalg.norm(slopes, axis=1) > 1e-10
    if (least[~some] > 1e-8).any():
        return None
    root = np.linalg.cholesky(free.T @ problem.hessian @ free)
    shift = np.linalg.solve(root, free.T @ (problem.gradient + problem.hessian @ point))
    slopes = np.linalg.solve(root, slopes[some].T)
    system = np.vstack([slopes, least[some] + shift @ slopes])
    norms = np.linalg.norm(system, axis=0)
    goal = np.append(np.zeros(len(shift)), 1.0)
    residual = (system / norms) @ nnls(system / norms, goal, maxiter=1000)[0] - goal
    if abs(residual[-1]) < 1e-12:
        return None
    z = point + free @ np.linalg.solve(root.T, -residual[:-1] / residual[-1] - shift)
    return z if (sides @ (z - point) >= least - 1e-7).all() else None


def random_problems(count: int = 1000, most: int = 5, seed: int = 0) -> dict[str, object]:
    """Controller with 1 to ``most`` contacts: how often it finds the enumerated optimum, and its time."""
    rng = np.random.default_rng(seed)
    # The first call imports the solver.
    warm = random_problem(rng, 1)
    warm.controller.solve(warm.model, warm.goal, warm.command)
    hits, infeasible, seconds, programs, closures = 0, 0, [], [], 0
    for _ in range(count):
        case = random_problem(rng, int(rng.integers(1, most + 1)))
        before = case.model.lambda_.c > 0.0
        started = time.perf_counter()
        try:
            case.controller.solve(case.model, case.goal, case.command, forces=case.forces)
        except ConvergenceError:
            found = np.inf
        else:
            found = case.controller.optimum.value
            programs.append(case.controller.optimum.programs)
            closures += int((case.controller.optimum.closed != before).any())
        seconds.append(time.perf_counter() - started)
        problem = case.controller.problem(case.model, case.goal, case.command, forces=case.forces).program
        best = enumerated_optimum(problem)
        infeasible += int(np.isinf(best))
        hits += int(found == best or found <= best + 1e-6 * abs(best) + 1e-9)
    milliseconds = 1e3 * np.array(seconds)
    return {
        "problems": count,
        "contacts": f"1 to {most}",
        "hit_rate": hits / count,
        "infeasible": infeasible,
        "share_with_contacts_opened_or_closed": closures / max(1, len(programs)),
        "median_ms": float(np.median(milliseconds)),
        "p95_ms": float(np.percentile(milliseconds, 95)),
        "median_programs": float(np.median(programs)),
    }


def many_contacts(counts: tuple[int, ...] = (8, 12, 16), problems: int = 20, seed: int = 1) -> dict[str, object]:
    """Controller with more contacts: time, and how often the optimum is proven."""
    rng = np.random.default_rng(seed)
    results: dict[str, object] = {}
    for count in counts:
        seconds, proven = [], 0
        for _ in range(problems):
            case = random_problem(rng, count, actuators=4)
            started = time.perf_counter()
            case.controller.solve(case.model, case.goal, case.command, forces=case.forces)
            seconds.append(time.perf_counter() - started)
            proven += int(case.controller.optimum.proven)
        results[f"{count}_contacts"] = {"median_ms": 1e3 * float(np.median(seconds)), "proven": proven / problems}
    return results


def force_goal(
    friction: float = 0.0, force: float = 1.0, steps: int = 15, *, modelled: bool = False
) -> dict[str, object]:
    """Soft Finger that starts 25 mm from a rod and presses on it with a given force.

    Args:
        friction: coefficient.
        force: wanted [N].
        steps: of the loop.
        modelled: whether the controller knows friction.
    """
    rod = Cylinder((0.0, 0.055, -0.10), (1.0, 0.0, 0.0), 0.01, name="rod", friction=friction)
    robot = make_robot("finger", obstacles=[rod])
    fem = FEMBackend(robot)
    controller = ContactQP.for_robot(robot, rates=np.full(2, 0.004))
    return _press(ContactControl(fem, controller, friction=modelled), "rod", force, steps)


def hold(friction: float = 0.85, force: float = 1.0, steps: int = 15, *, modelled: bool = False) -> dict[str, object]:
    """Contact-aided finger of measured design 203 that touches itself and holds a plane; see `force_goal`."""
    plane = Plane((0.0631, 0.0, 0.0), (-1.0, 0.0, 0.0), name="object", friction=friction)
    robot = make_robot("contact_aided_finger", obstacles=[plane], self_contact=True)
    lengths = [14.7, 3.2, 9.7, 12.2, 17.3, 13.1, 15.1, 18.1, 28.0, 20.9, 9.0, 18.3, 19.3, 10.6, 18.1]  # mm
    names = ["e1", "e2", "e3", *(f"d{k}" for k in range(12))]
    fem = FEMBackend(robot, {name: 1e-3 * length for name, length in zip(names, lengths, strict=True)})
    controller = ContactQP.for_robot(robot, rates=np.full(1, np.radians(3.0)))
    return _press(ContactControl(fem, controller, friction=modelled), "object", force, steps)


def _press(loop: ContactControl, name: str, force: float, steps: int) -> dict[str, object]:
    forces, predicted = [], []
    for _ in range(steps):
        state = loop.step(None, forces=[ForceGoal({name: 1.0}, force)])
        assert state.contacts is not None
        forces.append(float(state.contacts.pressing.sum()))
        predicted.append(float(loop.controller.contact_force.sum()))
    errors = np.abs(np.array(forces) / force - 1.0)
    within = np.flatnonzero(errors > 0.01)
    return {
        "force_N": forces[-1],
        "relative_error": float(errors[-1]),
        "largest_error_of_a_prediction_N": float(np.abs(np.array(forces) - predicted).max()),
        "steps_to_1_percent": int(within[-1]) + 2 if len(within) else 1,
    }


TRUNK_GOAL = np.array([0.0273, 0.0, 0.155])
"""Between the trunk and the wall, 40 mm below the tip at rest [m]."""


def _pull(length: float) -> np.ndarray:
    """Command of the trunk [m], shape (8,): one long cable is pulled, the others are paid out."""
    return np.where(np.arange(8) == 3, length, -0.03)


def reach_along_wall(
    friction: float = 0.0, steps: int = 20, layers: int = 24, *, modelled: bool = False
) -> dict[str, object]:
    """Trunk that slides its tip along a wall to a goal which it cannot reach without the wall.

    Only the long cable towards the wall pulls, and the others are paid out, so without the wall the tip stays on one
    curve. Both controllers have the same limits, rates and weights.
    """
    limits = {
        "lower": _pull(0.0),
        "upper": _pull(0.035),
        "rates": np.full(8, 0.004),
        "effort_weight": 1e-7,
    }
    wall = Plane((0.03, 0.0, 0.0), (-1.0, 0.0, 0.0), name="wall", friction=friction)
    results: dict[str, object] = {}
    for name, obstacles in (("without_wall", []), ("with_wall", [wall])):
        fem = FEMBackend(make_robot("cable_trunk", obstacles=obstacles, layers=layers))
        state = fem.step(_pull(0.0))
        plain = InverseQP.for_robot(fem.robot, **limits)
        loop = ContactControl(fem, ContactQP.for_robot(fem.robot, **limits), friction=modelled)
        distances = []
        for _ in range(steps):
            if obstacles:
                state = loop.step(TRUNK_GOAL)
            else:
                state = fem.step(plain.solve(state.condensed, TRUNK_GOAL, state.command, state.slack))
            distances.append(1e3 * float(np.linalg.norm(state.effector - TRUNK_GOAL)))
        results[f"{name}_final_mm"] = distances[-1]
        results[f"{name}_smallest_mm"] = min(distances)
        if state.contacts is not None:
            results["wall_force_N"] = float(state.contacts.pressing.sum())
    return results


def distance_without_wall(samples: int = 36, layers: int = 24) -> float:
    """Smallest distance [mm] from the goal to the curve of the trunk's tip without the wall."""
    fem = FEMBackend(make_robot("cable_trunk", layers=layers))
    tips = np.array([fem.step(_pull(length)).effector[0] for length in np.linspace(0.0, 0.035, samples)])
    return 1e3 * float(np.linalg.norm(tips - TRUNK_GOAL, axis=1).min())


def contact_control(count: int = 1000) -> dict[str, object]:
    """Inverse control with contact: random problems against enumeration, and closed loops on finite elements."""
    return {
        "random_problems": random_problems(count),
        "many_contacts": many_contacts(),
        "force_goal": force_goal(),
        "force_goal_with_friction": force_goal(0.5),
        "hold_with_contact_aided_finger": hold(),
        "reach_along_wall": reach_along_wall(),
        "reach_along_wall_with_friction": reach_along_wall(0.3),
        "distance_of_the_curve_without_wall_mm": distance_without_wall(),
    }
