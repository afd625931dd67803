"""Agents of hands that need no training: closing without measuring anything, and control of measured forces."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.grasping.control.contact_qp import ContactQP, ForceGoal
from softgym_envs.extensions.grasping.robots.lifting import Lifting, lifting_of


class OpenLoopGrasp:
    """Closes all servos at full rate to a share of their range; then hands that lift rise by the goal's height.

    Nothing is measured. Forces are whatever the angle gives.

    Args:
        seed: not used; nothing is random.
        share: of the range of the servos.
    """

    title = "open loop"

    def __init__(self, seed: int = 0, share: float = 0.75) -> None:
        self._share = share

    def __call__(self, observation: Any, env: Any) -> np.ndarray:
        """Return the action in the state of ``env``, shape (n_a,)."""
        present, command = env.state.command, self._share * env.robot.upper
        if (lifting := lifting_of(env.robot)) is not None:
            drive = lifting.drive
            closed = (np.delete(present, drive) >= np.delete(command, drive) - 1e-9).all()
            command[drive] = env.goal[2] - env.robot.effector_rest[2] if closed else present[drive]
        return _towards(env, command)


class ForceGrasp:
    """Controls contact forces that it measures.

    On an object that stands still: inverse QP with contacts for the wanted force (`ContactQP`), whose steps become
    smaller while the error of the force grows. On a free object: closes until the fingers press it with twice the force
    that friction needs for its weight, then lifts, and corrects the height by the error that is left.
    """

    title = "force control"
    margin = 2.0

    def __init__(self, seed: int = 0) -> None:
        self._controls: WeakKeyDictionary[Any, tuple[ContactQP, float, float]] = WeakKeyDictionary()

    def __call__(self, observation: Any, env: Any) -> np.ndarray:
        """Return the action in the state of ``env``, shape (n_a,)."""
        lifting = lifting_of(env.robot)
        return self._press(env) if lifting is None else self._lift(env, lifting)

    def _press(self, env: Any) -> np.ndarray:
        present = env.state.command
        if env not in self._controls or not present.any():
            self._controls[env] = (ContactQP.for_robot(env.robot), 1.0, np.inf)
        controller, size, before = self._controls[env]
        error = float(env.task.distance(env.task.measure(env.state), env.goal))
        size = max(0.5 * size, 1.0 / 64.0) if error > before + 1e-9 else min(1.0, 1.5 * size)
        self._controls[env] = (controller, size, error)
        # The controller counts normal forces; friction and the direction of the normals add their share.
        contacts, along = env.state.contacts, float(env.task.measure(env.state)[0])
        share = contacts.pressing[contacts.obstacle == 0].sum() / along if along > 0.0 else 1.0
        wanted = ForceGoal({contacts.obstacles[0]: 1.0}, float(env.goal[0] * share))
        try:
            model = env.backend.contact_model()
            command = controller.solve(model, None, present, env.state.slack, forces=[wanted], size=size)
        except ConvergenceError:
            command = present
        return _towards(env, command)

    def _lift(self, env: Any, lifting: Lifting) -> np.ndarray:
        state, command, drive = env.state, env.state.command.copy(), lifting.drive
        weight = 9.81 * env.design[lifting.mass]
        pressing = state.contacts.pressing[state.contacts.obstacle == 1].sum()
        if pressing < self.margin * weight / env.design[lifting.friction]:
            closing = np.arange(len(command)) != drive
            command[closing] = env.robot.upper[closing]
        else:
            command[drive] += env.goal[2] - state.effector[0, 2]
        return _towards(env, command)


def _towards(env: Any, command: np.ndarray) -> np.ndarray:
    """Return the action that moves the commands of ``env`` towards others, shape (n_a,)."""
    present, rates = env.state.command, env.robot.rates
    return env.spaces.action(present + np.clip(command - present, -rates, rates), present)
