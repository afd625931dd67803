"""Tapered bodies of beams with pairs of fibre-reinforced chambers beside their axis, and a tail without."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.chamber import Chamber
from softgym_envs.extensions.beams.skins import tube_skin
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.actuator import Actuator

CHAMBER_OFFSET, CHAMBER_RADIUS = 0.55, 0.35
"""Distance of the chambers from the axis and their radius, in radii of the end of the tail."""
CORNERS = 12
"""Corners of the sections that are drawn."""
ORDER = 2
"""Half elements in an element."""


def lay_body(
    builder: ModelBuilder,
    design: Mapping[str, float],
    start: Sequence[float],
    axes: np.ndarray,
    *,
    segments: int,
    elements: int,
    fixed: bool = False,
    **material: Any,
) -> tuple[list[int], np.ndarray]:
    """Add a straight body to a model in the making.

    Args:
        builder: the model.
        design: its ``length``, ``radius`` [m], ``taper``, the radius of its end over that, and ``tail``, the part of
            its length behind the segments.
        start: its first end [m], shape (3,).
        axes: along it, towards the first chambers of pairs, and across, as columns, shape (3, 3).
        segments: pairs of chambers along it.
        elements: quadratic beam elements of a segment; the tail has as many.
        fixed: whether its first end is clamped.
        **material: of `Beam`.

    Returns:
        The first rows of its frames, from the first end on, and the radii there [m].
    """
    length = design["length"]
    active = (1.0 - design["tail"]) * length
    ends = np.concatenate(
        [np.linspace(0.0, active, segments * elements + 1), np.linspace(active, length, elements + 1)[1:]]
    )
    places = np.interp(np.arange(ORDER * (len(ends) - 1) + 1) / ORDER, np.arange(len(ends)), ends)
    radii = design["radius"] * (1.0 - (1.0 - design["taper"]) * places / length)
    origins = np.asarray(start) + places[:, None] * axes[:, 0]
    clamped = [fixed, *[False] * (len(places) - 1)]
    frames = [
        builder.add_frame(origin, axes, fixed=held, fixed_spin=held)
        for origin, held in zip(origins, clamped, strict=True)
    ]
    builder.add_element(Beam, frames, section=[Section.circle(radius) for radius in radii[1::ORDER]], **material)
    return frames, radii


def add_chambers(model: MechanicalModel, radii: np.ndarray, actuators: Sequence[Actuator], elements: int) -> None:
    """Add the chambers and the skin of the body of `lay_body`, which is the only beam of the model.

    Args:
        model: the model.
        radii: of the body, from `lay_body` [m].
        actuators: of the chambers, those of one segment after the other, first the one towards the second axis.
        elements: as for `lay_body`.
    """
    (beam,) = (block for block in model.blocks if isinstance(block, Beam))
    thin = radii[-1]
    for k, actuator in enumerate(actuators):
        segment, side = divmod(k, 2)
        offset = CHAMBER_OFFSET * thin * (1.0 if side == 0 else -1.0)
        line = beam.line(range(segment * elements, (segment + 1) * elements), (offset, 0.0), model.nodes)
        model.add("a", Chamber(actuator.name, [line], math.pi * (CHAMBER_RADIUS * thin) ** 2))
    angles = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    model.skins.append(tube_skin(beam, model.nodes, radii[:, None, None] * circle))
