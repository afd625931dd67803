"""The embedded control loop: efforts out, at most an effector position in (thesis Algorithm 2)."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from softgym_envs.backends.backend import Backend, State
from softgym_envs.control.inverse_qp import InverseQP
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.condensation import CondensedModel


class PICorrection:
    """Moves a goal by what the effector misses: ``goal + proportional * error + integral * sum of errors``.

    The gains are per call, so that they do not depend on the rate of the loop (thesis 4.4.3: 0.01 and 0.002).

    Anti-windup by conditional integration and clamping: the part of an error that points the way in which the model
    itself falls short of the corrected goal (out of reach, or limited by a rate) is not summed up, and the sum never
    moves the goal by more than ``limit``.

    Args:
        proportional: gain on the present error.
        integral: gain on the sum of errors.
        limit: largest correction by the sum [m].
        slip: distance below which the model counts as having reached the corrected goal [m]: above what one
            linearisation leaves of a step (a hundredth of a millimetre for the Stiff-Flop on its circle).
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
            ValueError: if the measurement has another shape or is not finite: a lost sensor must not be summed up.
        """
        measured = np.asarray(measured, dtype=float).ravel()
        if measured.shape != goal.shape or not np.isfinite(measured).all():
            raise ValueError(f"measured effector must be {goal.size} finite coordinates, got {measured.tolist()}")
        error = goal - measured
        self._increment = self.integral * error
        self.correction = self._clamped(self.correction + self._increment)
        return goal + self.proportional * error + self.correction

    def hold(self, shortfall: np.ndarray) -> None:
        """Take back what was just summed up towards where the model falls short, ``corrected goal - reached``."""
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
    """Open- or closed-loop control in effort, on a model that is asked by actuator displacement.

    No sensor of the actuators is needed: their displacement is predicted from the last model,
    ``delta_a = W_aa effort + delta_free_a``. Where they are measured, the measurement takes its place.

    Args:
        model: function from actuator displacements (n_a,) to the condensed model there, or a backend.
        controller: inverse QP that commands every actuator in effort.
        correction: correction of the goal from a measured effector, or None.

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
            raise ValueError("the embedded loop commands efforts: make its InverseQP with mode='effort'")
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
            measured: measured effector coordinates [m], shape (n_e,), where the loop is closed.
            displacement: measured actuator displacements, shape (n_a,), where there are sensors.

        Raises:
            ValueError: for malformed or non-finite input.
            ConvergenceError: if model or QP find no answer; the last efforts stand.
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
                closed.correction = summed  # what is not acted upon must not wind up
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
    """Drive a plant in effort along goals [m] (n_e,), one call of the loop each.

    Args:
        loop: the control loop.
        plant: the robot, or a backend in its place.
        goals: one goal per call.
        feedback: give the loop the measured effector.
        encoders: give it the measured actuator displacements.

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
