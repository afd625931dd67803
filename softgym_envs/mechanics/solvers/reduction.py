"""Mass, damping and stiffness of a body in the coordinates of its condensed model: static reduction (Guyan 1965).

If constraint values change by ``d delta`` and everything else stays in equilibrium, the equations move by
``T d delta`` with the static modes ``T = A^-1 H W^-1``. Motion in these coordinates alone has the mass ``T^T M T``, the
damping ``T^T D T`` and the stiffness ``T^T A T = W^-1``. Motions of the body that leave all constraint values unchanged
are left out, so natural frequencies are upper bounds of those of the body.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.assembly import MassAndDamping
from softgym_envs.mechanics.solvers.schemes import StartingAcceleration
from softgym_envs.mechanics.solvers.statics import Statics

DEPENDENT = 1e-10
"""Eigenvalue of the scaled compliance below which constraint values count as dependent."""


@dataclass(frozen=True)
class ReducedMotion:
    """Linear motion about an equilibrium, in the n constraint values of a body (those of bonds too).

    Attributes:
        mass: ``T^T M T``, shape (n, n), symmetric and positive definite [effort unit s2 / displacement unit].
        damping: ``T^T D T``, shape (n, n), symmetric and positive semidefinite [effort unit s / displacement unit].
        stiffness: ``W^-1``, shape (n, n) [effort unit / displacement unit].
        modes: ``T``, motion of the equations for each constraint value, shape (N, n).
    """

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    modes: np.ndarray


def reduce_motion(statics: Statics, *, mass_damping: float = 0.0, stiffness_damping: float = 0.0) -> ReducedMotion:
    """Return mass, damping and stiffness of a body about the present state of its solver.

    Args:
        statics: solver of a body without contact and without friction of cables, at an equilibrium.
        mass_damping: Rayleigh's alpha [1/s].
        stiffness_damping: Rayleigh's beta [s].

    Raises:
        ConvergenceError: if the tangent is singular.
        ValueError: for a body with contact or with friction of cables, whose ``W`` is not symmetric, and for
            constraint values that depend on each other.
    """
    linear, model, x = statics.linearisation, statics.model, statics.x
    if linear.contact is not None or linear.cable_friction is not None:
        raise ValueError("motion is reduced only for bodies without contact and without friction of cables")
    if not linear.update(x, statics.effort, exact=True):
        raise ConvergenceError("the tangent is singular, so the body has no static modes", fraction=0.0)
    size = np.sqrt(np.diag(linear.W))
    smallest = np.linalg.eigvalsh(linear.W / np.outer(size, size))[0]
    if abs(smallest) < DEPENDENT:
        raise ValueError(
            "the constraint values depend on each other: W, scaled to a unit diagonal, has the eigenvalue "
            f"{smallest:.1e}; allowed: at least {DEPENDENT:g} in magnitude"
        )
    stiffness = np.linalg.inv(linear.W)
    modes = np.stack([linear.response(effort) for effort in np.eye(len(size))], axis=1) @ stiffness
    mass_matrix = model.assembly.mass_matrix()
    rows = np.stack([model.kinematics.row_velocity(x, mode).ravel() for mode in modes.T], axis=1)
    moved = mass_matrix.rows @ rows.reshape(len(x), -1)
    mass = rows.T @ moved.reshape(rows.shape)
    body = MassAndDamping(mass_matrix, mass_damping, stiffness_damping)

    def power(mode: np.ndarray) -> float:
        return model.assembly.dissipated_power(StartingAcceleration(model.kinematics, x, mode, 1.0, body), x)

    # Powers of sums give the entries beside the diagonal. Modes of equal kinetic energy keep digits.
    scale = np.sqrt(np.diag(mass))
    scaled = modes / scale
    own = np.array([power(mode) for mode in scaled.T])
    damping = np.diag(own)
    for i, j in zip(*np.tril_indices(len(own), -1), strict=True):
        damping[i, j] = damping[j, i] = 0.5 * (power(scaled[:, i] + scaled[:, j]) - own[i] - own[j])
    mass, stiffness = 0.5 * (mass + mass.T), 0.5 * (stiffness + stiffness.T)
    return ReducedMotion(mass, damping * np.outer(scale, scale), stiffness, modes)
