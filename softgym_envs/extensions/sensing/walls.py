"""Walls of cavities that close."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from softgym_envs.errors import InfeasibleDesign
from softgym_envs.mechanics.constraints.cavity import Cavity, SealedAir
from softgym_envs.mechanics.constraints.constraint import Constraint
from softgym_envs.mechanics.surfaces import self_intersection


def check_cavities(cavities: Iterable[Constraint], x: np.ndarray) -> None:
    """Check that no cavity closes: without self-contact, its walls then pass through each other.

    Args:
        cavities: constraints, of which those without a cavity are left out.
        x: rows of a state [m], shape (n, 3).

    Raises:
        InfeasibleDesign: if the surface of a cavity crosses itself.
    """
    for constraint in cavities:
        cavity = constraint.cavity if isinstance(constraint, SealedAir) else constraint
        if isinstance(cavity, Cavity) and (place := self_intersection(x, cavity.flat_triangles)) is not None:
            raise InfeasibleDesign(
                f"the walls of '{cavity.name}' pass through each other near {np.round(place, 4).tolist()} m, because "
                "they do not touch each other in this model"
            )
