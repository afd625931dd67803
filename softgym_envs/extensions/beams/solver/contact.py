"""Points of the skins of beams and rigid parts that touch obstacles, for the compiled equations of `beam_equations`.

The law is that of the general solver (`softgym_envs.mechanics.contact.law`). While points slide, the tangent is
``S + U V^T`` with a symmetric ``S``, which is factorised; the formula of Woodbury does the rest, as in `Linearisation`.

Kernels take None in place of `ContactPoints` for bodies that touch nothing, and are then compiled without contact.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from softgym_envs.extensions.beams.solver.block_cholesky import SIZE
from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.contact.compiled import (
    PointTouch,
    make_touch,
    quick_gap,
    table_of,
    touch_point,
)
from softgym_envs.mechanics.contact.obstacles import MeshObstacle, Obstacle

if TYPE_CHECKING:  # kernels do not depend on them, see `compilation`
    from softgym_envs.mechanics.contact.contact import Contact
    from softgym_envs.mechanics.frames import Frames

MAX_SLIDING = 160
"""Points that may slide at once; the general solver takes over beyond it."""
MAX_TOUCHING = 64
"""Points that may touch in one Newton step; the general solver takes over beyond it."""
NEAREST = 0.3
"""Part of its gap, or of the distance of contact if that is smaller, that a point keeps in one Newton step."""


class ContactPoints(NamedTuple):
    """Points that may touch obstacles, in groups of points between the same frames, and these obstacles.

    A point is a linear combination of the own rows of at most F frames.

    Attributes:
        groups: where the points of each group start, shape (g + 1,).
        frames: first rows of the frames of each group, shape (g, F); those of the first frame fill up.
        blocks: their blocks; -1 for fixed frames and for those that only fill up, shape (g, F).
        place: block of the tangent for each pair of them, -1 below the diagonal and for fixed ones, shape (g, F, F).
        share: largest weights of the origins of the frames, shape (g, F).
        reach: largest lengths of the arms along their directors [m], shape (g, F).
        weights: of the four rows of the frames, shape (p, F, 4).
        area: shape (p,).
        order: number of each point among those of the surface, shape (p,).
        obstacles: see `table_of`, shape (o, 17).
        edges: shape (o, e, 7).
        law: distance of contact [m], stiffness [Pa] and stick [Pa/m], shape (3,).
    """

    groups: np.ndarray
    frames: np.ndarray
    blocks: np.ndarray
    place: np.ndarray
    share: np.ndarray
    reach: np.ndarray
    weights: np.ndarray
    area: np.ndarray
    order: np.ndarray
    obstacles: np.ndarray
    edges: np.ndarray
    law: np.ndarray


class LocalForces(NamedTuple):
    """Forces at points that may touch, on the linearised body; work arrays for k points, which have 3 k components.

    Attributes:
        number: how many points are chosen, shape (1,).
        points: their numbers, shape (k,).
        group: their groups, shape (k,).
        place: where they are [m], shape (k, 3).
        free: their motion under the present forces [m], shape (3 k,).
        start: present forces on them [N], shape (3 k,).
        force: forces on them [N], shape (3 k,).
        limit: of friction [N], shape (k, o).
        pull: minus what contact does to them [N], shape (3 k,).
        tangent: its derivative, shape (k, 3, 3).
        residual: by how much forces and contact differ [N], shape (3 k,).
        motion: what that moves [m], shape (3 k,).
        compliance: motion by forces, with driven rows held [m/N], shape (3 k, 3 k).
        relief: minus the efforts of driven rows by the forces, shape (size, 3 k).
        half: ``L^-1`` times the forces, shape (3 k, b, 6).
        axes: unit vectors, shape (3, 3).
        p: a point [m], shape (3,).
        smooth: an obstacle without friction, shape (17,).
    """

    number: np.ndarray
    points: np.ndarray
    group: np.ndarray
    place: np.ndarray
    free: np.ndarray
    start: np.ndarray
    force: np.ndarray
    limit: np.ndarray
    pull: np.ndarray
    tangent: np.ndarray
    residual: np.ndarray
    motion: np.ndarray
    compliance: np.ndarray
    relief: np.ndarray
    half: np.ndarray
    axes: np.ndarray
    p: np.ndarray
    smooth: np.ndarray


class Slides(NamedTuple):
    """Terms of sliding points in a tangent, and work arrays of contact.

    Attributes:
        number: how many points slide, or -1 if a point is inside an obstacle or too many slide, shape (1,).
        direction: ``U``; once the tangent is factorised ``L^-1 U``, shape (s, b, 6).
        loading: ``V``; once the tangent is factorised ``L^-1 V``, shape (s, b, 6).
        core: inverse of ``1 + V^T S^-1 U``, shape (s, s).
        before: anchors at the start of the last time step [m], shape (o, p, 3).
        touch: what an obstacle does to a point.
        p: a point [m], shape (3,).
        q: another one [m], shape (3,).
        arms: its arms along the directors of its frames [m], shape (F, 3).
        slip: work array, shape (s,).
        local: forces at points that may touch.
    """

    number: np.ndarray
    direction: np.ndarray
    loading: np.ndarray
    core: np.ndarray
    before: np.ndarray
    touch: PointTouch
    p: np.ndarray
    q: np.ndarray
    arms: np.ndarray
    slip: np.ndarray
    local: LocalForces


def make_slides(contact: ContactPoints | None, blocks: int, size: int) -> Slides | None:
    """Return arrays for a body with ``blocks`` movable frames and ``size`` rows, or None for one without contact."""
    if contact is None:
        return None
    points = len(contact.area)
    most = min(MAX_SLIDING, points * len(contact.obstacles))
    return Slides(
        number=np.zeros(1, dtype=np.int64),
        direction=np.zeros((most, blocks, SIZE)),
        loading=np.zeros((most, blocks, SIZE)),
        core=np.zeros((most, most)),
        before=np.zeros((len(contact.obstacles), points, 3)),
        touch=make_touch(),
        p=np.zeros(3),
        q=np.zeros(3),
        arms=np.zeros((contact.frames.shape[1], 3)),
        slip=np.zeros(most),
        local=_make_local(contact, blocks, size),
    )


def _make_local(contact: ContactPoints, blocks: int, size: int) -> LocalForces:
    """Return work arrays for forces at points."""
    k = min(MAX_TOUCHING, len(contact.area))
    return LocalForces(
        number=np.zeros(1, dtype=np.int64),
        points=np.zeros(k, dtype=np.int64),
        group=np.zeros(k, dtype=np.int64),
        place=np.zeros((k, 3)),
        free=np.zeros(3 * k),
        start=np.zeros(3 * k),
        force=np.zeros(3 * k),
        limit=np.zeros((k, len(contact.obstacles))),
        pull=np.zeros(3 * k),
        tangent=np.zeros((k, 3, 3)),
        residual=np.zeros(3 * k),
        motion=np.zeros(3 * k),
        compliance=np.zeros((3 * k, 3 * k)),
        relief=np.zeros((size, 3 * k)),
        half=np.zeros((3 * k, blocks, SIZE)),
        axes=np.eye(3),
        p=np.zeros(3),
        smooth=np.zeros(contact.obstacles.shape[1]),
    )


def reason_against(contact: Contact | None) -> str | None:
    """Return why compiled code cannot compute a contact, or None if it can."""
    if contact is None:
        return None
    if contact.self_contact:
        return "surfaces of the body touch each other"
    for obstacle in contact.obstacles:
        label = f"obstacle '{obstacle.name or obstacle.kind}'"
        if isinstance(obstacle, MeshObstacle):
            return f"{label} is a mesh"
        if obstacle.frame is not None:
            return f"{label} moves with a frame"
    return None


def contact_points(contact: Contact, frames: Frames, follow: csr_matrix, block: np.ndarray) -> ContactPoints:
    """Return the points of a contact; places in the tangent are still missing.

    Args:
        contact: one for which `reason_against` has none.
        frames: of the model.
        follow: rows as combinations of the own rows of frames, shape (n, n).
        block: of the frame that each row belongs to, -1 if it is fixed, shape (n,).
    """
    weights, area = contact.surface.points
    own = (weights @ follow).tocsr()
    own.sum_duplicates()
    first = np.full(own.shape[1], -1)
    for k in range(4):
        first[frames.rows + k] = frames.rows
    parts: list[dict[int, np.ndarray]] = []
    for p in range(own.shape[0]):
        found: dict[int, np.ndarray] = {}
        for column, value in zip(
            own.indices[own.indptr[p] : own.indptr[p + 1]], own.data[own.indptr[p] : own.indptr[p + 1]], strict=True
        ):
            row = int(first[column])
            found.setdefault(row, np.zeros(4))[column - row] = value
        parts.append(found)
    keys = [tuple(sorted(found)) for found in parts]
    # Points of parts that cannot move touch nothing.
    moving = [p for p, key in enumerate(keys) if any(block[row] >= 0 for row in key)]
    order = np.array(sorted(moving, key=lambda p: keys[p]), dtype=np.int64)
    used = [keys[p] for p in order]
    starts = [k for k in range(len(used)) if k == 0 or used[k] != used[k - 1]]
    width = max((len(key) for key in used), default=1)
    groups, count = np.array([*starts, len(used)], dtype=np.int64), len(starts)
    rows, blocks = np.zeros((count, width), dtype=np.int64), np.full((count, width), -1, dtype=np.int64)
    sorted_weights = np.zeros((len(used), width, 4))
    for g, start in enumerate(starts):
        key = used[start]
        rows[g] = key[0]
        rows[g, : len(key)] = key
        blocks[g, : len(key)] = block[list(key)]
    for k, p in enumerate(order):
        for f, row in enumerate(used[k]):
            sorted_weights[k, f] = parts[p][row]
    arms = np.linalg.norm(sorted_weights[:, :, 1:], axis=2)
    cut = [slice(groups[g], groups[g + 1]) for g in range(count)]
    obstacles = [each for each in contact.obstacles if isinstance(each, Obstacle)]
    table, edges = table_of(obstacles)
    return ContactPoints(
        groups=groups,
        frames=rows,
        blocks=blocks,
        place=np.full((count, width, width), -1),
        share=np.array([np.abs(sorted_weights[s, :, 0]).max(axis=0) for s in cut]).reshape(count, width),
        reach=np.array([arms[s].max(axis=0) for s in cut]).reshape(count, width),
        weights=sorted_weights,
        area=np.ascontiguousarray(area[order]),
        order=order,
        obstacles=table,
        edges=edges,
        law=np.array([contact.distance, contact.stiffness, contact.stick]),
    )


@njit(cache=True, error_model="numpy")
def point_at(contact, g, k, x, out):
    """Fill a point [m] (3,) of group ``g``."""
    for d in range(3):
        out[d] = 0.0
    for f in range(contact.frames.shape[1]):
        row, w = contact.frames[g, f], contact.weights[k, f]
        for d in range(3):
            out[d] += w[0] * x[row, d] + w[1] * x[row + 1, d] + w[2] * x[row + 2, d] + w[3] * x[row + 3, d]


@njit(cache=True, error_model="numpy")
def fill_arms(contact, g, k, x, out):
    """Fill the arms (F, 3) of a point [m] of group ``g`` along the directors of its frames."""
    for f in range(contact.frames.shape[1]):
        row, w = contact.frames[g, f], contact.weights[k, f]
        for d in range(3):
            out[f, d] = w[1] * x[row + 1, d] + w[2] * x[row + 2, d] + w[3] * x[row + 3, d]


@njit(cache=True, error_model="numpy")
def spread_of(contact, g, x):
    """Return a bound of the distance of the points of group ``g`` from the origin of its first frame [m]."""
    first, value = contact.frames[g, 0], contact.reach[g, 0]
    for f in range(1, contact.frames.shape[1]):
        row, square = contact.frames[g, f], 0.0
        for d in range(3):
            square += (x[row, d] - x[first, d]) ** 2
        value += contact.reach[g, f] + contact.share[g, f] * np.sqrt(square)
    return value


@njit(cache=True, error_model="numpy")
def add_contact(contact, slides, x, anchors, equations, full):
    """Add the forces of contact to the gradient and, if ``full``, their tangent; fill the terms of sliding points."""
    if contact is None:
        return
    slides.number[0] = 0
    distance, gradient, tangent = contact.law[0], equations.gradient, equations.tangent
    p, found, arms, width = slides.p, slides.touch, slides.arms, contact.frames.shape[1]
    for g in range(contact.frames.shape[0]):
        far = distance + spread_of(contact, g, x)
        for o in range(contact.obstacles.shape[0]):
            obstacle, edges = contact.obstacles[o], contact.edges[o]
            if quick_gap(x[contact.frames[g, 0]], obstacle, edges) >= far:
                continue
            for k in range(contact.groups[g], contact.groups[g + 1]):
                point_at(contact, g, k, x, p)
                gap = quick_gap(p, obstacle, edges)
                if gap >= distance:
                    continue
                if not gap > 0.0:
                    slides.number[0] = -1
                    return
                sliding = touch_point(p, contact.area[k], obstacle, edges, anchors[o, k], contact.law, False, found)[4]
                pull, K = found.pull, found.tangent
                for f in range(width):
                    row, w = contact.frames[g, f], contact.weights[k, f]
                    for m in range(4):
                        for d in range(3):
                            gradient[row + m, d] += w[m] * pull[d]
                if not full:
                    continue
                fill_arms(contact, g, k, x, arms)
                for f in range(width):
                    for h in range(width):
                        if contact.place[g, f, h] >= 0:
                            block = tangent[contact.place[g, f, h]]
                            _add_block(K, arms[f], contact.weights[k, f, 0], arms[h], contact.weights[k, h, 0], block)
                if sliding:
                    s = slides.number[0]
                    if s >= slides.slip.shape[0]:
                        slides.number[0] = -1
                        return
                    slides.number[0] = s + 1
                    slides.direction[s] = 0.0
                    slides.loading[s] = 0.0
                    for f in range(width):
                        if contact.blocks[g, f] >= 0:
                            b, share = contact.blocks[g, f], contact.weights[k, f, 0]
                            add_wrench(found.direction, arms[f], share, slides.direction[s, b])
                            add_wrench(found.loading, arms[f], share, slides.loading[s, b])


@njit(cache=True, error_model="numpy")
def add_wrench(force, arm, share, out):
    """Add to ``out`` (6,) what a force (3,) at a point does to a frame that moves it by ``share u + w x arm``."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i] += share * force[i]
        out[3 + i] += arm[j] * force[k] - arm[k] * force[j]


