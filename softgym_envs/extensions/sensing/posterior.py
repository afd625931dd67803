"""The most probable parameters given readings with Gaussian noise, a Gaussian prior and limits: Gauss-Newton."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Linearised = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Parameters (m,) to the predicted readings (k,) and their derivative (k, m)."""


@dataclass(frozen=True)
class Gaussian:
    """A normal distribution of parameters, cut off at limits.

    Attributes:
        mean: of the distribution before it is cut off, shape (m,); it may lie beyond the limits.
        covariance: likewise, shape (m, m).
        low: lower limits, shape (m,).
        high: upper limits, shape (m,).
    """

    mean: np.ndarray
    covariance: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def joined_with(self, other: Gaussian) -> Gaussian:
        """Return the distribution of these parameters and those of another one, independent of each other."""
        n, m = len(self.mean), len(other.mean)
        covariance = np.zeros((n + m, n + m))
        covariance[:n, :n], covariance[n:, n:] = self.covariance, other.covariance
        return Gaussian(
            np.concatenate([self.mean, other.mean]),
            covariance,
            np.concatenate([self.low, other.low]),
            np.concatenate([self.high, other.high]),
        )


@dataclass(frozen=True)
class Posterior:
    """What readings tell about parameters.

    Attributes:
        mode: the most probable parameters within their limits, shape (m,).
        parameters: their distribution, from the Gauss-Newton Hessian at the mode. Where limits are active, its mean
            lies beyond them, so that further readings find what all readings at once would.
        residuals: of the readings, in standard deviations of their noise, shape (k,).
        cost: sum of their squares and of that of the distance from the prior; least at the mode.
        iterations: Gauss-Newton steps.
        converged: whether the last step was short.
    """

    mode: np.ndarray
    parameters: Gaussian
    residuals: np.ndarray
    cost: float
    iterations: int
    converged: bool

    @property
    def misfit(self) -> float:
        """Sum of the squared residuals of the readings."""
        return float(self.residuals @ self.residuals)


def limited_step(matrix: np.ndarray, right: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the ``step`` (m,) that minimises ``|matrix step - right|`` between limits (m,), which contain zero."""
    from scipy.optimize import lsq_linear

    free = np.linalg.lstsq(matrix, right, rcond=None)[0]
    if ((free >= low) & (free <= high)).all():
        return free
    # The solver needs intervals that are not empty.
    low, high = low - 1e-12, high + 1e-12
    return np.clip(lsq_linear(matrix, right, (low, high), method="bvls").x, low, high)


def most_probable(
    predict: Linearised,
    readings: np.ndarray,
    noise: np.ndarray,
    prior: Gaussian,
    *,
    start: np.ndarray | None = None,
    iterations: int = 20,
    tolerance: float = 1e-3,
) -> Posterior:
    """Return the maximum of the posterior and its Laplace approximation.

    Args:
        predict: readings and their exact derivative at some parameters.
        readings: shape (k,).
        noise: their standard deviations, shape (k,).
        prior: distribution of the parameters before the readings.
        start: first parameters, shape (m,); default: the mean of the prior.
        iterations: largest number of Gauss-Newton steps.
        tolerance: length of the last step, in standard deviations of the prior.

    Raises:
        ValueError: if a standard deviation of the noise is not positive, or the prior's covariance is not definite.
    """
    if not (noise > 0.0).all():
        raise ValueError(f"standard deviations of readings must be positive, got {noise.tolist()}")
    try:
        factor = np.linalg.inv(np.linalg.cholesky(prior.covariance))
    except np.linalg.LinAlgError:
        raise ValueError("the covariance of the prior is not positive definite") from None
    spread = np.sqrt(np.diag(prior.covariance))

    def linearise(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        predicted, slope = predict(parameters)
        residual = np.concatenate([(readings - predicted) / noise, factor @ (prior.mean - parameters)])
        return residual, np.vstack([slope / noise[:, None], factor]), float(residual @ residual)

    parameters = np.clip(prior.mean if start is None else start, prior.low, prior.high)
    residual, matrix, cost = linearise(parameters)
    taken, converged = 0, False
    while taken < iterations and not converged:
        step = limited_step(matrix, residual, prior.low - parameters, prior.high - parameters)
        converged = bool((np.abs(step) <= tolerance * spread).all())
        length = 1.0
        while True:
            moved = np.clip(parameters + length * step, prior.low, prior.high)
            trial = linearise(moved)
            if trial[2] <= cost or length < 0.1:
                break
            length *= 0.5
        taken += 1
        if trial[2] > cost:  # round-off, or a kink: no step along this direction is better
            linearise(parameters)
            break
        parameters, (residual, matrix, cost) = moved, trial
    covariance = np.linalg.inv(matrix.T @ matrix)
    mean = parameters + np.linalg.lstsq(matrix, residual, rcond=None)[0]
    return Posterior(
        mode=parameters,
        parameters=Gaussian(mean, 0.5 * (covariance + covariance.T), prior.low, prior.high),
        residuals=residual[: len(readings)],
        cost=cost,
        iterations=taken,
        converged=converged,
    )
