"""Chambers of solids: the cavity that a point lies in, or that the surface in a file fills."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from softgym_envs.mechanics.io import UNITS, read_surface, unit_factor
from softgym_envs.mechanics.surfaces import cavity_around, cavity_like
from softgym_envs.quantities import numbers


def chamber_triangles(
    name: str,
    nodes: np.ndarray,
    corners: np.ndarray,
    surface: np.ndarray | str | Path | None,
    inside: Sequence[float] | np.ndarray | None,
    unit: str | None,
) -> np.ndarray:
    """Return the triangles of a cavity of a solid, shape (k, 3); see `MechanicalModel.add_cavity`.

    Args:
        name: of the cavity, for messages.
        nodes: [m], shape (n, 3).
        corners: of the solid's elements, shape (m, 4).
        surface: its triangles, or a file.
        inside: a point in it [m], shape (3,), where there is no surface.
        unit: unit of the file; by default the one in which it fills a cavity.

    Raises:
        DataError: if the file cannot be read.
        ValueError: if no closed cavity encloses the point or is filled by the file's surface.
    """
    if surface is None:
        return cavity_around(nodes, corners, np.asarray(inside), name)
    if isinstance(surface, str | Path):
        points, faces, in_metres = read_surface(surface)
        factors = [1.0] if in_metres else [unit_factor(None, unit)] if unit else list(UNITS.values())
        return cavity_like(nodes, corners, [(f * points, faces) for f in factors], name)
    numbers(surface, f"surface of cavity '{name}'")
    return np.asarray(surface)
