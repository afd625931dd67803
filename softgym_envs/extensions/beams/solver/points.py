"""Points of the skins of beams and rigid parts that may touch obstacles, as plain arrays for `contact`."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from softgym_envs.extensions.beams.contact_law import table_of
from softgym_envs.mechanics.contact.obstacles import MeshObstacle, Obstacle

if TYPE_CHECKING:  # kernels do not depend on them, see `compilation`
    from softgym_envs.mechanics.contact.contact import Contact
    from softgym_envs.mechanics.frames import Frames


class ContactPoints(NamedTuple):
    """Points that may touch obstacles, in groups of points between the same frames, and these obstacles.

    A point is a linear combination of the own rows of at most F frames.

    Attributes:
        groups: where the points of each group start, shape (g + 1,).
        rows: first rows of all frames that move points, shape (r,).
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
    rows: np.ndarray
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
        rows=np.unique(rows),
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
