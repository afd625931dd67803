"""Time integration schemes: velocities and accelerations at the end of a step as functions of where it ends."""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.assembly import Inertia, MassAndDamping
from softgym_envs.mechanics.kinematics import Kinematics

SCHEMES = ("euler", "generalised_alpha")
"""Names of the time integration schemes."""


class ImplicitEuler(Inertia):
    """Implicit Euler from rows ``x`` (n, 3) with velocities of the rows ``v`` (n, 3) over ``h`` [s]."""

    def __init__(self, x: np.ndarray, v: np.ndarray, h: float, body: MassAndDamping) -> None:
        self.start, self._v, self._h = x, v, h
        self.body = body
        self.velocity_factor, self.acceleration_factor = 1.0 / h, 1.0 / h**2

    def motion(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        velocity = (x - self.start) / self._h
        return velocity, (velocity - self._v) / self._h

    def middle(self, x: np.ndarray) -> np.ndarray:
        return 0.5 * (self.start + x)


class StartingAcceleration(Inertia):
    """Scheme that finds accelerations at rows ``x`` and velocities ``v`` (N,): a step is ``h^2`` times them."""

    def __init__(self, kinematics: Kinematics, x: np.ndarray, v: np.ndarray, h: float, body: MassAndDamping) -> None:
        self._motion = kinematics.row_velocity(x, v), kinematics.row_acceleration(x, v, np.zeros_like(v))
        self.start, self.body = x, body
        self.velocity_factor, self.acceleration_factor = 0.0, 1.0 / h**2

    def motion(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._motion

    def middle(self, x: np.ndarray) -> np.ndarray:
        return x


class GeneralisedAlpha(Inertia):
    """Generalised alpha; its history is kept in the equations, in which frames have spins instead of directors.

    Args:
        kinematics: degrees of freedom of the body.
        x: rows at the start of the step [m], shape (n, 3).
        v: velocities of the equations, shape (N,).
        acceleration: their derivatives at the start, shape (N,).
        a: auxiliary accelerations of the scheme, shape (N,).
        h: step [s].
        radius: spectral radius at infinite frequency, 0 to 1.
        body: mass and damping.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        x: np.ndarray,
        v: np.ndarray,
        acceleration: np.ndarray,
        a: np.ndarray,
        h: float,
        radius: float,
        body: MassAndDamping,
    ) -> None:
        self._kinematics, self.start, self._v, self._a, self._h = kinematics, x, v, a, h
        self._acceleration = acceleration
        self._am, self._af = (2.0 * radius - 1.0) / (radius + 1.0), radius / (radius + 1.0)
        self._gamma = 0.5 - self._am + self._af
        self._beta = 0.25 * (self._gamma + 0.5) ** 2
        self.body = body
        self.velocity_factor = self._gamma / (self._beta * h)
        self.acceleration_factor = (1.0 - self._am) / ((1.0 - self._af) * self._beta * h**2)

    def equations(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Velocities, their derivatives and auxiliary accelerations of the equations at the end, each (N,)."""
        h, step = self._h, self._kinematics.increment(self.start, x)
        a = ((step - h * self._v) / h**2 - (0.5 - self._beta) * self._a) / self._beta
        v = self._v + h * ((1.0 - self._gamma) * self._a + self._gamma * a)
        acceleration = ((1.0 - self._am) * a + self._am * self._a - self._af * self._acceleration) / (1.0 - self._af)
        return v, acceleration, a

    def motion(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        v, acceleration, _ = self.equations(x)
        return self._kinematics.row_velocity(x, v), self._kinematics.row_acceleration(x, v, acceleration)

    def middle(self, x: np.ndarray) -> np.ndarray:
        return x
