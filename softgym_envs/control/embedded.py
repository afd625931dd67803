"""Embedded control loop: commands efforts and measures at most the effector position (thesis, algorithm 2)."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from softgym_envs.backends.backend import Backend, State
from softgym_envs.control.inverse_qp import InverseQP
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.condensation import CondensedModel


class PICorrection:
    """Shifts a goal by the measured error: ``goal + proportional * error + integral * sum of errors``.

    Gains are per call and thus independent of the rate of the loop (thesis, sec. 4.4.4: 0.01 and 0.002).

    Anti-windup by conditional integration and clamping: if the model itself cannot reach the corrected goal (out of
    reach, or limited by a rate), the part of the error in that direction is not integrated, and the integral never
    moves the goal by more than ``limit``.

    Args:
        proportional: gain on the current error.
        integral: gain on the sum of errors.
        limit: largest correction by the integral [m].
        slip: distance below which the model counts as having reached the corrected goal [m]. It must exceed the error
            of one linearised step (a hundredth of a millimetre for the Stiff-Flop on its circle).
    """

    def __init__(
        self, proportional: float = 0.01, integral: float = 0.002, *, limit: float = 0.02, slip: float = 1e-4
    ) -> None:
        gains = np.array([proportional, integral, limit, slip])
        if not (np.isfinite(gains) & (gains >= 0.0)).all():
            raise ValueError(f"gains, limit and slip must be finite and not negative, got {gains.tolist()}")
        self.proportional = proportional
        self.integral = integral
        self.limit = limit
        self.slip = slip
        self.reset()

    def reset(self) -> None:
        """Forget the past errors."""
        self.correction = self._increment = np.zeros(1)  # broadcast to the goal's shape

    def correct(self, goal: np.ndarray, measured: np.ndarray) -> np.ndarray:
        """Return the corrected goal [m], shape (n_e,), for a measured effector (n_e,).

        Raises:
            ValueError: if the measurement has another shape or is not finite, as with a lost sensor.
        """
        measured = np.asarray(measured, dtype=float).ravel()
        if measured.shape != goal.shape or not np.isfinite(measured).all():
            raise ValueError(f"measured effector must be {goal.size} finite coordinates, got {measured.tolist()}")
        error = goal - measured
        self._increment = self.integral * error
        self.correction = self._clamped(self.correction + self._increment)
        return goal + self.proportional * error + self.correction

    def hold(self, shortfall: np.ndarray) -> None:
        """Undo the last integration in the direction of the shortfall, ``corrected goal - reached``."""
        distance = float(np.linalg.norm(shortfall))
        if distance > self.slip:
            direction = shortfall / distance
            self.correction = self._clamped(
                self.correction - max(0.0, float(np.dot(self._increment, direction))) * direction
            )
        self._increment = np.zeros_like(shortfall)

    def _clamped(self, correction: np.ndarray) -> np.ndarray:
        length = float(np.linalg.norm(correction))
        return correction * (self.limit / length) if length > self.limit else correction


class EmbeddedLoop:
    """Open- or closed-loop control by effort, with a model that is evaluated at actuator displacements.

    The actuators need no sensors: the last model predicts their displacement,
    ``delta_a = W_aa effort + delta_free_a``. A measurement, if given, replaces the prediction.

    Args:
        model: function from actuator displacements (n_a,) to the condensed model there, or a backend.
        controller: inverse QP that commands every actuator in effort.
        correction: corrects the goal by the measured effector; None for an open loop.

    Attributes:
        effort: last commanded efforts, shape (n_a,).
        displacement: predicted or measured actuator displacements, shape (n_a,).
        predicted: effector coordinates that the model predicts for ``effort`` [m], shape (n_e,).

    Raises:
        ValueError: if the controller commands displacements.
    """

    def __init__(
        self,
        model: Callable[[np.ndarray], CondensedModel] | Backend,
        controller: InverseQP,
        correction: PICorrection | None = None,
    ) -> None:
        if not controller.by_effort.all():
            raise ValueError("the embedded loop commands efforts: its InverseQP needs mode='effort'")
        self.model = model
        self.controller = controller
        self.correction = correction
        self.reset()

    def reset(self) -> None:
        """Start from rest: no effort, ``delta_a = delta_free_a``."""
        if isinstance(self.model, Backend):
            self.model.reset()
        if self.correction is not None:
            self.correction.reset()
        self.effort = np.zeros_like(self.controller.rates)
        condensed = self._condensed(np.zeros_like(self.effort))
        self.displacement = np.array(condensed.delta_free.a)
        self.predicted = np.array(condensed.delta_free.e)

    def _condensed(self, displacement: np.ndarray) -> CondensedModel:
        if isinstance(self.model, Backend):
            return self.model.step(displacement).condensed
        return self.model(displacement)

    def step(
        self, goal: np.ndarray, measured: np.ndarray | None = None, *, displacement: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the efforts to apply, shape (n_a,).

        Args:
            goal: desired effector coordinates [m], shape (n_e,).
            measured: measured effector coordinates [m], shape (n_e,); with None, the goal is not corrected.
            displacement: measured actuator displacements, shape (n_a,), if there are sensors.

        Raises:
            ValueError: for malformed or non-finite input.
            ConvergenceError: if the model or the QP finds no solution; the last efforts are kept.
        """
        goal = np.asarray(goal, dtype=float).ravel()
        if displacement is not None:
            displacement = np.asarray(displacement, dtype=float)
            if displacement.shape != self.effort.shape or not np.isfinite(displacement).all():
                raise ValueError(
                    f"measured displacement must be {self.effort.size} finite numbers, got {displacement.tolist()}"
                )
            self.displacement = displacement
        condensed = self._condensed(self.displacement)
        closed = None if measured is None else self.correction
        aim, summed = goal, None if closed is None else closed.correction
        if closed is not None and measured is not None:
            aim = closed.correct(goal, measured)
        try:
            self.effort = self.controller.solve(condensed, aim, self.effort)
        except ConvergenceError:
            if closed is not None and summed is not None:
                closed.correction = summed  # do not integrate an error without acting on it
            raise
        change = self.effort - condensed.lambda_.a
        self.displacement = condensed.delta.a + condensed.W.aa @ change
        self.predicted = condensed.delta.e + condensed.W.ea @ change
        if closed is not None:
            closed.hold(aim - self.predicted)
        return self.effort


def follow(
    loop: EmbeddedLoop, plant: Backend, goals: Iterable[np.ndarray], *, feedback: bool = True, encoders: bool = False
) -> list[State]:
    """Drive a plant by efforts along goals [m] (n_e,), calling the loop once per goal.

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
        effort = loop.step(
            goal,
            before.effector.ravel() if feedback else None,
            displacement=before.displacement if encoders else None,
        )
        states.append(plant.step(effort, "effort"))
    return states
