"""Surfaces that move with frames, for pictures, export and contact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints


@dataclass(frozen=True)
class Skin:
    """A closed triangle surface that moves with frames.

    Attributes:
        points: the vertices, as points of frames (v of them).
        triangles: vertex indices, seen counter-clockwise from outside, shape (t, 3).
        rigid: whether it is a rigid object rather than a part of the soft body.
        touches: whether it takes part in contact; surfaces that are only drawn do not.
    """

    points: EmbeddedPoints
    triangles: np.ndarray
    rigid: bool = False
    touches: bool = True
