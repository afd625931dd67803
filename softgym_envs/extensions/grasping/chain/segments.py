"""Learned stiffness of segments: small networks that correct beam theory, for NumPy.

A segment deforms in three ways: it grows longer, and its two ends turn against the line between them. Its energy is
quadratic in them, with a stiffness ``S G G^T S``: S holds the roots of those of a beam of the same thickness, and the
triangular G is that of the beam times what the network returns. The stiffness is positive definite for all weights.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softgym_envs.extensions.grasping.chain.body import KINDS, ChainBodies

BEAM = np.linalg.cholesky([[1.0, 0.0, 0.0], [0.0, 4.0, 2.0], [0.0, 2.0, 4.0]])
"""Factor of the stiffness of a beam, in units of E A / l and E I / l."""

OUTPUTS = 6


def beam_scale(bodies: ChainBodies, modulus: float, width: float) -> np.ndarray:
    """Return the roots of E A / l and twice E I / l of the segments, shape (S, N - 1, 3)."""
    area = width * bodies.thickness
    bending = area * bodies.thickness**2 / 12.0
    return np.sqrt(modulus * np.stack([area, bending, bending], axis=2) / bodies.length[:, :, None])


def segment_stiffness(
    tensors: Mapping[str, np.ndarray], bodies: ChainBodies, modulus: float, width: float
) -> np.ndarray:
    """Return the stiffness of all segments for each member of the ensemble, shape (M, S, N - 1, 3, 3).

    Args:
        tensors: weights ``kind.layer.weight`` (M, out, in) and ``kind.layer.bias`` (M, out).
        bodies: the chains.
        modulus: Young's modulus [Pa].
        width: along z [m].
    """
    parts = []
    for kind in KINDS:
        h = bodies.features[kind][None]
        for layer in range(3):
            weight, bias = tensors[f"{kind}.{layer}.weight"], tensors[f"{kind}.{layer}.bias"]
            h = h @ weight.astype(float).swapaxes(1, 2)[:, None] + bias.astype(float)[:, None, None]
            if layer < 2:
                h = np.tanh(h)
        parts.append(h)
    out = np.concatenate(parts, axis=2)
    factor = np.exp(out[..., :3])[..., None] * BEAM
    factor[..., 1, 0] += out[..., 3]
    factor[..., 2, :2] += out[..., 4:]
    factor = beam_scale(bodies, modulus, width)[..., None] * factor
    return factor @ factor.swapaxes(-1, -2)
