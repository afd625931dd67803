"""Friction of cables on their guides by the capstan law.

Past a guide where it turns by an angle ``theta``, a cable with tension ``T`` continues with ``T exp(-mu theta sigma)``.
``sigma`` is 1 where the cable slides towards the drive, -1 where it slides back, and between where it sticks. So the
drive pulls the body along ``G = -sum_k s_k grad(length_k)`` with ``s_k`` the share of its tension in segment ``k``, but
still shortens the cable along ``H = -sum_k grad(length_k)``: the tangent is not symmetric, nor is ``W = H^T A^-1 G``,
which stays the exact derivative.

``sigma`` follows the slip since the last equilibrium, like bristles that bend before they slide: from one direction to
the other over twice `PRESLIDING` of the cable's length. Angles below `SMALLEST_ANGLE` count less, which removes the
kink of a straight cable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix, hstack

from softgym_envs.mechanics.constraints.cable import Cable
from softgym_envs.mechanics.model import MechanicalModel

PRESLIDING = 1e-3
"""Slip from sticking without force to sliding, as a share of the cable's rest length."""
SMALLEST_ANGLE = 1e-3
"""Angles ``a`` count as ``a^2 / sqrt(a^2 + SMALLEST_ANGLE^2)`` [rad]."""


@dataclass(frozen=True)
class CableMemory:
    """What the friction of each cable remembers, one entry per guide that cables pass.

    Attributes:
        bend: bend of the bristles in [-1, 1].
        beyond: length of the cable beyond the guide [m].
    """

    bend: np.ndarray
    beyond: np.ndarray


@dataclass(frozen=True)
class FrictionTerms:
    """What friction adds to the equations.

    Attributes:
        gradients: ``G - H``, shape (N, size).
        tangent: symmetric part, (N, N).
        directions: columns (N, k) of the other part, ``directions @ loading.T``.
        loading: columns (N, k).
    """

    gradients: np.ndarray
    tangent: csr_matrix
    directions: csc_matrix
    loading: csc_matrix


