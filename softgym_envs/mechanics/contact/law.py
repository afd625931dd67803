"""The law of contact at one point: a barrier against penetration, and Coulomb friction with memory.

The barrier is that of incremental potential contact in physical units (Li et al. 2020; area times a stiffness in Pa).
Its stiffness is fixed, so that all contact forces derive from one scalar.

Friction is a tangential spring that slides: the spring leads from an anchor, which rests on the obstacle, to the point,
and its force cannot exceed the coefficient of friction times the normal force (return mapping). The anchor moves only
between load increments. The normal force is that of the same instant, so the law is implicit. While a point slides,
its friction force depends on its normal force but not the other way round, which makes the tangent unsymmetric.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


def barrier(gap: np.ndarray, distance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the energy per area and stiffness [m] of gaps (k,), and its first and second derivatives.

    Args:
        gap: [m], positive.
        distance: gap at which the force vanishes [m].
    """
    s = (gap / distance) ** 2
    near = s < 1.0
    s = np.where(near, s, 1.0)
    log, rest = np.log(s), s - 1.0
    value = -distance * rest**2 * log
    by_s = -distance * (2.0 * rest * log + rest**2 / s)
    by_ss = -distance * (2.0 * log + 4.0 * rest / s - rest**2 / s**2)
    first, second = 2.0 * gap / distance**2, 2.0 / distance**2
    return value, by_s * first, by_ss * first**2 + by_s * second


class Friction(NamedTuple):
    """Friction forces at points.

    Attributes:
        stretch: of the springs, along the surface [m], shape (k, 3).
        force: minus the force on the point [N], shape (k, 3).
        tangent: its derivative while the normal force is held [N/m], shape (k, 3, 3).
        sliding: shape (k,).
        direction: unit vectors of the stretch, shape (k, 3).
    """

    stretch: np.ndarray
    force: np.ndarray
    tangent: np.ndarray
    sliding: np.ndarray
    direction: np.ndarray


def friction(stretch: np.ndarray, normal: np.ndarray, stiffness: np.ndarray, limit: np.ndarray) -> Friction:
    """Return the friction of springs.

    Args:
        stretch: from the anchors to the points [m], shape (k, 3).
        normal: of the obstacle at the anchors, shape (k, 3).
        stiffness: of the springs [N/m], shape (k,).
        limit: largest forces [N], shape (k,).
    """
    plane = np.eye(3) - normal[:, :, None] * normal[:, None, :]
    along = np.einsum("kij,kj->ki", plane, stretch)
    length = np.linalg.norm(along, axis=1)
    sliding = stiffness * length > limit
    direction = along / np.maximum(length, 1e-300)[:, None]
    factor = np.where(sliding, limit / np.maximum(length, 1e-300), stiffness)
    across = np.where(sliding, factor, 0.0)[:, None, None] * (direction[:, :, None] * direction[:, None, :])
    return Friction(along, factor[:, None] * along, factor[:, None, None] * plane - across, sliding, direction)


def friction_energy(stretch: np.ndarray, stiffness: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Return the potential [J] (k,) of springs stretched by lengths (k,) whose largest forces (k,) are held."""
    sliding = stiffness * stretch > limit
    held = limit * stretch - 0.5 * limit**2 / np.where(stiffness > 0.0, stiffness, 1.0)
    return np.where(sliding, held, 0.5 * stiffness * stretch**2)
