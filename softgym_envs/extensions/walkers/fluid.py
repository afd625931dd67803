"""Resistance of a still, viscous fluid to slender bodies: resistive force theory.

A piece of a slender body feels forces in proportion to its own velocity alone, fewer along its axis than across it
(Gray and Hancock 1955). This holds where inertia of the fluid does not count: where the Reynolds number of the radius,
density times speed times radius over viscosity, is below about one.
"""

from __future__ import annotations

import math


def slender_drag(viscosity: float, length: float, radius: float) -> tuple[float, float]:
    """Return the resistance per length of a slender cylinder along and across its axis [N s/m2].

    Those of Cox (1970) for a straight cylinder with flat ends, to the second order of its slenderness.

    Args:
        viscosity: of the fluid [Pa s].
        length: of the cylinder [m].
        radius: [m].

    Raises:
        ValueError: for numbers that are not positive and finite, or a length below ten radii.
    """
    for name, value in (("viscosity", viscosity), ("length", length), ("radius", radius)):
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} = {value} must be positive and finite")
    if length < 10.0 * radius:
        raise ValueError(f"length = {length} m of a slender body must be at least ten radii of {radius} m")
    slender = math.log(length / radius)
    return 2.0 * math.pi * viscosity / (slender - 0.807), 4.0 * math.pi * viscosity / (slender + 0.193)
