"""Points of the skins of beams and rigid parts that touch obstacles, for the compiled equations of `equations`.

The law is that of the general solver (`softgym_envs.mechanics.contact.law`). While points slide, the tangent is
``S + U V^T`` with a symmetric ``S``, which is factorised; the formula of Woodbury does the rest, as in `Linearisation`.

Kernels take None in place of `ContactPoints` for bodies that touch nothing, and are then compiled without contact.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from softgym_envs.extensions.beams.contact_law import PointTouch, make_touch, quick_gap, touch_point
from softgym_envs.extensions.beams.solver.block_cholesky import SIZE, copy_values
from softgym_envs.extensions.beams.solver.points import ContactPoints
from softgym_envs.mechanics.compilation import FAST, njit

MAX_SLIDING = 160
"""Points that may slide at once; the general solver takes over beyond it."""
FEW = 16
"""Points that may touch in one Newton step with a dense compliance."""
NEAREST = 0.3
"""Part of its gap, or of the distance of contact if that is smaller, that a point keeps in one Newton step."""
MARGIN = 3.0
"""Gap up to which points are listed as near ones, beyond the distance of contact and in parts of it."""


class NearPoints(NamedTuple):
    """Points that may touch an obstacle while no point moves far: work arrays for m pairs of a point and an obstacle.

    Attributes:
        number: how many pairs there are; -1 before they are looked for, shape (1,).
        point: their points, shape (m,).
        group: the groups of these, shape (m,).
        obstacle: their obstacles, ascending, shape (m,).
        x: rows at which they were found [m], shape (n, 3).
        way: how far the points of each group may move from there before others can touch [m], shape (g,).
        moved: how far origins [m] and directors of frames have moved from there, shape (n, 2).
        anchor: where friction springs of touching points begin [m], shape (m, 3).
    """

    number: np.ndarray
    point: np.ndarray
    group: np.ndarray
    obstacle: np.ndarray
    x: np.ndarray
    way: np.ndarray
    moved: np.ndarray
    anchor: np.ndarray


class LocalForces(NamedTuple):
    """Forces at points that may touch, on the linearised body; work arrays for k points, which have 3 k components.

    Up to `FEW` of them, m, have a dense compliance; see `response`.

    Attributes:
        number: how many points are chosen, shape (1,).
        points: their numbers, shape (k,).
        group: their groups, shape (k,).
        first: the first blocks of the tangent that forces on them change, shape (k,).
        place: where they are [m], shape (k, 3).
        arms: along the directors of their frames [m], shape (k, F, 3).
        free: their motion under the present forces [m], shape (3 k,).
        start: present forces on them [N], shape (3 k,).
        force: forces on them [N], shape (3 k,).
        limit: of friction [N], shape (k, o).
        pull: minus what contact does to them [N], shape (3 k,).
        tangent: its derivative, shape (k, 3, 3).
        residual: by how much forces and contact differ [N], shape (3 k,).
        motion: what that moves [m], shape (3 k,).
        moved: what the forces move, less what the present ones do [m], shape (3 k,).
        before: the same before a step of the forces [m], shape (3 k,).
        reach: what the whole step moves [m], shape (3 k,).
        step: of the forces [N], shape (3 k,).
        kept: forces before the step [N], shape (3 k,).
        spare: shape (3 k,).
        slack: which driven rows are slack, shape (size,).
        among: inverse of ``W`` of driven rows, shape (size, size).
        row: values of driven rows, shape (size,).
        change: their efforts, shape (size,).
        wrench: of the frames, and their motion, shape (b, 6).
        compliance: motion by forces, with driven rows held [m/N], shape (3 m, 3 m).
        coupling: values of driven rows by forces, shape (size, 3 m).
        relief: minus the efforts of driven rows by forces, shape (size, 3 m).
        half: ``L^-1`` times the forces, shape (3 m, b, 6).
        active: components of forces on points that press, shape (3 m,).
        matrix: of dense equations, shape (n, n).
        right: their right-hand side, shape (n,).
        bare: tangent without the stiffness of contact, shape (blocks, 6, 6).
        upper: with it, on the diagonal and above it, shape (blocks, 6, 6).
        lower: below the diagonal, shape (blocks - b, 6, 6).
        columns: motion of the frames by driven rows, shape (size, b, 6).
        block: shape (6, 6).
        axes: unit vectors, shape (3, 3).
        p: a point [m], shape (3,).
        smooth: an obstacle without friction, shape (17,).
    """

    number: np.ndarray
    points: np.ndarray
    group: np.ndarray
    first: np.ndarray
    place: np.ndarray
    arms: np.ndarray
    free: np.ndarray
    start: np.ndarray
    force: np.ndarray
    limit: np.ndarray
    pull: np.ndarray
    tangent: np.ndarray
    residual: np.ndarray
    motion: np.ndarray
    moved: np.ndarray
    before: np.ndarray
    reach: np.ndarray
    step: np.ndarray
    kept: np.ndarray
    spare: np.ndarray
    slack: np.ndarray
    among: np.ndarray
    row: np.ndarray
    change: np.ndarray
    wrench: np.ndarray
    compliance: np.ndarray
    coupling: np.ndarray
    relief: np.ndarray
    half: np.ndarray
    active: np.ndarray
    matrix: np.ndarray
    right: np.ndarray
    bare: np.ndarray
    upper: np.ndarray
    lower: np.ndarray
    columns: np.ndarray
    block: np.ndarray
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
        near: points that may touch.
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
    near: NearPoints
    local: LocalForces


def make_slides(contact: ContactPoints | None, blocks: int, size: int, rows: int, stored: int) -> Slides | None:
    """Return arrays for contact, or None without it.

    Args:
        contact: points and obstacles.
        blocks: frames that move.
        size: constraints.
        rows: of the body.
        stored: blocks of the tangent.
    """
    if contact is None:
        return None
    points, pairs = len(contact.area), len(contact.area) * len(contact.obstacles)
    most = min(MAX_SLIDING, pairs)
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
        near=NearPoints(
            number=np.full(1, -1),
            point=np.zeros(pairs, dtype=np.int64),
            group=np.zeros(pairs, dtype=np.int64),
            obstacle=np.zeros(pairs, dtype=np.int64),
            x=np.zeros((rows, 3)),
            way=np.zeros(len(contact.frames)),
            moved=np.zeros((rows, 2)),
            anchor=np.zeros((pairs, 3)),
        ),
        local=_make_local(contact, blocks, size, stored),
    )


def _make_local(contact: ContactPoints, blocks: int, size: int, stored: int) -> LocalForces:
    """Return work arrays for forces at points."""
    k = len(contact.area)
    m = min(FEW, k)
    n = max(3 * m, size, SIZE)
    return LocalForces(
        number=np.zeros(1, dtype=np.int64),
        points=np.zeros(k, dtype=np.int64),
        group=np.zeros(k, dtype=np.int64),
        first=np.zeros(k, dtype=np.int64),
        place=np.zeros((k, 3)),
        arms=np.zeros((k, contact.frames.shape[1], 3)),
        free=np.zeros(3 * k),
        start=np.zeros(3 * k),
        force=np.zeros(3 * k),
        limit=np.zeros((k, len(contact.obstacles))),
        pull=np.zeros(3 * k),
        tangent=np.zeros((k, 3, 3)),
        residual=np.zeros(3 * k),
        motion=np.zeros(3 * k),
        moved=np.zeros(3 * k),
        before=np.zeros(3 * k),
        reach=np.zeros(3 * k),
        step=np.zeros(3 * k),
        kept=np.zeros(3 * k),
        spare=np.zeros(3 * k),
        slack=np.zeros(size, dtype=bool),
        among=np.zeros((size, size)),
        row=np.zeros(size),
        change=np.zeros(size),
        wrench=np.zeros((blocks, SIZE)),
        compliance=np.zeros((3 * m, 3 * m)),
        coupling=np.zeros((size, 3 * m)),
        relief=np.zeros((size, 3 * m)),
        half=np.zeros((3 * m, blocks, SIZE)),
        active=np.zeros(3 * m, dtype=np.int64),
        matrix=np.zeros((n, n)),
        right=np.zeros(n),
        bare=np.zeros((stored, SIZE, SIZE)),
        upper=np.zeros((stored, SIZE, SIZE)),
        lower=np.zeros((stored - blocks, SIZE, SIZE)),
        columns=np.zeros((size, blocks, SIZE)),
        block=np.zeros((SIZE, SIZE)),
        axes=np.eye(3),
        p=np.zeros(3),
        smooth=np.zeros(contact.obstacles.shape[1]),
    )


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST, forceinline=True)
def point_at(contact, g, k, x, out):
    """Fill a point [m] (3,) of group ``g``."""
    p, q, r = 0.0, 0.0, 0.0
    for f in range(contact.frames.shape[1]):
        row = contact.frames[g, f]
        for m in range(4):
            w = contact.weights[k, f, m]
            p += w * x[row + m, 0]
            q += w * x[row + m, 1]
            r += w * x[row + m, 2]
    out[0], out[1], out[2] = p, q, r


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def fill_arms(contact, g, k, x, out):
    """Fill the arms (F, 3) of a point [m] of group ``g`` along the directors of its frames."""
    for f in range(contact.frames.shape[1]):
        row, w = contact.frames[g, f], contact.weights[k, f]
        for d in range(3):
            out[f, d] = w[1] * x[row + 1, d] + w[2] * x[row + 2, d] + w[3] * x[row + 3, d]


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def spread_of(contact, g, x):
    """Return a bound of the distance of the points of group ``g`` from the origin of its first frame [m]."""
    first, value = contact.frames[g, 0], contact.reach[g, 0]
    for f in range(1, contact.frames.shape[1]):
        row, square = contact.frames[g, f], 0.0
        for d in range(3):
            square += (x[row, d] - x[first, d]) ** 2
        value += contact.reach[g, f] + contact.share[g, f] * np.sqrt(square)
    return value


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _fill_moved(contact, near, start, end):
    """Fill how far the frames move between rows (n, 3)."""
    for i in range(contact.rows.shape[0]):
        row, turn, shift = contact.rows[i], 0.0, 0.0
        for d in range(3):
            shift += (end[row, d] - start[row, d]) ** 2
            for m in range(1, 4):
                turn += (end[row + m, d] - start[row + m, d]) ** 2
        near.moved[row, 0], near.moved[row, 1] = np.sqrt(shift), np.sqrt(turn)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def _way_of(contact, near, g):
    """Return a bound of the way of the points of group ``g`` as its frames move [m]."""
    way = 0.0
    for f in range(contact.frames.shape[1]):
        row = contact.frames[g, f]
        way += contact.share[g, f] * near.moved[row, 0] + contact.reach[g, f] * near.moved[row, 1]
    return way


@njit(cache=True, error_model="numpy", _nrt=False)
def _covers(contact, near, x):
    """Return whether the list holds all points that may touch at rows ``x`` (n, 3)."""
    if near.number[0] < 0:
        return False
    _fill_moved(contact, near, near.x, x)
    for g in range(near.way.shape[0]):
        if _way_of(contact, near, g) > near.way[g]:
            return False
    return True


@njit(cache=True, error_model="numpy", _nrt=False)
def forget_near(slides):
    """Let near points be looked for again, for another body or other obstacles."""
    if slides is None:
        return
    slides.near.number[0] = -1


@njit(cache=True, error_model="numpy", _nrt=False)
def find_near(contact, slides, x, other):
    """List the points that may come as near to an obstacle as the distance of contact between two rows (n, 3).

    The list stays while no point that is not listed can have come so near.
    """
    near, p = slides.near, slides.p
    if _covers(contact, near, x) and (other is x or _covers(contact, near, other)):
        return
    _fill_moved(contact, near, x, other)
    count, distance = 0, contact.law[0]
    copy_values(x, near.x)
    near.way[:] = np.inf
    for o in range(contact.obstacles.shape[0]):
        obstacle, edges = contact.obstacles[o], contact.edges[o]
        for g in range(contact.frames.shape[0]):
            margin = MARGIN * distance + _way_of(contact, near, g)
            far = quick_gap(x[contact.frames[g, 0]], obstacle, edges) - spread_of(contact, g, x) - distance
            if far > margin:
                near.way[g] = min(near.way[g], far)
                continue
            for k in range(contact.groups[g], contact.groups[g + 1]):
                point_at(contact, g, k, x, p)
                left = quick_gap(p, obstacle, edges) - distance
                if left > margin:
                    near.way[g] = min(near.way[g], left)
                else:
                    near.point[count], near.group[count], near.obstacle[count] = k, g, o
                    count += 1
    near.number[0] = count


@njit(cache=True, error_model="numpy", _nrt=False)
def add_contact(contact, slides, x, anchors, equations, full):
    """Add the forces of contact to the gradient and, if ``full``, their tangent; fill the terms of sliding points."""
    if contact is None:
        return
    slides.number[0] = 0
    distance, gradient, tangent = contact.law[0], equations.gradient, equations.tangent
    p, found, arms, width, near = slides.p, slides.touch, slides.arms, contact.frames.shape[1], slides.near
    find_near(contact, slides, x, x)
    for i in range(near.number[0]):
        k, g, o = near.point[i], near.group[i], near.obstacle[i]
        obstacle, edges = contact.obstacles[o], contact.edges[o]
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
                    add_block(K, arms[f], contact.weights[k, f, 0], arms[h], contact.weights[k, h, 0], block)
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


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def add_wrench(force, arm, share, out):
    """Add to ``out`` (6,) what a force (3,) at a point does to a frame that moves it by ``share u + w x arm``."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i] += share * force[i]
        out[3 + i] += arm[j] * force[k] - arm[k] * force[j]


