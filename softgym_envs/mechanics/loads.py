"""Named dead loads on points, edges and rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.solids import Fixed

Shares: TypeAlias = tuple[np.ndarray, np.ndarray]
"""Rows, shape (k,), and the share of a load on each of them, shape (k,)."""


@dataclass(frozen=True)
class Load:
    """A force that keeps its direction, spread over rows of the body.

    Attributes:
        force: the whole of it [N], shape (3,).
        rows: on which it acts, shape (k,).
        shares: of the force on each of them, shape (k,).
    """

    force: np.ndarray
    rows: np.ndarray
    shares: np.ndarray

    def add_to(self, loads: np.ndarray, sign: float = 1.0) -> None:
        """Add it to loads on all rows [N], shape (n, 3)."""
        np.add.at(loads, self.rows, sign * self.shares[:, None] * self.force)


def spread(name: str, on: EmbeddedPoints | Shares | Fixed, nodes: np.ndarray) -> Shares:
    """Return rows and shares of a load: equal on points, in proportion to the length along an edge.

    Args:
        name: of the load, for messages.
        on: points, rows with their shares, or the nodes of a straight edge as for ``fixed`` in
            `MechanicalModel.from_mesh`.
        nodes: rest rows [m], shape (n, 3).

    Raises:
        ValueError: if no node is chosen, or the chosen ones do not lie on a straight line.
    """
    if isinstance(on, EmbeddedPoints):
        return on.node_ids.ravel(), on.weights.ravel() / len(on.node_ids)
    if isinstance(on, tuple) and isinstance(on[0], np.ndarray):
        return on
    chosen = np.asarray(on(nodes) if callable(on) else on)
    rows = np.flatnonzero(chosen) if chosen.dtype == bool else chosen.astype(np.int64)
    if not len(rows):
        raise ValueError(f"load '{name}' acts on no node")
    if len(rows) == 1:
        return rows, np.ones(1)
    places = nodes[rows]
    middle = places.mean(axis=0)
    _, sizes, axes = np.linalg.svd(places - middle)
    if sizes[1] > 1e-6 * sizes[0]:
        raise ValueError(f"load '{name}': its {len(rows)} nodes do not lie on a straight line; load points instead")
    along = (places - middle) @ axes[0]
    order = np.argsort(along)
    gaps = np.diff(along[order])
    widths = np.zeros(len(rows))
    widths[:-1] += 0.5 * gaps
    widths[1:] += 0.5 * gaps
    shares = np.empty(len(rows))
    shares[order] = widths / widths.sum()
    return rows, shares
