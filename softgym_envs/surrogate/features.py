"""Inputs of the networks: actuation and design, scaled to about [-1, 1]."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from softgym_envs.robots.base import Robot

if TYPE_CHECKING:
    from torch import Tensor

    Array = TypeVar("Array", np.ndarray, Tensor)


def learned_variables(robot: Robot) -> tuple[str, ...]:
    """Design variables a surrogate learns: all but the one that only scales efforts."""
    return tuple(name for name in robot.design_space.names if name != robot.learning.stiffness_variable)


class Features:
    """Scaling of displacements and designs, for NumPy arrays and torch tensors alike.

    Designs are given as values (B, len(space)) in the order of the robot's design space.

    Args:
        robot: the robot.
        learned: design variables that are inputs, in order; default all but the stiffness variable.
        bounds: smallest and largest values of design variables by which they are scaled, instead of the robot's.

    Attributes:
        units: of the rows of W in the network, shape (n,): 1 for actuators and effectors; sensor rows [m3] become
            lengths.
    """

    def __init__(
        self,
        robot: Robot,
        learned: tuple[str, ...] | None = None,
        bounds: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        self.robot, self.space = robot, robot.design_space.within(bounds or {})
        self.learned = learned_variables(robot) if learned is None else learned
        self.design_size = len(self.learned) + ("poisson_ratio" in self.learned)
        # A typical reading counts as much as a tenth of the robot's size.
        sensors = robot.sensing.scale / (0.1 * robot.size)
        self.units = np.concatenate([np.ones(len(robot.actuators) + 3 * len(robot.effectors)), sensors])

    def design(self, values: Array) -> Array:
        """Scale the learned design variables; returns (B, design_size)."""
        columns = []
        for name in self.learned:
            variable, value = self.space[name], values[:, self.space.names.index(name)]
            ends = np.array([variable.low, variable.high])
            columns.append(_scaled(_log(value), *np.log(ends)) if variable.log else _scaled(value, *ends))
            if name == "poisson_ratio":
                # Near 0.5 everything depends on 1 - 2 nu, over orders of magnitude.
                columns.append(_scaled(_log(1.0 - 2.0 * value), *np.log(1.0 - 2.0 * ends)))
        if not columns:
            return values[:, :0]
        return np.stack(columns, axis=1) if isinstance(values, np.ndarray) else sys.modules["torch"].stack(columns, 1)

    def stiffness(self, values: Array) -> Array:
        """Stiffness relative to the baseline, which scales all efforts; shape (B, 1)."""
        name = self.robot.learning.stiffness_variable
        if name is None:
            return 0.0 * values[:, :1] + 1.0
        return values[:, [self.space.names.index(name)]] / self.space[name].baseline

    def actuation(self, displacement: np.ndarray) -> np.ndarray:
        """Scale displacements (B, n_a)."""
        return _scaled(displacement, self.robot.lower, self.robot.upper)


def _log(x: Array) -> Array:
    return np.log(x) if isinstance(x, np.ndarray) else x.log()


def _scaled(x, low, high):
    """Map [low, high] to [-1, 1]."""
    return 2.0 * (x - low) / (high - low) - 1.0