@njit(cache=True, error_model="numpy")
def _add_block(K, arm, share, other_arm, other_share, block):
    """Add the tangent ``J^T K J`` of a point to the block (6, 6) of two frames that move it."""
    for j in range(3):
        # Columns of K J: K e_j and K (w_j x r), (e_j x r) = r_{j+2} along j + 1 with minus, r_{j+1} along j + 2.
        b, c = (j + 1) % 3, (j + 2) % 3
        u0, u1, u2 = other_share * K[0, j], other_share * K[1, j], other_share * K[2, j]
        v0 = K[0, c] * other_arm[b] - K[0, b] * other_arm[c]
        v1 = K[1, c] * other_arm[b] - K[1, b] * other_arm[c]
        v2 = K[2, c] * other_arm[b] - K[2, b] * other_arm[c]
        block[0, j] += share * u0
        block[1, j] += share * u1
        block[2, j] += share * u2
        block[3, j] += arm[1] * u2 - arm[2] * u1
        block[4, j] += arm[2] * u0 - arm[0] * u2
        block[5, j] += arm[0] * u1 - arm[1] * u0
        block[0, 3 + j] += share * v0
        block[1, 3 + j] += share * v1
        block[2, 3 + j] += share * v2
        block[3, 3 + j] += arm[1] * v2 - arm[2] * v1
        block[4, 3 + j] += arm[2] * v0 - arm[0] * v2
        block[5, 3 + j] += arm[0] * v1 - arm[1] * v0


