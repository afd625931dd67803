"""A load of unknown size at an unknown place: a normal distribution of actuators and size at each of many places.

At a given place the readings are linear in the errors of the actuators and in the size of the load, so the
distribution at that place is exactly normal. Along the places, ``size x response(place)`` stays constant: a curve,
which the sum over places follows and one normal distribution of size and place cannot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr

from softgym_envs.estimation.posterior import Gaussian


@dataclass(frozen=True)
class Places:
    """Places at which a load may act.

    Attributes:
        coordinates: of each place, shape (q, m - 1).
        directions: forces on effectors and points under a load of size one, shape (q, n_f).
        shares: probability of each place before any reading, shape (q,).
    """

    coordinates: np.ndarray
    directions: np.ndarray
    shares: np.ndarray


@dataclass(frozen=True)
class Moments:
    """Means and covariances of a mixture.

    Attributes:
        displacement: errors of the actuators, shape (n_a,).
        load: size and place, shape (m,).
        load_covariance: shape (m, m).
        outputs: shape (o,).
        output_covariance: shape (o, o).
    """

    displacement: np.ndarray
    load: np.ndarray
    load_covariance: np.ndarray
    outputs: np.ndarray
    output_covariance: np.ndarray


@dataclass(frozen=True)
class Mixture:
    """Distribution of the errors of actuators and of the size of a load, at least 0, at each of q places.

    Attributes:
        places: where the load may act.
        logarithms: of the places' unnormalised weights, shape (q,).
        means: of actuators and size, before sizes below 0 are cut off, shape (q, n_a + 1).
        covariances: likewise, shape (q, n_a + 1, n_a + 1).
    """

    places: Places
    logarithms: np.ndarray
    means: np.ndarray
    covariances: np.ndarray

    @classmethod
    def before_readings(cls, places: Places, actuators: Gaussian, size: float) -> Mixture:
        """Return the distribution before any reading, from that of the actuators and the spread of the size."""
        count, n = len(places.shares), len(actuators.mean) + 1
        covariance = np.zeros((n, n))
        covariance[:-1, :-1], covariance[-1, -1] = actuators.covariance, size**2
        mean = np.append(actuators.mean, 0.0)
        return cls(places, np.log(places.shares), np.tile(mean, (count, 1)), np.tile(covariance, (count, 1, 1)))

    def after(self, measured: np.ndarray, spread: np.ndarray, base: np.ndarray, slopes: np.ndarray) -> Mixture:
        """Return the distribution after readings.

        Args:
            measured: readings, shape (k,).
            spread: their standard deviations, shape (k,).
            base: readings without errors and load, shape (k,), or at each place (q, k).
            slopes: their derivatives by errors and size at each place, shape (q, k, n_a + 1).
        """
        residuals = measured - base - np.einsum("qkn,qn->qk", slopes, self.means)
        crossed = np.einsum("qkn,qnm->qkm", slopes, self.covariances)
        innovation = np.einsum("qkm,qjm->qkj", crossed, slopes) + np.diag(spread**2)
        solved = np.linalg.solve(innovation, np.concatenate([residuals[:, :, None], crossed], axis=2))
        cost = np.einsum("qk,qk->q", residuals, solved[:, :, 0]) + np.linalg.slogdet(innovation)[1]
        means = self.means + np.einsum("qkn,qk->qn", crossed, solved[:, :, 0])
        covariances = self.covariances - np.einsum("qkn,qkm->qnm", crossed, solved[:, :, 1:])
        covariances = 0.5 * (covariances + covariances.transpose(0, 2, 1))
        return replace(self, logarithms=self.logarithms - 0.5 * cost, means=means, covariances=covariances)

    def moments(self, base: np.ndarray, slopes: np.ndarray) -> Moments:
        """Return means and covariances, also of outputs that depend on errors and size as `after` describes.

        Args:
            base: outputs without errors and load, shape (o,), or at each place (q, o).
            slopes: their derivatives by errors and size at each place, shape (q, o, n_a + 1).
        """
        spread = np.sqrt(self.covariances[:, -1, -1])
        ratio = self.means[:, -1] / spread
        inside = log_ndtr(ratio)
        weights = np.exp(self.logarithms + inside - (self.logarithms + inside).max())
        weights /= weights.sum()
        # A normal distribution without its values below 0 [Johnson, Kotz, Balakrishnan, 1994, sec. 13.10.1].
        density = np.exp(-0.5 * ratio**2 - inside) / np.sqrt(2.0 * np.pi)
        gain = self.covariances[:, :, -1] / spread[:, None]
        means = self.means + density[:, None] * gain
        covariances = self.covariances - (density * (ratio + density))[:, None, None] * gain[:, :, None] * gain[:, None]

        loads = np.column_stack([means[:, -1], self.places.coordinates])
        within = np.zeros((loads.shape[1], loads.shape[1]))
        within[0, 0] = weights @ covariances[:, -1, -1]
        outputs = base + np.einsum("qon,qn->qo", slopes, means)
        scatter = np.einsum("q,qon,qnm,qpm->op", weights, slopes, covariances, slopes, optimize=True)
        return Moments(
            displacement=weights @ means[:, :-1],
            load=weights @ loads,
            load_covariance=within + np.cov(loads.T, aweights=weights, bias=True),
            outputs=weights @ outputs,
            output_covariance=scatter + np.cov(outputs.T, aweights=weights, bias=True),
        )
