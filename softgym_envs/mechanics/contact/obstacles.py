"""Rigid obstacles, most with closed formulas for gap, normal and curvature.

Such an obstacle is a convex solid, or the half-space behind a plane. Its *gap* is the distance of a point to its
surface, positive outside. The normal is the gradient of the gap, the curvature its second derivative; both are exact.
The gap of a rounded prism is continuously differentiable: only its curvature jumps, where a flat face meets a rounded
edge.

An obstacle stands still in space, or a frame of the model carries it: then all its coordinates are along the frame's
directors, from the frame's origin.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from softgym_envs.errors import unknown_name
from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.frames import frame_rows
from softgym_envs.quantities import check_quantity

_LENGTHS = ("point", "centre", "radius", "half_height", "polygon", "vertices")
"""Fields of obstacles that are lengths [m]."""

IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
Geometry = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Gap [m] (k,), normal (k, 3) and curvature [1/m] (k, 3, 3) at k points."""


@dataclass(frozen=True, kw_only=True)
class RigidShape(ABC):
    """A rigid solid that bodies may touch but not enter: what all kinds have in common.

    Attributes:
        name: name in messages and results.
        friction: Coulomb coefficient of friction.
        frame: first row of the frame of the model that carries the obstacle; None if it stands still in space.
    """

    kind: ClassVar[str]
    name: str = ""
    friction: float = 0.0
    frame: int | None = None

    def __post_init__(self) -> None:
        self._store("friction", self.friction, (), at_least=0.0)
        check_quantity("friction", self.friction, f"{self._label}: friction")
        whole = isinstance(self.frame, int | np.integer) and not isinstance(self.frame, bool)
        if self.frame is not None and (not whole or self.frame < 0):
            raise ValueError(f"{self._label}: frame must be None or a row >= 0, got {self.frame!r}")

    @property
    def _label(self) -> str:
        return f"{self.kind} '{self.name}'" if self.name else self.kind

    def _store(
        self,
        field: str,
        value: object,
        shape: tuple[int, ...],
        *,
        at_least: float | None = None,
        above: float | None = None,
        unit: bool = False,
    ) -> None:
        """Check a field and store it as a float or as nested tuples of floats.

        Args:
            field: name of the field.
            value: the value given.
            shape: required shape; -1 allows any length.
            at_least: smallest value allowed.
            above: value that must be exceeded.
            unit: whether to scale a vector to length one.
        """
        wanted = "a finite number" if not shape else f"finite numbers of shape {shape}".replace("-1", "m")
        try:
            array = np.asarray(value, dtype=float)
        except (TypeError, ValueError):
            array = np.full(1, np.nan)
        fits = array.ndim == len(shape) and all(n in (-1, m) for n, m in zip(shape, array.shape, strict=True))
        if not fits or not np.isfinite(array).all():
            raise ValueError(f"{self._label}: {field} must be {wanted}, got {value!r}")
        if at_least is not None and (array < at_least).any():
            raise ValueError(f"{self._label}: {field} must be at least {at_least:g}, got {value!r}")
        if above is not None and (array <= above).any():
            raise ValueError(f"{self._label}: {field} must be greater than {above:g}, got {value!r}")
        if field in _LENGTHS:
            check_quantity("length", array, f"{self._label}: {field}")
        if unit:
            length = np.linalg.norm(array)
            if length == 0.0:
                raise ValueError(f"{self._label}: {field} must not be zero, got {value!r}")
            if abs(length - 1.0) > 1e-15:  # a stored vector stays what it is
                array = array / length
        stored = tuple(map(tuple, array.tolist())) if array.ndim == 2 else array.tolist()
        object.__setattr__(self, field, tuple(stored) if array.ndim == 1 else stored)

    @abstractmethod
    def skin(self, extent: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
        """Surface for pictures: vertices [m] (v, 3) and triangles (t, 3), counter-clockwise from outside.

        Args:
            extent: half the size [m] of the part shown of an obstacle that is infinite.
        """

    @abstractmethod
    def distance_to(self, points: np.ndarray) -> float:
        """Smallest distance [m] to points [m] (k, 3), or to the box around them; negative inside."""

    def as_dict(self) -> dict[str, Any]:
        """The record from which `obstacle_from` makes an equal obstacle; it can be stored as JSON."""
        return {"kind": self.kind, **{field.name: getattr(self, field.name) for field in fields(self)}}


class Obstacle(RigidShape):
    """A rigid solid with a closed formula for the gap."""

    def distance_to(self, points: np.ndarray) -> float:
        return float(self.gap(points).min())

    @abstractmethod
    def gap(self, points: np.ndarray) -> np.ndarray:
        """Distance [m] (k,) of points [m] (k, 3) to the surface, negative inside."""

    @abstractmethod
    def geometry(self, points: np.ndarray) -> Geometry:
        """Gap [m] (k,), its gradient (k, 3) and its second derivative [1/m] (k, 3, 3) at points [m] (k, 3)."""


@dataclass(frozen=True)
class Plane(Obstacle):
    """A half-space.

    Attributes:
        point: a point of its surface [m].
        normal: direction out of the solid, of any length; stored as a unit vector.
    """

    kind: ClassVar[str] = "plane"
    point: Sequence[float]
    normal: Sequence[float]

    def __post_init__(self) -> None:
        super().__post_init__()
        self._store("point", self.point, (3,))
        self._store("normal", self.normal, (3,), unit=True)

    @cached_property
    def _offset(self) -> float:
        return float(np.dot(self.point, self.normal))

    def gap(self, points: np.ndarray) -> np.ndarray:
        return points @ np.asarray(self.normal) - self._offset

    def geometry(self, points: np.ndarray) -> Geometry:
        normal = np.broadcast_to(np.asarray(self.normal), points.shape)
        return self.gap(points), normal, np.zeros((len(points), 3, 3))

    def skin(self, extent: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
        a, b = extent * across(np.asarray(self.normal))
        corners = np.asarray(self.point) + np.array([-a - b, a - b, a + b, b - a])
        return corners, np.array([(0, 1, 2), (0, 2, 3)])


class _Round(Obstacle):
    """Offset of a point or a line: the gap is the length of a projected vector less the radius."""

    radius: float

    @property
    @abstractmethod
    def _centre(self) -> np.ndarray:
        """A point of the axis, or the centre [m] (3,)."""

    @property
    @abstractmethod
    def _projection(self) -> np.ndarray:
        """Projection across the axis, or the identity (3, 3)."""

    def _arms(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Vectors [m] (k, 3) from the centre or the axis to the points, and their lengths (k,)."""
        arms = (points - self._centre) @ self._projection
        return arms, np.sqrt(np.einsum("ki,ki->k", arms, arms))

    def gap(self, points: np.ndarray) -> np.ndarray:
        return self._arms(points)[1] - self.radius

    def geometry(self, points: np.ndarray) -> Geometry:
        arms, length = self._arms(points)
        # The normal has no value at the centre; it is zero there.
        safe = np.maximum(length, np.finfo(float).tiny)
        normal = arms / safe[:, None]
        curvature = (self._projection - normal[:, :, None] * normal[:, None, :]) / safe[:, None, None]
        return length - self.radius, normal, curvature


@dataclass(frozen=True)
class Sphere(_Round):
    """A ball.

    Attributes:
        centre: [m].
        radius: [m].
    """

    kind: ClassVar[str] = "sphere"
    centre: Sequence[float]
    radius: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self._store("centre", self.centre, (3,))
        self._store("radius", self.radius, (), above=0.0)

    @cached_property
    def _centre(self) -> np.ndarray:
        return np.asarray(self.centre)

    @cached_property
    def _projection(self) -> np.ndarray:
        return np.eye(3)

    def skin(self, extent: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
        return convex_surface(self._centre + self.radius * directions())


@dataclass(frozen=True)
class Cylinder(_Round):
    """An infinite round cylinder.

    Attributes:
        point: a point of its axis [m].
        axis: direction of its axis, of any length; stored as a unit vector.
        radius: [m].
    """

    kind: ClassVar[str] = "cylinder"
    point: Sequence[float]
    axis: Sequence[float]
    radius: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self._store("point", self.point, (3,))
        self._store("axis", self.axis, (3,), unit=True)
        self._store("radius", self.radius, (), above=0.0)

    @cached_property
    def _centre(self) -> np.ndarray:
        return np.asarray(self.point)

    @cached_property
    def _projection(self) -> np.ndarray:
        return np.eye(3) - np.outer(self.axis, self.axis)

    def skin(self, extent: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
        angle = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
        circle = self._centre + self.radius * np.column_stack([np.cos(angle), np.sin(angle)]) @ across(
            np.asarray(self.axis)
        )
        end = extent * np.asarray(self.axis)
        return convex_surface(np.concatenate([circle - end, circle + end]))


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


@dataclass(frozen=True)
class MeshObstacle(RigidShape):
    """A solid bounded by triangles.

    It has no formula for its gap: bodies touch it by their surfaces, see `self_contact`. Only its surface keeps them
    out, so no part of a body may lie inside at the start.

    Attributes:
        vertices: [m], shape (m, 3).
        triangles: vertex numbers, counter-clockwise from outside, shape (t, 3).
    """

    kind: ClassVar[str] = "mesh"
    vertices: Sequence[Sequence[float]]
    triangles: Sequence[Sequence[int]]

    def __post_init__(self) -> None:
        super().__post_init__()
        self._store("vertices", self.vertices, (-1, 3))
        self._store("triangles", self.triangles, (-1, 3), at_least=0.0)
        numbers = np.asarray(self.triangles)
        if len(numbers) == 0:
            raise ValueError(f"{self._label}: triangles must not be empty")
        if (numbers % 1.0 != 0.0).any() or numbers.max() >= len(self.vertices):
            raise ValueError(f"{self._label}: triangles must be whole numbers below {len(self.vertices)}")
        object.__setattr__(self, "triangles", tuple(map(tuple, numbers.astype(int).tolist())))

    def distance_to(self, points: np.ndarray) -> float:
        own = np.asarray(self.vertices)
        between = np.maximum(own.min(axis=0) - points.max(axis=0), points.min(axis=0) - own.max(axis=0))
        return float(np.linalg.norm(between.clip(min=0.0)))

    def skin(self, extent: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(self.vertices), np.asarray(self.triangles)


# -- surfaces for pictures ----------------------------------------------------------------------------------------


def across(axis: np.ndarray) -> np.ndarray:
    """Two unit vectors (2, 3) that are right-handed with a unit vector (3,)."""
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(axis, first)])


def directions(azimuths: np.ndarray | Sequence[float] = ()) -> np.ndarray:
    """Unit vectors (k, 3) on a grid of the sphere that has z as its pole and includes the given azimuths [rad]."""
    turn = np.concatenate([np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False), azimuths])[:, None]
    rise = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 13)[None]
    grid = np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise) + 0.0 * turn], axis=2)
    return grid.reshape(-1, 3)


def convex_surface(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and outward triangles (t, 3) of the convex hull of points (k, 3)."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    triangles = hull.simplices.copy()
    a, b, c = points[triangles].swapaxes(0, 1)
    inward = np.einsum("ti,ti->t", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    triangles[inward] = triangles[inward, ::-1]
    used, indices = np.unique(triangles, return_inverse=True)
    return points[used], indices.reshape(-1, 3)


# -- records ------------------------------------------------------------------------------------------------------

KINDS: Mapping[str, type[Obstacle] | type[MeshObstacle]] = {
    each.kind: each for each in (Plane, Sphere, Cylinder, RoundedPrism, MeshObstacle)
}


def obstacle_from(record: Mapping[str, Any] | Obstacle | MeshObstacle) -> Obstacle | MeshObstacle:
    """Make an obstacle from a plain record such as ``{"kind": "plane", "point": [0, 0, 0], "normal": [0, 0, 1]}``.

    Args:
        record: the kind and the attributes of its class; an obstacle is returned as it is.

    Raises:
        ValueError: the kind or a key does not exist, a key is missing, or a value is not allowed.
    """
    if isinstance(record, Obstacle | MeshObstacle):
        return record
    if not isinstance(record, Mapping) or "kind" not in record:
        raise ValueError(f"an obstacle needs a record with a kind ({', '.join(KINDS)}), got {record!r}")
    values = dict(record)
    kind = values.pop("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        raise ValueError(unknown_name("kind of obstacle", kind, KINDS))
    allowed = fields(KINDS[kind])
    for key in values:
        if key not in [field.name for field in allowed]:
            raise ValueError(unknown_name(f"key of obstacle '{kind}'", key, [field.name for field in allowed]))
    missing = [field.name for field in allowed if field.default is MISSING and field.name not in values]
    if missing:
        raise ValueError(f"obstacle '{kind}': missing {', '.join(missing)}")
    return KINDS[kind](**values)
