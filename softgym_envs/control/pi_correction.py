"""PI controller on the measured effector: it shifts the goal of a model-based controller."""

from __future__ import annotations

import numpy as np

from softgym_envs.wording import counted


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
            ValueError: if the goal is not finite, or the measurement has another shape or is not finite, as with a lost
                sensor.
        """
        if not np.isfinite(goal).all():
            raise ValueError(f"goal must be finite coordinates, got {np.asarray(goal).tolist()}")
        measured = np.asarray(measured, dtype=float).ravel()
        if measured.shape != goal.shape or not np.isfinite(measured).all():
            raise ValueError(
                f"measured effector must be {counted(goal.size, 'finite coordinate')}, got {measured.tolist()}"
            )
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
