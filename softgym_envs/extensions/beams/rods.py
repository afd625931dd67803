"""Slender rods: beam elements along a line, with their surface, material points and guides of tendons."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from softgym_envs.arguments import explained
from softgym_envs.extensions.beams.beam import Beam, Section, lagrange
from softgym_envs.extensions.beams.skins import tube_skin
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.cable import Cable
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.loads import Shares
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.quantities import check_quantity, numbers
from softgym_envs.wording import brief

ENDS = {"none": (), "start": (0,), "both": (0, -1)}
"""Which frames of a rod are clamped, by name."""


@explained
@dataclass
class Rod:
    """A chain of beam elements whose frames are known by their place along it, from `add_rod`.

    Attributes:
        frames: first rows of its frames.
        places: of its frames along the rod at rest [m], from zero, shape (c,).
        beam: the elements, once the model is built.
    """

    frames: list[int]
    places: np.ndarray
    beam: Beam = field(init=False)

    @property
    def length(self) -> float:
        """Length at rest [m]."""
        return float(self.places[-1])

    def points(self, places: ArrayLike, offsets: ArrayLike, nodes: np.ndarray) -> EmbeddedPoints:
        """Return points that are fixed to cross-sections.

        Between frames the directors are interpolated, so a point lies a little closer to the axis of a bent rod there:
        put frames where points matter.

        Args:
            places: along the rod at rest [m], shape (p,) or a number.
            offsets: along d_2 and d_3 [m], or along all three directors, shape (2,), (3,), (p, 2) or (p, 3).
            nodes: rest rows [m], shape (n, 3).

        Raises:
            ValueError: for a place that is not on the rod.
        """
        s = np.atleast_1d(np.asarray(places, dtype=float))
        slack = 1e-9 * self.length
        outside = ~((s >= -slack) & (s <= self.length + slack))
        if outside.any():
            raise ValueError(f"place {s[outside][0]:g} m is not on the rod; allowed: 0 to {self.length:g} m")
        local = np.asarray(offsets, dtype=float)
        if local.shape[-1] == 2:
            local = np.concatenate([np.zeros((*local.shape[:-1], 1)), local], axis=-1)
        factors = np.column_stack([np.ones(len(s)), np.broadcast_to(local, (len(s), 3))])
        nearest = np.abs(s[:, None] - self.places).argmin(axis=1)
        if (np.abs(s - self.places[nearest]) <= slack).all():
            return EmbeddedPoints.from_weights(self.beam.chain[nearest][:, None] + np.arange(4), factors, nodes)
        order = self.beam.order
        ends = self.places[::order]
        element = np.clip(np.searchsorted(ends, s, side="right") - 1, 0, len(ends) - 2)
        t = 2.0 * (s - ends[element]) / (ends[element + 1] - ends[element]) - 1.0
        shape, _ = lagrange(order, t)
        ids = self.beam.rows[element][:, :, None] + np.arange(4)
        weights = shape[:, :, None] * factors[:, None, :]
        return EmbeddedPoints.from_weights(ids.reshape(len(s), -1), weights.reshape(len(s), -1), nodes)

    def spread(self) -> Shares:
        """Return rows and their shares of a load that acts evenly along the rod, for `MechanicalModel.add_load`."""
        beam = self.beam
        shares = np.array([0.5, 0.5]) if beam.order == 1 else np.array([1.0, 4.0, 1.0]) / 6.0
        return beam.rows.ravel(), (beam.lengths[:, None] * shares / beam.lengths.sum()).ravel()

    def add_tendon(
        self,
        model: MechanicalModel,
        name: str,
        places: ArrayLike,
        offsets: ArrayLike,
        *,
        pull_point: ArrayLike | None = None,
        unilateral: bool = True,
        compliance: float = 0.0,
    ) -> Cable:
        """Add an actuator to a model: a tendon along the rod, a cable that runs straight from disc to disc.

        Args:
            model: of which the rod is a part.
            name: identifier.
            places: of the discs that guide it, along the rod at rest from the base to the anchor [m], shape (p,).
            offsets: of the tendon along d_2 and d_3 in each disc [m], shape (2,) or (p, 2).
            pull_point: fixed point where the tendon leaves [m], shape (3,); default: beside the start of the rod, with
                the offset of the first disc.
            unilateral: True for a real tendon, which cannot push.
            compliance: how far it stretches per tension [m/N], see `Cable`.

        Raises:
            ValueError: for a disc that is not on the rod.
        """
        if not np.size(places):
            raise ValueError(f"tendon '{name}' needs one disc or more, got places = {brief(places)}")
        check_quantity("compliance", compliance, f"tendon '{name}': compliance")
        label, far = f"tendon '{name}': offsets", float(self.length)
        check_quantity("length", offsets, label, high=far, example="the length of the rod")
        through = np.broadcast_to(np.asarray(offsets, dtype=float), (np.size(places), 2))
        if pull_point is None:
            pull_point = self.points(0.0, through[0], model.nodes).points[0]
        guides = self.points(places, through, model.nodes)
        cable = Cable(name, guides, np.asarray(pull_point), unilateral=unilateral, compliance=compliance)
        model.add("a", cable)
        return cable


@explained
def add_rod(
    builder: ModelBuilder,
    path: ArrayLike,
    *,
    section: Section | Callable[[float], Section],
    elements: int | Sequence[float] | np.ndarray = 10,
    order: int = 2,
    up: ArrayLike | None = None,
    held: str = "start",
    **options: Any,
) -> Rod:
    """Add a rod to a builder: beam elements along a line, with the surface of its sections.

    Args:
        builder: of the model.
        path: both ends of a straight rod [m], shape (2, 3), or all frames of a curved one, shape (c, 3). The rod is
            free of stress in this shape.
        section: of all elements, or a function of the place along the rod [m] that returns that of the element with its
            middle there.
        elements: of a straight rod: a number of equal ones, or their ends along the rod [m], e.g. at its discs.
        order: 1 or 2, see `Beam`; with 2 every second frame is the middle of an element.
        up: direction of d_2 at the start; default: the axis of space that is least along the rod.
        held: which ends are clamped: ``"start"``, ``"both"`` or ``"none"``.
        **options: ``young_modulus`` and others of `Beam`.

    Raises:
        ValueError: for a path or elements that describe no rod.
    """
    points = np.asarray(path, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2 or not np.isfinite(points).all():
        raise ValueError(f"the path of a rod must be two or more points [m] of three finite numbers, got {path!r}")
    if held not in ENDS:
        raise ValueError(f"held = {held!r} is unknown; allowed: {', '.join(ENDS)}")
    if len(points) == 2:
        places = straight_places(float(np.linalg.norm(points[1] - points[0])), elements, order)
        points = points[0] + (places / places[-1])[:, None] * (points[1] - points[0])
    else:
        places = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    clamped = np.isin(np.arange(len(points)), np.array(ENDS[held], dtype=int) % len(points))
    frames = [
        builder.add_frame(point, rotation, fixed=bool(fix), fixed_spin=bool(fix))
        for point, rotation, fix in zip(points, transported_frames(points, up), clamped, strict=True)
    ]
    middles = 0.5 * (places[:-order:order] + places[order::order])
    sections = section if isinstance(section, Section) else [section(float(s)) for s in middles]
    number = builder.add_element(Beam, frames, section=sections, order=order, **options)
    rod, outline = Rod(frames, places), outlines(section, places)

    def complete(model: MechanicalModel) -> None:
        beam = model.blocks[number]
        assert isinstance(beam, Beam)
        rod.beam = beam
        if outline is not None:
            model.skins.append(tube_skin(beam, model.nodes, outline))

    builder.finish(complete)
    return rod


def straight_places(length: float, elements: int | Sequence[float] | np.ndarray, order: int) -> np.ndarray:
    """Return the places of frames [m] for a number of equal elements, or for given ends of elements, shape (c,).

    Raises:
        ValueError: if the ends do not rise from zero to the length.
    """
    numbers(elements, "elements")
    if isinstance(elements, int | np.integer) and not isinstance(elements, bool):
        elements = np.linspace(0.0, length, max(int(elements), 0) + 1)
    ends = np.atleast_1d(np.asarray(elements, dtype=float))
    rise = ends.ndim == 1 and len(ends) > 1 and bool((np.diff(ends) > 0.0).all())
    if not rise or not np.allclose(ends[[0, -1]], [0.0, length], atol=1e-9):
        raise ValueError(f"ends of elements must rise from 0 to {length:g} m, got {ends.tolist()}")
    if order == 1:
        return ends
    return np.insert(ends, np.arange(1, len(ends)), 0.5 * (ends[1:] + ends[:-1]))


def transported_frames(points: np.ndarray, up: ArrayLike | None) -> np.ndarray:
    """Return rotations (c, 3, 3) of frames along a line (c, 3): d_1 along it, d_2 as near to the last one as possible.

    Args:
        points: positions [m].
        up: direction of the first d_2; default: the axis of space that is least along the line.

    Raises:
        ValueError: if two successive points coincide, or ``up`` is along the line.
    """
    edges = np.diff(points, axis=0)
    lengths = np.linalg.norm(edges, axis=1)
    if not (lengths > 1e-9).all():
        raise ValueError(f"two successive points of a rod coincide: {points.tolist()} m")
    units = edges / lengths[:, None]
    # Through three points goes a parabola; at its middle one, this is its tangent.
    inner = (units[:-1] * lengths[1:, None] + units[1:] * lengths[:-1, None]) / (lengths[1:] + lengths[:-1])[:, None]
    first = 2.0 * units[0] - inner[0] if len(inner) else units[0]
    last = 2.0 * units[-1] - inner[-1] if len(inner) else units[-1]
    tangents = np.vstack([first, inner, last])
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    second = np.eye(3)[np.abs(tangents[0]).argmin()] if up is None else np.asarray(up, dtype=float)
    frames = np.empty((len(points), 3, 3))
    for k, tangent in enumerate(tangents):
        second = second - (second @ tangent) * tangent
        size = float(np.linalg.norm(second))
        if not size > 1e-6:
            raise ValueError(f"up = {np.asarray(up).tolist()} must not be along the rod")
        second = second / size
        frames[k] = np.column_stack([tangent, second, np.cross(tangent, second)])
    return frames


def outlines(section: Section | Callable[[float], Section], places: np.ndarray) -> np.ndarray | None:
    """Return the outlines of the cross-sections at places [m], shape (c, k, 2); None if they have none."""
    sections = [section if isinstance(section, Section) else section(float(s)) for s in places]
    shapes = {len(s.outline) for s in sections}
    return np.array([s.outline for s in sections]) if len(shapes) == 1 and 0 not in shapes else None
