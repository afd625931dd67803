"""The model in torch: the same numbers, and exact derivatives with respect to the design."""

import numpy as np
import pytest
import torch

from softgym_envs import make_robot
from softgym_envs.extensions.fitting.torch_potential import TorchModel
from tests.helpers import random_states, untrained_potential
from tests.surrogate.test_model import untrained_residual

NAMES = ("finger", "trunk", "press_finger")


@pytest.mark.parametrize("name", NAMES)
def test_torch_agrees_with_the_compiled_model(name):
    robot = make_robot(name)
    model, _ = untrained_potential(robot, members=2)
    designs, displacement = random_states(robot, 10)
    context = model.context(designs)
    effort, effector, W = (
        v.numpy() for v in TorchModel(model)(torch.as_tensor(designs), torch.as_tensor(displacement))
    )
    found = (*model.state(context, displacement)[:2], model.compliance(context, displacement))
    for got, wanted in zip(found, (effort, effector, W), strict=True):
        assert np.abs(got - wanted).max() < 2e-4 * np.abs(wanted).max()


@pytest.mark.parametrize("name", NAMES)
def test_design_gradients_are_derivatives(name):
    robot = make_robot(name)
    model, _ = untrained_potential(robot, members=2)
    net = TorchModel(model)
    designs, displacement = (torch.as_tensor(v) for v in random_states(robot, 4))
    low = torch.as_tensor([v.low for v in robot.design_space], dtype=torch.float64)
    high = torch.as_tensor([v.high for v in robot.design_space], dtype=torch.float64)
    rng = torch.Generator().manual_seed(1)

    def outputs(unit):
        return torch.cat(
            [
                v.reshape(len(unit), -1) / s
                for v, s in zip(net(low + unit * (high - low), displacement), scales, strict=True)
            ],
            1,
        )

    unit = (designs - low) / (high - low) * 0.98 + 0.01
    scales = [1.0, 1.0, 1.0]
    scales = [float(v.abs().max()) for v in net(designs, displacement)]
    direction = torch.randn(unit.shape, generator=rng, dtype=torch.float64)
    weights = torch.randn(outputs(unit).shape, generator=rng, dtype=torch.float64)
    unit.requires_grad_(True)
    (gradient,) = torch.autograd.grad((weights * outputs(unit)).sum(), unit)
    exact = (gradient * direction).sum()
    h = 1e-5
    with torch.no_grad():
        difference = (weights * (outputs(unit + h * direction) - outputs(unit - h * direction))).sum() / (2 * h)
    assert abs(exact - difference) < 1e-6 * (weights.abs().sum() + abs(exact))


def test_other_networks_are_refused():
    with pytest.raises(ValueError, match="residual"):
        TorchModel(untrained_residual(make_robot("finger")))
