"""The contact-aided finger with the points whose compliance a chain learns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from softgym_envs.extensions.grasping.chain.body import FingerChain
from softgym_envs.extensions.grasping.robots.contact_aided_finger import ContactAidedFinger
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.geometry.meshing import BodyMesh

HEIGHTS = (-0.4, 0.0, 0.4)
"""Where a marker is measured, as parts of the finger's thickness: its displacement is the mean over these."""


class MarkedFinger(ContactAidedFinger):
    """A contact-aided finger whose effectors are its tip and the markers of its chain; it touches nothing.

    Args:
        **options: of `ContactAidedFinger`.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._chain = FingerChain(self)
        self.effectors = ("tip", *(f"marker {k + 1}" for k in range(len(self._chain.marker_nodes))))

    def build_model(self, mesh: BodyMesh, design: Mapping[str, float]) -> MechanicalModel:
        """Return the model of the finger with the markers as further effectors."""
        model = super().build_model(mesh, design)
        values = np.array([[design[name] for name in self.design_space.names]])
        places = self._chain.bodies(values).markers[0]
        heights = self.thickness * np.array(HEIGHTS)
        columns = np.repeat(places, len(heights), axis=0)
        lines = model.embed(np.column_stack([columns, np.tile(heights, len(places))]))
        nodes, weights = (part.reshape(len(places), -1) for part in (lines.node_ids, lines.weights / len(heights)))
        for k, (ids, parts) in enumerate(zip(nodes, weights, strict=True)):
            unique, inverse = np.unique(ids, return_inverse=True)
            total = np.bincount(inverse.ravel(), parts)
            model.add(
                "e", Point(self.effectors[k + 1], EmbeddedPoints.from_weights(unique[None], total[None], model.nodes))
            )
        return model
