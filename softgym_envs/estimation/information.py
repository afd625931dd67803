"""How much sensors tell about a touch: the Fisher information of an estimate."""

from __future__ import annotations

import numpy as np

from softgym_envs.estimation.posterior import Gaussian


def sensor_information(slope: np.ndarray, noise: np.ndarray, prior: Gaussian) -> float:
    """Return the information that readings add to a prior [nat]: half of ``log det(I + P J^T R^-1 J)``.

    It is half of the logarithm of the ratio of the determinants of the covariances before and after the readings.

    Args:
        slope: derivative ``J`` of the readings by the parameters, shape (k, m).
        noise: standard deviations of the readings, shape (k,), whose squares are the diagonal of ``R``.
        prior: of the parameters; ``P`` is its covariance (m, m).
    """
    factor = np.linalg.cholesky(prior.covariance)
    scaled = (slope / noise[:, None]) @ factor
    return 0.5 * float(np.linalg.slogdet(np.eye(len(prior.mean)) + scaled.T @ scaled)[1])
