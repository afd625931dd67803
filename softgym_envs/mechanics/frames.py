"""Frames: rigid parts and beam nodes, and everything that they carry.

A frame takes four rows of the position array ``x``: its origin and its three directors (the columns of its rotation
matrix). Everything else about a frame is linear in these rows: a point of a rigid part is ``origin + sum X_k d_k``, a
beam's strains are products of rows. So elements and constraints treat all rows alike, and one kinematic map describes
how rows move: directors, and mesh nodes that a frame carries, follow the frame's six degrees of freedom,

    x = c p + r,  r = sum_k X_k d_k,    dx = c dp + w x r,    d2x = w x (w x r)

with ``w`` the spin of the frame (rotations are updated by the exponential of the spin, so the second derivative is
the symmetric one) and ``c`` 1 for points, 0 for directors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from softgym_envs.mechanics.compilation import njit


def frame_rows(position: np.ndarray | Sequence[float], rotation: np.ndarray | None = None) -> np.ndarray:
    """Rows of a frame at a position [m] (3,) with a rotation matrix (3, 3), shape (4, 3)."""
    rotation = np.eye(3) if rotation is None else np.asarray(rotation, dtype=float)
    if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9):
        raise ValueError(f"rotation must be an orthonormal matrix (3, 3), got {rotation.tolist()}")
    if np.linalg.det(rotation) < 0.0:
        raise ValueError(f"rotation must be right-handed, got a reflection: {rotation.tolist()}")
    return np.vstack([np.asarray(position, dtype=float), rotation.T])


def rotation_of(x: np.ndarray, row: int) -> np.ndarray:
    """Rotation matrix (3, 3) of the frame whose origin is in a row of ``x``."""
    return x[row + 1 : row + 4].T


@njit(cache=True, error_model="numpy")
def _rodrigues(vectors, out):
    for k in range(vectors.shape[0]):
        x, y, z = vectors[k]
        squared = x * x + y * y + z * z
        angle = np.sqrt(squared)
        if angle < 1e-4:
            a = 1.0 - squared / 6.0
            b = 0.5 - squared / 24.0
        else:
            a = np.sin(angle) / angle
            half = np.sin(0.5 * angle) / angle
            b = 2.0 * half * half
        out[k, 0, 0], out[k, 0, 1], out[k, 0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
        out[k, 1, 0], out[k, 1, 1], out[k, 1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
        out[k, 2, 0], out[k, 2, 1], out[k, 2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)


def rotation_vector_matrix(vectors: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), by Rodrigues' formula."""
    vectors = np.asarray(vectors, dtype=float)
    out = np.empty((*vectors.shape, 3))
    _rodrigues(np.ascontiguousarray(vectors).reshape(-1, 3), out.reshape(-1, 3, 3))
    return out


@njit(cache=True)
def _displace(x, rows, carried, owner, moves, arm, translation, turn, out):
    bases = np.empty((rows.shape[0], 3, 3))
    gram = np.empty((3, 3))
    for f in range(rows.shape[0]):
        turned = np.zeros((3, 3))
        for k in range(3):
            for i in range(3):
                for j in range(3):
                    turned[k, i] += turn[f, i, j] * x[rows[f] + 1 + k, j]
        # Orthonormalise, so that round-off does not accumulate over a long motion.
        for k in range(3):
            for m in range(3):
                gram[k, m] = turned[k, 0] * turned[m, 0] + turned[k, 1] * turned[m, 1] + turned[k, 2] * turned[m, 2]
        for k in range(3):
            for i in range(3):
                bases[f, k, i] = 1.5 * turned[k, i]
                for m in range(3):
                    bases[f, k, i] -= 0.5 * gram[k, m] * turned[m, i]
            out[rows[f], k] = translation[f, k]
    for c in range(carried.shape[0]):
        f = owner[c]
        for i in range(3):
            value = moves[c] * (x[rows[f], i] + translation[f, i])
            for k in range(3):
                value += arm[c, k] * bases[f, k, i]
            out[carried[c], i] = value - x[carried[c], i]


@njit(cache=True)
def _add_curvature(values, owner, count, arms, gradient, target):
    """Add ``(g r^T + r g^T) / 2 - (g . r) I`` of every carried row to the spin block of its frame."""
    blocks = np.zeros((count, 6))
    for c in range(owner.shape[0]):
        block = blocks[owner[c]]
        g, r = gradient[c], arms[c]
        dot = g[0] * r[0] + g[1] * r[1] + g[2] * r[2]
        k = 0
        for a in range(3):
            for b in range(a + 1):
                block[k] += 0.5 * (g[a] * r[b] + r[a] * g[b])
                if a == b:
                    block[k] -= dot
                k += 1
    for f in range(count):
        for k in range(6):
            if target[6 * f + k] >= 0:
                values[target[6 * f + k]] += blocks[f, k]


