"""Free rigid objects that a hand can lift: a box, an upright hexagonal prism, and a ball with a small flat base."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from softgym_envs.extensions.beams.prism import RoundedPrism
from softgym_envs.extensions.beams.skins import box_skin, revolved_skin
from softgym_envs.mechanics.contact.obstacles import Obstacle, Sphere
from softgym_envs.mechanics.elements.rigid import box_inertia, sphere_inertia
from softgym_envs.mechanics.skins import Skin

ROUNDING = 1.0e-3
"""Radius of the edges of prisms [m]."""

BASE = 0.3
"""Radius of the flat base of a ball, relative to that of the ball. Without it the ball would roll away."""


@dataclass(frozen=True)
class Shape:
    """What a hand needs to know about an object whose frame is in its middle, with z up.

    Attributes:
        half_width: half its size along x, where fingers press [m].
        half_height: height of its middle above its base [m].
        inertia: about the middle, along the axes, of an object of unit mass [m2], shape (3, 3).
        obstacle: makes what the fingers touch, of the name, coefficient of friction and frame.
        skin: makes the surface with which it stands on a table, of the first row of its frame and the rest rows.
    """

    half_width: float
    half_height: float
    inertia: np.ndarray
    obstacle: Callable[[str, float, int], Obstacle]
    skin: Callable[[int, np.ndarray], Skin]


def box(size: tuple[float, float, float]) -> Shape:
    """Return a box of a width (x), depth (y) and height (z) [m]."""
    half = [0.5 * length for length in size]
    return Shape(
        half[0],
        half[2],
        box_inertia(1.0, np.array(half)),
        lambda name, friction, frame: RoundedPrism.box(half, ROUNDING, name=name, friction=friction, frame=frame),
        lambda row, nodes: box_skin(row, half, nodes),
    )


def hexagon(size: tuple[float, float, float]) -> Shape:
    """Return an upright hexagonal prism with a width between flats (x) and a height (z) [m]; y has no effect."""
    width, _, height = size
    radius, half = width / math.sqrt(3.0), 0.5 * height
    across = 5.0 / 24.0 * radius**2 + height**2 / 12.0
    return Shape(
        0.5 * width,
        half,
        np.diag([across, across, 5.0 / 12.0 * radius**2]),
        lambda name, friction, frame: RoundedPrism.hexagonal(
            width, half, ROUNDING, name=name, friction=friction, frame=frame
        ),
        lambda row, nodes: revolved_skin(row, [(radius, -half), (radius, half)], nodes, sides=6),
    )


def ball(size: tuple[float, float, float]) -> Shape:
    """Return a ball of a diameter (x) [m]; y and z have no effect. Its mass is that of a whole ball."""
    radius = 0.5 * size[0]
    angles = np.linspace(-math.acos(BASE), 0.5 * math.pi, 8)[:-1]
    profile = [(radius * math.cos(t), radius * math.sin(t)) for t in angles]
    return Shape(
        radius,
        -profile[0][1],
        sphere_inertia(1.0, radius),
        lambda name, friction, frame: Sphere((0.0, 0.0, 0.0), radius, name=name, friction=friction, frame=frame),
        lambda row, nodes: revolved_skin(row, profile, nodes, sides=24),
    )


CARRIED: dict[str, Callable[[tuple[float, float, float]], Shape]] = {"box": box, "hexagon": hexagon, "ball": ball}
"""Objects by name, made from a width, depth and height [m]."""
