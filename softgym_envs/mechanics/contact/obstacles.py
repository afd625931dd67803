"""Rigid obstacles, most with closed formulas for gap, normal and curvature.

Such an obstacle is a convex solid, or the half-space behind a plane. Its *gap* is the distance of a point to its
surface, positive outside. The normal is the gradient of the gap, the curvature its second derivative; both are exact.

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
from softgym_envs.quantities import check_quantity
from softgym_envs.registry import Table

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

KINDS = Table(
    "kind of obstacle",
    {each.kind: each for each in (Plane, Sphere, Cylinder, MeshObstacle)},
    group="softgym_envs.obstacles",
)
"""Classes of obstacles by kind: those given here and those of installed packages."""


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
    made = KINDS[kind]
    allowed = fields(made)
    for key in values:
        if key not in [field.name for field in allowed]:
            raise ValueError(unknown_name(f"key of obstacle '{kind}'", key, [field.name for field in allowed]))
    missing = [field.name for field in allowed if field.default is MISSING and field.name not in values]
    if missing:
        raise ValueError(f"obstacle '{kind}': missing {', '.join(missing)}")
    found: Obstacle | MeshObstacle = made(**values)
    return found
