"""Agents that need no training: the inverse QP in several forms, control of forces, and random actions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from softgym_envs.backends.backend import Backend, State
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.surrogate import SurrogateBackend
from softgym_envs.control.contact_qp import ContactQP, ForceGoal
from softgym_envs.control.embedded import PICorrection
from softgym_envs.control.inverse_qp import InverseQP
from softgym_envs.envs.tasks.base import Task
from softgym_envs.errors import ConvergenceError, WeightsError
from softgym_envs.estimation import Estimator, Noise, Touch
from softgym_envs.estimation.learned import LearnedEstimator
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

    def __init__(self) -> None:
        self._controllers: WeakKeyDictionary[Any, InverseQP] = WeakKeyDictionary()
        self._forces = ForceGrasp()

    def __call__(self, observation: Any, env: Any) -> np.ndarray:
        """Return the action in the state of ``env``, shape (n_a,); the command is held if the QP finds no solution.

        A state in which no actuator is commanded begins an episode. For tasks with forces, this is `ForceGrasp`.
        """
        if env.task.needs_state:
            return self._forces(observation, env)
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
        return controller.solve(env.state.condensed, env.aim, present, env.state.slack)


class StaticQPAgent(InverseQPAgent):
    """Inverse QP on the static equilibrium under the present command, which ignores momentum."""

    def _solve(self, env: Any, controller: InverseQP, present: np.ndarray) -> np.ndarray:
        still = env.backend.probe(present) if env.backend.moving else env.state
        return controller.solve(still.condensed, env.aim, present, still.slack)


class ModelQPAgent(InverseQPAgent):
    """Inverse QP on the surrogate, which only sees the commands: open loop, or closed by a PI controller.

    On FEM, as on a physical robot, the model then differs from the plant. For robots without a surrogate, the model is
    the static equilibrium of the plant.

    Args:
        closed: shift the goal by a PI controller on the measured effector (thesis, algorithm 2).

    Raises:
        ValueError: with ``closed``, for a task that hides the effector.
    """

    def __init__(self, closed: bool) -> None:
        super().__init__()
        self._closed = closed
        self._models: WeakKeyDictionary[Any, Backend | None] = WeakKeyDictionary()
        self._corrections: WeakKeyDictionary[Any, PICorrection] = WeakKeyDictionary()
        self._previous_aims: WeakKeyDictionary[Any, np.ndarray] = WeakKeyDictionary()

    def _begin(self, env: Any) -> None:
        super()._begin(env)
        if self._closed and env.task.sensors:
            raise ValueError(f"agent 'qp_pi' measures the effector, which task '{env.task.name}' hides")
        self._corrections[env] = PICorrection(*PI_GAINS)
        self._previous_aims[env] = env.aim
        if env not in self._models:
            try:
                self._models[env] = SurrogateBackend(env.robot, env.design)
            except WeightsError:
                # The plant itself, unless something touches it that the agent does not know.
                self._models[env] = FEMBackend(env.robot, env.design) if env.task.touches else None
        model = self._models[env]
        if model is not None:
            model.reset(env.design)

    def _predict(self, env: Any, command: np.ndarray) -> State:
        model = self._models[env]
        return env.backend.probe(command) if model is None else model.step(command)

    def _solve(self, env: Any, controller: InverseQP, present: np.ndarray) -> np.ndarray:
        expected = self._predict(env, present)
        if not self._closed:
            return controller.solve(expected.condensed, env.aim, present, expected.slack)
        axes, correction = env.task.axes, self._corrections[env]
        # The effector follows the previous aim; the motion of the aim since then is not an error of the model.
        error = axes * (self._previous_aims[env] - env.sensed.effector)
        self._previous_aims[env] = env.aim
        aim = correction.correct(env.aim, env.aim - error)
        command = controller.solve(expected.condensed, aim, present, expected.slack)
        model = expected.condensed
        reached = model.delta.e + model.W.ea @ (controller.effort - model.lambda_.a)
        correction.hold(axes * (aim - reached))
        return command


class EstimatedQPAgent(InverseQPAgent):
    """Inverse QP on the effector and the condensed model that the estimator finds from all sensors."""

    def __init__(self) -> None:
        super().__init__()
        self._estimators: WeakKeyDictionary[Any, Estimator | LearnedEstimator] = WeakKeyDictionary()

    def _begin(self, env: Any) -> None:
        if not env.task.sensors:
            raise ValueError(f"agent 'qp_estimated' needs a task that shows sensors; '{env.task.name}' does not")
        super()._begin(env)
        # A tenth of a percent stands for the differences between touches of the plant and of the estimator.
        level = max(env.plant.noise, 1e-3) * float(np.mean(env.robot.sensor_scale))
        # A body has sensors of one kind; the other level is not used.
        noise = Noise(displacement=1e-5, volume=level, pressure=level)
        if isinstance(env.backend, SurrogateBackend):
            # The plant is the learned model itself, so the errors of its volumes do not count.
            self._estimators[env] = LearnedEstimator(
                env.robot, design=env.design, noise=noise, model=env.backend.model, exact=True
            )
        else:
            self._estimators[env] = Estimator(env.robot, design=env.design, noise=noise)

    def _solve(self, env: Any, controller: InverseQP, present: np.ndarray) -> np.ndarray:
        estimator, task = self._estimators[env], env.task
        load = None if task.touched is None else Touch(task.grid, task.touched, task.largest_force)
        if load != estimator.load:
            estimator.touch(load)
        found = estimator.update(estimator.reading(present, env.sensed.sensors * env.robot.sensor_scale))
        aim = env.aim + found.condensed.delta.e[:3] - found.effector[:3]
        return controller.solve(found.condensed, aim, present, found.slack)


class OpenLoopGrasp:
    """Closes all servos at full rate to a share of their range; then the drive ``"lift"`` rises by the goal's height.

    Nothing is measured. Forces are whatever the angle gives.

    Args:
        share: of the range of the servos.
    """

    def __init__(self, share: float = 0.75) -> None:
        self._share = share

    def __call__(self, observation: Any, env: Any) -> np.ndarray:
        """Return the action in the state of ``env``, shape (n_a,)."""
        present, command = env.state.command, self._share * env.robot.upper
        if _lifts(env.robot):
            closed = (present[:-1] >= command[:-1] - 1e-9).all()
            command[-1] = env.goal[2] - env.robot.effector_rest[2] if closed else present[-1]
        return _towards(env, command)


class ForceGrasp:
    """Controls contact forces that it measures.

    On an object that stands still: inverse QP with contacts for the wanted force (`ContactQP`), whose steps become
    smaller while the error of the force grows. On a free object: closes until the fingers press it with twice the force
    that friction needs for its weight, then lifts, and corrects the height by the error that is left.
    """

    margin = 2.0

    def __init__(self) -> None:
        self._controls: WeakKeyDictionary[Any, tuple[ContactQP, float, float]] = WeakKeyDictionary()

    def __call__(self, observation: Any, env: Any) -> np.ndarray:
        """Return the action in the state of ``env``, shape (n_a,)."""
        return self._lift(env) if _lifts(env.robot) else self._press(env)

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

    def _lift(self, env: Any) -> np.ndarray:
        state, command = env.state, env.state.command.copy()
        weight = 9.81 * env.design["object_mass"]
        pressing = state.contacts.pressing[state.contacts.obstacle == 1].sum()
        if pressing < self.margin * weight / env.design["friction"]:
            command[:-1] = env.robot.upper[:-1]
        else:
            command[-1] += env.goal[2] - state.effector[0, 2]
        return _towards(env, command)


def _lifts(robot: Robot) -> bool:
    return robot.actuators[-1].name == "lift"


def _towards(env: Any, command: np.ndarray) -> np.ndarray:
    """Return the action that moves the commands of ``env`` towards others, shape (n_a,)."""
    present, rates = env.state.command, env.robot.rates
    return env.spaces.action(present + np.clip(command - present, -rates, rates), present)


def _random(seed: int) -> Agent:
    rng = np.random.default_rng(seed)
    return lambda observation, env: rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)


_MAKERS: dict[str, Callable[[int], Agent]] = {
    "qp": lambda seed: InverseQPAgent(),
    "qp_static": lambda seed: StaticQPAgent(),
    "qp_model": lambda seed: ModelQPAgent(closed=False),
    "qp_pi": lambda seed: ModelQPAgent(closed=True),
    "qp_estimated": lambda seed: EstimatedQPAgent(),
    "close": lambda seed: OpenLoopGrasp(),
    "force": lambda seed: ForceGrasp(),
    "random": _random,
}

BASELINES = tuple(_MAKERS)
"""Names of agents that need no training."""


def baselines_for(task: type[Task]) -> tuple[str, ...]:
    """Return the names of the agents that a task is compared with: those for forces, for sensors or for positions."""
    if task.hides_effector:
        return ("qp_model", "qp_estimated", "random")
    return ("close", "force", "random") if task.needs_state else ("qp", "qp_model", "qp_pi", "random")


def make_baseline(name: str, seed: int = 0) -> Agent:
    """Return an agent that needs no training.

    Args:
        name: ``"qp"``: inverse QP on the condensed model of the plant's present state, in dynamics of its next time
            step, and for forces ``"force"``; ``"qp_static"``: on the static equilibrium under the present command,
            without momentum;
            ``"qp_model"``: on the surrogate, whatever the plant is; ``"qp_pi"``: as ``"qp_model"``, with a PI
            controller on the measured effector; ``"qp_estimated"``: on the estimate from sensors, for tasks that hide
            the effector; ``"close"``: closing a hand without measuring anything; ``"force"``:
            control of the measured contact forces; ``"random"``: uniform actions.
        seed: seed of the random agent.

    Raises:
        ValueError: for an unknown name.
    """
    if name not in _MAKERS:
        raise ValueError(f"agent = {name!r} is unknown; allowed: {', '.join(BASELINES)}")
    return _MAKERS[name](seed)
