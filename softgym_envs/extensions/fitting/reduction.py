"""Mass, damping and stiffness of a body in the coordinates of its condensed model: static reduction (Guyan 1965).

If constraint values change by ``d delta`` and everything else stays in equilibrium, the equations move by
``T d delta`` with the static modes ``T = A^-1 H W^-1``. Motion in these coordinates alone has the mass ``T^T M T``, the
damping ``T^T D T`` and the stiffness ``T^T A T = W^-1``.

Static modes leave out all motions that do not change a constraint value. The inertia of the static modes excites the
inner modes ``R = A_0^-1 M T``, where ``A_0`` is the tangent with all constraint values held: the first load-dependent
Ritz vectors (Wilson, Yuan & Dickens 1982). They move no constraint, so ``T^T A R = 0``. Natural frequencies are upper
bounds of those of the body, with inner modes closer ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.motion.inertia import root
from softgym_envs.mechanics.assembly import MassAndDamping
from softgym_envs.mechanics.solvers.schemes import StartingAcceleration

if TYPE_CHECKING:
    from softgym_envs.mechanics.solvers.statics import Statics

DEPENDENT = 1e-10
"""Eigenvalue of the scaled compliance below which constraint values count as dependent."""


@dataclass(frozen=True)
class ReducedMotion:
    """Linear motion about an equilibrium, in k coordinates: the n constraint values of a body, then its inner modes.

    Units are those of constraint values; an inner mode has unit stiffness [J], so its coordinate has no unit.

    Attributes:
        mass: ``T^T M T``, shape (k, k), symmetric and positive definite [effort unit s2 / displacement unit].
        damping: ``T^T D T``, shape (k, k), symmetric and positive semidefinite [effort unit s / displacement unit].
        stiffness: ``W^-1``, and the identity for inner modes, shape (k, k) [effort unit / displacement unit].
        modes: ``T`` and the inner modes, motion of the equations for each coordinate, shape (N, k).
    """

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    modes: np.ndarray


def reduce_motion(
    statics: Statics,
    *,
    mass_damping: float = 0.0,
    stiffness_damping: float = 0.0,
    inner: bool = False,
    units: np.ndarray | None = None,
) -> ReducedMotion:
    """Return mass, damping and stiffness of a body about the present state of its solver.

    Args:
        statics: solver of a body without contact and without friction of cables, at an equilibrium.
        mass_damping: Rayleigh's alpha [1/s].
        stiffness_damping: Rayleigh's beta [s].
        inner: add as many inner modes as there are constraint values.
        units: typical sizes of the constraint values, shape (n,), by which inner modes are made independent of their
            units; default the roots of the diagonal of ``W``.

    Raises:
        ConvergenceError: if the tangent is singular, or with ``inner`` the equilibrium unstable.
        ValueError: for a body with contact or with friction of cables, whose ``W`` is not symmetric, and for
            constraint values that depend on each other.
    """
    linear, model, x = statics.linearisation, statics.model, statics.x
    if linear.contact is not None or linear.cable_friction is not None:
        raise ValueError("motion is reduced only for bodies without contact and without friction of cables")
    if not linear.update(x, statics.effort, exact=True):
        raise ConvergenceError("the tangent is singular, so the body has no static modes", fraction=0.0)
    size = np.sqrt(np.abs(np.diag(linear.W)))
    smallest = np.linalg.eigvalsh(linear.W / np.outer(size, size))[0]
    if abs(smallest) < DEPENDENT:
        raise ValueError(
            "the constraint values depend on each other: W, scaled to a unit diagonal, has the eigenvalue "
            f"{smallest:.1e}; allowed: at least {DEPENDENT:g} in magnitude"
        )
    stiffness = np.linalg.inv(linear.W)
    modes = np.stack([linear.response(effort) for effort in np.eye(len(size))], axis=1) @ stiffness
    mass_matrix = model.assembly.mass_matrix()
    if inner:
        if not linear.positive_definite:
            raise ConvergenceError("the equilibrium is unstable, so the body has no inner modes", fraction=0.0)
        modes = np.hstack([modes, _inner_modes(statics, modes, mass_matrix.rows, size if units is None else units)])
        stiffness = block_diag(stiffness, np.eye(len(size)))
    rows = np.stack([model.kinematics.row_velocity(x, mode).ravel() for mode in modes.T], axis=1)
    moved = mass_matrix.rows @ rows.reshape(len(x), -1)
    mass = rows.T @ moved.reshape(rows.shape)
    mass, stiffness = 0.5 * (mass + mass.T), 0.5 * (stiffness + stiffness.T)
    damping = np.zeros_like(mass)
    if mass_damping or stiffness_damping:
        damping = _damping(statics, modes, mass, MassAndDamping(mass_matrix, mass_damping, stiffness_damping))
    return ReducedMotion(mass, damping, stiffness, modes)


def _inner_modes(statics: Statics, modes: np.ndarray, mass_rows, units: np.ndarray) -> np.ndarray:
    """Return the inner modes (N, n) of static modes (N, n), orthogonal to each other with unit stiffness."""
    linear, kinematics, x = statics.linearisation, statics.model.kinematics, statics.x
    even = modes @ (units[:, None] * root(linear.W / np.outer(units, units)))
    loads = [kinematics.equation_force(x, mass_rows @ kinematics.row_velocity(x, mode)) for mode in even.T]
    moved = np.stack([linear.solve(load) for load in loads], axis=1)
    moved -= modes @ (linear.H.T @ moved)
    stiffness = np.stack(loads) @ moved  # (M T)^T A_0^-1 (M T) = R^T A R
    return moved @ root(0.5 * (stiffness + stiffness.T), -0.5)


def _damping(statics: Statics, modes: np.ndarray, mass: np.ndarray, body: MassAndDamping) -> np.ndarray:
    """Return the damping (k, k) of modes (N, k) with a reduced mass (k, k)."""
    model, x = statics.model, statics.x

    def power(mode: np.ndarray) -> float:
        return model.assembly.dissipated_power(StartingAcceleration(model.kinematics, x, mode, 1.0, body), x)

    # Powers of sums give the entries beside the diagonal. Modes of equal kinetic energy keep digits.
    scale = np.sqrt(np.diag(mass))
    scaled = modes / scale
    own = np.array([power(mode) for mode in scaled.T])
    damping = np.diag(own)
    for i, j in zip(*np.tril_indices(len(own), -1), strict=True):
        damping[i, j] = damping[j, i] = 0.5 * (power(scaled[:, i] + scaled[:, j]) - own[i] - own[j])
    return damping * np.outer(scale, scale)
