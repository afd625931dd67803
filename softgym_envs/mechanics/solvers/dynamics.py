"""Implicit time stepping of solids, beams and rigid parts together.

The mass matrix is constant between rows (see `frames`: directors carry the rotary inertia), and inertia joins the
static equilibrium at the end of the step: the same Newton method, constraints, bonds and cables that cannot push. The
condensed model is that of the thesis' dynamic case (eq. 2.5-2.13), where ``A`` holds mass and damping of the step.

* ``"euler"``: implicit Euler in its variational form, the minimum of ``E(x) + |x - x_n - h v_n|_M^2 / (2 h^2)`` over
  what the frames allow. First order, damps what moves fast. Its tangent is symmetric and exact, so ``W`` is the
  derivative of where the step ends.
* ``"generalised_alpha"``: second order, with a chosen damping of the fastest motions (Chung and Hulbert 1993; for
  frames and constraints Arnold and Bruels 2007, Bruels and Cardona 2010). ``spectral_radius`` 1 is the trapezoidal
  rule, which damps nothing. The tangent leaves out the gyroscopic terms of turning frames: Newton's method converges
  linearly on them, and ``W`` is exact but for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.model import Inertia, MechanicalModel
from softgym_envs.mechanics.solvers.statics import Equilibrium, Statics, _NotFound

__all__ = ["SCHEMES", "Dynamics", "Motion"]

SCHEMES = ("euler", "generalised_alpha")
"""Names of the time integration schemes."""


class _Euler(Inertia):
    """Implicit Euler from rows ``x`` with velocities ``v`` over ``h``."""

    def __init__(self, x: np.ndarray, v: np.ndarray, h: float) -> None:
        self._x, self._v, self._h = x, v, h
        self.step = h
        self.velocity_factor, self.acceleration_factor = 1.0 / h, 1.0 / h**2

    def motion(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        velocity = (x - self._x) / self._h
        return velocity, (velocity - self._v) / self._h


class _Start(Inertia):
    """The start of a motion, at rows ``x`` with velocities of the equations ``v``: a step of ``h^2`` accelerations."""

    def __init__(self, model: MechanicalModel, x: np.ndarray, v: np.ndarray, h: float) -> None:
        self._motion = model.row_velocity(x, v), model.row_acceleration(x, v, np.zeros_like(v))
        self.velocity_factor, self.acceleration_factor = 0.0, 1.0 / h**2

    def motion(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._motion


class _Alpha(Inertia):
    """Generalised alpha; histories are kept in the equations, in which frames have spins instead of directors.

    Args:
        model: the body.
        x: rows at the start of the step [m], shape (n, 3).
        v: velocities of the equations, shape (N,).
        true: their derivatives at the start, shape (N,).
        a: the scheme's auxiliary accelerations, shape (N,).
        h: step [s].
        radius: spectral radius at infinite frequency, 0 to 1.
    """

    def __init__(
        self,
        model: MechanicalModel,
        x: np.ndarray,
        v: np.ndarray,
        true: np.ndarray,
        a: np.ndarray,
        h: float,
        radius: float,
    ) -> None:
        self._model, self._x, self._v, self._true, self._a, self._h = model, x, v, true, a, h
        self._am, self._af = (2.0 * radius - 1.0) / (radius + 1.0), radius / (radius + 1.0)
        self._gamma = 0.5 - self._am + self._af
        self._beta = 0.25 * (self._gamma + 0.5) ** 2
        self.step = h
        self.velocity_factor = self._gamma / (self._beta * h)
        self.acceleration_factor = (1.0 - self._am) / ((1.0 - self._af) * self._beta * h**2)

    def equations(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Velocities, their derivatives and auxiliary accelerations of the equations at the end, each (N,)."""
        h, step = self._h, self._model.increment(self._x, x)
        a = ((step - h * self._v) / h**2 - (0.5 - self._beta) * self._a) / self._beta
        v = self._v + h * ((1.0 - self._gamma) * self._a + self._gamma * a)
        true = ((1.0 - self._am) * a + self._am * self._a - self._af * self._true) / (1.0 - self._af)
        return v, true, a

    def motion(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        v, true, _ = self.equations(x)
        return self._model.row_velocity(x, v), self._model.row_acceleration(x, v, true)


@dataclass(frozen=True)
class Motion:
    """A state in motion.

    Attributes:
        equilibrium: rows, efforts and condensed model at the end of the step.
        velocity: of the rows [m/s], shape (n, 3).
        time: [s].
        kinetic: kinetic energy [J].
        potential: elastic energy and potential of the dead loads [J].
        work: done by actuators and driven contacts since the start [J].
        dissipated: by Rayleigh damping since the start [J].
        substeps: time steps that were needed; more than one where the step had to be cut.
    """

    equilibrium: Equilibrium
    velocity: np.ndarray
    time: float
    kinetic: float
    potential: float
    work: float
    dissipated: float
    substeps: int

    @property
    def energy(self) -> float:
        """Kinetic plus potential energy [J]."""
        return self.kinetic + self.potential


class Dynamics(Statics):
    """Follows the motion of a model under changing commands.

    Args:
        model: the body.
        step: time step [s].
        scheme: a name of `SCHEMES`.
        spectral_radius: of the generalised alpha scheme: 1 damps nothing, 0 all that the step does not resolve.
        mass_damping: Rayleigh's alpha [1/s].
        stiffness_damping: Rayleigh's beta [s], on the stiffness against strain rates at the start of each step.
        lumped: lump the masses.
        tolerance: largest correction of any node left at convergence [m].
        max_iterations: Newton iterations per load increment.
        max_cuts: how often a step that cannot be solved is halved.

    Attributes:
        velocity: present velocity of the rows [m/s], shape (n, 3).
        time: [s].

    Raises:
        ValueError: for an unknown scheme, a step that is not positive or a negative damping.
    """

    def __init__(
        self,
        model: MechanicalModel,
        *,
        step: float,
        scheme: str = "euler",
        spectral_radius: float = 0.9,
        mass_damping: float = 0.0,
        stiffness_damping: float = 0.0,
        lumped: bool = False,
        tolerance: float = 1e-11,
        max_iterations: int = 30,
        max_cuts: int = 6,
    ) -> None:
        if scheme not in SCHEMES:
            raise ValueError(f"scheme = {scheme!r} is unknown; allowed: {', '.join(SCHEMES)}")
        if not (np.isfinite(step) and step > 0.0):
            raise ValueError(f"step = {step} s must be positive and finite")
        for name, value in (("mass_damping", mass_damping), ("stiffness_damping", stiffness_damping)):
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} = {value} must be finite and not negative")
        self.step = float(step)
        if not 0.0 <= spectral_radius <= 1.0:
            raise ValueError(f"spectral_radius = {spectral_radius} is out of bounds; allowed: [0, 1]")
        self.scheme = scheme
        self.spectral_radius = float(spectral_radius)
        self.mass_damping = float(mass_damping)
        self.stiffness_damping = float(stiffness_damping)
        self.max_cuts = max_cuts
        super().__init__(model, tolerance=tolerance, max_iterations=max_iterations, max_halvings=2)
        self._mass = model.mass_matrix(lumped)
        self._lumped = lumped

    def reset(self) -> None:
        super().reset()
        self.rest()

    def rest(self) -> None:
        """Stop all motion where the body is; time and energies start anew."""
        self.velocity = np.zeros_like(self.x)
        self.time = 0.0
        self._history: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        self._work = self._dissipated = 0.0

    def restore(self, x: np.ndarray, effort: np.ndarray, velocity: np.ndarray | None = None) -> None:
        """Start from rows ``x`` (n, 3), efforts (size,) and velocities (n, 3), by default at rest."""
        super().restore(x, effort)
        self.rest()
        if velocity is not None:
            self.velocity = velocity.copy()
            self._history = None

    def launch(self, velocity: np.ndarray) -> None:
        """Set the velocity of the equations: of free rows [m/s] and frames' spins [rad/s], shape (equations,)."""
        velocity = np.asarray(velocity, dtype=float)
        if velocity.shape != (self.model.equations,):
            raise ValueError(f"velocity must have shape ({self.model.equations},), got {velocity.shape}")
        self.velocity = self.model.row_velocity(self.x, velocity)
        self._history = None

    @property
    def snapshot(self) -> tuple:
        """All that a step starts from; assign it to take steps back."""
        return (
            self.x,
            self.effort,
            self.velocity,
            self.time,
            self._history,
            self._work,
            self._dissipated,
        )

    @snapshot.setter
    def snapshot(self, kept: tuple) -> None:
        self.x, self.effort, self.velocity, self.time, self._history, self._work, self._dissipated = kept
        self._fresh = False

    def effector_velocity(self) -> np.ndarray:
        """Velocity of the effector rows [m/s], shape (n_e,)."""
        parts = [c.jacobian(self.x) @ self.velocity.ravel()[c.dofs] for c in self.model.constraints["e"]]
        return np.concatenate([np.zeros(0), *parts])

    def energies(self) -> tuple[float, float]:
        """Kinetic and potential energy [J] of the present state."""
        return 0.5 * float(np.vdot(self.velocity, self._mass @ self.velocity)), self.model.energy(self.x)

    def advance(
        self,
        target: Sequence[float] | np.ndarray,
        mode: str | Sequence[str] = "displacement",
        *,
        effector_force: Sequence[float] | np.ndarray | None = None,
        contact: Sequence[float] | np.ndarray | None = None,
        contact_mode: str = "effort",
    ) -> Motion:
        """Go one time step further; arguments as for `Statics.solve`, reached at the end of the step.

        A step that cannot be solved is cut into halves, along which commands are ramped.

        Raises:
            ConvergenceError: if that does not help either; the state at the start of the step is kept.
            ValueError: as `Statics.solve`.
        """
        target = np.asarray(target, dtype=float)
        options = {"effector_force": effector_force, "contact": contact, "contact_mode": contact_mode}
        start = self.snapshot
        first = self._present_command(mode)
        for cut in range(self.max_cuts + 1):
            count = 2**cut
            try:
                for k in range(count):
                    # The last one takes the target itself: no round-off.
                    part = target if k == count - 1 else first + (k + 1) / count * (target - first)
                    found = self._advance(part, mode, self.step / count, options)
                break
            except ConvergenceError:
                self.snapshot = start
                if cut == self.max_cuts:
                    raise ConvergenceError(
                        f"no motion over {self.step:g} s to actuators {target.tolist()}, even in {count} steps",
                        fraction=0.0,
                    ) from None
            except BaseException:
                # Whatever stopped it, a refused command or Ctrl-C: the body has not moved.
                self.snapshot = start
                raise
        kinetic, potential = self.energies()
        return Motion(
            found, self.velocity.copy(), self.time, kinetic, potential, self._work, self._dissipated, substeps=count
        )

    def _displacement_rows(self, mode: str | Sequence[str]) -> np.ndarray:
        modes = [mode] * self._actuators if isinstance(mode, str) else list(mode)
        return np.array([i for i, m in enumerate(modes) if m == "displacement"], dtype=int)

    def _move(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        # Steps in time are short: warping them costs more than it saves.
        return self.model.displace(x, step)

    def _present_command(self, mode: str | Sequence[str]) -> np.ndarray:
        command, rows = self.effort[: self._actuators].copy(), self._displacement_rows(mode)
        command[rows] = self._rows_delta()[rows]
        return command

    def _advance(self, target: np.ndarray, mode: str | Sequence[str], h: float, options: dict) -> Equilibrium:
        x, v, effort = self.x, self.velocity, self.effort
        terms: _Euler | _Alpha
        if self.scheme == "euler":
            terms = _Euler(x, v, h)
        else:
            if self._history is None:
                acceleration = self._starting_acceleration(target, mode)
                self._history = self.model.equation_velocity(x, v), acceleration, acceleration
            terms = _Alpha(self.model, x, *self._history, h, self.spectral_radius)
        terms.mass_damping, terms.stiffness_damping = self.mass_damping, self.stiffness_damping
        if self.stiffness_damping:
            terms.stiffness = self.model.viscosity(x)
        kept = self._rows_delta()
        found = self._solve_with(terms, target, mode, options)
        self.velocity = terms.motion(self.x)[0]
        if isinstance(terms, _Alpha):
            self._history = terms.equations(self.x)
        self.time += h
        rows = self._moving
        self._work += float(0.5 * (effort + self.effort)[rows] @ (found.delta - kept)[rows])
        drag = self.mass_damping * (self._mass @ self.velocity)
        if self.stiffness_damping:
            drag = drag + self.model.damping_force(terms, self.velocity)
        self._dissipated += float(np.vdot(drag, self.x - x))
        return found

    def _solve_with(
        self, terms: _Euler | _Alpha, target: np.ndarray, mode: str | Sequence[str], options: dict
    ) -> Equilibrium:
        self._fresh = False
        # Dead loads act in full: their ramp belongs to statics.
        self._carried = self.model.loads
        self.model.mass_matrix(self._lumped)
        self.model.inertia = terms
        # What moves is likely to move on; where that inverts an element, the step starts where it is.
        kept = self.x
        drift = terms.step * self.model.equation_velocity(kept, self.velocity)
        self.x = kept + self.model.displace(kept, drift)
        try:
            if not self._linearise():
                self.x = kept
            return self.solve(target, mode, **options)
        except ConvergenceError:
            self.x = kept
            raise
        finally:
            self.model.inertia = None
            self._fresh = False

    def _starting_acceleration(self, target: np.ndarray, mode: str | Sequence[str]) -> np.ndarray:
        """Accelerations of the equations at the start, (N,): efforts as they are, driven rows move on steadily."""
        h = 1e-3 * self.step
        speed = self.model.equation_velocity(self.x, self.velocity)
        terms = _Start(self.model, self.x, speed, h)
        terms.mass_damping, terms.stiffness_damping = self.mass_damping, self.stiffness_damping
        if self.stiffness_damping:
            terms.stiffness = self.model.viscosity(self.x)
        delta = self._rows_delta()
        rows = self._displacement_rows(mode)
        # A cable that hangs slack goes on doing so.
        slack = self.unilateral[rows] & (self.effort[rows] <= 0.0) & (delta[rows] > target[rows])
        driven = np.concatenate([rows[~slack], self._bonds])
        # Along a steady motion a driven value changes by h^2 times this; the acceleration makes up for it.
        before, after = (
            self._rows_delta(self.x + self.model.displace(self.x, s * self.step * speed)) for s in (-0.01, 0.01)
        )
        change = (before - 2.0 * delta + after) / (0.01 * self.step) ** 2
        goal = self.effort.copy()
        goal[driven] = -(h**2) * change[driven]
        self.model.mass_matrix(self._lumped)
        self.model.applied_loads = self.model.loads
        self.model.inertia = terms
        try:
            if not self._linearise():
                raise ConvergenceError("the starting state has inverted elements or a singular tangent", fraction=0.0)
            step, _ = self._correction(self._Ar, np.zeros_like(delta), self.effort, goal, driven)
        except _NotFound:
            raise ConvergenceError("the starting state has no single acceleration", fraction=0.0) from None
        finally:
            self.model.inertia = None
            self._fresh = False
        return step / h**2

    @property
    def _moving(self) -> np.ndarray:
        return np.concatenate([np.arange(self._actuators), self._effectors, self._contacts])

    def _rows_delta(self, x: np.ndarray | None = None) -> np.ndarray:
        x = self.x if x is None else x
        return np.concatenate([np.zeros(0), *(c.value(x) for c, _ in self.model.rows)])
