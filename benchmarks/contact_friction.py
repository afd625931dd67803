"""Inverse control with contact and friction: random problems against enumeration, and loops on finite elements.

``python -m benchmarks.contact_friction`` prints one JSON object.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Iterator
from dataclasses import replace

import click
import numpy as np

from benchmarks.contact_control import Problem, enumerated_optimum, random_problem
from softgym_envs.control import ContactQP
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.condensation import ContactModel, Row

SIZES = {1: 250, 2: 250, 3: 250, 4: 150, 5: 100}
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
