"""A learned leg with its derivatives, for the mechanics: networks of `LegNetwork` in NumPy.

Second derivatives by the pose need no automatic differentiation: of a layer ``y = s(a)`` with inputs ``dx`` along m
directions, the energy's Hessian has the part ``da^T diag(lambda s''(a)) da``, with the adjoint lambda of ``y``.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softgym_envs.surrogate.parts.jets import HALF_PI, Jet, JetFunctions, columns, weighted_second
from softgym_envs.surrogate.parts.pose import (
    COORDINATES,
    EVEN,
    FORM_SCALE,
    ODD,
    OFFSET_SCALE,
    PRODUCT_SCALE,
    PRODUCTS,
    STIFFEST,
    features,
)

_I, _J = np.array(PRODUCTS).T


class LegFunction:
    """Energy over EI / L of legs of one shape, with gradient and Hessian by their poses.

    Args:
        tensors: weights of `LegNetwork`, by their names there.
        shape: width and thickness over the length, and three curvatures times it, shape (5,).
    """

    def __init__(self, tensors: Mapping[str, np.ndarray], shape: np.ndarray) -> None:
        self.shape = np.asarray(shape, dtype=float)
        depth = sum(name.startswith("layers.") and name.endswith(".weight") for name in tensors)
        names = [*(f"layers.{k}" for k in range(depth)), "head"]
        self._weights = [np.array(tensors[f"{name}.weight"], dtype=float) for name in names]
        self._biases = [np.array(tensors[f"{name}.bias"], dtype=float) for name in names]
        ratio = (self.shape[0] / self.shape[1]) ** 2
        self._stiff = float(ratio / (1.0 + STIFFEST * ratio))

    def evaluate(self, y: np.ndarray, *, second: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return energies (n,), gradients (n, 15) and Hessians (n, 15, 15) at poses (n, 15).

        Without ``second`` the Hessians are not computed; the last result is then empty.
        """
        n, m, count = len(y), COORDINATES, len(PRODUCTS)
        found = features(Jet.coordinates(y), self.shape, np.log, JetFunctions)
        even, even_slope = columns(found.even, n, m)
        odd, odd_slope = columns(found.odd, n, m)
        products = odd[:, _I] * odd[:, _J]
        product_slope = odd[:, _I, None] * odd_slope[:, _J] + odd[:, _J, None] * odd_slope[:, _I]
        x = np.concatenate([even, PRODUCT_SCALE * products], axis=1)
        hidden, slopes, curvatures = [], [], []
        for k, (weight, bias) in enumerate(zip(self._weights[:-1], self._biases[:-1], strict=True)):
            a = x @ weight.T + bias
            share = 0.5 * (1.0 + np.tanh(0.5 * a))
            new = a * share
            slope = share + new * (1.0 - share)
            slopes.append(slope)
            curvatures.append(share * (1.0 - share) * (2.0 + a - 2.0 * new))
            hidden.append(x)
            x = new if k == 0 else x + new
        head = self._weights[-1]
        out = x @ head.T + self._biases[-1]
        # Derivatives of the energy by the outputs, and back to the inputs.
        by_out = np.empty((n, 1 + 2 * count))
        by_out[:, 0] = OFFSET_SCALE
        by_out[:, 1 : 1 + count] = FORM_SCALE * products
        by_out[:, 1 + count :] = FORM_SCALE * self._stiff * products
        adjoint = by_out @ head
        adjoints = []
        for k in range(len(hidden) - 1, -1, -1):
            adjoints.append(adjoint)
            back = (adjoint * slopes[k]) @ self._weights[k]
            adjoint = back if k == 0 else adjoint + back
        adjoints.reverse()
        form = out[:, 1 : 1 + count] + self._stiff * out[:, 1 + count :]
        by_product = PRODUCT_SCALE * adjoint[:, EVEN:] + FORM_SCALE * form
        angle = found.turn.value + HALF_PI
        by_even = adjoint[:, :EVEN].copy()
        by_even[:, 0] += angle
        energy = 0.5 * angle**2 + OFFSET_SCALE * out[:, 0] + FORM_SCALE * (form * products).sum(axis=1)
        gradient = np.einsum("nk,nkm->nm", by_even, even_slope) + np.einsum("nk,nkm->nm", by_product, product_slope)
        if not second:
            return energy, gradient, np.empty((n, 0, 0))
        # The quadratic form of the odd features, as a symmetric matrix.
        matrix = np.zeros((n, ODD, ODD))
        matrix[:, _I, _J] += by_product
        matrix[:, _J, _I] += by_product
        hessian = weighted_second(found.even, by_even, m)
        hessian += weighted_second(found.odd, np.einsum("nij,nj->ni", matrix, odd), m)
        hessian += np.einsum("npi,nij,njq->npq", odd_slope.transpose(0, 2, 1), matrix, odd_slope, optimize=True)
        turn_slope = found.turn.first
        hessian += turn_slope[:, :, None] * turn_slope[:, None, :]
        # The network, along the m directions.
        move = np.concatenate([even_slope, PRODUCT_SCALE * product_slope], axis=1).transpose(0, 2, 1)
        for k, weight in enumerate(self._weights[:-1]):
            inner = move @ weight.T
            hessian += (inner * (adjoints[k] * curvatures[k])[:, None, :]) @ inner.transpose(0, 2, 1)
            new = inner * slopes[k][:, None, :]
            move = new if k == 0 else move + new
        form_move = move @ head[1:].T
        crossed = FORM_SCALE * (form_move[:, :, :count] + self._stiff * form_move[:, :, count:]) @ product_slope
        hessian += crossed + crossed.transpose(0, 2, 1)
        return energy, gradient, hessian
