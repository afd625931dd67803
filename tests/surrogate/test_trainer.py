"""The trainer: schedules of the learning rate, and dropout, which must not act on the validation loss."""

from __future__ import annotations

import pytest
import torch

from softgym_envs.surrogate.baselines import thesis
from softgym_envs.surrogate.baselines.perceptron import perceptron
from softgym_envs.surrogate.trainer import Trainer


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
