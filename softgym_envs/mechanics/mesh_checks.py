"""Whether a tetrahedral mesh is the body that it looks like, and whether what is clamped holds it.

Every check ends in one line with the place and the remedy. They run when a body is made, never in a step.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from softgym_envs.errors import InfeasibleDesign
from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.elements.tetrahedra import FACES, boundary_triangles, orient_corners

COINCIDENT = 1e-6
"""Nodes nearer to each other than this part of the body's diagonal are one place."""

_DEPTH = 1e-5
"""Elements that overlap by less than this part of their edges only touch: round-off of files in single precision."""

_WEAK = 1e-9
"""A motion that meets less than this part of the largest resistance is one that nothing resists."""

_MANY_PARTS = 100
"""Parts of a mesh that share no face, from which their hinges are no longer looked for."""


def _place(point: np.ndarray) -> str:
    return f"{[float(f'{value:.4g}') for value in point]} m"


def check_mesh(nodes: np.ndarray, tetrahedra: np.ndarray) -> None:
    """Check that tetrahedra fill a body once and hang together at their faces.

    Args:
        nodes: [m], shape (n, 3).
        tetrahedra: corner indices, shape (m, 4), oriented either way.

    Raises:
        ValueError: for degenerate, repeated, folded or overlapping elements, nodes at one place that are not merged,
            and faces that lie on each other without sharing their corners.
    """
    tetrahedra, _, _ = orient_corners(nodes, tetrahedra)
    middles = nodes[tetrahedra].mean(axis=1)
    _, first, count = np.unique(np.sort(tetrahedra, axis=1), axis=0, return_index=True, return_counts=True)
    if len(first) < len(tetrahedra):
        where = _place(middles[first[count > 1][0]])
        raise ValueError(
            f"{len(tetrahedra) - len(first)} of {len(tetrahedra)} tetrahedra repeat others, the first near {where}: "
            "the body would be too stiff there; leave the copies out"
        )
    _check_faces(nodes, tetrahedra)
    used = np.unique(tetrahedra)
    diagonal = float(np.linalg.norm(np.ptp(nodes[used], axis=0)))
    pairs = cKDTree(nodes[used]).query_pairs(COINCIDENT * diagonal, output_type="ndarray")
    if len(pairs):
        raise ValueError(
            f"{len(pairs)} pairs of nodes coincide and are not merged, the first at {_place(nodes[used[pairs[0, 0]]])}:"
            " the body comes apart there; merge them with merge_nodes, or pass check=False for a cut that is meant"
        )
    corners = nodes[tetrahedra]
    i, j = _first_overlap(corners, tetrahedra, np.arange(len(corners)), _order(corners), _DEPTH)
    if i >= 0:
        raise ValueError(
            f"tetrahedra {i} and {j} overlap near {_place(0.5 * (middles[i] + middles[j]))}: both would carry load "
            "there; unite the parts before meshing"
        )
    _check_seams(nodes, boundary_triangles(tetrahedra), tetrahedra)


def check_apart(nodes: np.ndarray, solids: Sequence[np.ndarray]) -> None:
    """Check that solids of one model do not overlap; they may touch.

    Args:
        nodes: [m], shape (n, 3).
        solids: corner indices of the tetrahedra of each, shapes (m, 4).

    Raises:
        InfeasibleDesign: with the place.
    """
    boxes = [(nodes[solid].min(axis=(0, 1)), nodes[solid].max(axis=(0, 1))) for solid in solids]
    for k, (low, high) in enumerate(boxes):
        for other in range(k):
            bottom, top = np.maximum(low, boxes[other][0]), np.minimum(high, boxes[other][1])
            if (bottom >= top).any():
                continue
            near = [
                each[((nodes[each].max(axis=1) > bottom) & (nodes[each].min(axis=1) < top)).all(axis=1)]
                for each in (solids[other], solids[k])
            ]
            cells, part = np.concatenate(near), np.repeat([0, 1], [len(each) for each in near])
            corners = nodes[cells]
            middles = corners.mean(axis=1)
            i, j = _first_overlap(corners, cells, part, _order(corners), _DEPTH)
            if i >= 0:
                raise InfeasibleDesign(
                    f"solids {other} and {k} of the model overlap near {_place(0.5 * (middles[i] + middles[j]))}: both "
                    "would carry load there; move them apart, unite them before meshing, or pass check=False to "
                    "add_solid if that is meant"
                )