class _Guides:
    """One cable: points from the pull point to the anchor, and their derivatives by the equations."""

    def __init__(self, cable: Cable, row: int, number: np.ndarray, equations: int) -> None:
        self.cable, self.row, self.friction = cable, row, cable.friction
        ids, weights = cable.embedding.node_ids, cable.embedding.weights
        self.count = len(ids)
        places = number[3 * ids[:, :, None] + np.arange(3)]  # (p, k, 3)
        rows = np.broadcast_to(3 * np.arange(self.count)[:, None, None] + np.arange(3), places.shape)
        values = np.broadcast_to(weights[:, :, None], places.shape)
        free = places >= 0
        self.embedding = csr_matrix((values[free], (rows[free], places[free])), shape=(3 * self.count, equations))

    def geometry(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return lengths (p,) and directions (p, 3) of the segments, and the derivatives (p, 3 p) of the lengths."""
        points = self.cable.path(x)
        edges = np.diff(points, axis=0)
        lengths = np.linalg.norm(edges, axis=1)
        along = edges / lengths[:, None]
        p = self.count
        slopes = np.zeros((p, p, 3))
        slopes[np.arange(p), np.arange(p)] = along
        slopes[np.arange(1, p), np.arange(p - 1)] = -along[1:]
        return lengths, along, slopes.reshape(p, 3 * p)

    def beyond(self, lengths: np.ndarray) -> np.ndarray:
        """Return the lengths of cable beyond each guide, shape (p - 1,)."""
        return np.cumsum(lengths[::-1])[::-1][1:]


class CableFriction:
    """The frictional cables of a model.

    Args:
        model: the body, whose guides lie in solids.
        cables: cables with friction and their rows among the constraints.
    """

    def __init__(self, model: MechanicalModel, cables: list[tuple[Cable, int]]) -> None:
        kinematics = model.kinematics
        self._cables = [_Guides(cable, row, kinematics.number, kinematics.equations) for cable, row in cables]
        self._equations, self._size = kinematics.equations, model.assembly.size
        ends = np.cumsum([0, *(guides.count - 1 for guides in self._cables)])
        self._parts = [slice(low, high) for low, high in zip(ends[:-1], ends[1:], strict=True)]
        self.begin(model.nodes)

    @classmethod
    def of(cls, model: MechanicalModel) -> CableFriction | None:
        """Return the friction of a model's cables, or None without any.

        Raises:
            ValueError: for frictional cables of a body with frames or contact.
        """
        cables = [
            (constraint, rows.start)
            for constraint, rows in model.rows
            if isinstance(constraint, Cable) and constraint.friction > 0.0
        ]
        if not cables:
            return None
        if model.kinematics.map is not None or model.contact is not None:
            raise ValueError(f"cable '{cables[0][0].name}' has friction: its body must have no frames and no contact")
        return cls(model, cables)

    def begin(self, x: np.ndarray) -> None:
        """Forget the past: at rows ``x`` (n, 3) no guide holds back its cable."""
        beyond = [guides.beyond(guides.geometry(x)[0]) for guides in self._cables]
        self.memory = CableMemory(np.zeros(self._parts[-1].stop), np.concatenate(beyond))

    def _bend(self, guides: _Guides, part: slice, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the bends (p - 1,) and their derivatives by the slip [1/m], zero for guides that slide."""
        give = PRESLIDING * guides.cable.rest_length
        bend = self.memory.bend[part] + (self.memory.beyond[part] - guides.beyond(lengths)) / give
        return np.clip(bend, -1.0, 1.0), np.where(np.abs(bend) < 1.0, 1.0 / give, 0.0)

    def commit(self, x: np.ndarray) -> None:
        """Remember the state at rows ``x`` (n, 3), from which further slip counts."""
        bends, beyond = [], []
        for guides, part in zip(self._cables, self._parts, strict=True):
            lengths = guides.geometry(x)[0]
            bends.append(self._bend(guides, part, lengths)[0])
            beyond.append(guides.beyond(lengths))
        self.memory = CableMemory(np.concatenate(bends), np.concatenate(beyond))

    def evaluate(self, x: np.ndarray, effort: np.ndarray) -> FrictionTerms:
        """Return what friction adds at rows ``x`` (n, 3) and efforts (size,)."""
        gradients = np.zeros((self._equations, self._size), order="F")
        tangent = csr_matrix((self._equations, self._equations))
        directions, loading = [], []
        for guides, part in zip(self._cables, self._parts, strict=True):
            p, tension, B = guides.count, float(effort[guides.row]), guides.embedding
            lengths, along, slopes = guides.geometry(x)
            shares, changes = self._shares(guides, part, lengths, along, slopes)
            gradients[:, guides.row] = B.T @ ((1.0 - shares) @ slopes)
            # Curvature of the segments' lengths, as in `Cable.hessian`.
            curvature = np.zeros((p + 1, 3, p + 1, 3))
            for k in range(p):
                block = tension * (shares[k] - 1.0) / lengths[k] * (np.eye(3) - np.outer(along[k], along[k]))
                for i, j, sign in ((k, k, 1.0), (k + 1, k + 1, 1.0), (k, k + 1, -1.0), (k + 1, k, -1.0)):
                    curvature[i, :, j] += sign * block
            inner = csr_matrix(curvature[1:, :, 1:].reshape(3 * p, 3 * p))
            tangent = tangent + B.T @ inner @ B
            # Shares of the segments beyond guide j change with its angle and slip.
            pulls = np.cumsum((shares[:, None] * slopes)[::-1], axis=0)[::-1][1:]
            directions.append(csc_matrix(B.T @ pulls.T))
            loading.append(csc_matrix(B.T @ (-tension * guides.friction * changes).T))
        return FrictionTerms(
            gradients, csr_matrix(tangent), hstack(directions, format="csc"), hstack(loading, format="csc")
        )

    def shares(self, x: np.ndarray) -> list[np.ndarray]:
        """Return for each cable the shares of the drive's tension in its segments, shape (p,), at rows ``x`` (n, 3)."""
        found = []
        for guides, part in zip(self._cables, self._parts, strict=True):
            found.append(self._shares(guides, part, *guides.geometry(x))[0])
        return found

    def _shares(
        self, guides: _Guides, part: slice, lengths: np.ndarray, along: np.ndarray, slopes: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the shares (p,), and for each guide the derivative (p - 1, 3 p) of ``angle sigma`` by the points."""
        p = guides.count
        turn = along[1:] - along[:-1]
        chord = np.linalg.norm(turn, axis=1)
        angle = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
        smooth = np.sqrt(angle**2 + SMALLEST_ANGLE**2)
        # d counted angle = ratio turn . d turn, finite for straight cables.
        ratio = np.where(chord > 1e-12, angle / np.maximum(chord, 1e-12), 1.0)
        ratio *= (angle**2 + 2.0 * SMALLEST_ANGLE**2) / smooth**3
        ratio /= np.sqrt(np.maximum(1.0 - 0.25 * chord**2, 1e-12))
        bend, rate = self._bend(guides, part, lengths)
        sigma, slope = 1.5 * bend - 0.5 * bend**3, (1.5 - 1.5 * bend**2) * rate
        angles = angle**2 / smooth
        shares = np.exp(-guides.friction * np.append(0.0, np.cumsum(angles * sigma)))
        changes = np.zeros((p - 1, p + 1, 3))
        for j in range(p - 1):
            for k, sign in ((j, -1.0), (j + 1, 1.0)):
                # d turn = sign (1 - t t^T) / length (d end - d start) of segment k
                pull = sign * ratio[j] * sigma[j] * (turn[j] - along[k] * (along[k] @ turn[j])) / lengths[k]
                changes[j, k + 1] += pull
                changes[j, k] -= pull
        flat = changes[:, 1:].reshape(p - 1, 3 * p)
        slip = np.cumsum(slopes[::-1], axis=0)[::-1][1:]  # derivative of the length beyond each guide
        return shares, flat - (angles * slope)[:, None] * slip
