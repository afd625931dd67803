"""A slender swimmer in the plane whose curvature is prescribed: resistive force theory with three unknowns.

Forces per length are -C_t and -C_n times the velocity along and across the axis; nothing else acts, so that at each
moment force and torque vanish together, which gives the velocity and spin of the head (Gray and Hancock 1955). No beam,
no finite elements, no inertia.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def swim(
    curvature: Callable[[np.ndarray, float], np.ndarray],
    length: float,
    drag: tuple[float, float],
    times: np.ndarray,
    points: int = 400,
    parts: int = 4,
) -> np.ndarray:
    """Return the centroid at some times [m], shape (k, 2); the straight body begins along x, head at its end +x.

    Args:
        curvature: of the axis from head to tail, at arc lengths [m] (p,) and a time [s]; positive to the left [1/m].
        length: [m].
        drag: resistance per length along and across the axis [N s/m2].
        times: evenly spaced, from 0 [s].
        points: midpoints of the axis.
        parts: steps between two times.
    """
    along, across = drag
    ds = length / points
    s = (np.arange(points) + 0.5) * ds

    def shape(time: float) -> tuple[np.ndarray, np.ndarray]:
        """Places (p, 2) and directions (p, 2) of the axis in the frame of the head."""
        angle = np.pi + (np.cumsum(curvature(s, time)) - 0.5 * curvature(s, time)) * ds
        directions = np.column_stack([np.cos(angle), np.sin(angle)])
        return (np.cumsum(directions, axis=0) - 0.5 * directions) * ds, directions

    def velocity(time: float) -> np.ndarray:
        """Velocity and spin of the head in its own frame, shape (3,)."""
        h = 1e-6
        places, directions = shape(time)
        change = (shape(time + h)[0] - shape(time - h)[0]) / (2.0 * h)
        turned = np.column_stack([-places[:, 1], places[:, 0]])
        moves = np.stack([np.tile([1.0, 0.0], (points, 1)), np.tile([0.0, 1.0], (points, 1)), turned, change])
        parallel = (moves * directions).sum(axis=2, keepdims=True) * directions
        forces = -(along * parallel + across * (moves - parallel)) * ds
        totals = np.column_stack([forces.sum(axis=1), (forces * turned).sum(axis=(1, 2))])
        return np.linalg.solve(totals[:3].T, -totals[3])

    pose = np.zeros(3)

    found = []
    for k, time in enumerate(times):
        c, d = np.cos(pose[2]), np.sin(pose[2])
        found.append(pose[:2] + np.array([[c, -d], [d, c]]) @ shape(time)[0].mean(axis=0))
        h = (times[1] - times[0]) / parts
        for part in range(parts if k + 1 < len(times) else 0):
            # The curvature may have kinks at the given times, never between them.
            vx, vy, spin = velocity(time + (part + 0.5) * h)
            c, d = np.cos(pose[2] + 0.5 * h * spin), np.sin(pose[2] + 0.5 * h * spin)
            pose = pose + h * np.array([c * vx - d * vy, d * vx + c * vy, spin])
    return np.array(found)
