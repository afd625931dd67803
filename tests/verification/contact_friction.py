"""Inverse control with contact and friction: random problems against enumeration, and loops on finite elements."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.control import InverseQP
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.grasping import ContactControl, ContactQP
from softgym_envs.mechanics.condensation import ContactModel, Row
from tests.verification.contact_control import (
    Problem,
    enumerated_optimum,
    force_goal,
    hold,
    random_problem,
    reach_along_wall,
)

SIZES = {1: 300, 2: 300, 3: 300, 4: 80, 5: 20}
"""Random problems by their number of contacts."""


def random_friction_problem(rng: np.random.Generator, contacts: int, directions: int = 1) -> Problem:
    """Return a problem as `random_problem` does, with friction; contacts are open, stick, or slide.

    Args:
        rng: random numbers.
        contacts: number of contacts.
        directions: of friction at each contact.
    """
    plain = random_problem(rng, contacts)
    model = plain.model
    t = contacts * directions
    size = len(model.free) + t
    half = rng.normal(size=(size, size + 2))
    W = 1e-3 * half @ half.T / size
    owner = np.repeat(np.arange(contacts), directions)
    coefficient = rng.uniform(0.1, 1.0, contacts)
    limit = (coefficient * model.lambda_.c)[owner]
    share = np.where(rng.random(t) < 0.5, rng.uniform(-1.0, 1.0, t), rng.choice([-1.0, 1.0], t))
    effort = np.concatenate([model.effort, share * limit])
    delta = np.concatenate([model.delta.array, np.zeros(t)])
    rows = (*model.rows, *(Row(f"slip {k + 1}", "m", "N") for k in range(t)))
    rubbing = ContactModel(
        W,
        delta - W @ effort,
        effort,
        (*model.roles, ("t", t)),
        rows,
        coefficient=coefficient,
        owner=owner,
        hold=np.zeros(contacts + t),
    )
    return replace(plain, model=rubbing)


def states_of_contacts(owner: np.ndarray, contacts: int) -> Iterator[np.ndarray]:
    """Return the closed pairs of every state: each contact is open, or sticks or slides in each of its directions."""
    sticks, slides_back, slides_on = (True, False), (True, True), (False, False)
    of = [np.flatnonzero(owner == k) for k in range(contacts)]
    choices = [[None, *itertools.product((sticks, slides_back, slides_on), repeat=len(rows))] for rows in of]
    for chosen in itertools.product(*choices):
        closed = np.zeros(contacts + 2 * len(owner), dtype=bool)
        for k, states in enumerate(chosen):
            closed[k] = states is not None
            # Friction of an open contact is at both limits, which are zero.
            for row, state in zip(of[k], [(False, True)] * len(of[k]) if states is None else states, strict=True):
                closed[contacts + row], closed[contacts + len(owner) + row] = state
        yield closed


def random_problems(sizes: dict[int, int] | None = None, directions: int = 1, seed: int = 0) -> dict[str, object]:
    """Controller with friction: how often it finds the enumerated optimum, and its time.

    Args:
        sizes: problems by their number of contacts.
        directions: of friction at each contact.
        seed: of the problems.
    """
    rng = np.random.default_rng(seed)
    warm = random_friction_problem(rng, 1, directions)
    warm.controller.solve(warm.model, warm.goal, warm.command)
    results: dict[str, object] = {}
    every_hit, every_time = [], []
    for contacts, count in (SIZES if sizes is None else sizes).items():
        hits, seconds, infeasible, changed, slid = [], [], 0, 0, 0
        for _ in range(count):
            case = random_friction_problem(rng, contacts, directions)
            model, qp = case.model, case.controller
            assert isinstance(model, ContactModel)
            started = time.perf_counter()
            try:
                qp.solve(model, case.goal, case.command, forces=case.forces)
            except ConvergenceError:
                found = np.inf
            else:
                found = qp.optimum.value
                changed += int(((qp.contact_force > 1e-9) != (model.lambda_.c > 0.0)).any())
                slid += int((np.abs(qp.slip) > 1e-9)[qp.contact_force[model.owner] > 1e-9].any())
            seconds.append(time.perf_counter() - started)
            problem = qp.problem(model, case.goal, case.command, forces=case.forces).program
            best = enumerated_optimum(problem, states_of_contacts(model.owner, contacts))
            infeasible += int(np.isinf(best))
            hits.append(bool(found == best or found <= best + 1e-6 * abs(best) + 1e-9))
        milliseconds = 1e3 * np.array(seconds)
        results[f"{contacts} contacts"] = {
            "problems": count,
            "hit_rate": float(np.mean(hits)),
            "infeasible": infeasible,
            "share_with_contacts_opened_or_closed": changed / count,
            "share_with_sliding": slid / count,
            "median_ms": float(np.median(milliseconds)),
            "p95_ms": float(np.percentile(milliseconds, 95)),
        }
        every_hit += hits
        every_time += milliseconds.tolist()
    results["all"] = {
        "problems": len(every_hit),
        "hit_rate": float(np.mean(every_hit)),
        "median_ms": float(np.median(every_time)),
        "p95_ms": float(np.percentile(every_time, 95)),
    }
    return results


def carry(controller: str, goals: int = 6, calls: int = 3, friction: float = 0.6) -> dict[str, object]:
    """Three fingers that hold a cube by friction and carry its centre along a circle of radius 1 mm.

    Args:
        controller: ``"friction"``, which knows stick and slide; or ``"inverse QP"`` on the compliance of the grip as it
            is, with no lower limit of the cables' forces or, as ``"inverse QP, 1 N"``, with one.
        goals: on the circle; four more lead there.
        calls: of the controller for each goal.
        friction: coefficient between cube and fingers.
    """
    robot = make_robot("three_finger_friction_gripper", friction=friction)
    fem = FEMBackend(robot)
    for pull in np.linspace(0.5e-3, 2e-3, 4):
        state = fem.step(np.full(6, pull))
    rates = np.full(6, 4e-4)
    loop = ContactControl(fem, ContactQP.for_robot(robot, rates=rates), friction=True)
    least = np.ones(6) if controller.endswith("1 N") else None
    plain = InverseQP.for_robot(robot, rates=rates, min_effort=least)
    circle = robot.reference_path(goals)
    errors, smallest, seconds, steps, end = [], np.inf, 0.0, 0, "held"
    try:
        for goal in np.vstack([np.linspace(state.effector[0], circle[0], 5)[1:], circle]):
            for _ in range(calls):
                started = time.process_time()
                if controller == "friction":
                    state = loop.step(goal)
                else:
                    state = fem.step(plain.solve(state.condensed, goal, state.command, state.slack))
                seconds, steps = seconds + time.process_time() - started, steps + 1
                assert state.contacts is not None
                smallest = min(smallest, float(state.contacts.pressing.sum()))
            errors.append(1e6 * float(np.linalg.norm(state.effector[0] - goal)))
    except ConvergenceError:
        end = "lost"
    return {
        "goals": len(errors[4:]),
        "end": end,
        "mean_um": float(np.mean(errors[4:])) if errors[4:] else np.nan,
        "largest_um": float(np.max(errors[4:], initial=0.0)),
        "smallest_sum_of_normal_forces_N": smallest,
        "cpu_s_per_step": seconds / max(1, steps),
    }


def contact_friction() -> dict[str, object]:
    """Inverse control with contact and friction: random problems against enumeration, and loops on finite elements."""
    known, unknown = {"modelled": True}, {"modelled": False}
    return {
        "one_direction": random_problems(),
        "two_directions": random_problems({1: 100, 2: 100, 3: 10}, 2),
        "force_goal": {"friction": force_goal(0.5, **known), "no friction": force_goal(0.5, **unknown)},
        "hold_with_contact_aided_finger": {"friction": hold(**known), "no friction": hold(**unknown)},
        "reach_along_wall": {
            "friction": reach_along_wall(0.3, **known),
            "no friction": reach_along_wall(0.3, **unknown),
        },
        "carry_cube": {name: carry(name) for name in ("friction", "inverse QP", "inverse QP, 1 N")},
    }
