"""A load of unknown size at an unknown place: a normal distribution of actuators and size at each of many places.

At a given place the readings are linear in the errors of the actuators and in the size of the load, so the
distribution at that place is exactly normal. Along the places, ``size x response(place)`` stays constant: a curve,
which the sum over places follows and one normal distribution of size and place cannot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr

from softgym_envs.extensions.sensing.posterior import Gaussian


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
class Bend:
    """Second-order deviation of outputs, ``curvature y^2 / 2``, where ``y = axis (outputs - origin)``.

    Attributes:
        origin: shape (o,).
        axis: unit vector, shape (o,).
        curvature: shape (o,).
    """

    origin: np.ndarray
    axis: np.ndarray
    curvature: np.ndarray

    def apply(self, outputs: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the means (q, o) and covariances (q, o, o) of normally distributed outputs with their deviation."""
        along = covariances @ self.axis
        y, variance = (outputs - self.origin) @ self.axis, along @ self.axis
        bent = outputs + 0.5 * (y**2 + variance)[:, None] * self.curvature
        cross = y[:, None, None] * along[:, :, None] * self.curvature
        own = (y**2 * variance + 0.5 * variance**2)[:, None, None] * np.outer(self.curvature, self.curvature)
        return bent, covariances + cross + cross.transpose(0, 2, 1) + own


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

    def cut(self, offset: np.ndarray | float, slope: np.ndarray) -> Mixture:
        """Return the distribution where ``offset + slope (errors, size)`` is at least 0, as one with its exact moments.

        Args:
            offset: for all places, or at each (q,).
            slope: shape (n_a + 1,), or at each place (q, n_a + 1).
        """
        slope = np.broadcast_to(slope, self.means.shape)
        gain = np.einsum("qnm,qm->qn", self.covariances, slope)
        spread = np.sqrt(np.einsum("qn,qn->q", gain, slope))
        ratio = (offset + np.einsum("qn,qn->q", slope, self.means)) / spread
        inside = log_ndtr(ratio)
        # A normal distribution without its values below 0 [Johnson, Kotz, Balakrishnan, 1994, sec. 13.10.1].
        density = np.exp(-0.5 * ratio**2 - inside) / np.sqrt(2.0 * np.pi)
        gain = gain / spread[:, None]
        return replace(
            self,
            logarithms=self.logarithms + inside,
            means=self.means + density[:, None] * gain,
            covariances=self.covariances
            - (density * (ratio + density))[:, None, None] * gain[:, :, None] * gain[:, None],
        )

    def joined_with(self, other: Mixture) -> Mixture:
        """Return the sum of two distributions over the same places, with a normal one at each place."""
        logarithms = np.logaddexp(self.logarithms, other.logarithms)
        shares = [np.exp(part.logarithms - logarithms)[:, None] for part in (self, other)]
        means = shares[0] * self.means + shares[1] * other.means
        covariances = np.zeros_like(self.covariances)
        for share, part in zip(shares, (self, other), strict=True):
            away = part.means - means
            covariances += share[:, :, None] * (part.covariances + away[:, :, None] * away[:, None])
        return replace(self, logarithms=logarithms, means=means, covariances=covariances)

    def moments(self, base: np.ndarray, slopes: np.ndarray) -> Moments:
        """Return means and covariances, also of outputs that depend on errors and size as `after` describes.

        Args:
            base: outputs without errors and load, shape (o,), or at each place (q, o).
            slopes: their derivatives by errors and size at each place, shape (q, o, n_a + 1).
        """
        return joint_moments([(self, base, slopes)])


def joint_moments(parts: Sequence[tuple[Mixture, np.ndarray, np.ndarray]], bend: Bend | None = None) -> Moments:
    """Return the moments of a sum of distributions, whose sizes are at least 0.

    Args:
        parts: distribution, and base and slopes of the outputs as in `Mixture.moments`.
        bend: how the outputs deviate from these lines.
    """
    found = []
    for mixture, base, slopes in parts:
        positive = mixture.cut(0.0, np.append(np.zeros(mixture.means.shape[1] - 1), 1.0))
        outputs = base + np.einsum("qon,qn->qo", slopes, positive.means)
        scatter = np.einsum("qon,qnm,qpm->qop", slopes, positive.covariances, slopes, optimize=True)
        if bend is not None:
            outputs, scatter = bend.apply(outputs, scatter)
        loads = np.column_stack([positive.means[:, -1], mixture.places.coordinates])
        sizes = positive.covariances[:, -1, -1]
        found.append((positive.logarithms, positive.means[:, :-1], loads, sizes, outputs, scatter))
    logarithms, errors, loads, within, outputs, scatter = (
        np.concatenate(column) for column in zip(*found, strict=True)
    )
    weights = np.exp(logarithms - logarithms.max())
    weights /= weights.sum()
    covariance = np.cov(loads.T, aweights=weights, bias=True).reshape(loads.shape[1], -1)
    covariance[0, 0] += weights @ within
    return Moments(
        displacement=weights @ errors,
        load=weights @ loads,
        load_covariance=covariance,
        outputs=weights @ outputs,
        output_covariance=np.einsum("q,qop->op", weights, scatter) + np.cov(outputs.T, aweights=weights, bias=True),
    )
