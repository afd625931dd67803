"""Agents that need no training: the inverse QP in several forms, and random actions."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from softgym_envs.backends.backend import Backend, State
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.surrogate import SurrogateBackend
from softgym_envs.control.inverse_qp import InverseQP
from softgym_envs.control.pi_correction import PICorrection
from softgym_envs.envs.tasks.base import Task
from softgym_envs.errors import ConvergenceError, WeightsError
from softgym_envs.registry import Table
from softgym_envs.robots.base import Robot

Agent = Callable[[np.ndarray, Any], np.ndarray]
"""``agent(observation, env.unwrapped) -> action``."""

PI_GAINS = (0.1, 0.3)
"""Proportional and integral gain per control step. The plant responds to a correction within one step, so the integral
alone leaves 0.7^k of an error after k steps. The gains of the thesis (0.01 and 0.002) are meant for many calls per
goal."""


def make_controller(robot: Robot, task: Task) -> InverseQP:
    """Return the inverse QP of a robot with one effector for the goals of a task, along the task's axes."""
    return InverseQP.for_robot(robot, goal_weights=task.axes)


class InverseQPAgent:
    """Inverse QP on the condensed model of the plant's present state; in dynamics, on that of its next time step."""

    title = "QP"

    def __init__(self, seed: int = 0) -> None:
        self._controllers: WeakKeyDictionary[Any, InverseQP] = WeakKeyDictionary()
        self._others: dict[str, Agent] = {}

    def __call__(self, observation: Any, env: Any) -> np.ndarray:
        """Return the action in the state of ``env``, shape (n_a,); the command is held if the QP finds no solution.

        A state in which no actuator is commanded begins an episode. A task may name another agent for its goals.
        """
        if (other := env.task.qp_agent) != "qp":
            if other not in self._others:
                self._others[other] = make_baseline(other)
            return self._others[other](observation, env)
        present = env.command
        if env not in self._controllers or not present.any():
            self._begin(env)
        try:
            command = self._solve(env, self._controllers[env], present)
        except ConvergenceError:
            command = present
        return env.spaces.action(command, present)

    def _begin(self, env: Any) -> None:
        self._controllers[env] = make_controller(env.robot, env.task)

    def _solve(self, env: Any, controller: InverseQP, present: np.ndarray) -> np.ndarray:
        return controller.solve(env.state.condensed, env.observed_goal, present, env.state.slack)


class StaticQPAgent(InverseQPAgent):
    """Inverse QP on the static equilibrium under the present command, which ignores momentum."""

    title = "QP, static"

    def _solve(self, env: Any, controller: InverseQP, present: np.ndarray) -> np.ndarray:
        still = env.backend.probe(present) if env.backend.moving else env.state
        return controller.solve(still.condensed, env.observed_goal, present, still.slack)


class ModelQPAgent(InverseQPAgent):
    """Inverse QP on the surrogate, which only sees the commands.

    On FEM, as on a physical robot, the model then differs from the plant. For robots without a surrogate, the model is
    the static equilibrium of the plant.
    """

    title = "QP, model"

    def __init__(self, seed: int = 0) -> None:
        super().__init__(seed)
        self._models: WeakKeyDictionary[Any, Backend | None] = WeakKeyDictionary()

    def _begin(self, env: Any) -> None:
        super()._begin(env)
        if env not in self._models:
            try:
                self._models[env] = SurrogateBackend(env.robot, env.design)
            except WeightsError:
                # The plant itself, unless something touches it that the agent does not know.
                disturbed = env.task.load is not None and env.task.load.on_body
                self._models[env] = FEMBackend(env.robot, env.design) if disturbed else None
        model = self._models[env]
        if model is not None:
            model.reset(env.design)

    def _predict(self, env: Any, command: np.ndarray) -> State:
        model = self._models[env]
        return env.backend.probe(command) if model is None else model.step(command)

    def _solve(self, env: Any, controller: InverseQP, present: np.ndarray) -> np.ndarray:
        expected = self._predict(env, present)
        return controller.solve(expected.condensed, env.observed_goal, present, expected.slack)