@njit(cache=True, error_model="numpy", _nrt=False, fastmath=FAST)
def add_block(K, arm, share, other_arm, other_share, block):
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


@njit(cache=True, error_model="numpy", _nrt=False)
def hold_slides(slides, free):
    """Leave out components that are held, where ``free`` (b, 6) is zero."""
    if slides is None:
        return
    for s in range(slides.number[0]):
        for b in range(free.shape[0]):
            for i in range(SIZE):
                slides.direction[s, b, i] *= free[b, i]
                slides.loading[s, b, i] *= free[b, i]


@njit(cache=True, error_model="numpy", _nrt=False)
def has_failed(slides):
    """Return whether a point was found inside an obstacle, or too many slide."""
    if slides is None:
        return False
    return slides.number[0] < 0


@njit(cache=True, error_model="numpy", _nrt=False)
def slide(slides, y, signs):
    """Change ``y`` (b, 6), a solution ``L^-1 b`` of the symmetric part, into that of the whole tangent."""
    if slides is None:
        return
    count = slides.number[0]
    if count <= 0:
        return
    flat, sign, slip = y.flat, signs.flat, slides.slip
    for s in range(count):
        loading, value = slides.loading[s].flat, 0.0
        for i in range(y.size):
            value += loading[i] * sign[i] * flat[i]
        slip[s] = value
    for s in range(count):
        value, direction = 0.0, slides.direction[s].flat
        for t in range(count):
            value += slides.core[s, t] * slip[t]
        for i in range(y.size):
            flat[i] -= value * direction[i]


