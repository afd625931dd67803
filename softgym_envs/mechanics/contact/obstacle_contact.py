"""Contact of the points of a surface with one obstacle."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix, vstack

from softgym_envs.mechanics.contact.law import barrier, friction, friction_energy
from softgym_envs.mechanics.contact.obstacles import Obstacle
from softgym_envs.mechanics.contact.surface import Mapping


class Touch(NamedTuple):
    """Points near an obstacle, at one state. Vectors are along the axes of the obstacle's frame, if it has one.

    Attributes:
        points: their numbers, shape (k,).
        gap: [m], shape (k,).
        normal: of the obstacle, shape (k, 3).
        pressing: normal forces [N], shape (k,).
        rubbing: friction forces on the points [N], shape (k, 3).
        sliding: shape (k,).
        elastic: stretch of the friction springs [m], shape (k, 3).
        force: on the points, along the axes of space [N], shape (k, 3).
        jacobian: derivatives of points and frame by the equations, shape (m k, N), m = 3 or, with a frame, 15.
        pull: derivative of the energy by points and frame, shape (k, m).
        tangent: its derivative while the limits of friction are held, shape (k, m, m).
        direction: derivative of the length of the springs of sliding points, shape (k, m).
        loading: derivative of the limits of friction, shape (k, m); zero where points do not slide.
        gaps: derivative of the gaps, shape (k, m).
        stiffness: derivative of minus the normal forces by the gaps [N/m], shape (k,).
    """

    points: np.ndarray
    gap: np.ndarray
    normal: np.ndarray
    pressing: np.ndarray
    rubbing: np.ndarray
    sliding: np.ndarray
    elastic: np.ndarray
    force: np.ndarray
    jacobian: csr_matrix
    pull: np.ndarray
    tangent: np.ndarray
    direction: np.ndarray
    loading: np.ndarray
    gaps: np.ndarray
    stiffness: np.ndarray

    def hessian(self) -> csr_matrix:
        """Return the tangent over the equations, shape (N, N)."""
        count = len(self.tangent)
        blocks = bsr_matrix((self.tangent, np.arange(count), np.arange(count + 1))) if count else csr_matrix((0, 0))
        return (self.jacobian.T @ (blocks.tocsr() @ self.jacobian)).tocsr()

    def columns(self, values: np.ndarray, chosen: np.ndarray) -> csc_matrix:
        """Return derivatives (k, m) of chosen points as columns over the equations, shape (N, c)."""
        rows = np.flatnonzero(chosen)
        m = values.shape[1]
        places = (m * rows[:, None] + np.arange(m)).ravel()
        pointers = m * np.arange(len(rows) + 1)
        return self.jacobian.T.tocsc() @ csc_matrix(
            (values[rows].ravel(), places, pointers), shape=(values.size, len(rows))
        )


class ObstacleContact:
    """Energy of the points of a surface that touch one obstacle, and its derivatives.

    Args:
        obstacle: the obstacle.
        weights: the points as combinations of the rows, shape (p, n).
        area: of the points [m2], shape (p,).
        mapping: of the points to the equations.
        frame: mapping of the rows of the obstacle's frame, or None.
        distance: gap at which forces vanish [m].
        stiffness: of the barrier [Pa].
        stick: stiffness of friction springs per area [Pa/m].
    """

    def __init__(
        self,
        obstacle: Obstacle,
        weights: csr_matrix,
        area: np.ndarray,
        mapping: Mapping,
        frame: Mapping | None,
        *,
        distance: float,
        stiffness: float,
        stick: float,
    ) -> None:
        self.obstacle = obstacle
        self.weights = weights
        self.area = area
        self._mapping = mapping
        self._frame = frame
        self.distance = distance
        self.stiffness = stiffness
        self._stick = stick * area

    def local(self, x: np.ndarray) -> np.ndarray:
        """Return the points [m] (p, 3) along the axes of the obstacle's frame at rows ``x`` (n, 3)."""
        places = self.weights @ x
        frame = self.obstacle.frame
        return places if frame is None else (places - x[frame]) @ x[frame + 1 : frame + 4].T

    def gaps(self, x: np.ndarray) -> np.ndarray:
        """Return all gaps [m], shape (p,)."""
        return self.obstacle.gap(self.local(x))

    def next_point(self, x: np.ndarray, motions: np.ndarray) -> tuple[int, float]:
        """Return the point that motions bring to the obstacle first, and its gap [m].

        Args:
            x: rows (n, 3).
            motions: of the equations, scaled alike, shape (N, k). Without any, the nearest point that can move counts.
        """
        touch = self.touch(x, None, points=np.arange(len(self.area)))
        if motions.shape[1]:
            moved = (touch.jacobian @ motions).reshape(*touch.gaps.shape, -1)
            speed = np.abs(np.einsum("pi,pik->pk", touch.gaps, moved)).max(axis=1)
        else:
            speed = np.asarray(abs(touch.jacobian).sum(axis=1)).reshape(touch.gaps.shape).any(axis=1).astype(float)
        with np.errstate(divide="ignore"):
            way = touch.gap / speed
        point = int((way if np.isfinite(way).any() else touch.gap).argmin())
        return point, float(touch.gap[point])

    def energy(self, x: np.ndarray, anchors: np.ndarray | None, limits: np.ndarray | None) -> float:
        """Return the potential [J]; inf if a point is inside the obstacle.

        Args:
            x: rows (n, 3).
            anchors: of friction [m], shape (p, 3).
            limits: held limits of friction [N], shape (p,).
        """
        local = self.local(x)
        gap = self.obstacle.gap(local)
        if not (gap > 0.0).all():
            return np.inf
        near = gap < self.distance
        total = 0.0
        if near.any():
            total = self.stiffness * float(self.area[near] @ barrier(gap[near], self.distance)[0])
        if anchors is not None and limits is not None and (limits > 0.0).any():
            held = np.flatnonzero(limits > 0.0)
            normal = self.obstacle.geometry(anchors[held])[1]
            stretch = local[held] - anchors[held]
            stretch = stretch - np.einsum("ki,ki->k", normal, stretch)[:, None] * normal
            total += float(friction_energy(np.linalg.norm(stretch, axis=1), self._stick[held], limits[held]).sum())
        return total

    def touch(
        self,
        x: np.ndarray,
        anchors: np.ndarray | None,
        *,
        convex: bool = False,
        held: bool = False,
        points: np.ndarray | None = None,
    ) -> Touch:
        """Return forces and derivatives at rows ``x`` (n, 3).

        Args:
            x: rows.
            anchors: of friction [m], shape (p, 3), or None without friction.
            convex: leave out the terms that can make the tangent indefinite.
            held: the tangent is that of forces which do not change.
            points: numbers of the points, by default those within the distance of contact.
        """
        local = self.local(x)
        if points is None:
            points = np.flatnonzero(self.obstacle.gap(local) < self.distance)
        near = local[points]
        gap, normal, curvature = self.obstacle.geometry(near)
        _, first, second = barrier(gap, self.distance)
        first, second = self.stiffness * self.area[points] * first, self.stiffness * self.area[points] * second
        pull = first[:, None] * normal
        tangent = np.where(held, 0.0, second)[:, None, None] * normal[:, :, None] * normal[:, None, :]
        if not convex:
            tangent = tangent + first[:, None, None] * curvature
        count = len(points)
        rubbing, elastic = np.zeros((count, 3)), np.zeros((count, 3))
        sliding = np.zeros(count, dtype=bool)
        direction, loading = np.zeros((count, 3)), np.zeros((count, 3))
        if anchors is not None and count:
            coefficient = self.obstacle.friction
            start = anchors[points]
            found = friction(near - start, self.obstacle.geometry(start)[1], self._stick[points], -coefficient * first)
            rubbing, sliding = -found.force, found.sliding
            elastic = -rubbing / self._stick[points][:, None]
            pull = pull + found.force
            tangent = tangent + (0.0 if held else found.tangent)
            direction = np.where(sliding[:, None], found.direction, 0.0)
            loading = np.where(sliding[:, None], -coefficient * second[:, None] * normal, 0.0)
        force = -pull
        jacobian = self._mapping.jacobian(points)
        gaps = normal
        chain = self._chain(x, points)
        if chain is not None:
            force = force @ chain[0, :, :3] if count else force
            tangent = np.einsum("kai,kab,kbj->kij", chain, tangent, chain)
            if not convex:
                for k in range(3):
                    for axis in range(3):
                        director = 6 + 3 * k + axis
                        for other, sign in ((axis, 1.0), (3 + axis, -1.0)):
                            tangent[:, director, other] += sign * pull[:, k]
                            tangent[:, other, director] += sign * pull[:, k]
            pull, direction, loading, gaps = (
                np.einsum("ka,kai->ki", v, chain) for v in (pull, direction, loading, normal)
            )
            jacobian = self._with_frame(jacobian, count)
        return Touch(
            points, gap, normal, -first, rubbing, sliding, elastic, force, jacobian, pull, tangent, direction, loading,
            gaps, second,
        )  # fmt: skip

    def _chain(self, x: np.ndarray, points: np.ndarray) -> np.ndarray | None:
        """Derivatives of local coordinates ``l_k = d_k . (p - o)`` by p, o and the directors d_k, shape (k, 3, 15)."""
        frame = self.obstacle.frame
        if frame is None:
            return None
        chain = np.zeros((len(points), 3, 15))
        chain[:, :, 0:3] = x[frame + 1 : frame + 4]
        chain[:, :, 3:6] = -x[frame + 1 : frame + 4]
        arm = (self.weights[points] @ x) - x[frame]
        for k in range(3):
            chain[:, k, 6 + 3 * k : 9 + 3 * k] = arm
        return chain

    def along(self, x: np.ndarray, touch: Touch, axes: np.ndarray) -> np.ndarray:
        """Return the derivative of the motion of touching points along fixed axes (k, 3), shape (k, m)."""
        chain = self._chain(x, touch.points)
        return axes if chain is None else np.einsum("ka,kai->ki", axes, chain)

    @property
    def stick(self) -> np.ndarray:
        """Stiffness of the friction springs of all points [N/m], shape (p,)."""
        return self._stick

    def limits(self, touch: Touch) -> np.ndarray:
        """Return the largest friction force of each point [N], shape (p,)."""
        limits = np.zeros(len(self.area))
        limits[touch.points] = self.obstacle.friction * touch.pressing
        return limits

    def _with_frame(self, jacobian: csr_matrix, count: int) -> csr_matrix:
        """Interleave the derivatives of points (3 k, N) with those of the frame's four rows, shape (15 k, N)."""
        assert self._frame is not None
        both = vstack([jacobian, self._frame.all]).tocsr()
        order = np.concatenate(
            [3 * np.arange(count)[:, None] + np.arange(3), np.tile(3 * count + np.arange(12), (count, 1))], axis=1
        )
        return both[order.ravel()]

    def add_to_rows(self, touch: Touch, out: np.ndarray) -> None:
        """Add the derivative of the energy by the rows to ``out`` (n, 3)."""
        out += self.weights[touch.points].T @ touch.pull[:, :3]
        if self.obstacle.frame is not None:
            frame = self.obstacle.frame
            out[frame : frame + 4] += touch.pull[:, 3:].sum(axis=0).reshape(4, 3)

    def free_path(self, start: np.ndarray, end: np.ndarray) -> float:
        """Return the part of the way from rows ``start`` to ``end`` (n, 3) that no point enters the obstacle on.

        Points advance by no more than their gap, which changes by no more than the distance that they move. A point
        that comes nearer than a tenth of its gap stops.
        """
        first, last = self.local(start), self.local(end)
        way = last - first
        length = np.linalg.norm(way, axis=1)
        gap = self.obstacle.gap(first)
        active = np.flatnonzero(gap <= length)
        part = np.zeros(len(active))
        goal, left = 0.1 * gap[active], gap[active]
        result = 1.0
        while len(active):
            part = part + 0.9 * left / length[active]
            inside = part < min(result, 1.0)
            active, part, goal = active[inside], part[inside], goal[inside]
            left = self.obstacle.gap(first[active] + part[:, None] * way[active])
            stopped = left <= goal
            if stopped.any():
                result = min(result, float(part[stopped].min()))
                active, part, goal, left = active[~stopped], part[~stopped], goal[~stopped], left[~stopped]
        return result