@njit(cache=True)
def _expand(values, offset, source, first, second, factor, target, coefficient):
    for t in range(source.shape[0]):
        v = values[offset + source[t]]
        values[target[t]] += v * coefficient[first[t]] * coefficient[second[t]] * factor[t]


class Expansion(NamedTuple):
    """How tangent entries of carried rows add to entries of the equations, as a list of products.

    Attributes:
        source: entry that is expanded, shape (t,).
        first: term of the kinematic map for its low index, shape (t,).
        second: term for its high index, shape (t,).
        factor: 2 where the entry and its mirror image meet on the diagonal, else 1, shape (t,).
        pairs: low and high equation that the product adds to, shape (t, 2).
    """

    source: np.ndarray
    first: np.ndarray
    second: np.ndarray
    factor: np.ndarray
    pairs: np.ndarray


class Frames:
    """All frames of a model and the rows they carry.

    Args:
        nodes: rest rows [m], shape (n, 3).
        rows: first row (the origin) of each frame, shape (f,).
        carried: mesh nodes that move with a frame: index of the frame -> rows.
        mounted: frames fixed to another one and therefore not in ``rows``: index of the frame -> first rows.

    Attributes:
        rows: as given.
        carried: all carried rows, directors first, shape (c,).
        owner: frame of each carried row, shape (c,).
        arm: coordinates of each carried row in its frame's directors, shape (c, 3).
        moves: 1 where a carried row also follows the origin, 0 for directors, shape (c,).

    Raises:
        ValueError: if frames overlap, a row is carried twice, or directors are not orthonormal.
    """

    def __init__(
        self,
        nodes: np.ndarray,
        rows: np.ndarray,
        carried: Mapping[int, np.ndarray] | None = None,
        mounted: Mapping[int, np.ndarray] | None = None,
    ) -> None:
        self.rows = np.asarray(rows, dtype=np.int64).reshape(-1)
        count = len(self.rows)
        parts = [(np.arange(count).repeat(3), (self.rows[:, None] + np.arange(1, 4)).ravel(), 0.0)]
        for table, mount in ((carried or {}, False), (mounted or {}, True)):
            for frame, ids in table.items():
                if not 0 <= frame < count:
                    raise ValueError(f"rows are carried by frame {frame}, but the model has {count} frames")
                first = np.unique(np.asarray(ids, dtype=np.int64))
                parts.append((np.full(len(first), frame), first, 1.0))
                if mount:
                    directors = (first[:, None] + np.arange(1, 4)).ravel()
                    parts.append((np.full(len(directors), frame), directors, 0.0))
        self.owner = np.concatenate([owner for owner, _, _ in parts]).astype(np.int64)
        self.carried = np.concatenate([rows for _, rows, _ in parts]).astype(np.int64)
        taken = np.concatenate([self.rows, self.carried])
        if len(np.unique(taken)) != len(taken) or (len(taken) and taken.max() >= len(nodes)):
            raise ValueError("two frames overlap, or a row is carried by two frames")
        bases = np.array([nodes[row + 1 : row + 4] for row in self.rows]).reshape(count, 3, 3)
        if not np.allclose(bases @ np.swapaxes(bases, 1, 2), np.eye(3), atol=1e-9):
            raise ValueError("the directors of a frame are not orthonormal")
        self.moves = np.concatenate([np.full(len(rows), moves) for _, rows, moves in parts])
        offset = nodes[self.carried] - self.moves[:, None] * nodes[self.rows[self.owner]]
        self.arm = np.einsum("ckd,cd->ck", bases[self.owner], offset)

    def __len__(self) -> int:
        return len(self.rows)

    def arms(self, x: np.ndarray) -> np.ndarray:
        """Vectors ``r`` of the carried rows in space [m], shape (c, 3)."""
        return x[self.carried] - self.moves[:, None] * x[self.rows[self.owner]]

    def displace(self, x: np.ndarray, translation: np.ndarray, spin: np.ndarray, out: np.ndarray) -> None:
        """Write to ``out`` (n, 3) the displacement of the frames' rows and carried rows under a finite motion.

        Args:
            x: positions [m], shape (n, 3).
            translation: of the origins [m], shape (f, 3).
            spin: rotation vectors [rad], shape (f, 3).
            out: displacements [m], shape (n, 3).
        """
        turn = rotation_vector_matrix(spin)
        _displace(x, self.rows, self.carried, self.owner, self.moves, self.arm, translation, turn, out)


