"""A potential model in torch, in SI units: everything it says, differentiable in the design and the displacement."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from softgym_envs.surrogate.potential import model as potential
from softgym_envs.surrogate.potential.network import PotentialNet

__all__ = ["TorchModel"]


class TorchModel(nn.Module):
    """The condensed model of `potential.Model` as a function of tensors, in double precision.

    Args:
        model: a trained ensemble.

    Raises:
        ValueError: for a model of another kind: their outputs are not exact derivatives of each other.
    """

    def __init__(self, model: potential.Model) -> None:
        super().__init__()
        if not isinstance(model, potential.Model):
            raise ValueError(f"gradients need a 'potential' network, got {getattr(model, 'network', model)!r}")
        self.model = model
        self.features = model.features
        n, e = model.count, model.effectors
        rest = model.tensors.get("rest")
        members = []
        for state in potential.unstack_members(model.tensors)[0]:
            body_width = state["body.0.weight"].shape[0]
            sizes = (n, e, self.features.design_size, model.width, body_width)
            net = PotentialNet(*sizes, rest, convex=model.robot.convex)
            net.load_state_dict({k: torch.as_tensor(np.array(v)) for k, v in state.items()})
            members.append(net.double())
        self.members = nn.ModuleList(members)
        self.requires_grad_(False)

    def _design(self, design):
        """Features of designs (B, len(space)), as `Features.design` has them."""
        space = self.features.space
        columns = []
        for name in self.features.learned:
            variable, value = space[name], design[:, space.names.index(name)]
            ends = np.array([variable.low, variable.high])
            low, high = np.log(ends) if variable.log else ends
            columns.append(2.0 * ((torch.log(value) if variable.log else value) - low) / (high - low) - 1.0)
            if name == "poisson_ratio":
                low, high = np.log(1.0 - 2.0 * variable.low), np.log(1.0 - 2.0 * variable.high)
                columns.append(2.0 * (torch.log(1.0 - 2.0 * value) - low) / (high - low) - 1.0)
        return torch.stack(columns, dim=1) if columns else design[:, :0]

    def forward(self, design, displacement):
        """Evaluate the condensed model.

        Args:
            design: values in the order of the design space, double (B, len(space)).
            displacement: reached actuator displacements, double (B, n_a).

        Returns:
            Efforts (B, n_a), effector [m] (B, n_e) and W (B, n, n).
        """
        model = self.model
        half = torch.as_tensor(model.half_range)
        u = (displacement - torch.as_tensor(model.middle)) / half
        features = self._design(design)
        parts = [net(features, u) for net in self.members]
        count = len(parts)
        gradient = sum(part[0] for part in parts) / count
        K = sum(part[1] for part in parts) / count * (model.energy_scale / half[:, None] / half)
        x = sum(part[2] for part in parts) / count * model.effector_scale + torch.as_tensor(model.effector_mean)
        J = sum(part[3] for part in parts) / count * (model.effector_scale / half)
        C = sum(part[4] @ part[4].mT for part in parts) / count * model.held_scale
        name = model.robot.stiffness_variable
        stiffness = torch.ones(len(design), 1, dtype=design.dtype)
        if name is not None:
            variable = self.features.space[name]
            stiffness = design[:, [self.features.space.names.index(name)]] / variable.baseline
        W_aa = torch.linalg.inv(K)
        W_ea = J @ W_aa
        W = torch.cat([torch.cat([W_aa, W_ea.mT], 2), torch.cat([W_ea, C + W_ea @ J.mT], 2)], 1)
        return gradient * (model.energy_scale / half) * stiffness, x, W / stiffness[:, :, None]