def merge_nodes(nodes: np.ndarray, tetrahedra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge nodes at one place, and leave out those without elements.

    Args:
        nodes: [m], shape (n, 3).
        tetrahedra: node indices, shape (m, 4) or (m, 10).

    Returns:
        Nodes (k, 3), in the order of their first copies, and elements of the same shape.
    """
    nodes, tetrahedra = np.asarray(nodes, dtype=float), np.asarray(tetrahedra, dtype=np.int64)
    used, local = np.unique(tetrahedra, return_inverse=True)
    places = nodes[used]
    diagonal = float(np.linalg.norm(np.ptp(places, axis=0)))
    pairs = cKDTree(places).query_pairs(COINCIDENT * diagonal, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=2 * (len(places),))
    group = connected_components(graph, directed=False)[1]
    _, first, number = np.unique(group, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return places[first[order]], rank[number.ravel()][local.ravel()].reshape(tetrahedra.shape)


def _check_faces(nodes: np.ndarray, tetrahedra: np.ndarray) -> None:
    """Check that each face has at most two tetrahedra (m, 4), positively oriented, on different sides of it."""
    faces = tetrahedra[:, FACES].reshape(-1, 3)
    low = np.argmin(faces, axis=1)
    turned = np.take_along_axis(faces, (low[:, None] + np.arange(3)) % 3, axis=1)  # smallest index first
    _, which, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    which = which.ravel()
    crowded = np.flatnonzero(count[which] > 2)
    if len(crowded):
        raise ValueError(
            f"{int((count > 2).sum())} faces belong to more than two tetrahedra, the first near "
            f"{_place(nodes[faces[crowded[0]]].mean(axis=0))}: elements overlap there; unite the parts before meshing"
        )
    # Seen from outside its element, a face turns the other way than from its neighbour's.
    order = np.argsort(which, kind="stable")
    shared = np.flatnonzero(np.diff(which[order]) == 0)
    left, right = order[shared], order[shared + 1]
    folded = left[turned[left, 1] == turned[right, 1]]
    if len(folded):
        raise ValueError(
            f"the mesh is folded onto itself at {len(folded)} faces, the first near "
            f"{_place(nodes[faces[folded[0]]].mean(axis=0))}: both tetrahedra lie on the same side of the face; mesh "
            "the body anew"
        )


def _check_seams(nodes: np.ndarray, triangles: np.ndarray, tetrahedra: np.ndarray) -> None:
    """Check that no boundary triangles (t, 3) face each other without a gap: the body would come apart there."""
    corners = nodes[triangles]
    i = _first_facing(corners, _order(corners), 1e-4)
    if i < 0:
        i = _other_diagonal(triangles, tetrahedra)
    if i >= 0:
        raise ValueError(
            f"faces of tetrahedra lie on each other near {_place(corners[i].mean(axis=0))} but do not have the same "
            "three corners (the other diagonal of a quadrilateral, or parts that are meshed differently): the body "
            "comes apart there; mesh its parts together, or pass check=False for a cut that is meant"
        )


def _other_diagonal(triangles: np.ndarray, tetrahedra: np.ndarray) -> int:
    """Return a triangle (a, b, c) of the boundary for which (a, c, d), (a, b, d) and (b, c, d) belong to it too, or -1.

    So two pairs of tetrahedra meet at a quadrilateral that each splits along its own diagonal. In a plane the four
    triangles lie on each other; otherwise they leave a hole without an element.
    """
    known = {tuple(sorted(each)) for each in triangles.tolist()}
    cells = {tuple(sorted(each)) for each in tetrahedra.tolist()}
    across: dict[tuple[int, int], list[int]] = {}
    for a, b, c in triangles.tolist():
        for p, q, r in ((a, b, c), (b, c, a), (c, a, b)):
            across.setdefault((min(p, q), max(p, q)), []).append(r)
    for number, (a, b, c) in enumerate(triangles.tolist()):
        for p, q, r in ((a, b, c), (b, c, a), (c, a, b)):
            for d in across[min(p, q), max(p, q)]:
                if d == r or tuple(sorted((p, q, r, d))) in cells:
                    continue
                if tuple(sorted((p, r, d))) in known and tuple(sorted((q, r, d))) in known:
                    return number
    return -1


def _order(corners: np.ndarray) -> np.ndarray:
    """Return cells, with corners (m, k, 3), sorted by their lowest coordinate along the longest side of the body.

    ``corners`` is turned in place so that this is the first axis.
    """
    axes = np.argsort(-np.ptp(corners.reshape(-1, 3), axis=0))
    corners[:] = corners[:, :, axes]
    return np.argsort(corners[:, :, 0].min(axis=1))


@njit(cache=True, error_model="numpy")
def _separated(p, q, axis, tolerance):
    """Whether points p and q (k, 3) lie on different sides of a plane across an axis, but for a tolerance [m]."""
    length = np.sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2])
    if length == 0.0:
        return False
    low_p, high_p, low_q, high_q = np.inf, -np.inf, np.inf, -np.inf
    for k in range(p.shape[0]):
        value = (p[k, 0] * axis[0] + p[k, 1] * axis[1] + p[k, 2] * axis[2]) / length
        low_p, high_p = min(low_p, value), max(high_p, value)
        value = (q[k, 0] * axis[0] + q[k, 1] * axis[1] + q[k, 2] * axis[2]) / length
        low_q, high_q = min(low_q, value), max(high_q, value)
    return low_q >= high_p - tolerance or low_p >= high_q - tolerance


@njit(cache=True, error_model="numpy")
def _across(a, b, c, d, out):
    """The vector across b - a and d - c; zero where they are parallel."""
    u0, u1, u2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    v0, v1, v2 = d[0] - c[0], d[1] - c[1], d[2] - c[2]
    out[0], out[1], out[2] = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    square = out[0] ** 2 + out[1] ** 2 + out[2] ** 2
    if square <= 1e-16 * (u0 * u0 + u1 * u1 + u2 * u2) * (v0 * v0 + v1 * v1 + v2 * v2):
        out[:] = 0.0


@njit(cache=True, error_model="numpy")
def _overlap(p, q, tolerance):
    """Whether two tetrahedra (4, 3) overlap: no plane along a face or an edge of each separates them."""
    axis = np.empty(3)
    for t in (p, q):
        for i, j, k in ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)):
            _across(t[i], t[j], t[i], t[k], axis)
            if _separated(p, q, axis, tolerance):
                return False
    for i in range(3):
        for j in range(i + 1, 4):
            for k in range(3):
                for n in range(k + 1, 4):
                    _across(p[i], p[j], q[k], q[n], axis)
                    if _separated(p, q, axis, tolerance):
                        return False
    return True


@njit(cache=True, error_model="numpy")
def _bounds(corners, low, high):
    for e in range(corners.shape[0]):
        for d in range(3):
            low[e, d], high[e, d] = np.inf, -np.inf
            for a in range(corners.shape[1]):
                low[e, d] = min(low[e, d], corners[e, a, d])
                high[e, d] = max(high[e, d], corners[e, a, d])


@njit(cache=True, error_model="numpy")
def _first_overlap(corners, tetrahedra, part, order, depth):
    """Two tetrahedra of different parts (m,) that overlap, or (-1, -1); corners (m, 4, 3) in ``order`` along axis 0.

    Those that share a face are on different sides of it, which has been checked.
    """
    count = corners.shape[0]
    low, high = np.empty((count, 3)), np.empty((count, 3))
    _bounds(corners, low, high)
    for m in range(count):
        i = order[m]
        size = max(high[i, 0] - low[i, 0], max(high[i, 1] - low[i, 1], high[i, 2] - low[i, 2]))
        for n in range(m + 1, count):
            j = order[n]
            if low[j, 0] >= high[i, 0]:
                break
            if part[i] == part[j]:
                continue
            if low[j, 1] >= high[i, 1] or low[i, 1] >= high[j, 1] or low[j, 2] >= high[i, 2] or low[i, 2] >= high[j, 2]:
                continue
            common = 0
            for a in range(4):
                for b in range(4):
                    common += tetrahedra[i, a] == tetrahedra[j, b]
            if common < 3 and _overlap(corners[i], corners[j], depth * size):
                return i, j
    return -1, -1


@njit(cache=True, error_model="numpy")
def _first_facing(corners, order, flat):
    """A triangle on which another one lies, facing it, or -1; corners (t, 3, 3) in ``order`` along the first axis.

    Both lie in one plane but for ``flat`` times their size, and overlap by more than that in it.
    """
    count = corners.shape[0]
    low, high = np.empty((count, 3)), np.empty((count, 3))
    _bounds(corners, low, high)
    normals, axis = np.empty((count, 3)), np.empty(3)
    for t in range(count):
        _across(corners[t, 0], corners[t, 1], corners[t, 0], corners[t, 2], normals[t])
        normals[t] /= np.sqrt((normals[t] ** 2).sum())
    for m in range(count):
        i = order[m]
        size = max(high[i, 0] - low[i, 0], max(high[i, 1] - low[i, 1], high[i, 2] - low[i, 2]))
        gap = flat * size
        for n in range(m + 1, count):
            j = order[n]
            if low[j, 0] > high[i, 0] + gap:
                break
            if (
                low[j, 1] > high[i, 1] + gap
                or low[i, 1] > high[j, 1] + gap
                or low[j, 2] > high[i, 2] + gap
                or low[i, 2] > high[j, 2] + gap
            ):
                continue
            turn = 0.0
            for d in range(3):
                turn += normals[i, d] * normals[j, d]
            if turn > -1.0 + flat:
                continue
            near = True
            for a in range(3):
                away = 0.0
                for d in range(3):
                    away += normals[i, d] * (corners[j, a, d] - corners[i, 0, d])
                near = near and abs(away) <= gap
            if not near:
                continue
            apart = False
            for t in (corners[i], corners[j]):
                for a in range(3):
                    b = (a + 1) % 3
                    # In the plane, across an edge.
                    for d in range(3):
                        e, f = (d + 1) % 3, (d + 2) % 3
                        axis[d] = normals[i, e] * (t[b, f] - t[a, f]) - normals[i, f] * (t[b, e] - t[a, e])
                    apart = apart or _separated(corners[i], corners[j], axis, gap)
            if not apart:
                return i
    return -1


# -- what holds a body ----------------------------------------------------------------------------------------------


def _face_parts(tetrahedra: np.ndarray) -> np.ndarray:
    """Number of the part that each tetrahedron (m, 4) belongs to, shape (m,): parts hang together at their faces."""
    _, which = np.unique(np.sort(tetrahedra[:, FACES].reshape(-1, 3), axis=1), axis=0, return_inverse=True)
    element = np.repeat(np.arange(len(tetrahedra)), 4)
    order = np.argsort(which.ravel(), kind="stable")
    shared = np.flatnonzero(np.diff(which.ravel()[order]) == 0)
    pairs = element[order[shared]], element[order[shared + 1]]
    graph = coo_matrix((np.ones(len(shared)), pairs), shape=2 * (len(tetrahedra),))
    return connected_components(graph, directed=False)[1]


def _direction(motions: np.ndarray) -> list[float]:
    """Return the direction of the largest of some motions (3, k)."""
    along = np.linalg.svd(motions)[0][:, 0]
    return (np.round(along * np.sign(along[np.argmax(np.abs(along))]), 3) + 0.0).tolist()


def check_held(
    nodes: np.ndarray,
    held: np.ndarray,
    solids: Sequence[np.ndarray],
    ties: Sequence[tuple[np.ndarray, np.ndarray]] = (),
) -> None:
    """Check that no part of solid bodies can move without being strained.

    Parts that hang together at their faces move as rigid bodies. What nodes that they share, held components and ties
    leave of these motions is a mechanism.

    Args:
        nodes: rest rows [m], shape (n, 3).
        held: components that do not move by themselves, mask of shape (n, 3).
        solids: node indices of the elements of each solid, shapes (m, k), corners first.
        ties: linear functions of the rows that stay zero, such as bonds: components (3 * row + axis) of shape (k,) and
            their factors (r, k).

    Raises:
        ValueError: with the motion that is left, or the part that hangs on nothing.
    """
    parts: list[np.ndarray] = []
    counts: list[int] = []
    for elements in solids:
        part = _face_parts(elements[:, :4])
        parts += [np.unique(elements[part == k]) for k in range(part.max() + 1)]
        counts += np.bincount(part).tolist()
    if not parts:
        return
    owners: list[list[int]] = [[] for _ in nodes]
    for number, used in enumerate(parts):
        for node in used.tolist():
            owners[node].append(number)
    joints = [(node, group) for node, group in enumerate(owners) if len(group) > 1]
    tied = [(dofs, factors, np.unique(dofs[(factors != 0.0).any(axis=0)] // 3).tolist()) for dofs, factors in ties]
    links = [group for _, group in joints] + [[k for node in rows for k in owners[node]] for _, _, rows in tied]
    pairs = np.array([(group[0], other) for group in links if group for other in group], dtype=np.int64).reshape(-1, 2)
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=2 * (len(parts),))
    piece = connected_components(graph, directed=False)[1]
    anchored = np.array([held[used].any() for used in parts])
    for _, _, rows in tied:  # to the ground, or to a frame
        if any(not owners[node] for node in rows) or len({k for node in rows for k in owners[node]}) == 1:
            anchored[[k for node in rows for k in owners[node]]] = True
    for each in np.unique(piece):
        members = np.flatnonzero(piece == each)
        if not anchored[members].any():
            used = np.unique(np.concatenate([parts[k] for k in members]))
            raise ValueError(
                f"a part of {sum(counts[k] for k in members)} tetrahedra near {_place(nodes[used].mean(axis=0))} is "
                "not connected to anything that is held; leave it out, join it to the body, or clamp some of its nodes"
            )
    if len(parts) > _MANY_PARTS:
        raise ValueError(
            f"the mesh falls into {len(parts)} parts that share no face, only nodes and edges; mesh the body anew"
        )
    everything = nodes[np.unique(np.concatenate(parts))]
    centre, size = everything.mean(axis=0), float(np.linalg.norm(np.ptp(everything, axis=0)))

    def motion(node: int, number: int) -> np.ndarray:
        """Displacement of a node over the body's size by the motions of all parts, shape (3, 6 p)."""
        out = np.zeros((3, 6 * len(parts)))
        x, y, z = (nodes[node] - centre) / size
        out[:, 6 * number : 6 * number + 3] = np.eye(3)
        out[:, 6 * number + 3 : 6 * number + 6] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        return out

    resistance = np.zeros((6 * len(parts), 6 * len(parts)))
    for number, used in enumerate(parts):
        own = slice(6 * number, 6 * number + 6)
        for node in used[held[used].any(axis=1)].tolist():
            rows = motion(node, number)[held[node], own]
            resistance[own, own] += rows.T @ rows
    for node, group in joints:
        for other in group[1:]:
            rows = motion(node, group[0]) - motion(node, other)
            resistance += rows.T @ rows
    for dofs, factors, _ in tied:
        rows = np.zeros((len(factors), 6 * len(parts)))
        for k, dof in enumerate(dofs.tolist()):
            if owners[dof // 3]:
                rows += np.outer(factors[:, k], motion(dof // 3, owners[dof // 3][0])[dof % 3])
        resistance += rows.T @ rows
    values, vectors = np.linalg.eigh(resistance)
    weak = values <= _WEAK * values[-1]
    if not weak.any():
        return
    # Of the motions that are left, those of the part that takes the largest share in them.
    shares = (vectors[:, weak] ** 2).sum(axis=1).reshape(len(parts), 6).sum(axis=1)
    loose = int(np.argmax(shares))
    left = vectors[6 * loose : 6 * loose + 6, weak]
    name = f"a part of {counts[loose]} tetrahedra near {_place(nodes[parts[loose]].mean(axis=0))}"
    if len(parts) == 1:
        name = "the body"
    remedy = (
        "clamp or bond it at more nodes, not on one line, or join it at faces (allowed: ModelBuilder(floating=True))"
    )
    touching = [node for node in parts[loose].tolist() if held[node].any() or len(owners[node]) > 1]
    if touching and np.ptp(nodes[touching], axis=0).max() <= COINCIDENT * size:
        raise ValueError(f"{name} is held at one point only, {_place(nodes[touching[0]])}, and can rotate; {remedy}")
    if np.linalg.matrix_rank(left[3:], tol=1e-4) == 0:
        raise ValueError(f"{name} is a mechanism: it can slide along {_direction(left[:3])}; {remedy}")
    about = nodes[touching].mean(axis=0) if touching else nodes[parts[loose]].mean(axis=0)
    raise ValueError(
        f"{name} is a mechanism: it can rotate about a line along {_direction(left[3:])} near {_place(about)}; {remedy}"
    )
