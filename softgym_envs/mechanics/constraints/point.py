"""Coordinates of a material point: an effector or a contact point."""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.constraints.constraint import Constraint
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints


class Point(Constraint):
    """The three coordinates of one embedded point; delta [m] is its position, effort [N] a force on it."""

    size = 3

    def __init__(self, name: str, embedding: EmbeddedPoints) -> None:
        if len(embedding.elements) != 1:
            raise ValueError(f"point '{name}' needs exactly one embedded point, got {len(embedding.elements)}")
        self.name = name
        self.embedding = embedding
        ids = embedding.node_ids[0]
        self.dofs = (3 * ids[:, None] + np.arange(3)).ravel()
        self._jacobian = np.kron(embedding.weights[0], np.eye(3))

    def value(self, x: np.ndarray) -> np.ndarray:
        return self.embedding.weights[0] @ x[self.embedding.node_ids[0]]

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        return self._jacobian