@njit(cache=True, error_model="numpy", _nrt=False)
def free_part(contact, slides, start, end):
    """Return the part, in (0, 1], of the straight way between rows (n, 3) on which no point enters an obstacle.

    Points keep a part of their gap (`NEAREST`). They advance by no more than their gap, which changes by no more than
    the distance that they move.
    """
    result = 1.0
    if contact is None:
        return result
    p, q, r, distance, near = slides.p, slides.q, slides.touch.pull, contact.law[0], slides.near
    find_near(contact, slides, start, end)
    for i in range(near.number[0]):
        k, g, o = near.point[i], near.group[i], near.obstacle[i]
        obstacle, edges = contact.obstacles[o], contact.edges[o]
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


@njit(cache=True, error_model="numpy", _nrt=False)
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


@njit(cache=True, error_model="numpy", _nrt=False)
def commit(contact, slides, x, anchors, totals):
    """Let springs that slid at the accepted rows ``x`` (n, 3) catch up, as `ContactState.commit`.

    Adds the energy stored in barriers and springs to ``totals[1]``, and what friction dissipated to ``totals[3]``.
    """
    if contact is None:
        return
    copy_values(anchors, slides.before)
    p, found, law, near = slides.p, slides.touch, contact.law, slides.near
    find_near(contact, slides, x, x)
    for i in range(near.number[0]):
        k, g, o = near.point[i], near.group[i], near.obstacle[i]
        obstacle, edges, anchor = contact.obstacles[o], contact.edges[o], anchors[o, k]
        point_at(contact, g, k, x, p)
        if quick_gap(p, obstacle, edges) < law[0]:
            catch_up(p, contact.area[k], obstacle, edges, anchor, law, found, totals)
        else:
            copy_values(p, anchor)
        copy_values(anchor, near.anchor[i])
    # All other points are free.
    for g in range(contact.frames.shape[0]):
        for k in range(contact.groups[g], contact.groups[g + 1]):
            point_at(contact, g, k, x, p)
            for o in range(contact.obstacles.shape[0]):
                for d in range(3):
                    anchors[o, k, d] = p[d]
    for i in range(near.number[0]):
        copy_values(near.anchor[i], anchors[near.obstacle[i], near.point[i]])


@njit(cache=True, error_model="numpy", _nrt=False)
def touching(contact, slides, x, anchors, numbers, values):
    """Fill what touches at rows ``x`` (n, 3); return how many points do, at most as many as there is place for.

    ``numbers`` (k, 3) are filled with obstacle, point of the surface and sliding; ``values`` (k, 8) with point, gap,
    force and pressing.
    """
    p, found, law, count, near = slides.p, slides.touch, contact.law, 0, slides.near
    find_near(contact, slides, x, x)
    for i in range(near.number[0]):
        k, g, o = near.point[i], near.group[i], near.obstacle[i]
        obstacle, edges = contact.obstacles[o], contact.edges[o]
        point_at(contact, g, k, x, p)
        if quick_gap(p, obstacle, edges) >= law[0] or count >= numbers.shape[0]:
            continue
        _, _, gap, pressing, sliding = touch_point(p, contact.area[k], obstacle, edges, anchors[o, k], law, True, found)
        numbers[count, 0], numbers[count, 1], numbers[count, 2] = o, contact.order[k], sliding
        for d in range(3):
            values[count, d], values[count, 4 + d] = p[d], -found.pull[d]
        values[count, 3], values[count, 7] = gap, pressing
        count += 1
    return count
