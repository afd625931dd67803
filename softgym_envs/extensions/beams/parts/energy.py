"""A learned leg with its derivatives: networks of `LegNetwork` without automatic differentiation.

On NumPy arrays it is an element of the mechanics; on tensors it steps bodies on any device. Of a layer ``y = s(a)``
with inputs ``dx`` along m directions, the energy's Hessian has the part ``da^T diag(lambda s''(a)) da``, with the
adjoint lambda of ``y``.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softgym_envs.extensions.beams.parts.jets import (
    HALF_PI,
    Array,
    Jet,
    JetFunctions,
    columns,
    namespace,
    weighted_second,
    zeros,
)
from softgym_envs.extensions.beams.parts.pose import (
    EVEN,
    FORM_SCALE,
    ODD,
    OFFSET_SCALE,
    PRODUCT_SCALE,
    PRODUCTS,
    STIFFEST,
    features,
)

_I, _J = (list(column) for column in zip(*PRODUCTS, strict=True))
COUNT = len(PRODUCTS)


class LegFunction:
    """Energy over EI / L of legs, with gradient and Hessian by their poses.

    Args:
        tensors: weights of `LegNetwork`, by their names there: arrays or tensors.
        shape: width and thickness over the length, and three curvatures times it: of all legs (5,), or of each (n, 5).
    """

    def __init__(self, tensors: Mapping[str, Array], shape: Array) -> None:
        self.shape = np.asarray(shape, dtype=float) if isinstance(shape, np.ndarray) else shape
        depth = sum(name.startswith("layers.") and name.endswith(".weight") for name in tensors)
        names = [*(f"layers.{k}" for k in range(depth)), "head"]
        self._layers = self._layers_of(tensors, names)
        count = sum(name.startswith("errors.") and name.endswith(".weight") for name in tensors)
        self._errors = self._layers_of(tensors, [f"errors.layers.{k}" for k in range(count)])

    def _layers_of(self, tensors: Mapping[str, Array], names: list[str]) -> list[tuple[Array, Array]]:
        return [(self._own(tensors[f"{name}.weight"]), self._own(tensors[f"{name}.bias"])) for name in names]

    def _own(self, values: Array) -> Array:
        return np.array(values, dtype=float) if isinstance(self.shape, np.ndarray) else values

    def errors(self, y: Array) -> Array:
        """Return how far tips at poses (n, 15) may move under the errors of their wrenches, over the length, (n,).

        They are those of `ErrorNetwork`: nearly all errors of the states that it learned from are smaller.
        """
        xp = namespace(y)
        found = features(Jet.coordinates(y), [self.shape[..., k] for k in range(5)], xp.log, JetFunctions)
        even, odd = (columns(part, y)[0] for part in (found.even, found.odd))
        x = xp.concatenate([even, PRODUCT_SCALE * odd[:, _I] * odd[:, _J]], axis=1)
        for weight, bias in self._errors[:-1]:
            a = x @ weight.T + bias
            x = 0.5 * a * (1.0 + xp.tanh(0.5 * a))
        weight, bias = self._errors[-1]
        return xp.exp(x @ weight.T + bias)[:, 0]

    def evaluate(self, y: Array, *, second: bool = True) -> tuple[Array, Array, Array]:
        """Return energies (n,), gradients (n, 15) and Hessians (n, 15, 15) at poses (n, 15).

        Without ``second`` the Hessians are not computed; the last result is then empty.
        """
        xp, n = namespace(y), len(y)
        shape = [self.shape[..., k] for k in range(5)]
        ratio = (shape[0] / shape[1]) ** 2
        stiff = (ratio / (1.0 + STIFFEST * ratio))[..., None]
        found = features(Jet.coordinates(y), shape, xp.log, JetFunctions)
        even, even_slope = columns(found.even, y)
        odd, odd_slope = columns(found.odd, y)
        products = odd[:, _I] * odd[:, _J]
        product_slope = odd[:, _I, None] * odd_slope[:, _J] + odd[:, _J, None] * odd_slope[:, _I]
        x = xp.concatenate([even, PRODUCT_SCALE * products], axis=1)
        slopes, curvatures = [], []
        for k, (weight, bias) in enumerate(self._layers[:-1]):
            a = x @ weight.T + bias
            share = 0.5 * (1.0 + xp.tanh(0.5 * a))
            new = a * share
            slopes.append(share + new * (1.0 - share))
            curvatures.append(share * (1.0 - share) * (2.0 + a - 2.0 * new))
            x = new if k == 0 else x + new
        head, bias = self._layers[-1]
        out = x @ head.T + bias
        # Derivatives of the energy by the outputs, and back to the inputs.
        by_out = xp.concatenate(
            [0.0 * out[:, :1] + OFFSET_SCALE, FORM_SCALE * products, FORM_SCALE * stiff * products], axis=1
        )
        adjoint = by_out @ head
        adjoints = []
        for k in range(len(slopes) - 1, -1, -1):
            adjoints.append(adjoint)
            back = (adjoint * slopes[k]) @ self._layers[k][0]
            adjoint = back if k == 0 else adjoint + back
        adjoints.reverse()
        form = out[:, 1 : 1 + COUNT] + stiff * out[:, 1 + COUNT :]
        by_product = PRODUCT_SCALE * adjoint[:, EVEN:] + FORM_SCALE * form
        angle = found.turn.value + HALF_PI
        by_even = 1.0 * adjoint[:, :EVEN]
        by_even[:, 0] += angle
        energy = 0.5 * angle**2 + OFFSET_SCALE * out[:, 0] + FORM_SCALE * (form * products).sum(1)
        gradient = xp.einsum("nk,nkm->nm", by_even, even_slope) + xp.einsum("nk,nkm->nm", by_product, product_slope)
        if not second:
            return energy, gradient, zeros(y, n, 0, 0)
        # The quadratic form of the odd features, as a symmetric matrix.
        matrix = zeros(y, n, ODD, ODD)
        matrix[:, _I, _J] += by_product
        matrix[:, _J, _I] += by_product
        hessian = weighted_second(found.even, by_even, y)
        hessian += weighted_second(found.odd, (matrix @ odd[:, :, None])[:, :, 0], y)
        hessian += odd_slope.swapaxes(1, 2) @ matrix @ odd_slope
        turn_slope = found.turn.first
        hessian += turn_slope[:, :, None] * turn_slope[:, None, :]
        # The network, along all directions of motion.
        move = xp.concatenate([even_slope, PRODUCT_SCALE * product_slope], axis=1).swapaxes(1, 2)
        for k, (weight, _) in enumerate(self._layers[:-1]):
            inner = move @ weight.T
            hessian += (inner * (adjoints[k] * curvatures[k])[:, None, :]) @ inner.swapaxes(1, 2)
            new = inner * slopes[k][:, None, :]
            move = new if k == 0 else move + new
        form_move = move @ head[1:].T
        mixed = form_move[:, :, :COUNT] + (stiff[..., None] if stiff.ndim > 1 else stiff) * form_move[:, :, COUNT:]
        crossed = FORM_SCALE * mixed @ product_slope
        hessian += crossed + crossed.swapaxes(1, 2)
        return energy, gradient, hessian
