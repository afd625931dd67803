"""Embedded control loop: measures at most the effector position (thesis, algorithm 2)."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from softgym_envs.backends.backend import Backend, State
from softgym_envs.control.inverse_qp import InverseQP
from softgym_envs.control.pi_correction import PICorrection
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.solvers.complementarity import complementary_step
from softgym_envs.wording import counted

MAX_SETTLING_STEPS = 25
SETTLED = 2.5e-4
"""Newton's method for slack cables ends when a step is below this share of the rates: single precision is near."""
SLACK = 10.0 * SETTLED
"""A cable is slack if the model stretches it beyond its command by more than this share of its rate."""


class EmbeddedLoop:
    """Open- or closed-loop control with a model that is evaluated at actuator displacements.

    The actuators need no sensors. Commanded in effort, the last model predicts their displacement,
    ``delta_a = W_aa effort + delta_free_a``; a measurement, if given, replaces the prediction. Commanded in
    displacement, the model tells which cables hang slack (`settle`).

    Args:
        model: function from actuator displacements (n_a,) to the condensed model there, or a backend.
        controller: inverse QP that commands all actuators in effort, or all in displacement.
        correction: corrects the goal by the measured effector; None for an open loop.

    Attributes:
        command: last command, shape (n_a,).
        effort: efforts that the model predicts for it, shape (n_a,).
        displacement: predicted or measured actuator displacements, shape (n_a,).
        predicted: effector coordinates that the model predicts for the command [m], shape (n_e,).

    Raises:
        ValueError: if the controller commands displacements of some actuators and efforts of others.
    """

    def __init__(
        self,
        model: Callable[[np.ndarray], CondensedModel] | Backend,
        controller: InverseQP,
        correction: PICorrection | None = None,
    ) -> None:
        self.by_effort = bool(controller.by_effort.all())
        if controller.by_effort.any() != self.by_effort:
            raise ValueError("the embedded loop commands all actuators in one mode: its InverseQP mixes two")
        self.model = model
        self.controller = controller
        self.correction = correction
        self.reset()

    def reset(self) -> None:
        """Start from rest: no command; without effort ``delta_a = delta_free_a``."""
        if isinstance(self.model, Backend):
            self.model.reset()
        if self.correction is not None:
            self.correction.reset()
        self.command = np.zeros_like(self.controller.rates)
        self.effort = np.zeros_like(self.command)
        condensed = self._condensed(np.zeros_like(self.command))
        self.displacement = np.array(condensed.delta_free.a) if self.by_effort else np.zeros_like(self.command)
        self.predicted = np.array(condensed.delta_free.e)

    def _condensed(self, displacement: np.ndarray) -> CondensedModel:
        if isinstance(self.model, Backend):
            return self.model.step(displacement).condensed
        return self.model(displacement)

    def _present(self) -> tuple[CondensedModel, np.ndarray | None]:
        """Return the condensed model under the last command, and which cables are slack."""
        if self.by_effort:
            return self._condensed(self.displacement), None
        if isinstance(self.model, Backend):
            state = self.model.step(self.command)
            return state.condensed, state.slack
        return settle(self.model, self.controller, self.command, self.displacement)

    def step(
        self, goal: np.ndarray, measured: np.ndarray | None = None, *, displacement: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the next command, shape (n_a,): efforts, or displacements.

        Args:
            goal: desired effector coordinates [m], shape (n_e,).
            measured: measured effector coordinates [m], shape (n_e,); with None, the goal is not corrected.
            displacement: measured actuator displacements, shape (n_a,), if there are sensors; only for a loop that
                commands efforts.

        Raises:
            ValueError: for malformed or non-finite input.
            ConvergenceError: if the model or the QP finds no solution; the last command is kept.
        """
        goal = np.asarray(goal, dtype=float).ravel()
        if displacement is not None:
            displacement = np.asarray(displacement, dtype=float)
            if not self.by_effort:
                raise ValueError("measured displacements are for loops that command efforts")
            if displacement.shape != self.command.shape or not np.isfinite(displacement).all():
                raise ValueError(
                    f"measured displacement must be {counted(self.command.size, 'finite number')}, got "
                    f"{displacement.tolist()}"
                )
            self.displacement = displacement
        condensed, slack = self._present()
        closed = None if measured is None else self.correction
        aim, summed = goal, None if closed is None else closed.correction
        weights = self.controller.goal_weights
        chosen = np.ones(goal.size, dtype=bool) if weights is None else weights > 0.0
        if closed is not None and measured is not None:
            seen = np.asarray(measured, dtype=float).ravel()
            self.controller.check_near("measured effector", seen)
            aim = closed.correct(goal, np.where(chosen, seen, goal) if seen.shape == goal.shape else seen)
        try:
            self.command = self.controller.solve(condensed, aim, self.command, slack)
        except (ConvergenceError, ValueError):
            if closed is not None and summed is not None:
                closed.correction = summed  # do not integrate an error without acting on it
            raise
        self.effort = self.command if self.by_effort else self.controller.effort
        change = self.effort - condensed.lambda_.a
        if self.by_effort:
            self.displacement = condensed.delta.a + condensed.W.aa @ change
        else:
            self.displacement = self.controller.displacement
        self.predicted = condensed.delta.e + condensed.W.ea @ change
        if closed is not None:
            closed.hold(np.where(chosen, aim - self.predicted, 0.0))
        return self.command


def settling_span(controller: InverseQP) -> np.ndarray:
    """Return the longest step of `settle`, shape (n_a,): a quarter of the ranges."""
    return 0.25 * (controller.upper - controller.lower)


def settle(
    model: Callable[[np.ndarray], CondensedModel], controller: InverseQP, command: np.ndarray, start: np.ndarray
) -> tuple[CondensedModel, np.ndarray]:
    """Return the condensed model under commanded displacements, and which cables are slack, shape (n_a,).

    Newton's method on the complementarity of tensions and slack lengths; if all cables are taut, it evaluates the
    model once.

    Args:
        model: function from actuator displacements (n_a,) to the condensed model there.
        controller: which actuators cannot push, their rates and ranges.
        command: commanded displacements, shape (n_a,).
        start: displacements to start from, shape (n_a,).

    Raises:
        ConvergenceError: if it does not settle.
    """
    unilateral, rates, span = controller.unilateral, controller.rates, settling_span(controller)
    displacement = np.where(unilateral & (start > command + SLACK * rates), start, command)
    for _ in range(MAX_SETTLING_STEPS):
        condensed = model(displacement)
        try:
            change = complementary_step(condensed.W.aa, displacement - command, condensed.lambda_.a, unilateral)
        except np.linalg.LinAlgError:
            raise ConvergenceError(
                f"the model at displacements {displacement.tolist()} is unstable: its W_aa is not positive definite"
            ) from None
        step = condensed.W.aa @ change
        if (np.abs(step) <= SETTLED * rates).all():
            break
        displacement = displacement + step / max(1.0, (np.abs(step) / span).max())  # a long step, shortened as a whole
    else:
        raise ConvergenceError(f"the model finds no equilibrium under displacements {command.tolist()}")
    slack = unilateral & (displacement > command + SLACK * rates)
    effort = np.where(slack, 0.0, np.where(unilateral, np.maximum(condensed.lambda_.a, 0.0), condensed.lambda_.a))
    full = np.concatenate([effort, condensed.lambda_.array[len(effort) :]])
    free = condensed.delta.array - condensed.compliance @ full
    return CondensedModel(condensed.compliance, free, full, condensed.roles, condensed.rows), slack


def follow(
    loop: EmbeddedLoop, plant: Backend, goals: Iterable[np.ndarray], *, feedback: bool = True, encoders: bool = False
) -> list[State]:
    """Drive a plant along goals [m] (n_e,), calling the loop once per goal.

    Args:
        loop: the control loop.
        plant: backend of the robot.
        goals: one goal per call.
        feedback: whether to pass the measured effector to the loop.
        encoders: whether to pass the measured actuator displacements to the loop.

    Returns:
        The state of the plant after each call.
    """
    states = []
    for goal in goals:
        before = plant.state
        command = loop.step(
            goal,
            before.effector.ravel() if feedback else None,
            displacement=before.displacement if encoders else None,
        )
        states.append(plant.step(command, "effort" if loop.by_effort else "displacement"))
    return states
