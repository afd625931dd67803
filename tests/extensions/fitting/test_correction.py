"""Corrections of efforts: known factors are found, and the corrected model stays a condensed model."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from softgym_envs import make_robot
from softgym_envs.config import load_config, shipped_configs
from softgym_envs.errors import DataError
from softgym_envs.extensions.fitting.correction import HIGHEST_ORDER, LOWEST_ORDER, fit_correction, order_of
from softgym_envs.extensions.fitting.torch_potential import TorchModel
from softgym_envs.extensions.fitting.training import FitConfig
from softgym_envs.extensions.gpu.surrogates import TorchBatch
from softgym_envs.surrogate.correction import EffortCorrection
from softgym_envs.surrogate.potential.model import Model
from softgym_envs.surrogate.pretrained import pretrained_folder
from tests.helpers import random_states, untrained_potential

SIZES = (5.0, 3.0, 2.0)


def levels(log_factor, order, bodies, rng):
    """Datasets on three meshes whose efforts converge with a known order and factor from the middle mesh."""
    features = rng.uniform(-1.0, 1.0, (bodies, 2))
    # converged = middle * factor and effort(h) = converged * (1 + c h^p) give c.
    c = (np.exp(-log_factor(features)) - 1.0) / SIZES[1] ** order
    rest = np.tile([True, False, False], bodies)
    body = np.repeat(np.arange(bodies), 3)
    delta = np.where(rest[:, None], 0.0, rng.uniform(0.1, 1.0, (len(body), 2)))
    exact = delta * rng.uniform(1.0, 2.0, (len(body), 2))
    data = [
        {
            "design": features[body],
            "displacement": delta,
            "effort": exact * (1.0 + c * h**order)[body, None],
            "rest": rest,
        }
        for h in SIZES
    ]
    return data, features[body]


@pytest.mark.parametrize("order", [0.7, 1.3, 2.0])
def test_a_known_factor_is_found(order):
    data, features = levels(lambda x: -0.2 + 0.05 * x[:, 0] - 0.03 * x[:, 1], order, 9, np.random.default_rng(0))
    found = fit_correction(data, SIZES, features)
    assert found.order == pytest.approx(order, rel=1e-6)
    assert (found.constant, *found.slopes) == pytest.approx((-0.2, 0.05, -0.03), rel=1e-6)
    assert found.scatter < 1e-6 and found.states == 18
    expected = np.exp(-0.2 + features @ [0.05, -0.03])
    np.testing.assert_allclose(found.factor(features)[:, 0], expected, rtol=1e-6)
    in_torch = found.factor(torch.as_tensor(features))
    assert in_torch.shape == (27, 1)
    np.testing.assert_allclose(in_torch[:, 0], expected, rtol=1e-6)


def test_few_bodies_give_a_constant_factor():
    data, features = levels(lambda x: -0.3 + 0.01 * np.sin(20.0 * x.sum(axis=1)), 1.0, 3, np.random.default_rng(1))
    found = fit_correction(data, SIZES, features)
    assert found.slopes == (0.0, 0.0) and found.constant == pytest.approx(-0.3, abs=0.01)
    values = 0.01 * np.sin(20.0 * features[::3].sum(axis=1))
    assert found.scatter == pytest.approx(
        1.5 * np.std(values), rel=0.01
    )  # the mean without a value is 3/2 as far from it


def test_features_that_do_not_matter_are_left_out():
    data, features = levels(lambda x: -0.3 + 0.1 * x[:, 1], 1.0, 8, np.random.default_rng(4))
    data[1]["effort"] = data[1]["effort"] * (1.0 + 1e-4 * np.cos(90.0 * features[:, 1:]))
    found = fit_correction(data, SIZES, features)
    assert found.slopes == pytest.approx((0.0, 0.1), abs=2e-3) and 1e-5 < found.scatter < 1e-3


def test_bodies_without_all_states_are_left_out():
    data, features = levels(lambda x: -0.2 + 0.05 * x[:, 0], 1.0, 9, np.random.default_rng(2))
    whole = fit_correction(data, SIZES, features)
    fewer = np.arange(27) != 4  # a state of the second body is missing on the fine mesh
    data[2] = {name: column[fewer] for name, column in data[2].items()}
    found = fit_correction(data, SIZES, features)
    assert found.states == 16 and found.constant == pytest.approx(whole.constant, rel=1e-6)
    few = [{name: column[:6] for name, column in level.items()} for level in data]
    with pytest.raises(DataError, match="only 1 bodies have all their states on every mesh; a correction needs 3"):
        fit_correction(few, SIZES, features)


def test_efforts_that_do_not_converge_are_refused():
    data, features = levels(lambda x: -0.2 + 0.0 * x[:, 0], 1.0, 4, np.random.default_rng(3))
    data[2] = data[2] | {"effort": 0.2 * data[2]["effort"]}
    with pytest.raises(
        DataError, match=r"efforts of 4 of 4 bodies do not converge on meshes of sizes \[5.0, 3.0, 2.0\]"
    ):
        fit_correction(data, SIZES, features)


def test_the_observed_order_stays_within_its_bounds():
    assert order_of(math.inf, SIZES) == HIGHEST_ORDER
    assert order_of(0.0, SIZES) == LOWEST_ORDER


def test_a_corrected_model_is_a_condensed_model():
    robot = make_robot("finger")
    plain, _ = untrained_potential(robot)
    size = plain.features.design_size
    correction = {"constant": -0.2, "slopes": list(np.linspace(-0.1, 0.1, size))}
    model = Model(robot, plain.tensors, {"correction": correction})
    designs, displacement = random_states(robot, 6)
    factor = EffortCorrection(-0.2, tuple(correction["slopes"])).factor(plain.features.design(designs))
    assert np.ptp(factor) > 0.01
    effort, effector, _ = model.state(model.context(designs), displacement)
    effort_0, effector_0, _ = plain.state(plain.context(designs), displacement)
    np.testing.assert_allclose(effort, factor * effort_0, rtol=1e-6)
    np.testing.assert_array_equal(effector, effector_0)
    W = model.compliance(model.context(designs), displacement)
    np.testing.assert_allclose(
        W * factor[:, :, None], plain.compliance(plain.context(designs), displacement), rtol=1e-6
    )
    bodies = TorchBatch(model, torch.device("cpu"), torch.float64).prepare(torch.as_tensor(designs))
    stiffness = model.context(designs).stiffness
    np.testing.assert_allclose(bodies["effort"], stiffness * model.energy_scale / model.half_range, rtol=1e-6)
    in_torch = TorchModel(model)(torch.as_tensor(designs), torch.as_tensor(displacement))
    for value, expected in zip(in_torch, (effort, effector, W), strict=True):
        np.testing.assert_allclose(value.detach(), expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


def test_the_design_gradient_contains_that_of_the_correction():
    robot = make_robot("finger")
    plain, _ = untrained_potential(robot)
    slopes = np.linspace(-0.3, 0.3, plain.features.design_size)
    model = TorchModel(Model(robot, plain.tensors, {"correction": {"constant": 0.1, "slopes": list(slopes)}}))
    designs, displacement = (torch.as_tensor(x) for x in random_states(robot, 1))
    designs.requires_grad_()
    effort = model(designs, displacement)[0].sum()
    (gradient,) = torch.autograd.grad(effort, designs)
    for k, variable in enumerate(robot.design_space):
        step = torch.zeros_like(designs)
        step[0, k] = 1e-5 * (variable.high - variable.low)
        with torch.no_grad():
            difference = model(designs + step, displacement)[0].sum() - model(designs - step, displacement)[0].sum()
        expected = float(difference / (2.0 * step[0, k]))
        assert float(gradient[0, k]) == pytest.approx(expected, rel=1e-5, abs=1e-5 * float(gradient.abs().max()))


@pytest.mark.parametrize(
    ("correction", "message"),
    [({"constant": 0.0, "slopes": [1.0]}, "1 slopes for 5 features"), ({"factor": 2.0}, "malformed")],
)
def test_a_damaged_correction_is_refused(correction, message):
    robot = make_robot("finger")
    plain, _ = untrained_potential(robot)
    with pytest.raises(ValueError, match=message):
        Model(robot, plain.tensors, {"correction": correction})


ACCURATE = [path for name, path in shipped_configs("surrogate").items() if name.endswith("_accurate")]


@pytest.mark.parametrize("path", ACCURATE, ids=lambda p: p.stem)
def test_configurations_of_accurate_meshes_fit_their_robots(path):
    config = load_config(path, FitConfig)
    robot = make_robot(config.robot, **config.robot_options)
    assert path.stem == pretrained_folder(robot).name  # where the weights ship
    assert config.pretraining is not None
    first = make_robot(config.robot, **config.robot_options | config.pretraining.robot_options)
    assert first.design_space == robot.design_space and first.mechanics_key != robot.mechanics_key
    assert config.data.plan_of(config.pretraining.train).boundary > 0.0
    plan = config.data.plan("train")
    states = (plan.states + 1) * plan.groups
    if config.correction is not None:
        coarser, finer = (
            make_robot(config.robot, **config.robot_options | options)
            for options in (config.correction.coarser, config.correction.finer)
        )
        assert config.correction.sizes == (coarser.mesh_size, robot.mesh_size, finer.mesh_size)
        few = config.correction.states
        assert few.groups * (few.states + 1) <= 60  # on the finer mesh
        states += few.groups * (few.states + 1)
    assert states <= 400  # on the robot's mesh
