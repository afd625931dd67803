"""Whether a state of a body of learned parts may be trusted, and how far off its effector may be."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_matrix

from softgym_envs.extensions.beams.elements import PoseParts
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.domain import OUTSIDE, SOFT, SPREAD

SOFTEST = 100.0
"""Smallest stiffness of a trusted state while its actuators are held, over that of a part: EI / L^3. Spins count as
motions of a point at the robot's `workspace_scale`."""


class Judged(NamedTuple):
    """What is known of the errors of a state.

    Attributes:
        uncertainty: how far the errors of the parts may put the first effector off [m].
        stiffness: smallest stiffness while the actuators are held, over that of a part.
        known: whether all parts are at poses and under loads that they have learned.
        distrust: why the state is not trusted, as `surrogate.domain.DISTRUST_REASONS`; 0 for a trusted one.
    """

    uncertainty: float
    stiffness: float
    known: bool
    distrust: int


def judge(
    statics: Statics,
    robot: Robot,
    x: np.ndarray,
    effort: np.ndarray,
    held: np.ndarray,
    *,
    limit: float = np.inf,
    before: int = 0,
) -> Judged:
    """Judge a state of a body of parts, whether it moves or not.

    An error of the wrench of a part moves the effector by its work along the motion that a unit force on the effector
    causes while the actuators are held.

    A body that was soft on its way may have taken another branch of equilibria than finite elements, on which it is
    stiff again: it remains untrusted until it rests.

    Args:
        statics: solver of the body, whose state it leaves as it is.
        robot: of the body.
        x: rows, shape (n, 3).
        effort: of all constraints, shape (size,).
        held: which actuators are held, shape (n_a,).
        limit: largest uncertainty of a trusted state [m], besides the robot's goal tolerance.
        before: distrust of the state that it came from, 0 from rest.
    """
    model, linear = statics.model, statics.linearisation
    assembled = linear.assemble(x, effort)
    assert assembled is not None and assembled.tangent is not None
    n = len(assembled.residual)
    lower = csc_matrix((assembled.tangent, linear.assembly.indices, linear.assembly.indptr), shape=(n, n)).toarray()
    tangent = lower + np.tril(lower, -1).T
    scale = np.ones(n)
    spins = model.kinematics.spin_number
    scale[spins[spins >= 0]] = 1.0 / robot.workspace_scale
    driven = np.flatnonzero(held)
    columns = scale[:, None] * assembled.gradients[:, driven]
    free = np.linalg.qr(columns, mode="complete")[0][:, len(driven) :] if len(driven) else np.eye(n)
    motions = scale[:, None] * free
    values, vectors = np.linalg.eigh(motions.T @ tangent @ motions)
    motions = motions @ vectors
    first = dict(model.roles).get("a", 0)
    unit = (motions / values) @ (motions.T @ assembled.gradients[:, first : first + 3])
    fields = np.stack([model.kinematics.row_velocity(x, field) for field in unit.T])
    parts = [block for block in model.blocks if isinstance(block, PoseParts)]
    total = sum((block.possible_errors(x, fields) ** 2).sum() for block in parts)
    uncertainty = float(np.sqrt(total))
    stiffness = float(values[0] / max(block.scale / block.length**2 for block in parts))
    known = all(block.knows(x) for block in parts)
    distrust = before & SOFT | (0 if known else OUTSIDE)
    if not stiffness > SOFTEST:
        distrust |= SOFT
    if not uncertainty <= min(limit, robot.goal_tolerance):
        distrust |= SPREAD
    return Judged(uncertainty, stiffness, known, distrust)