class CorrectedQPAgent(ModelQPAgent):
    """Inverse QP on the surrogate, whose goal a PI controller on the measured effector shifts (thesis, algorithm 2).

    Raises:
        ValueError: for a task that hides the effector.
    """

    title = "QP, model, PI"

    def __init__(self, seed: int = 0) -> None:
        super().__init__(seed)
        self._corrections: WeakKeyDictionary[Any, PICorrection] = WeakKeyDictionary()
        self._previous_aims: WeakKeyDictionary[Any, np.ndarray] = WeakKeyDictionary()

    def _begin(self, env: Any) -> None:
        super()._begin(env)
        if env.task.sensors:
            raise ValueError(f"agent 'qp_pi' measures the effector, which task '{env.task.name}' hides")
        self._corrections[env] = PICorrection(*PI_GAINS)
        self._previous_aims[env] = env.observed_goal

    def _solve(self, env: Any, controller: InverseQP, present: np.ndarray) -> np.ndarray:
        expected = self._predict(env, present)
        axes, correction = env.task.axes, self._corrections[env]
        # The effector follows the previous aim; the motion of the aim since then is not an error of the model.
        error = axes * (self._previous_aims[env] - env.sensed.effector)
        self._previous_aims[env] = env.observed_goal
        aim = correction.correct(env.observed_goal, env.observed_goal - error)
        command = controller.solve(expected.condensed, aim, present, expected.slack)
        model = expected.condensed
        reached = model.delta.e + model.W.ea @ (controller.effort - model.lambda_.a)
        correction.hold(axes * (aim - reached))
        return command


class RandomAgent:
    """Uniform actions; those of `Robot.antagonists` are balanced.

    Args:
        seed: of the actions.
    """

    title = "random"

    def __init__(self, seed: int = 0) -> None:
        self._rng = np.random.default_rng(seed)

    def __call__(self, observation: Any, env: Any) -> np.ndarray:
        """Return an action, shape (n_a,)."""
        action = self._rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
        inner = env.unwrapped
        if not inner.robot.antagonists:
            return action
        present = inner.state.command
        return np.asarray(inner.spaces.action(inner.robot.balanced(inner.spaces.command(action, present)), present))


class Agents(Table):
    """Agents by name; some can take what a policy has learned: ``"steer@POLICY"``."""

    def __contains__(self, name: object) -> bool:
        kind, _, policy = str(name).partition("@")
        return super().__contains__(name) or bool(policy and super().__contains__(kind))

    def __getitem__(self, name: str) -> Any:
        kind, _, policy = name.partition("@")
        found = super().__getitem__(kind)
        if not policy:
            return found
        if not getattr(found, "takes_policy", False):
            raise ValueError(f"agent '{kind}' takes no policy, got '{policy}'; allowed: {kind}")
        return partial(found, policy=policy)


BASELINES = Agents(
    "agent",
    {
        "qp": f"{__name__}:InverseQPAgent",
        "qp_static": f"{__name__}:StaticQPAgent",
        "qp_model": f"{__name__}:ModelQPAgent",
        "qp_pi": f"{__name__}:CorrectedQPAgent",
        "random": f"{__name__}:RandomAgent",
    },
    group="softgym_envs.agents",
)
"""Agents that need no training by name: classes whose argument is a seed, with a ``title`` for tables.

Those with a true ``takes_policy`` have another argument, a policy.
"""


def make_baseline(name: str, seed: int = 0) -> Agent:
    """Return an agent that needs no training.

    Args:
        name: ``"qp"``: inverse QP on the condensed model of the plant's present state, in dynamics of its next time
            step, unless the task names another agent for its goals (`Task.qp_agent`); ``"qp_static"``: on the static
            equilibrium under the present command, without momentum; ``"qp_model"``: on the surrogate, whatever the
            plant is; ``"qp_pi"``: as ``"qp_model"``, with a PI controller on the measured effector; ``"random"``:
            uniform actions; or one of an installed package, some of which take a policy: ``"steer@POLICY"``.
        seed: seed of the random agent.

    Raises:
        ValueError: for an unknown name.
        WeightsError: for a policy that cannot be read, or does not fit.
    """
    agent: Agent = BASELINES.find(name)(seed)
    return agent
