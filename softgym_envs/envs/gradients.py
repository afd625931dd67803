"""Derivatives of the reward of one step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgym_envs.envs.arrays import with_tensors
from softgym_envs.envs.spaces import AgentSpaces
from softgym_envs.envs.tasks.base import Task


@dataclass(frozen=True)
class StepGradient:
    """Derivatives of the rewards of one step of B environments in what the agent did in this step.

    Asked for with ``log=True``, they are derivatives of `Task.log_reward`.

    Attributes:
        reward: the rewards, shape (B,).
        command: derivative in the commands, through the equilibrium of slack actuators, shape (B, n_a). It is zero for
            slack actuators, whose commands change nothing.
        held: derivative in the reached displacements as if no actuator were slack, shape (B, n_a). It tells what would
            be gained by tightening a slack actuator.
        slack: which actuators are slack, shape (B, n_a).
        gap: reached minus commanded displacement, positive for slack actuators, shape (B, n_a).
        slope: derivative of the commands in the actions where no limit holds them, shape (B, n_a).
        limited: 1 where a limit above holds the command, -1 for one below, 0 for none, shape (B, n_a).
    """

    reward: np.ndarray
    command: np.ndarray
    held: np.ndarray
    slack: np.ndarray
    gap: np.ndarray
    slope: np.ndarray
    limited: np.ndarray

    @property
    def action(self) -> np.ndarray:
        """Derivative in the actions, shape (B, n_a)."""
        return np.where(self.limited == 0.0, self.command * self.slope, 0.0)


class RewardGradient:
    """Derivatives of a task's reward in effector and efforts, by automatic differentiation of the task's own methods.

    Args:
        task: the task; its methods must take tensors, see `Task`.
        spaces: the agent's spaces.

    Raises:
        ImportError: without torch.
    """

    def __init__(self, task: Task, spaces: AgentSpaces) -> None:
        import torch

        self._axes = task.axes
        self._task, self._spaces = with_tensors(task, torch.as_tensor), with_tensors(spaces, torch.as_tensor)

    def __call__(
        self, effector: np.ndarray, effort: np.ndarray, goal: np.ndarray, log: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of the rewards in effectors (B, 3) and efforts (B, n_a), for goals (B, 3).

        Args:
            effector: first effectors [m].
            effort: efforts of the actuators [N, ...].
            goal: goals [m].
            log: return those of `Task.log_reward` instead.
        """
        import torch

        x, e = (torch.from_numpy(np.ascontiguousarray(part)).requires_grad_() for part in (effector, effort))
        share = self._spaces.effort_share(e)
        distance, _, value = self._task.rate(x, torch.from_numpy(np.ascontiguousarray(goal)), share)
        if log:
            value = self._task.log_reward(distance, share)
        by_effector, by_effort = torch.autograd.grad(value.sum(), (x, e), allow_unused=True, materialize_grads=True)
        # A distance of exactly zero has no derivative; the reward is at its peak there.
        met = (self._axes * (effector - goal) == 0.0).all(axis=1)
        return np.where(met[:, None], 0.0, by_effector.numpy()), by_effort.numpy()
