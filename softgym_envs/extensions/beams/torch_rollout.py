"""Motions of bodies of beams as a function of torch, with gradients by commands and by the design of the body."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from softgym_envs.extensions.beams.rollout import roll_out
from softgym_envs.extensions.beams.solver.design import Neighbours
from softgym_envs.mechanics.solvers.dynamics import Dynamics


class _Recorded(torch.autograd.Function):
    """`roll_out` forwards, `Rollout.gradient` backwards."""

    @staticmethod
    def forward(ctx: Any, commands: torch.Tensor, design: torch.Tensor, start: Any, neighbours: Any) -> Any:
        ctx.values, ctx.neighbours, ctx.kinds = _numbers(design), neighbours, (commands, design)
        ctx.rollout = roll_out(start(ctx.values), _numbers(commands))
        found = ctx.rollout.x, ctx.rollout.velocity, ctx.rollout.effort
        return tuple(torch.from_numpy(values).to(commands) for values in found)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_x: torch.Tensor, by_velocity: torch.Tensor, by_effort: torch.Tensor) -> Any:
        commands, design = ctx.kinds
        gradient = ctx.rollout.gradient(
            by_x=_numbers(by_x),
            by_velocity=_numbers(by_velocity),
            by_effort=_numbers(by_effort),
            neighbours=ctx.neighbours(ctx.values) if ctx.needs_input_grad[1] else None,
        )
        by_design = torch.from_numpy(gradient.design).to(design) if ctx.needs_input_grad[1] else None
        return torch.from_numpy(gradient.commands).to(commands), by_design, None, None


def _numbers(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().to("cpu", torch.float64).numpy()


def torch_rollout(
    start: Callable[[np.ndarray], Dynamics],
    commands: torch.Tensor,
    design: torch.Tensor | None = None,
    neighbours: Callable[[np.ndarray], Neighbours] | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Move a body under commands, one for each time step.

    Args:
        start: returns the dynamics of a design (d,) in the state from which the body moves, as `roll_out` takes it.
        commands: displacements of the actuators, shape (k, n_a).
        design: design variables, shape (d,); none for ``start`` of an empty array.
        neighbours: returns the neighbours of a design; needed where the design has gradients.

    Returns:
        Rows [m] (k, n, 3), their velocities [m/s] (k, n, 3) and the efforts (k, size) after each command.

    Raises:
        ConvergenceError: if a time step cannot be taken.
        ValueError: as for `roll_out`, or without the neighbours of a design that has gradients.
    """
    values = commands.new_empty(0) if design is None else design
    if values.requires_grad and neighbours is None:
        raise ValueError("gradients by the design need its neighbours, see `Neighbours.of`")
    return _Recorded.apply(commands, values, start, neighbours)
