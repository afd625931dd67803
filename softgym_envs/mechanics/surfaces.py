"""Closed surfaces of triangles: their connected pieces, the cavities of a mesh, and what lies inside."""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Iterable, Sequence
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from softgym_envs.errors import ImpossibleState
from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.constraints.cavity import Cavity, SealedAir, enclosed_volume
from softgym_envs.mechanics.elements.gas import EnclosedGas
from softgym_envs.mechanics.elements.quadratic import split_triangles
from softgym_envs.mechanics.elements.tetrahedra import boundary_triangles

MechanicalModel = Any
"""`softgym_envs.mechanics.model.MechanicalModel`, which imports this module."""


def connected_pieces(triangles: np.ndarray) -> list[np.ndarray]:
    """Split triangles (k, 3) into pieces that share no node."""
    count = int(triangles.max(initial=-1)) + 1
    pairs = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    piece = connected_components(graph, directed=False)[1][triangles[:, 0]]
    return [triangles[piece == number] for number in np.unique(piece)]


def sheets(nodes: np.ndarray, triangles: np.ndarray) -> list[np.ndarray]:
    """Split the closed boundary (k, 3) of a body into sheets, seen from outside the material.

    At an edge that more than two triangles share, where hollows of a coarse mesh pinch themselves or each other, those
    on both sides of one empty wedge belong together.

    Args:
        nodes: positions [m], shape (n, 3).
        triangles: boundary of tetrahedra, counter-clockwise from outside the material.
    """
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    owner = np.tile(np.arange(len(triangles)), 3)
    order = np.lexsort(np.sort(edges, axis=1).T)
    ends = np.sort(edges, axis=1)[order]
    starts = np.flatnonzero(np.r_[True, (np.diff(ends, axis=0) != 0).any(axis=1)])
    sizes = np.diff(np.r_[starts, len(order)])
    plain = starts[sizes == 2]
    pairs = [np.column_stack([owner[order[plain]], owner[order[plain + 1]]])]
    for start, size in zip(starts[sizes > 2].tolist(), sizes[sizes > 2].tolist(), strict=True):
        around = order[start : start + size]
        low, high = ends[start]
        axis = nodes[high] - nodes[low]
        axis /= np.linalg.norm(axis)
        apex = nodes[triangles[owner[around]].sum(axis=1) - low - high] - nodes[low]
        apex -= np.outer(apex @ axis, axis)
        first = apex[0] / np.linalg.norm(apex[0])
        angle = np.arctan2(apex @ np.cross(axis, first), apex @ first)
        turn = np.argsort(angle)
        # The empty side of a triangle that runs along the axis lies counter-clockwise of it.
        along = edges[around, 0] == low
        for k, here in enumerate(turn):
            after = turn[(k + 1) % size]
            if along[here] and not along[after]:
                pairs.append(np.array([[owner[around[here]], owner[around[after]]]]))
    joined = np.concatenate(pairs)
    graph = coo_matrix((np.ones(len(joined)), (joined[:, 0], joined[:, 1])), shape=2 * (len(triangles),))
    number = connected_components(graph, directed=False)[1]
    return [triangles[number == k] for k in range(number.max(initial=-1) + 1)]


def inner_surfaces(nodes: np.ndarray, tetrahedra: np.ndarray) -> list[np.ndarray]:
    """Find the closed cavities of a mesh.

    Args:
        nodes: positions [m], shape (n, 3).
        tetrahedra: corner indices of positively oriented tetrahedra, shape (m, 4).

    Returns:
        Triangles (k, 3) of each cavity, seen counter-clockwise from inside it.
    """
    # Material lies inside the hull and outside the cavities: the volume within a cavity counts as negative.
    return [piece for piece in sheets(nodes, boundary_triangles(tetrahedra)) if enclosed_volume(nodes, piece) < 0.0]


