"""Learning the inertia of a robot from the reduced motion of finite elements about equilibria."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.linalg import block_diag, eigh

from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.executors import parallel_map
from softgym_envs.extensions.fitting.data.sampling import SamplingPlan, solve_path
from softgym_envs.extensions.fitting.reduction import reduce_motion
from softgym_envs.extensions.motion.inertia import (
    LearnedInertia,
    Polynomials,
    half_stiffness,
    to_entries,
    typical_sizes,
)
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.features import Features
from softgym_envs.surrogate.weight_files import card_of

TESTED = 8
"""One of so many bodies is left out of the fit and tests it."""
RIDGE = 1e-3
"""Weight of the squares of the coefficients [squared error of an entry of one state], which keeps them small where few
states are."""


@dataclass(frozen=True)
class Periods:
    """Equilibria of bodies on finite elements.

    Attributes:
        design: shape (B, number of design variables).
        displacement: reached displacements, shape (B, n_a).
        compliance: ``W``, shape (B, n, n).
        periods: squared periods ``P`` [s2], shape (B, 2 n, 2 n).
    """

    design: np.ndarray
    displacement: np.ndarray
    compliance: np.ndarray
    periods: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence[Periods]) -> Periods:
        """Return the states of all parts."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))


def sample_periods(robot: Robot, plan: SamplingPlan, group: int) -> Periods | None:
    """Return the squared periods of one body at rest and under commands.

    Unstable states are left out. None for a body that is infeasible or without a stable state.
    """
    try:
        design = plan.designs(robot, group, 1)[0]
        statics = Statics(robot.build(design))
        rest = statics.solve(np.zeros(len(robot.actuators)))
    except (InfeasibleDesign, ConvergenceError):
        return None
    rows: list[tuple[np.ndarray, ...]] = []
    sizes = typical_sizes(robot)
    commands = np.concatenate([np.zeros((1, len(robot.actuators))), plan.commands(robot, group)])
    for _, equilibrium in solve_path(robot, statics, rest, commands):
        if equilibrium is None or not equilibrium.stable:
            continue
        try:
            reduced = reduce_motion(statics, inner=True, units=sizes)
        except ConvergenceError:
            continue
        n = len(reduced.mass) // 2
        W = np.linalg.inv(reduced.stiffness[:n, :n])
        W = 0.5 * (W + W.T)
        scale = block_diag(np.linalg.inv(half_stiffness(W, sizes)), np.eye(n))
        rows.append((design.array, equilibrium.delta[: len(robot.actuators)], W, scale @ reduced.mass @ scale.T))
    return Periods(*(np.stack(column) for column in zip(*rows, strict=True))) if rows else None


def fit_inertia(
    robot: Robot, *, bodies: int = 128, states: int = 4, degree: int = 3, workers: int = 1, progress: bool = False
) -> LearnedInertia:
    """Learn the inertia of a robot.

    Args:
        robot: a robot without contact and bonds.
        bodies: how many are drawn; one of eight is left out of the fit to test it.
        states: random commands per design, in addition to rest.
        degree: of the polynomials.
        workers: processes.
        progress: show a progress bar.

    Returns:
        The inertia; its card holds the errors of the two lowest frequencies with held actuators, of the bodies left
        out.

    Raises:
        ValueError: if too few bodies can exist for a fit.
    """
    from tqdm import tqdm

    terms = Polynomials(Features(robot).design_size + len(robot.actuators), degree).count
    _check_states(bodies, states, degree, terms, (bodies - bodies // TESTED) * (states + 1))
    plan = SamplingPlan(bodies, states, boundary=0.25)
    jobs = [(robot, plan, group) for group in range(bodies)]
    results = parallel_map(sample_periods, jobs, workers)
    found = [part for part in tqdm(results, "bodies", bodies, disable=not progress, leave=False) if part is not None]
    # Processes finish in any order.
    found = sorted(found, key=lambda part: tuple(part.design[0]))
    found = [found[k] for k in np.random.default_rng(0).permutation(len(found))]
    count = len(found) // TESTED
    if not count:
        raise ValueError(f"bodies = {bodies} gave {len(found)} bodies with stable states; at least {TESTED} are needed")
    tested, taught = Periods.joined(found[:count]), Periods.joined(found[count:])
    order = taught.periods.shape[1]
    card = {**card_of(robot, "inertia"), "bodies": len(found) - count, "states": len(taught.design)}
    _check_states(bodies, states, degree, terms, len(taught.design))
    inertia = LearnedInertia(robot, np.zeros((terms, order * (order + 1) // 2)), degree, card)
    body = inertia.body(taught.design)
    monomials = inertia.monomials(inertia.inputs(body, taught.displacement))
    wanted = to_entries(taught.periods * body[:, -1, None, None])
    penalty = RIDGE * np.eye(terms)
    penalty[0, 0] = 0.0
    inertia.coefficients = np.linalg.solve(monomials.T @ monomials + penalty, monomials.T @ wanted)
    errors = frequency_errors(inertia, tested)
    inertia.card |= {
        "tested_bodies": count,
        "mean_frequency_error": float(errors.mean()),
        "largest_frequency_error": float(errors.max()),
    }
    return inertia


def _check_states(bodies: int, states: int, degree: int, terms: int, count: int) -> None:
    if terms > count:
        raise ValueError(
            f"bodies = {bodies} with {states} commands each give {count} states to learn from; degree = {degree} needs "
            f"at least {terms}"
        )


def frequency_errors(inertia: LearnedInertia, states: Periods) -> np.ndarray:
    """Return the relative errors of the two lowest frequencies with held actuators (B, 2), with the W of FEM."""
    n, count = states.compliance.shape[1], len(inertia.robot.actuators)
    scale = np.tile(np.eye(2 * n), (len(states.design), 1, 1))
    scale[:, :n, :n] = half_stiffness(states.compliance, inertia.sizes)
    turned = scale.swapaxes(1, 2)
    # In these units eigenvalues of robots whose actuators are volumes keep their digits.
    units = np.concatenate([inertia.sizes, np.ones(n)])
    stiffness = (units[:, None] * (scale @ turned) * units)[:, count:, count:]
    predicted = inertia.periods(inertia.body(states.design), states.displacement)
    squares = []
    for periods in (states.periods, predicted):
        mass = (units[:, None] * (scale @ periods @ turned) * units)[:, count:, count:]
        squares.append(
            [eigh(K, M, eigvals_only=True, subset_by_index=[0, 1]) for K, M in zip(stiffness, mass, strict=True)]
        )
    true, found = np.array(squares)
    return np.abs(np.sqrt(found / true) - 1.0)
