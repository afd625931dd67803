"""The trainer: schedules of the learning rate, dropout, which must not act on the validation loss, and a loss."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from softgym_envs import make_robot
from softgym_envs.extensions.fitting.data.states import States
from softgym_envs.extensions.fitting.potential import make_targets, potential_loss, unstack_members
from softgym_envs.extensions.fitting.predictions import reached
from softgym_envs.extensions.fitting.torch_potential import PotentialNet
from softgym_envs.extensions.fitting.trainer import Trainer
from softgym_envs.extensions.networks import thesis
from softgym_envs.extensions.networks.perceptron import perceptron
from softgym_envs.surrogate.potential.model import Model
from softgym_envs.surrogate.pretrained import pretrained_model
from tests.helpers import random_states


@pytest.mark.parametrize("schedule", ["cycle", "plateau"])
def test_learns_a_parabola_with_dropout_in_training_only(schedule):
    torch.set_num_threads(1)
    net = perceptron(1, 1, 32, 2, "relu", 0, dropout=0.05)
    x = torch.linspace(-1.0, 1.0, 64)[:, None]
    modes = {True: set(), False: set()}

    def loss(rows):
        modes[rows is None].add(net.training)
        chosen = slice(None) if rows is None else rows
        return ((net(x[chosen]) - x[chosen] ** 2) ** 2).mean()

    options = thesis.Options(steps=300, batch_size=32, learning_rate=1e-2, dropout=0.05, schedule=schedule)
    history = Trainer(options, seed=0).optimise("parabola", net, loss, len(x))
    assert modes == {True: {False}, False: {True}}
    assert min(row["validation"] for row in history) < 0.1 * history[0]["validation"]


def test_a_share_of_dropout_is_below_one():
    with pytest.raises(ValueError, match="dropout"):
        thesis.Options(dropout=1.0)


def test_errors_at_equal_commands_include_where_slack_cables_reach():
    robot = make_robot("two_finger_gripper")
    shipped = pretrained_model(robot)
    exact = Model(robot, shipped.tensors, {}, members=1)
    rng = np.random.default_rng(0)
    tensors = {
        name: value * (1.0 + 1e-4 * rng.standard_normal(value.shape)) if name.startswith("energy") else value
        for name, value in exact.tensors.items()
    }
    other = Model(robot, tensors, {})
    designs, commands = random_states(robot, 40)
    context = exact.context(designs)
    displacement, found = reached(exact, context, commands)
    effort, effector, _ = exact.state(context, displacement)
    slack = displacement > commands + 1e-4
    assert found.all() and slack.any(axis=1).sum() > 20  # else there is nothing to see
    effort[slack] = 0.0  # round-off of the search
    factor = exact.features.stiffness(designs)
    states = States(
        design=exact.features.design(designs),
        actuation=exact.features.actuation(displacement),
        displacement=displacement,
        effort=effort / factor,
        effector=effector,
        W=exact.compliance(context, displacement) * factor[:, :, None],
        rest_of=np.arange(len(designs)),
    )
    scales = {name: exact.tensors[f"scale.{name}"] for name in ("energy", "effector_mean", "effector", "held")}
    targets = make_targets(robot, states, scales)
    (weights,), _ = unstack_members(tensors)
    net = PotentialNet(4, 3, targets.design.shape[1], exact.width, len(weights["body.0.bias"]))
    net.load_state_dict({name: torch.as_tensor(value) for name, value in weights.items()})
    with torch.no_grad():
        with_term, without = (float(potential_loss(net, targets, 1.0, 1.0, weight)) for weight in (100.0, 0.0))
    ends, _ = reached(other, context := other.context(designs), commands)
    errors = (other.effector(context, ends)[0] - effector) / float(scales["effector"])
    term = (with_term - without) / 100.0
    assert term == pytest.approx(float((errors**2).mean()), rel=0.05)
    assert (other.effector(context, displacement)[0] == effector).all()  # only efforts differ at equal displacements