@njit(cache=True, error_model="numpy")
def hold_slides(slides, free):
    """Leave out components that are held, where ``free`` (b, 6) is zero."""
    if slides is None:
        return
    for s in range(slides.number[0]):
        for b in range(free.shape[0]):
            for i in range(SIZE):
                slides.direction[s, b, i] *= free[b, i]
                slides.loading[s, b, i] *= free[b, i]


@njit(cache=True, error_model="numpy")
def has_failed(slides):
    """Return whether a point was found inside an obstacle, or too many slide."""
    if slides is None:
        return False
    return slides.number[0] < 0


@njit(cache=True, error_model="numpy")
def slide(slides, y, signs):
    """Change ``y`` (b, 6), a solution ``L^-1 b`` of the symmetric part, into that of the whole tangent."""
    if slides is None:
        return
    count = slides.number[0]
    if count <= 0:
        return
    flat, sign, slip = y.reshape(y.size), signs.reshape(signs.size), slides.slip
    for s in range(count):
        loading, value = slides.loading[s].reshape(y.size), 0.0
        for i in range(flat.shape[0]):
            value += loading[i] * sign[i] * flat[i]
        slip[s] = value
    for s in range(count):
        value, direction = 0.0, slides.direction[s].reshape(y.size)
        for t in range(count):
            value += slides.core[s, t] * slip[t]
        for i in range(flat.shape[0]):
            flat[i] -= value * direction[i]