def encloses(nodes: np.ndarray, triangles: np.ndarray, point: np.ndarray) -> bool:
    """Whether a closed, consistently oriented surface of triangles (k, 3) encloses a point [m] (3,).

    The sum of the solid angles of the triangles is 4 pi inside and 0 outside (Van Oosterom and Strackee 1983).
    """
    a, b, c = (nodes[triangles[:, i]] - point for i in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    across = la * lb * lc
    for u, v, length in ((a, b, lc), (b, c, la), (c, a, lb)):
        across += np.einsum("ij,ij->i", u, v) * length
    return abs(2.0 * np.arctan2(volume, across).sum()) > 2.0 * np.pi


def cavity_around(nodes: np.ndarray, tetrahedra: np.ndarray, point: np.ndarray, name: str) -> np.ndarray:
    """Return the surface (k, 3) of the cavity of a mesh that encloses a point.

    Args:
        nodes: positions [m], shape (n, 3).
        tetrahedra: corner indices of positively oriented tetrahedra, shape (m, 4).
        point: [m], shape (3,).
        name: of the cavity, for the message.

    Raises:
        ValueError: if no closed cavity encloses the point.
    """
    found = inner_surfaces(nodes, tetrahedra)
    around = [piece for piece in found if encloses(nodes, piece, point)]
    if not around:
        middles = [np.round(nodes[np.unique(piece)].mean(axis=0), 4).tolist() for piece in found]
        known = f"its cavities lie around {middles} m" if found else "it has none, or they are open to the outside"
        raise ValueError(f"no closed cavity of the body encloses {point.tolist()} m for '{name}'; {known}")
    # A part inside a cavity may itself have a cavity: take the smallest one.
    return min(around, key=lambda piece: abs(enclosed_volume(nodes, piece)))


def cavity_like(
    nodes: np.ndarray, tetrahedra: np.ndarray, surfaces: Sequence[tuple[np.ndarray, np.ndarray]], name: str
) -> np.ndarray:
    """Return the surface (k, 3) of the cavity of a mesh that a surface in space fills.

    It fills one if their boxes differ by less than a tenth of their size and their volumes by less than a quarter:
    meshes of one shape differ in how they round it.

    Args:
        nodes: positions [m], shape (n, 3).
        tetrahedra: corner indices of positively oriented tetrahedra, shape (m, 4).
        surfaces: points [m] (p, 3) and triangles (t, 3) of the surface, in each unit that it may have.
        name: of the cavity, for the message.

    Raises:
        ValueError: if the surface fills none, or several.
    """
    hollows = inner_surfaces(nodes, tetrahedra)
    boxes = [np.array([nodes[np.unique(each)].min(axis=0), nodes[np.unique(each)].max(axis=0)]) for each in hollows]
    found: dict[int, float] = {}
    for points, triangles in surfaces:
        used = points[np.unique(triangles)]
        box, volume = np.array([used.min(axis=0), used.max(axis=0)]), abs(enclosed_volume(points, triangles))
        for number, (hollow, other) in enumerate(zip(hollows, boxes, strict=True)):
            off = float(np.abs(box - other).max() / np.ptp(other, axis=0).max())
            inner = abs(enclosed_volume(nodes, hollow))
            if off < 0.1 and abs(volume - inner) < 0.25 * inner:
                found[number] = min(off, found.get(number, np.inf))
    if found:
        return hollows[min(found, key=lambda number: found[number])]
    points, triangles = surfaces[0]
    used = points[np.unique(triangles)]
    spans = ", ".join(f"{a:.4g} to {b:.4g}" for a, b in zip(used.min(axis=0), used.max(axis=0), strict=True))
    places = [" x ".join(f"{a:.4g} to {b:.4g}" for a, b in box.T) + " m" for box in boxes]
    known = f"its cavities span {'; '.join(places)}" if places else "it has none, or they are open to the outside"
    raise ValueError(
        f"the surface of cavity '{name}', which spans {spans} in the numbers of its file, fills no cavity of the body; "
        f"{known}"
    )


@njit(cache=True, error_model="numpy")
def _pierces(start, end, a, b, c, tolerance):
    """Whether the open segment from ``start`` to ``end`` crosses the inside of a triangle (Moeller and Trumbore)."""
    d0, d1, d2 = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    u0, u1, u2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    v0, v1, v2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    p0, p1, p2 = d1 * v2 - d2 * v1, d2 * v0 - d0 * v2, d0 * v1 - d1 * v0
    determinant = u0 * p0 + u1 * p1 + u2 * p2
    square = (d0 * d0 + d1 * d1 + d2 * d2) * (u0 * u0 + u1 * u1 + u2 * u2) * (v0 * v0 + v1 * v1 + v2 * v2)
    if determinant * determinant <= tolerance * tolerance * square:  # parallel
        return False
    inverse = 1.0 / determinant
    s0, s1, s2 = start[0] - a[0], start[1] - a[1], start[2] - a[2]
    first = inverse * (s0 * p0 + s1 * p1 + s2 * p2)
    if first <= tolerance or first >= 1.0 - tolerance:
        return False
    t0, t1, t2 = s1 * u2 - s2 * u1, s2 * u0 - s0 * u2, s0 * u1 - s1 * u0
    second = inverse * (d0 * t0 + d1 * t1 + d2 * t2)
    if second <= tolerance or first + second >= 1.0 - tolerance:
        return False
    along = inverse * (v0 * t0 + v1 * t1 + v2 * t2)
    return along > tolerance and along < 1.0 - tolerance


@njit(cache=True, error_model="numpy")
def _first_crossing(points, triangles, first, axis, tolerance):
    """Two triangles that cross each other, one of them among the ``first`` ones, or (-1, -1).

    They are compared in their order along an axis.
    """
    count = triangles.shape[0]
    low, high = np.empty((count, 3)), np.empty((count, 3))
    for t in range(count):
        a, b, c = triangles[t]
        for d in range(3):
            e = (axis + d) % 3
            p, q, r = points[a, e], points[b, e], points[c, e]
            low[t, d], high[t, d] = min(p, min(q, r)), max(p, max(q, r))
    bottom, top = np.full(3, np.inf), np.full(3, -np.inf)  # of the first ones: what lies beyond crosses none of them
    for t in range(first):
        for d in range(3):
            bottom[d], top[d] = min(bottom[d], low[t, d]), max(top[d], high[t, d])
    near = np.empty(count, dtype=np.int64)
    found = 0
    for t in range(count):
        apart = False
        for d in range(3):
            apart = apart or low[t, d] > top[d] or high[t, d] < bottom[d]
        near[found] = t
        found += not apart
    near = near[:found]
    order = near[np.argsort(low[near, 0])]
    chosen, passed = order[order < first], 0
    for m in range(found):
        i = order[m]
        passed += i < first
        others, start = (order, m + 1) if i < first else (chosen, passed)
        for n in range(start, others.shape[0]):
            j = others[n]
            if low[j, 0] > high[i, 0]:
                break
            if low[j, 1] > high[i, 1] or low[i, 1] > high[j, 1] or low[j, 2] > high[i, 2] or low[i, 2] > high[j, 2]:
                continue
            common = 0
            for k in range(3):
                p = triangles[i, k]
                common += p == triangles[j, 0] or p == triangles[j, 1] or p == triangles[j, 2]
            if common >= 2:  # every edge begins or ends on the other triangle, and so only touches it
                continue
            for one, other in ((i, j), (j, i)):
                u0, u1, u2 = triangles[other]
                for k in range(3):
                    p, q = triangles[one, k], triangles[one, (k + 1) % 3]
                    if p != u0 and p != u1 and p != u2 and q != u0 and q != u1 and q != u2:
                        if _pierces(points[p], points[q], points[u0], points[u1], points[u2], tolerance):
                            return i, j
    return -1, -1


def _crossing(points: np.ndarray, triangles: np.ndarray, first: int) -> tuple[int, int, np.ndarray] | None:
    """Return two triangles that cross, one of them among the ``first`` ones, and a point [m] (3,) there, or None."""
    axis = int(np.argmax(np.ptp(points[triangles[:, 0]], axis=0)))  # few triangles overlap along the longest side
    i, j = _first_crossing(points, triangles, first, axis, 1e-9)
    if i < 0:
        return None
    return i, j, 0.5 * (points[triangles[i]].mean(axis=0) + points[triangles[j]].mean(axis=0))


def self_intersection(points: np.ndarray, triangles: np.ndarray) -> np.ndarray | None:
    """Return a point [m] (3,) where triangles (k, 3) cross each other, or None. Touching is allowed."""
    found = _crossing(points, triangles, len(triangles))
    return None if found is None else found[2]


@njit(cache=True, error_model="numpy")
def _inside_out(x, tetrahedra):
    """The first tetrahedron (m, 4) of the corners whose volume is not positive, or -1."""
    for e in range(tetrahedra.shape[0]):
        o, a, b, c = tetrahedra[e]
        u0, u1, u2 = x[a, 0] - x[o, 0], x[a, 1] - x[o, 1], x[a, 2] - x[o, 2]
        v0, v1, v2 = x[b, 0] - x[o, 0], x[b, 1] - x[o, 1], x[b, 2] - x[o, 2]
        w0, w1, w2 = x[c, 0] - x[o, 0], x[c, 1] - x[o, 1], x[c, 2] - x[o, 2]
        if u0 * (v1 * w2 - v2 * w1) + u1 * (v2 * w0 - v0 * w2) + u2 * (v0 * w1 - v1 * w0) <= 0.0:
            return e
    return -1


@njit(cache=True, error_model="numpy")
def _quadratic_inside_out(x, cells):
    """The first quadratic tetrahedron (m, 10) whose map has no positive determinant at a corner, or -1.

    The edges of the cell are curved, so the tetrahedron of its corners says nothing.
    """
    corners = ((0, 1, 2, 3), (1, 0, 3, 2), (2, 0, 1, 3), (3, 0, 2, 1))
    midside = ((-1, 4, 6, 7), (4, -1, 5, 8), (6, 5, -1, 9), (7, 8, 9, -1))
    t = np.empty((3, 3))
    for e in range(cells.shape[0]):
        for k in range(4):
            o = corners[k][0]
            for row in range(3):
                other = corners[k][row + 1]
                for axis in range(3):  # derivative of the map along an edge, at the corner
                    t[row, axis] = (
                        4.0 * x[cells[e, midside[o][other]], axis]
                        - 3.0 * x[cells[e, o], axis]
                        - x[cells[e, other], axis]
                    )
            cross0 = t[1, 1] * t[2, 2] - t[1, 2] * t[2, 1]
            cross1 = t[1, 2] * t[2, 0] - t[1, 0] * t[2, 2]
            cross2 = t[1, 0] * t[2, 1] - t[1, 1] * t[2, 0]
            if t[0, 0] * cross0 + t[0, 1] * cross1 + t[0, 2] * cross2 <= 0.0:
                return e
    return -1


CHECKED = 16
"""One of so many states is checked for outer walls that cross, besides those farther from rest than all before."""

_TOLD: set[Hashable] = set()
"""Bodies, by the names of their rows, of which a `CrossingWarning` told."""


class CrossingWarning(UserWarning):
    """Outer walls of a body passed through each other: a body that touches itself would be elsewhere."""


class ShapeCheck:
    """Whether a state can be one: no wall of a cavity has passed through another, and no cell is inside out.

    The walls of a cavity may not cross each other, those of another cavity, or the outside of a solid; where a pressure
    drives the body, its outer walls may not cross each other either. Where nothing but cables and forces does, they
    lead to a warning. Elements whose Gauss points alone are kept from turning inside out are checked at their corners.

    Args:
        cavities: whose walls do not touch anything in the model.
        outside: triangles of the boundary of solids (k, 3), which may contain those of the cavities.
        cells: nodes of such elements, shapes (m, 4) or, with midside nodes as in `QuadraticTetrahedra`, (m, 10).
        driven: whether the pressure of a cavity drives the body.
        rest: rows at rest [m], shape (n, 3); without, there are no warnings.
        name: of the body, whose warning comes once.
    """

    def __init__(
        self,
        cavities: Iterable[Cavity],
        outside: np.ndarray,
        cells: Iterable[np.ndarray],
        *,
        driven: bool = False,
        rest: np.ndarray | None = None,
        name: Hashable = (),
    ) -> None:
        walls = [(each.name, each.flat_triangles) for each in cavities]
        self._name, self._rest, self._farthest, self._since = name, rest, 0.0, 0
        self._outside = np.empty((0, 3), dtype=np.int64) if driven or rest is None else np.ascontiguousarray(outside)
        self._names = [name for name, _ in walls]
        parts = [*(triangles for _, triangles in walls), *([outside] if walls else [])]
        owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
        triangles = np.concatenate(parts) if parts else np.empty((0, 3), dtype=np.int64)
        # A wall of several cavities, or of one and the outside, counts once.
        _, first = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
        first.sort()
        self._triangles, self._owner = np.ascontiguousarray(triangles[first]), owner[first]
        self._first = int(len(first) if driven else (self._owner < len(walls)).sum())
        self._cells = [np.ascontiguousarray(each) for each in cells]

    @classmethod
    def of(cls, model: MechanicalModel) -> ShapeCheck:
        """Return the check of a model. With self-contact, walls cannot pass through each other."""
        sealed = [block.air.cavity for block in model.blocks if isinstance(block, EnclosedGas)]
        rows = [c.cavity if isinstance(c, SealedAir) else c for group in "as" for c in model.constraints[group]]
        cavities = {id(each): each for each in [*rows, *sealed] if isinstance(each, Cavity)}
        touching = model.contact is not None and model.contact.self_contact
        # A sliver turns inside out by less than its neighbours are strained.
        cells = [
            block.connectivity[_no_slivers(model.nodes, block.corners)] for block in model.solids if block.points > 1
        ]
        if touching or not model.solids:
            return cls([], np.empty((0, 3), dtype=np.int64), cells)
        driven = any(isinstance(each, Cavity) for each in model.constraints["a"])
        outside = np.concatenate([_boundary(block) for block in model.solids])
        name = tuple(each.name for group in "aes" for each in model.constraints[group])
        return cls(cavities.values(), outside, cells, driven=driven, rest=model.nodes, name=name)

    def warn(self, x: np.ndarray) -> None:
        """Warn once of outer walls that cross each other at the rows of a state [m], shape (n, 3).

        States farther from rest than all before them are checked, and one of `CHECKED` others, which costs nothing.
        Triangles of which another touches both are neighbours, and may cross.
        """
        if not len(self._outside) or self._name in _TOLD:
            return
        away, self._since = float(np.abs(x - self._rest).max()), self._since + 1
        if away <= self._farthest and self._since < CHECKED:
            return
        self._farthest, self._since = max(away, self._farthest), 0
        while (found := _crossing(x, self._outside, len(self._outside))) is not None:
            # Neighbours on the surface fold over each other at slivers of the mesh, where the body only bends.
            first, second = (np.isin(self._outside, self._outside[each]).any(axis=1) for each in found[:2])
            if not (first & second).any():
                break
            self._outside = np.delete(self._outside, found[:2], axis=0)
        if found is None:
            return
        assert self._rest is not None
        if _crossing(self._rest, self._outside, len(self._outside)) is not None:  # parts that overlap by construction
            self._outside = self._outside[:0]
            return
        _TOLD.add(self._name)
        warnings.warn(
            f"outer walls of the body pass through each other near {np.round(found[2], 4).tolist()} m, because they do "
            "not touch each other in this model; let them touch with self_contact=True of the robot, or "
            "set_contact(settings=ContactSettings(self_contact=True))",
            CrossingWarning,
            stacklevel=4,
        )

    def problem(self, x: np.ndarray) -> ImpossibleState | None:
        """Return what is wrong with the rows of a state [m], shape (n, 3): the wall or cell, and the place."""
        if len(self._triangles) and (found := _crossing(x, self._triangles, self._first)) is not None:
            i, j, place = found
            first, second = sorted((int(self._owner[i]), int(self._owner[j])))
            return ImpossibleState(
                f"{self._walls(first, second)} pass through each other near {np.round(place, 4).tolist()} m, because "
                "they do not touch each other in this model; let them touch with "
                "set_contact(settings=ContactSettings(self_contact=True))"
            )
        for cells in self._cells:
            if (cell := (_inside_out if cells.shape[1] == 4 else _quadratic_inside_out)(x, cells)) >= 0:
                place = np.round(x[cells[cell, :4]].mean(axis=0), 4).tolist()
                return ImpossibleState(
                    f"an element near {place} m has turned inside out; refine the mesh there, or spread what loads it "
                    "over a radius"
                )
        return None

    def _walls(self, first: int, second: int) -> str:
        """Return the name of walls of two owners."""
        outside = len(self._names)
        if first == outside:
            return "outer walls of the body"
        if first == second:
            return f"the walls of '{self._names[first]}'"
        other = "the outside of the body" if second == outside else f"those of '{self._names[second]}'"
        return f"walls of '{self._names[first]}' and {other}"


def _boundary(block: Any) -> np.ndarray:
    """Return the boundary of a solid as flat triangles (k, 3), of quadratic elements split at their midside nodes."""
    triangles = boundary_triangles(block.corners)
    if block.connectivity.shape[1] == 4:
        return triangles
    return split_triangles(triangles, block.connectivity)


def _no_slivers(nodes: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return which tetrahedra (m, 4) are no slivers, but thicker than about a thirtieth of their edges, shape (m,)."""
    edges = nodes[tetrahedra[:, 1:]] - nodes[tetrahedra[:, :1]]
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    return np.linalg.det(edges) > 0.03 * longest**3
