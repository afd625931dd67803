"""Contact between triangle surfaces: of a body with itself, of bodies with each other, and with meshed obstacles.

The energy is a barrier between all pairs of a vertex and a face, and of two edges, that are closer than ``distance``:
Li et al., "Incremental Potential Contact" (2020), with the area weights and the barrier with physical units of Li et
al., "Convergent Incremental Potential Contact" (2023). Collisions, distances and their derivatives come from ipctk, the
library of the authors; steps are limited by its additive collision detection (Li, Kaufman, Jiang 2021).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any, Literal

import numpy as np
from scipy.sparse import csc_matrix

Pairs = Literal["IPC", "IMPROVED_MAX_APPROX"]
MAX_CCD_STEPS = 1_000
"""Steps of the collision detection along the path of one pair; where they end, the path is taken to end, too."""

CCD_SHARE = 0.9
"""Share of a distance that a step may use up."""

LONG_WAY = 3.0
"""Pairs along steps longer than this multiple of ``reach`` are too many to keep: they serve for one step only."""

PIECE = 8.0
"""Length of the pieces of such steps, relative to ``reach``."""


@cache
def load_ipctk() -> ModuleType:
    """Import ipctk, on one thread and without its messages.

    Raises:
        ImportError: it is not installed.
    """
    try:
        import ipctk
    except ImportError as error:
        raise ImportError(f"contact between surfaces needs ipctk ({error}): pip install ipctk") from None
    ipctk.set_num_threads(1)
    ipctk.set_logger_level(ipctk.error)
    return ipctk


def _relative(motion: np.ndarray) -> np.ndarray:
    """Motion [m] (m, 3) of the vertices less a common translation, which changes no distance."""
    return motion - 0.5 * (motion.min(axis=0) + motion.max(axis=0))


def _longest(vectors: np.ndarray) -> float:
    return float(np.sqrt(np.einsum("ki,ki->k", vectors, vectors).max(initial=0.0)))


def _friction_of_pair(first: float, second: float) -> float:
    """Coefficient of friction of two parts: that of the obstacle among them, marked by -1 - friction."""
    mark = min(first, second)
    return -1.0 - mark if mark < 0.0 else max(first, second)


@dataclass(frozen=True, eq=False)
class SelfContactMemory:
    """What friction remembers: where the vertices were when the increment began.

    Attributes:
        start: positions [m] (m, 3); None before the first increment.
    """

    start: np.ndarray | None = None


class SelfContact:
    """Barrier and friction between the vertices of triangle surfaces.

    All methods take the positions ``v`` [m] (m, 3) of the vertices. The surfaces must not intersect; `max_step` limits
    a step so that they never do. Parts of one surface that do not share a vertex are pairs, too: edges should be longer
    than ``distance``, and walls thicker.

    Friction is Coulomb's, smoothed over a sliding distance, with the normal forces and tangent planes of the beginning
    of an increment (Li et al. 2020, sec. 5). It has no memory beyond the increment: a contact that sticks creeps by
    less than ``smoothing`` in each.

    Args:
        rest: rest positions [m], shape (m, 3); the areas of the weights are theirs.
        faces: triangles, shape (f, 3).
        distance: distance [m] below which surfaces repel each other.
        stiffness: stiffness [Pa] of the barrier.
        friction: Coulomb coefficient of friction.
        pairs: how the pairs are combined, see ipctk. Both kinds pass the contact patch test.
        edges: edges, shape (e, 2); by default those of the faces.
        groups: group of each vertex, shape (m,). Vertices of one group do not touch each other; the vertices with a
            negative number touch all. By default all touch all.
        obstacle_friction: coefficient of friction between bodies and each vertex of an obstacle, NaN for the vertices
            of bodies, shape (m,). By default no vertex belongs to an obstacle.
        smoothing: sliding distance [m] in an increment over which friction grows to its full value.
        reach: the pairs closer than twice this [m] are kept, and searched anew when vertices have moved farther than it
            exceeds half of ``distance``; by default a twentieth of the mean edge. It affects the speed only.
    """

    def __init__(
        self,
        rest: np.ndarray,
        faces: np.ndarray,
        *,
        distance: float,
        stiffness: float,
        friction: float = 0.0,
        pairs: Pairs = "IPC",
        edges: np.ndarray | None = None,
        groups: np.ndarray | None = None,
        obstacle_friction: np.ndarray | None = None,
        smoothing: float = 1e-5,
        reach: float | None = None,
    ) -> None:
        for name, value in (("distance", distance), ("stiffness", stiffness), ("smoothing", smoothing)):
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"self-contact: {name} must be a positive number, got {value!r}")
        if reach is not None and not (np.isfinite(reach) and reach > 0.5 * distance):
            raise ValueError(f"self-contact: reach must be more than half of distance {distance!r}, got {reach!r}")
        if not (np.isfinite(friction) and friction >= 0.0):
            raise ValueError(f"self-contact: friction must be a number >= 0, got {friction!r}")
        ipctk = self._ipctk = load_ipctk()
        allowed = ("IPC", "IMPROVED_MAX_APPROX")
        if pairs not in allowed:
            raise ValueError(f"self-contact: pairs must be one of {', '.join(allowed)}, got {pairs!r}")
        rest = np.asarray(rest, dtype=float)
        if rest.ndim != 2 or rest.shape[1] != 3 or not np.isfinite(rest).all():
            raise ValueError(f"self-contact: rest must be finite numbers of shape (m, 3), got shape {rest.shape}")
        triangles = self._indices("faces", faces, 3, len(rest))
        lines = ipctk.edges(triangles) if edges is None else self._indices("edges", edges, 2, len(rest))
        self.mesh = ipctk.CollisionMesh(np.asfortranarray(rest), np.asfortranarray(lines, dtype=np.int32), triangles)
        if groups is not None:
            groups = np.asarray(groups)
            if groups.shape != (len(rest),):
                raise ValueError(f"self-contact: groups must have shape ({len(rest)},), got {groups.shape}")
            if (groups >= 0).any():
                own = groups.max() + 1 + np.arange(len(rest))
                labels = np.where(groups < 0, own, groups).astype(np.int32)
                self.mesh.can_collide = ipctk.make_vertex_patches_filter(labels)
        self.distance = distance
        self.friction = np.full(len(rest), float(friction))
        if obstacle_friction is not None:
            given = np.asarray(obstacle_friction, dtype=float)
            if given.shape != (len(rest),) or not ((given >= 0.0) & (given < np.inf) | np.isnan(given)).all():
                raise ValueError(
                    f"self-contact: obstacle_friction must be NaN or a number >= 0 per vertex, shape ({len(rest)},)"
                )
            # The marks of obstacles are negative, so that `_friction_of_pair` can tell them from bodies.
            self.friction = np.where(np.isnan(given), self.friction, -1.0 - given)
        ends = rest[lines]
        span = float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).mean()) if len(lines) else distance
        self.reach = 0.5 * distance + 0.05 * span if reach is None else reach
        self._kind = getattr(ipctk.NormalCollisions.CollisionSetType, pairs)
        self._barrier = ipctk.BarrierPotential(distance, stiffness, use_physical_barrier=True)
        self._friction = ipctk.FrictionPotential(smoothing)
        self._broad_phase = ipctk.LBVH()
        self._ccd = ipctk.AdditiveCCD(MAX_CCD_STEPS, CCD_SHARE)
        self._candidates: Any = None
        self._path = rest, np.zeros_like(rest)
        self._collisions: Any = None
        self._at = np.empty((0, 3))
        self._memory = SelfContactMemory()
        self._tangential: Any = None

    @staticmethod
    def _indices(name: str, values: np.ndarray, columns: int, count: int) -> np.ndarray:
        array = np.asarray(values)
        if array.size == 0:
            return np.empty((0, columns), dtype=np.int32, order="F")
        if array.ndim != 2 or array.shape[1] != columns or not np.issubdtype(array.dtype, np.integer):
            raise ValueError(f"self-contact: {name} must be integers of shape (n, {columns}), got shape {array.shape}")
        if array.min() < 0 or array.max() >= count:
            raise ValueError(
                f"self-contact: {name} must be vertex numbers from 0 to {count - 1}, got {array.min()} to {array.max()}"
            )
        return np.asfortranarray(array, dtype=np.int32)

    # -- pairs ----------------------------------------------------------------------------------------------------

    def _near(self, v: np.ndarray) -> bool:
        """Whether every pair closer than ``distance`` is among the candidates.

        They are the pairs that come closer than twice ``reach`` somewhere on a straight path. A distance shrinks by at
        most twice the largest motion away from that path.
        """
        if self._candidates is None:
            return False
        start, way = self._path
        moved, square = _relative(v - start), float(np.vdot(way, way))
        along = min(max(float(np.vdot(moved, way)) / square, 0.0), 1.0) if square > 0.0 else 0.0
        return _longest(_relative(moved - along * way)) <= self.reach - 0.5 * self.distance

    def _candidates_on(self, start: np.ndarray, way: np.ndarray) -> Any:
        """Pairs that can meet within ``reach`` less half of ``distance`` of the path from ``start`` along ``way``."""
        if not (self._near(start) and self._near(start + way)):
            self._candidates = self._ipctk.Candidates()
            self._candidates.build(self.mesh, start, np.asfortranarray(start + way), self.reach, self._broad_phase)
            self._path = start.copy(), way.copy()
        return self._candidates

    def _collisions_at(self, v: np.ndarray) -> Any:
        """Pairs closer than ``distance``; energy and derivatives at the same positions share them."""
        if self._collisions is None or not np.array_equal(v, self._at):
            collisions = self._ipctk.NormalCollisions()
            collisions.use_area_weighting = True
            collisions.collision_set_type = self._kind
            collisions.build(self._candidates_on(v, np.zeros_like(v)), self.mesh, v, self.distance)
            self._collisions, self._at = collisions, v.copy()
        return self._collisions

    def pairs(self, v: np.ndarray, within: float) -> np.ndarray:
        """Vertices of all pairs closer than a distance [m], -1 where a pair has fewer than four, shape (k, 4)."""
        v = np.asfortranarray(v)
        collisions = self._ipctk.NormalCollisions()
        collisions.build(self.mesh, v, within, broad_phase=self._broad_phase)
        edges, faces = self.mesh.edges, self.mesh.faces
        ids = [collisions[k].vertex_ids(edges, faces) for k in range(len(collisions))]
        return np.asarray(ids, dtype=np.int64).reshape(-1, 4)

    # -- energy ---------------------------------------------------------------------------------------------------

    def energy(self, v: np.ndarray) -> float:
        """Energy [J] of the barrier, and the potential [J] of the friction within the increment."""
        v = np.asfortranarray(v)
        collisions = self._collisions_at(v)
        energy = self._barrier(collisions, self.mesh, v) if len(collisions) else 0.0
        if self._tangential is not None:
            energy += self._friction(self._tangential, self.mesh, np.asfortranarray(v - self._memory.start))
        return float(energy)

    def gradient(self, v: np.ndarray) -> np.ndarray:
        """Derivative [N] of the energy by the positions, shape (m, 3): minus the forces on the vertices."""
        v = np.asfortranarray(v)
        collisions = self._collisions_at(v)
        gradient = self._barrier.gradient(collisions, self.mesh, v) if len(collisions) else np.zeros(v.size)
        if self._tangential is not None:
            slip = np.asfortranarray(v - self._memory.start)
            gradient = gradient + self._friction.gradient(self._tangential, self.mesh, slip)
        return gradient.reshape(-1, 3)

    def derivatives(self, v: np.ndarray, project: bool = False) -> tuple[np.ndarray, csc_matrix]:
        """First derivative [N] (m, 3) and second derivative [N/m] (3 m, 3 m) of the energy.

        Args:
            v: positions [m], shape (m, 3).
            project: whether to make the block of every pair positive semi-definite.
        """
        v = np.asfortranarray(v)
        modes = self._ipctk.PSDProjectionMethod
        mode = modes.CLAMP if project else modes.NONE
        collisions = self._collisions_at(v)
        if len(collisions):
            hessian = self._barrier.hessian(collisions, self.mesh, v, mode)
        else:
            hessian = csc_matrix((v.size, v.size))
        if self._tangential is not None:
            slip = np.asfortranarray(v - self._memory.start)
            hessian = hessian + self._friction.hessian(self._tangential, self.mesh, slip, mode)
        return self.gradient(v), hessian

    def forces(self, v: np.ndarray) -> np.ndarray:
        """Contact forces [N] on the vertices, shape (m, 3)."""
        return -self.gradient(v)

    # -- friction -------------------------------------------------------------------------------------------------

    @property
    def memory(self) -> SelfContactMemory:
        """What friction remembers; assign it to return to an earlier state."""
        return self._memory

    @memory.setter
    def memory(self, memory: SelfContactMemory) -> None:
        if memory is self._memory:
            return
        self._memory, self._tangential = memory, None
        if memory.start is None or np.isin(self.friction, (0.0, -1.0)).all():
            return
        start = np.asfortranarray(memory.start)
        collisions = self._collisions_at(start)
        if len(collisions):
            self._tangential = self._ipctk.TangentialCollisions()
            marks = self.friction
            self._tangential.build(self.mesh, start, collisions, self._barrier, marks, marks, _friction_of_pair)

    def begin_increment(self, v: np.ndarray) -> None:
        """Start a load increment: friction opposes motion from these positions, under their normal forces."""
        self.memory = SelfContactMemory(np.array(v, dtype=float))

    # -- steps ----------------------------------------------------------------------------------------------------

    def max_step(self, v0: np.ndarray, v1: np.ndarray) -> float:
        """Part of the straight step from ``v0`` to ``v1`` that can be taken without an intersection, in [0, 1]."""
        v0 = np.asfortranarray(v0)
        motion = _relative(v1 - v0)
        if 2.0 * _longest(motion) <= CCD_SHARE * min(self.minimum_distance(v0), self.distance):
            return 1.0
        v1 = np.asfortranarray(v0 + motion)
        if _longest(motion) > LONG_WAY * self.reach:
            return self._long_step(v0, motion)
        candidates = self._candidates_on(v0, motion)
        return float(candidates.compute_collision_free_stepsize(self.mesh, v0, v1, 0.0, self._ccd))

    def _long_step(self, v0: np.ndarray, motion: np.ndarray) -> float:
        """Part of a long motion that can be taken, found piece by piece: pieces have few pairs whose ways overlap."""
        pieces = int(np.ceil(_longest(motion) / (PIECE * self.reach)))
        for k in range(pieces):
            start, end = (np.asfortranarray(v0 + motion * (part / pieces)) for part in (k, k + 1))
            candidates = self._ipctk.Candidates()
            candidates.build(self.mesh, start, end, 0.0, self._broad_phase)
            part = float(candidates.compute_collision_free_stepsize(self.mesh, start, end, 0.0, self._ccd))
            if part < 1.0:
                # The share refers to the distances at the start of this piece, which may already be small.
                return (k + part) / pieces * (CCD_SHARE if k else 1.0)
        return 1.0

    def intersects(self, v: np.ndarray) -> bool:
        """Whether any edge passes through a face that it may touch."""
        return bool(self._ipctk.has_intersections(self.mesh, np.asfortranarray(v), self._broad_phase))

    def minimum_distance(self, v: np.ndarray) -> float:
        """Smallest distance [m] of two parts that do not share a vertex; infinite if none is below ``distance``."""
        v = np.asfortranarray(v)
        collisions = self._collisions_at(v)
        return float(np.sqrt(collisions.compute_minimum_distance(self.mesh, v))) if len(collisions) else np.inf
