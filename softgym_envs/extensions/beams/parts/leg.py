"""Scale laws of a printed leg: what is exact before anything is learned.

A leg of length L, width w, thickness t, modulus E and density rho has the energy ``EI / L`` times a function without
dimensions, with ``EI = E w t^3 / 12``: of w / L, t / L, the printed curvatures times L, the relative pose of its ends
with places over L, and the weight ``rho w t g`` over ``EI / L^3`` in the axes of its root.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from softgym_envs.extensions.beams.robots.tetrapod import DENSITY

VARIABLES = ("leg_length", "leg_width", "leg_thickness", "curvature_1", "curvature_2", "curvature_3", "young_modulus")


class LegScale(NamedTuple):
    """One leg, or many along a first axis.

    Attributes:
        length: [m], shape (...).
        energy: EI / L [J], shape (...).
        mass: [kg], shape (...).
        weight: what the acceleration of gravity [m/s2] is multiplied with, shape (...).
        shape: width and thickness over the length, and three curvatures times it, shape (..., 5).
    """

    length: np.ndarray
    energy: np.ndarray
    mass: np.ndarray
    weight: np.ndarray
    shape: np.ndarray

    @classmethod
    def of(cls, design: Mapping[str, float | np.ndarray]) -> LegScale:
        """Return the scale of the legs with `VARIABLES`."""
        length, width, thickness, *curvatures, modulus = (np.asarray(design[name], dtype=float) for name in VARIABLES)
        bending = modulus * width * thickness**3 / 12.0
        mass = DENSITY * width * thickness * length
        shape = np.stack([width / length, thickness / length, *(k * length for k in curvatures)], axis=-1)
        return cls(length, bending / length, mass, mass * length**2 / bending, shape)
