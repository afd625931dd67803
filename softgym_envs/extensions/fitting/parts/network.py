"""The network of a learned leg, in torch: training, and bodies of legs on any device."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from torch import Tensor

from softgym_envs.extensions.beams.parts.jets import HALF_PI
from softgym_envs.extensions.beams.parts.pose import (
    EVEN,
    FORM_SCALE,
    OFFSET_SCALE,
    OUTPUTS,
    PRODUCT_SCALE,
    PRODUCTS,
    STIFFEST,
    Features,
    features,
)

MATHS = SimpleNamespace(
    atan2=torch.atan2,
    cos=torch.cos,
    sin=torch.sin,
    sqrt=torch.sqrt,
    log=torch.log,
    softplus=torch.nn.functional.softplus,
)
_FIRST, _SECOND = torch.tensor(PRODUCTS).T
INPUTS = EVEN + len(PRODUCTS)


def _inputs(y: Tensor, shape: Tensor) -> tuple[Features, Tensor, Tensor]:
    """Return features, products of odd ones, and the inputs (n, `INPUTS`) of networks at poses (n, 15)."""
    found = features(y.unbind(1), shape.unbind(1), torch.log, MATHS)
    odd = torch.stack(found.odd, 1)
    products = odd[:, _FIRST] * odd[:, _SECOND]
    return found, products, torch.cat([torch.stack(found.even, 1), PRODUCT_SCALE * products], 1)


class LegNetwork(torch.nn.Module):
    """Energy of a leg over EI / L.

    ``phi^2 / 2 + N_0 + sum_k (N_k + r M_k) o_i o_j`` with the turn ``phi`` of the straight leg, the odd features
    ``o`` and ``r`` of their stiffness out of the plane. N and M are outputs of one residual network.

    Args:
        width: of the hidden layers.
        depth: their number.
    """

    def __init__(self, width: int, depth: int) -> None:
        super().__init__()
        sizes = [INPUTS, *[width] * depth]
        self.layers = torch.nn.ModuleList([torch.nn.Linear(i, o) for i, o in zip(sizes[:-1], sizes[1:], strict=True)])
        self.head = torch.nn.Linear(width, OUTPUTS)
        torch.nn.init.normal_(self.head.weight, std=0.01)

    def forward(self, y: Tensor, shape: Tensor) -> Tensor:
        """Return energies (n,) at poses ``y`` (n, 15) of legs of shapes (n, 5)."""
        found, products, x = _inputs(y, shape)
        for k, layer in enumerate(self.layers):
            new = torch.nn.functional.silu(layer(x))
            x = new if k == 0 else x + new
        out = self.head(x)
        ratio = (shape[:, 0] / shape[:, 1]) ** 2
        stiff = ratio / (1.0 + STIFFEST * ratio)
        count = len(PRODUCTS)
        form = out[:, 1 : 1 + count] + stiff[:, None] * out[:, 1 + count :]
        bent = 0.5 * (found.turn + HALF_PI) ** 2
        return bent + OFFSET_SCALE * out[:, 0] + FORM_SCALE * (form * products).sum(1)


class ErrorNetwork(torch.nn.Module):
    """How far the tip of a leg may move under the error of the wrench that `LegNetwork` gives it, over its length.

    Args:
        width: of the two hidden layers.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        sizes = [INPUTS, width, width, 1]
        self.layers = torch.nn.ModuleList([torch.nn.Linear(i, o) for i, o in zip(sizes[:-1], sizes[1:], strict=True)])

    def forward(self, y: Tensor, shape: Tensor) -> Tensor:
        """Return logarithms (n,) at poses ``y`` (n, 15) of legs of shapes (n, 5)."""
        x = _inputs(y, shape)[2]
        for layer in self.layers[:-1]:
            x = torch.nn.functional.silu(layer(x))
        return self.layers[-1](x)[:, 0]
