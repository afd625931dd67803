"""The law of contact at one point in compiled code, for obstacles that stand still: see `law` and `obstacles`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from softgym_envs.extensions.beams.prism import RoundedPrism, prism_geometry
from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.contact.obstacles import Cylinder, Obstacle, Plane, Sphere

PLANE, ROUND, PRISM = 0, 1, 2
"""Kinds of obstacles. A row of parameters holds: kind, friction, radius, half height, number of edges, centre (3),
matrix (9, row by row: the projection of round obstacles, the rotation of prisms, the normal of planes in its first
row)."""

PARAMETERS = 17


def table_of(obstacles: Sequence[Obstacle]) -> tuple[np.ndarray, np.ndarray]:
    """Return obstacles as the kernels take them: parameters (O, 17) and edges (O, E, 7).

    Raises:
        ValueError: for an obstacle on a moving frame or of another kind.
    """
    count = max([1, *(len(o.polygon) for o in obstacles if isinstance(o, RoundedPrism))])
    table, edges = np.zeros((len(obstacles), PARAMETERS)), np.zeros((len(obstacles), count, 7))
    for row, lines, obstacle in zip(table, edges, obstacles, strict=True):
        if obstacle.frame is not None:
            raise ValueError(
                f"obstacle '{obstacle.name or obstacle.kind}' moves with a frame; compiled contact needs fixed ones"
            )
        matrix = np.zeros((3, 3))
        row[1] = obstacle.friction
        if isinstance(obstacle, Plane):
            row[0], row[5:8], matrix[0] = PLANE, obstacle.point, obstacle.normal
        elif isinstance(obstacle, Sphere):
            row[0], row[2], row[5:8], matrix = ROUND, obstacle.radius, obstacle.centre, np.eye(3)
        elif isinstance(obstacle, Cylinder):
            row[0], row[2], row[5:8] = ROUND, obstacle.radius, obstacle.point
            matrix = np.eye(3) - np.outer(obstacle.axis, obstacle.axis)
        elif isinstance(obstacle, RoundedPrism):
            row[0], row[2], row[3], row[4] = PRISM, obstacle.radius, obstacle.half_height, len(obstacle.polygon)
            row[5:8], matrix = obstacle.centre, np.asarray(obstacle.rotation)
            start, length, direction, outward = obstacle.edges
            lines[: len(start)] = np.column_stack([start, length, direction, outward])
        else:
            raise ValueError(f"compiled contact knows no obstacles of kind '{obstacle.kind}'")
        row[8:17] = np.asarray(matrix).ravel()
    return table, edges


@njit(cache=True, error_model="numpy", _nrt=False)
def quick_gap(p, parameters, edges):
    """Return the gap [m] of a point (3,) to an obstacle, without its derivatives."""
    kind = int(parameters[0])
    x, y, z = p[0] - parameters[5], p[1] - parameters[6], p[2] - parameters[7]
    if kind == PLANE:
        return parameters[8] * x + parameters[9] * y + parameters[10] * z
    if kind == ROUND:
        square = 0.0
        for i in range(3):
            square += (parameters[8 + 3 * i] * x + parameters[9 + 3 * i] * y + parameters[10 + 3 * i] * z) ** 2
        return max(math.sqrt(square), 1e-300) - parameters[2]
    return _gap_of_prism(p, parameters, edges)


@njit(cache=True, error_model="numpy", _nrt=True)
def _gap_of_prism(p, parameters, edges):
    """Return the gap [m] of a point (3,) to a prism."""
    return _prism(p, parameters, edges, np.empty(3), np.empty((3, 3)))


@njit(cache=True, error_model="numpy", _nrt=True)
def _prism(p, parameters, edges, normal, curvature):
    """Do what `gap_of` says for a prism."""
    count, matrix = int(parameters[4]), parameters[8:17].reshape(3, 3)
    local = np.empty((1, 3))
    local[0] = (p - parameters[5:8]) @ matrix
    found, n, h = np.empty(1), np.empty((1, 3)), np.empty((1, 3, 3))
    prism_geometry(
        local, edges[:count, 0:2], edges[:count, 2], edges[:count, 3:5], edges[:count, 5:7], parameters[3],
        parameters[2], found, n, h,
    )  # fmt: skip
    normal[:] = matrix @ n[0]
    curvature[:, :] = matrix @ h[0] @ matrix.T
    return found[0]


@njit(cache=True, error_model="numpy", _nrt=False, forceinline=False)
def gap_of(p, parameters, edges, normal, curvature):
    """Return the gap [m] of a point (3,) to an obstacle; fill its normal (3,) and curvature (3, 3)."""
    kind = int(parameters[0])
    if kind == PLANE:
        gap = 0.0
        for i in range(3):
            normal[i] = parameters[8 + i]
            gap += normal[i] * (p[i] - parameters[5 + i])
            for j in range(3):
                curvature[i, j] = 0.0
        return gap
    matrix = parameters[8:17].reshape(3, 3)
    if kind == ROUND:
        x, y, z = p[0] - parameters[5], p[1] - parameters[6], p[2] - parameters[7]
        square = 0.0
        for i in range(3):
            normal[i] = matrix[i, 0] * x + matrix[i, 1] * y + matrix[i, 2] * z
            square += normal[i] ** 2
        length = max(math.sqrt(square), 1e-300)
        for i in range(3):
            normal[i] /= length
        for i in range(3):
            for j in range(3):
                curvature[i, j] = (matrix[i, j] - normal[i] * normal[j]) / length
        return length - parameters[2]
    return _prism(p, parameters, edges, normal, curvature)


class PointTouch(NamedTuple):
    """What an obstacle does to a point: results of `touch_point`, and its work arrays.

    Attributes:
        pull: minus the force on the point [N], shape (3,).
        tangent: its derivative by the point while the limit of friction is held, shape (3, 3).
        direction: unit vector of the stretch of the friction spring where the point slides, shape (3,).
        loading: derivative of the limit of friction by the point, shape (3,); the exact tangent of a sliding point adds
            ``direction loading^T``.
        normal: of the obstacle at the point, shape (3,).
        curvature: of the obstacle at the point [1/m], shape (3, 3).
        place: normal of the obstacle at the anchor, shape (3,).
        spare: work array, shape (3, 3).
    """

    pull: np.ndarray
    tangent: np.ndarray
    direction: np.ndarray
    loading: np.ndarray
    normal: np.ndarray
    curvature: np.ndarray
    place: np.ndarray
    spare: np.ndarray


@njit(cache=True, error_model="numpy")
def make_touch():
    """Return arrays for `touch_point`."""
    w = np.zeros((14, 3))
    return PointTouch(w[0], w[1:4], w[4], w[5], w[6], w[7:10], w[10], w[11:14])


@njit(cache=True, error_model="numpy", _nrt=False)
def barrier_value(gap, distance):
    """Return the energy of a barrier per area and stiffness [m]; see `law.barrier`."""
    s = (gap / distance) ** 2
    return -distance * (s - 1.0) ** 2 * math.log(s)


@njit(cache=True, error_model="numpy", _nrt=False)
def barrier_slope(gap, distance):
    """Return the derivative of `barrier_value` by the gap."""
    s = (gap / distance) ** 2
    rest = s - 1.0
    return -2.0 * gap / distance * (2.0 * rest * math.log(s) + rest * rest / s)


@njit(cache=True, error_model="numpy", _nrt=False)
def barrier_curvature(gap, distance):
    """Return the second derivative of `barrier_value` by the gap [1/m]."""
    s = (gap / distance) ** 2
    log, rest = math.log(s), s - 1.0
    by_s = 2.0 * rest * log + rest * rest / s
    return -(4.0 * s * (2.0 * log + 4.0 * rest / s - rest * rest / (s * s)) + 2.0 * by_s) / distance


@njit(cache=True, error_model="numpy", _nrt=False, forceinline=True)
def stretch_of(p, obstacle, edges, anchor, out):
    """Fill ``out.direction`` with the stretch of a friction spring along the surface [m]; return its length [m]."""
    along, place = out.direction, out.place
    gap_of(anchor, obstacle, edges, place, out.spare)
    across, square = 0.0, 0.0
    for i in range(3):
        across += place[i] * (p[i] - anchor[i])
    for i in range(3):
        along[i] = p[i] - anchor[i] - place[i] * across
        square += along[i] * along[i]
    return math.sqrt(square)


@njit(cache=True, error_model="numpy", _nrt=False, forceinline=True)
def add_friction(p, obstacle, edges, anchor, spring, limit, out):
    """Add the friction of a spring [N/m] whose limit [N] is held to pull and tangent; its energy [J] and if it slides.

    Fills ``out.direction``, if it slides with the unit vector of the stretch.
    """
    along, place, size = out.direction, out.place, stretch_of(p, obstacle, edges, anchor, out)
    sliding = spring * size > limit
    factor = limit / size if sliding else spring
    for i in range(3):
        out.pull[i] += factor * along[i]
    if sliding:
        for i in range(3):
            along[i] /= size
    for i in range(3):
        for j in range(3):
            value = -place[i] * place[j]
            if i == j:
                value += 1.0
            if sliding:
                value -= along[i] * along[j]
            out.tangent[i, j] += factor * value
    return (limit * size - 0.5 * limit * limit / spring if sliding else 0.5 * spring * size * size), sliding


@njit(cache=True, error_model="numpy", _nrt=False)
def touch_point(p, area, obstacle, edges, anchor, law, convex, out):
    """Fill what one obstacle does to a point that is nearer than the distance of contact, and outside.

    Returns the energy of the barrier, and that of friction with its limit held [J]; the gap [m]; the normal force [N];
    and whether the point slides.

    Args:
        p: point [m], shape (3,).
        area: [m2].
        obstacle: parameters.
        edges: of a prism.
        anchor: of the friction spring [m], shape (3,).
        law: distance of contact [m], stiffness [Pa], stick [Pa/m].
        convex: leave out the curvature of the obstacle, which can make the tangent indefinite.
        out: a `PointTouch`, is filled.
    """
    distance, stiffness, stick = law[0], law[1], law[2]
    pull, tangent, normal = out.pull, out.tangent, out.normal
    gap, scale = gap_of(p, obstacle, edges, normal, out.curvature), stiffness * area
    first, second = scale * barrier_slope(gap, distance), scale * barrier_curvature(gap, distance)
    for i in range(3):
        pull[i] = first * normal[i]
        for j in range(3):
            tangent[i, j] = second * normal[i] * normal[j]
            if not convex:
                tangent[i, j] += first * out.curvature[i, j]
    energy = scale * barrier_value(gap, distance)
    if not obstacle[1] > 0.0:
        return energy, 0.0, gap, -first, False
    rub, sliding = add_friction(p, obstacle, edges, anchor, stick * area, -obstacle[1] * first, out)
    for i in range(3):
        out.loading[i] = -obstacle[1] * second * normal[i]
    return energy, rub, gap, -first, sliding
