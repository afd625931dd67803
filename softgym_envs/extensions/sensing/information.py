"""How much sensors tell about a touch: the Fisher information of an estimate."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softgym_envs.extensions.sensing.estimator import held_response
from softgym_envs.extensions.sensing.posterior import Gaussian
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import TOUCH_RADIUS, Robot


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


def touch_slopes(
    robot: Robot, points: np.ndarray, normal: np.ndarray, command: np.ndarray, design: Mapping[str, float] | None = None
) -> np.ndarray:
    """Return how cavities respond to light touches, one at a time, of a body with held actuators.

    Args:
        robot: a robot with cavities as sensors.
        points: touched places of the undeformed body [m], shape (p, 3).
        normal: direction of the forces, shape (3,).
        command: displacements of the actuators, shape (n_a,).
        design: missing variables take their baseline.

    Returns:
        Derivatives of the volumes [m3] by the displacements of the actuators [m] and the force of the touch [N], shape
        (p, n_s, n_a + 1).

    Raises:
        DesignError: for a malformed design.
        InfeasibleDesign: if the geometry cannot exist.
        ConvergenceError: if there is no equilibrium.
        ValueError: if a point lies outside the body.
    """
    model = robot.build(design)
    for number, point in enumerate(points):
        model.add_contact(f"touch_{number}", point, radius=TOUCH_RADIUS)
    state = Statics(model).solve(command)
    sizes, condensed = dict(model.roles), state.condensed
    response = held_response(condensed, state.slack)[0][condensed.slices["s"]]
    n_a, first = sizes["a"], sizes["a"] + sizes.get("e", 0)
    by_force = response[:, first:].reshape(len(response), len(points), 3) @ normal
    return np.stack([np.column_stack([response[:, :n_a], by_force[:, k]]) for k in range(len(points))])