@njit(cache=True, error_model="numpy")
def free_part(contact, slides, start, end):
    """Return the part, in (0, 1], of the straight way between rows (n, 3) on which no point enters an obstacle.

    Points keep a part of their gap (`NEAREST`). They advance by no more than their gap, which changes by no more than
    the distance that they move.
    """
    result = 1.0
    if contact is None:
        return result
    p, q, r, distance = slides.p, slides.q, slides.touch.pull, contact.law[0]
    for g in range(contact.frames.shape[0]):
        spread, way = spread_of(contact, g, start), 0.0
        first = contact.frames[g, 0]
        for f in range(contact.frames.shape[1]):
            row, turn, shift = contact.frames[g, f], 0.0, 0.0
            for d in range(3):
                shift += (end[row, d] - start[row, d]) ** 2
                for m in range(1, 4):
                    turn += (end[row + m, d] - start[row + m, d]) ** 2
            way += contact.share[g, f] * np.sqrt(shift) + contact.reach[g, f] * np.sqrt(turn)
        for o in range(contact.obstacles.shape[0]):
            obstacle, edges = contact.obstacles[o], contact.edges[o]
            if quick_gap(start[first], obstacle, edges) >= spread + way + distance:
                continue
            for k in range(contact.groups[g], contact.groups[g + 1]):
                point_at(contact, g, k, start, p)
                point_at(contact, g, k, end, q)
                square = 0.0
                for d in range(3):
                    square += (q[d] - p[d]) ** 2
                length, left, part = np.sqrt(square), quick_gap(p, obstacle, edges), 0.0
                goal = NEAREST * min(left, distance)
                if left - length >= goal:
                    continue
                while part < result:
                    part += 0.9 * (left - 0.5 * goal) / length
                    if part >= result:
                        break
                    for d in range(3):
                        r[d] = p[d] + part * (q[d] - p[d])
                    left = quick_gap(r, obstacle, edges)
                    if left <= goal:
                        result = part
    return result


