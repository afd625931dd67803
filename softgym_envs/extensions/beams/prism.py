"""Rounded prisms as obstacles.

Their gap is continuously differentiable: only the curvature jumps, where a flat face meets a rounded edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.contact.obstacles import IDENTITY, Geometry, Obstacle, convex_surface, directions
from softgym_envs.mechanics.frames import frame_rows


@dataclass(frozen=True)
class RoundedPrism(Obstacle):
    """All points within a distance ``radius`` of a right prism over a convex polygon.

    `box` and `hexagonal` make prisms whose outer size, with the rounding, is given.

    Attributes:
        polygon: corners [m] of the prism's core in its local x-y plane, in either order, shape (m, 2).
        half_height: half the height [m] of the core, along local z.
        radius: rounding [m] of all edges and corners; the faces are offset by it.
        centre: origin of the local axes [m].
        rotation: matrix whose columns are the local axes, shape (3, 3).
    """

    kind: ClassVar[str] = "rounded_prism"
    polygon: Sequence[Sequence[float]]
    half_height: float
    radius: float
    centre: Sequence[float] = (0.0, 0.0, 0.0)
    rotation: Sequence[Sequence[float]] = IDENTITY

    def __post_init__(self) -> None:
        super().__post_init__()
        self._store("polygon", self.polygon, (-1, 2))
        self._store("half_height", self.half_height, (), above=0.0)
        self._store("radius", self.radius, (), above=0.0)
        self._store("centre", self.centre, (3,))
        self._store("rotation", self.rotation, (3, 3))
        try:
            frame_rows(self.centre, np.asarray(self.rotation))
        except ValueError as error:
            raise ValueError(f"{self._label}: {error}") from None
        polygon = np.asarray(self.polygon)
        if len(polygon) < 3:
            raise ValueError(f"{self._label}: polygon must have at least 3 corners, got {len(polygon)}")
        size = np.ptp(polygon, axis=0).max()
        start, lengths, _, outward = self.edges
        if lengths.min() <= 1e-9 * size:
            raise ValueError(f"{self._label}: two consecutive corners of polygon must not be equal, got {self.polygon}")
        heights = (start[None] - start[:, None]) @ outward[:, :, None]
        if heights.max() > 1e-9 * size or heights.min() > -1e-9 * size:
            raise ValueError(f"{self._label}: polygon must be convex and not flat, got {self.polygon}")

    @classmethod
    def box(
        cls,
        half_extents: Sequence[float],
        radius: float,
        *,
        centre: Sequence[float] = (0.0, 0.0, 0.0),
        rotation: Sequence[Sequence[float]] = IDENTITY,
        name: str = "",
        friction: float = 0.0,
        frame: int | None = None,
    ) -> RoundedPrism:
        """Box with rounded edges; ``half_extents`` [m] (3,) along the local axes include the rounding."""
        core = np.asarray(half_extents, dtype=float) - radius
        if core.shape != (3,) or not (core > 0.0).all():
            raise ValueError(f"half_extents of a box must be 3 numbers > radius {radius!r}, got {half_extents!r}")
        x, y, z = core
        polygon = [(-x, -y), (x, -y), (x, y), (-x, y)]
        return cls(polygon, z, radius, centre, rotation, name=name, friction=friction, frame=frame)

    @classmethod
    def hexagonal(
        cls,
        flats: float,
        half_height: float,
        radius: float,
        *,
        centre: Sequence[float] = (0.0, 0.0, 0.0),
        rotation: Sequence[Sequence[float]] = IDENTITY,
        name: str = "",
        friction: float = 0.0,
        frame: int | None = None,
    ) -> RoundedPrism:
        """Regular hexagonal prism with rounded edges; two of its flats face along local x.

        Args:
            flats: distance [m] between opposite flats, including the rounding.
            half_height: half the height [m] along local z, including the rounding.
            radius: rounding [m].
            centre: see the class.
            rotation: see the class.
            name: see the class.
            friction: see the class.
            frame: see the class.
        """
        inner, height = 0.5 * flats - radius, half_height - radius
        if not (inner > 0.0 and height > 0.0):
            raise ValueError(
                f"half of flats and half_height of a hexagonal prism must be > radius {radius!r}, "
                f"got {flats!r} and {half_height!r}"
            )
        angle = np.pi / 6.0 + np.pi / 3.0 * np.arange(6)
        polygon = inner / np.cos(np.pi / 6.0) * np.column_stack([np.cos(angle), np.sin(angle)])
        corners = [(float(x), float(y)) for x, y in polygon]
        return cls(corners, height, radius, centre, rotation, name=name, friction=friction, frame=frame)

    @cached_property
    def edges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Start (m, 2), length (m,), direction (m, 2) and outward normal (m, 2) of the polygon's edges."""
        start = np.asarray(self.polygon)
        x, y = start.T
        if x @ np.roll(y, -1) - y @ np.roll(x, -1) < 0.0:
            start = start[::-1].copy()
        span = np.roll(start, -1, axis=0) - start
        length = np.linalg.norm(span, axis=1)
        direction = span / np.maximum(length, np.finfo(float).tiny)[:, None]
        return start, length, direction, np.column_stack([direction[:, 1], -direction[:, 0]])

    @cached_property
    def _rotation(self) -> np.ndarray:
        return np.asarray(self.rotation)

    @cached_property
    def _centre(self) -> np.ndarray:
        return np.asarray(self.centre)

    def gap(self, points: np.ndarray) -> np.ndarray:
        out = np.empty(len(points))
        _prism_gap((points - self._centre) @ self._rotation, *self.edges, self.half_height, self.radius, out)
        return out

    def geometry(self, points: np.ndarray) -> Geometry:
        gap, normal, curvature = np.empty(len(points)), np.empty((len(points), 3)), np.empty((len(points), 3, 3))
        local = (points - self._centre) @ self._rotation
        prism_geometry(local, *self.edges, self.half_height, self.radius, gap, normal, curvature)
        return gap, normal @ self._rotation.T, self._rotation @ curvature @ self._rotation.T

    def skin(self, extent: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
        start, _, _, outward = self.edges
        rounding = self.radius * directions(np.arctan2(outward[:, 1], outward[:, 0]))
        core = [(x, y, z) for x, y in start for z in (-self.half_height, self.half_height)]
        points = (np.asarray(core)[:, None] + rounding).reshape(-1, 3)
        return convex_surface(points @ self._rotation.T + self._centre)


@njit(cache=True, error_model="numpy")
def _core_arm(x, y, z, start, length, direction, outward, half_height):
    """Arm from the nearest point of the prism's core to a local point, and where that nearest point lies.

    Returns (arm x, arm y, arm z, distance, edge, flat): ``edge`` is the index of the polygon's edge, -1 at a corner and
    -2 inside the polygon; ``flat`` says whether it lies between the end faces. Inside the core, the arm is the normal
    of the nearest face and the distance is minus its depth.
    """
    depth, nearest, edge, corner, best = -np.inf, 0, -1, 0, np.inf
    for e in range(start.shape[0]):
        u, v = x - start[e, 0], y - start[e, 1]
        height = u * outward[e, 0] + v * outward[e, 1]
        along = u * direction[e, 0] + v * direction[e, 1]
        if height > depth:
            depth, nearest = height, e
        if height > 0.0 and 0.0 <= along <= length[e]:
            edge = e
        squared = u * u + v * v
        if squared < best:
            best, corner = squared, e
    above = abs(z) - half_height
    sign = 1.0 if z >= 0.0 else -1.0
    if depth <= 0.0 and above <= 0.0:
        if above > depth:
            return 0.0, 0.0, sign, above, -2, False
        return outward[nearest, 0], outward[nearest, 1], 0.0, depth, nearest, True
    ax, ay, az = 0.0, 0.0, sign * above if above > 0.0 else 0.0
    if depth <= 0.0:
        edge = -2
    elif edge >= 0:
        height = (x - start[edge, 0]) * outward[edge, 0] + (y - start[edge, 1]) * outward[edge, 1]
        ax, ay = height * outward[edge, 0], height * outward[edge, 1]
    else:
        ax, ay = x - start[corner, 0], y - start[corner, 1]
    return ax, ay, az, np.sqrt(ax * ax + ay * ay + az * az), edge, above <= 0.0


@njit(cache=True, error_model="numpy")
def _prism_gap(points, start, length, direction, outward, half_height, radius, gap):
    for k in range(points.shape[0]):
        x, y, z = points[k]
        gap[k] = _core_arm(x, y, z, start, length, direction, outward, half_height)[3] - radius


@njit(cache=True, error_model="numpy")
def prism_geometry(points, start, length, direction, outward, half_height, radius, gap, normal, curvature):
    """Fill gap (k,), normal (k, 3) and curvature (k, 3, 3) of a prism at points (k, 3) in its local axes."""
    # The distance to a face, edge or corner is |P r| with P the projection across its tangents.
    for k in range(points.shape[0]):
        x, y, z = points[k]
        ax, ay, az, distance, edge, flat = _core_arm(x, y, z, start, length, direction, outward, half_height)
        gap[k] = distance - radius
        scale = distance if distance > 0.0 else 1.0
        normal[k, 0], normal[k, 1], normal[k, 2] = ax / scale, ay / scale, az / scale
        curvature[k] = 0.0
        if distance <= 0.0:
            continue
        if edge == -1:
            curvature[k, 0, 0] = curvature[k, 1, 1] = 1.0
        elif edge >= 0:
            for i in range(2):
                for j in range(2):
                    curvature[k, i, j] = outward[edge, i] * outward[edge, j]
        curvature[k, 2, 2] = 0.0 if flat else 1.0
        for i in range(3):
            for j in range(3):
                curvature[k, i, j] = (curvature[k, i, j] - normal[k, i] * normal[k, j]) / distance