class KinematicMap:
    """Linear map from the equations to the motion of carried rows, with a fixed sparsity pattern.

    Args:
        frames: the frames.
        origin: equation of each component of each frame's origin, -1 if fixed, shape (f, 3).
        spin: equation of each component of each frame's spin, -1 if fixed, shape (f, 3).
        size: number of equations.

    Attributes:
        matrix: sparse map of the equations to the components of carried rows, shape (3 c, size).
    """

    def __init__(self, frames: Frames, origin: np.ndarray, spin: np.ndarray, size: int) -> None:
        self.frames = frames
        self.size = size
        columns: list[int] = []
        kinds, counts = [], []
        for c, frame in enumerate(frames.owner):
            for axis in range(3):
                b, d = (axis + 1) % 3, (axis + 2) % 3
                # (w x r)_axis = w_b r_d - w_d r_b
                entries = [(origin[frame, axis], 0, 0)] if frames.moves[c] else []
                entries += [(spin[frame, b], 1, 3 * c + d), (spin[frame, d], -1, 3 * c + b)]
                entries = sorted(e for e in entries if e[0] >= 0)
                columns += [int(e[0]) for e in entries]
                kinds += [(e[1], e[2]) for e in entries]
                counts.append(len(entries))
        kind = np.array(kinds, dtype=np.int64).reshape(-1, 2)
        self._sign, self._source = kind[:, 0].astype(float), kind[:, 1]
        self._constant = (self._sign == 0.0).astype(float)
        pointers = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self.matrix = csr_matrix(
            (np.ones(len(columns)), np.array(columns, dtype=np.int64), pointers), shape=(3 * len(frames.owner), size)
        )
        #: Its transpose, which shares its data.
        self.transposed = self.matrix.T
        # Terms of the map with the identity of the equations before it.
        self._start = np.concatenate([np.arange(size), size + pointers])
        self._column = np.concatenate([np.arange(size), np.array(columns, dtype=np.int64)])
        self._coefficient = np.ones(len(self._column))
        # Pairs of spins of each frame to which the second derivative of its carried rows is added.
        pairs = [(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]
        self._spin = spin
        self.spin_pairs = np.array(
            [(min(s[a], s[b]), max(s[a], s[b])) if min(s[a], s[b]) >= 0 else (-1, -1) for s in spin for a, b in pairs],
            dtype=np.int64,
        ).reshape(-1, 2)

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)
        self.transposed = self.matrix.T  # in a copy, too, both must share their data

    def linearise(self, x: np.ndarray) -> np.ndarray:
        """Update the map at positions ``x`` (n, 3) and return the vectors r of the carried rows, shape (c, 3)."""
        arms = self.frames.arms(x)
        data = self._sign * arms.ravel()[self._source] + self._constant
        self.matrix.data[:] = data
        self._coefficient[self.size :] = data
        return arms

    def plan(self, low: np.ndarray, high: np.ndarray) -> Expansion:
        """Find how tangent entries between rows ``low`` and ``high`` contribute to entries of the equations.

        Rows are numbered as equations, then components of carried rows.
        """
        counts = np.diff(self._start)
        products = counts[low] * counts[high]
        source = np.repeat(np.arange(len(low)), products)
        within = np.arange(len(source)) - np.repeat(np.cumsum(products) - products, products)
        i, j = low[source], high[source]
        first, second = self._start[i] + within // counts[j], self._start[j] + within % counts[j]
        one, other = self._column[first], self._column[second]
        lower = (i != j) | (other <= one)  # a diagonal entry would otherwise list both halves
        factor = np.where((i != j) & (one == other), 2.0, 1.0)
        pairs = np.sort(np.stack([one, other], axis=1), axis=1)
        return Expansion(source[lower], first[lower], second[lower], factor[lower], pairs[lower])

    def expand(self, values: np.ndarray, offset: int, expansion: Expansion, target: np.ndarray) -> None:
        """Add entries ``values[offset:]`` of carried rows to the places ``target`` of the expansion's pairs."""
        source, first, second, factor, _ = expansion
        _expand(values, offset, source, first, second, factor, target, self._coefficient)

    def add_curvature(self, values: np.ndarray, arms: np.ndarray, gradient: np.ndarray, target: np.ndarray) -> None:
        """Add the second derivative of the map to the tangent.

        Args:
            values: values of the tangent.
            arms: result of `linearise`, shape (c, 3).
            gradient: energy gradient of the carried rows, shape (c, 3).
            target: places of `spin_pairs` in the values, -1 for pairs that are fixed.
        """
        _add_curvature(values, self.frames.owner, len(self.frames), arms, gradient, target)