@njit(cache=True, error_model="numpy")
def catch_up(p, area, obstacle, edges, anchor, law, found, totals):
    """Move the anchor (3,) of a touching point so that its spring carries no more than it can; see `commit`."""
    stored, _, _, pressing, _ = touch_point(p, area, obstacle, edges, anchor, law, True, found)
    totals[1] += stored
    for d in range(3):
        friction = found.pull[d] + pressing * found.normal[d]
        elastic = friction / (law[2] * area)
        new = p[d] - elastic
        totals[1] += 0.5 * friction * elastic
        totals[3] += friction * (new - anchor[d])
        anchor[d] = new


@njit(cache=True, error_model="numpy")
def commit(contact, slides, x, anchors, totals):
    """Let springs that slid at the accepted rows ``x`` (n, 3) catch up, as `ContactState.commit`.

    Adds the energy stored in barriers and springs to ``totals[1]``, and what friction dissipated to ``totals[3]``.
    """
    if contact is None:
        return
    slides.before[:] = anchors
    p, found, law = slides.p, slides.touch, contact.law
    for g in range(contact.frames.shape[0]):
        far = law[0] + spread_of(contact, g, x)
        for k in range(contact.groups[g], contact.groups[g + 1]):
            point_at(contact, g, k, x, p)
            for o in range(contact.obstacles.shape[0]):
                obstacle, edges, anchor = contact.obstacles[o], contact.edges[o], anchors[o, k]
                first = x[contact.frames[g, 0]]
                if quick_gap(first, obstacle, edges) >= far or quick_gap(p, obstacle, edges) >= law[0]:
                    for d in range(3):
                        anchor[d] = p[d]
                    continue
                catch_up(p, contact.area[k], obstacle, edges, anchor, law, found, totals)


@njit(cache=True, error_model="numpy")
def touching(contact, slides, x, anchors, numbers, values):
    """Fill what touches at rows ``x`` (n, 3); return how many points do, at most as many as there is place for.

    ``numbers`` (k, 3) are filled with obstacle, point of the surface and sliding; ``values`` (k, 8) with point, gap,
    force and pressing.
    """
    p, found, law, count = slides.p, slides.touch, contact.law, 0
    for o in range(contact.obstacles.shape[0]):
        obstacle, edges = contact.obstacles[o], contact.edges[o]
        for g in range(contact.frames.shape[0]):
            if quick_gap(x[contact.frames[g, 0]], obstacle, edges) >= law[0] + spread_of(contact, g, x):
                continue
            for k in range(contact.groups[g], contact.groups[g + 1]):
                point_at(contact, g, k, x, p)
                if quick_gap(p, obstacle, edges) >= law[0] or count >= numbers.shape[0]:
                    continue
                _, _, gap, pressing, sliding = touch_point(
                    p, contact.area[k], obstacle, edges, anchors[o, k], law, True, found
                )
                numbers[count, 0], numbers[count, 1], numbers[count, 2] = o, contact.order[k], sliding
                for d in range(3):
                    values[count, d], values[count, 4 + d] = p[d], -found.pull[d]
                values[count, 3], values[count, 7] = gap, pressing
                count += 1
    return count
