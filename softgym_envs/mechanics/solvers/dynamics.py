"""Implicit time stepping of solids, beams and rigid parts together.

A time step adds inertia to the static equilibrium at its end; Newton's method, constraints, bonds and unilateral cables
are those of `Statics`. The mass matrix between rows is constant (see `frames`: directors carry the rotary inertia).
The condensed model is that of the dynamic case (thesis, eq. 2.5-2.13): ``A`` includes mass and damping of the step.

* ``"euler"``: implicit Euler in its variational form, the minimum of ``E(x) + |x - x_n - h v_n|_M^2 / (2 h^2)`` over
  the motions that frames allow. First order; it damps fast motions. Its tangent is symmetric and exact, so ``W`` is the
  derivative of the end of the step.
* ``"generalised_alpha"``: second order, with a chosen damping of the fastest motions (Chung and Hulbert 1993; for
  frames and constraints Arnold and Bruels 2007, Bruels and Cardona 2010). ``spectral_radius`` 1 is the trapezoidal
  rule, which does not damp. The tangent omits the gyroscopic terms of rotating frames, and how the end of a step
  changes the strain rates at a given velocity: Newton's method then converges linearly, and ``W`` lacks these terms.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Unpack

import numpy as np

from softgym_envs.arguments import explained
from softgym_envs.errors import ConvergenceError, ImpossibleState
from softgym_envs.mechanics.assembly import Inertia, MassAndDamping
from softgym_envs.mechanics.contact.contact import ContactMemory
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.cable_friction import CableFriction, CableMemory
from softgym_envs.mechanics.solvers.equilibrium import AppliedLoads, Equilibrium, NewtonFailure
from softgym_envs.mechanics.solvers.schemes import SCHEMES, GeneralisedAlpha, ImplicitEuler, StartingAcceleration
from softgym_envs.mechanics.solvers.statics import Statics


@dataclass(frozen=True)
class Motion:
    """A state in motion.

    Attributes:
        equilibrium: rows, efforts and condensed model at the end of the step.
        velocity: of the rows [m/s], shape (n, 3).
        time: [s].
        kinetic: kinetic energy [J].
        potential: elastic energy, of contacts too, and potential of the dead loads [J].
        work: done by actuators and driven contacts since the start [J].
        dissipated: by Rayleigh damping, and by friction with obstacles, since the start [J].
        substeps: time steps that were needed; more than one if the step had to be divided.
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


@explained
class Dynamics(Statics):
    """Computes the motion of a model under changing commands.

    Args:
        model: the body.
        step: time step [s].
        scheme: a name of `SCHEMES`.
        spectral_radius: of the generalised alpha scheme; 1 does not damp, 0 damps motions too fast for the step most.
        mass_damping: Rayleigh's alpha [1/s].
        stiffness_damping: Rayleigh's beta [s], applied to the stiffness against rates of strain, which are zero in any
            rigid motion.
        lumped: lump the masses.
        tolerance: largest remaining correction of any node at convergence [m].
        max_iterations: limit of Newton iterations per load increment.
        max_cuts: how often a step that cannot be solved is halved.
        compiled: take implicit Euler steps of bodies of beams in compiled code (`BeamMotion`), which is many times
            faster and gives the same motion to the tolerance.

    Attributes:
        velocity: current velocity of the rows [m/s], shape (n, 3).
        time: [s].

    Raises:
        ValueError: for an unknown scheme, a step that is not positive or a negative damping.
    """

    _moving = True

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
        compiled: bool = True,
    ) -> None:
        if scheme not in SCHEMES:
            raise ValueError(f"scheme = {scheme!r} is unknown; allowed: {', '.join(SCHEMES)}")
        if not (np.isfinite(step) and step > 0.0):
            raise ValueError(f"step = {step} s must be positive and finite")
        for name, value in (("mass_damping", mass_damping), ("stiffness_damping", stiffness_damping)):
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} = {value} must be finite and not negative")
        if model.contact is not None and scheme != "euler":
            raise ValueError(
                f"scheme = {scheme!r} does not damp the fast motions that barriers of contact cause, which grow; with "
                "contact use 'euler'"
            )
        if CableFriction.of(model) is not None:
            raise ValueError("cables with friction are computed in statics only; allowed: dynamics with friction = 0")
        if any(constraint.compliance for constraint, _ in model.rows):
            raise ValueError(
                "drives with compliance are computed in statics only; allowed: dynamics with compliance = 0"
            )
        self.step = float(step)
        if not 0.0 <= spectral_radius <= 1.0:
            raise ValueError(f"spectral_radius = {spectral_radius} is out of bounds; allowed: [0, 1]")
        self.scheme = scheme
        self.spectral_radius = float(spectral_radius)
        self.mass_damping = float(mass_damping)
        self.stiffness_damping = float(stiffness_damping)
        self.max_cuts = max_cuts
        super().__init__(
            model,
            tolerance=tolerance,
            max_iterations=max_iterations,
            max_halvings=2,
            compiled=compiled and scheme == "euler",
        )
        self._mass = self._assembly.mass_matrix(lumped)
        self._body = MassAndDamping(self._mass, self.mass_damping, self.stiffness_damping)
        self._lumped = lumped

    def reset(self) -> None:
        super().reset()
        self.rest()

    def rest(self) -> None:
        """Stop all motion in the current shape, and set time and energies to zero."""
        self.velocity = np.zeros_like(self.x)
        self.time = 0.0
        self._history: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        self._work = self._dissipated = 0.0

    def restore(
        self,
        x: np.ndarray,
        effort: np.ndarray,
        velocity: np.ndarray | None = None,
        *,
        memory: ContactMemory | CableMemory | None = None,
    ) -> None:
        """Start from rows ``x`` (n, 3), efforts (size,) and velocities (n, 3), by default at rest; see `Statics`."""
        super().restore(x, effort, memory=memory)
        self.rest()
        if velocity is not None:
            self.velocity = velocity.copy()
            self._history = None

    def launch(self, velocity: np.ndarray) -> None:
        """Set the velocity of the equations: of free rows [m/s] and frames' spins [rad/s], shape (equations,)."""
        velocity = np.asarray(velocity, dtype=float)
        if velocity.shape != (self.model.equations,):
            raise ValueError(f"velocity must have shape ({self.model.equations},), got {velocity.shape}")
        self.velocity = self.model.kinematics.row_velocity(self.x, velocity)
        self._history = None

    @property
    def snapshot(self) -> tuple:
        """State that a step starts from; assign it to undo steps."""
        return (
            self.x,
            self.effort,
            self.velocity,
            self.time,
            self._history,
            self._work,
            self._dissipated,
            None if self.linearisation.contact is None else self.linearisation.contact.memory,
        )

    @snapshot.setter
    def snapshot(self, kept: tuple) -> None:
        self.x, self.effort, self.velocity, self.time, self._history, self._work, self._dissipated, memory = kept
        self._remember(memory)

    def effector_velocity(self) -> np.ndarray:
        """Velocity of the effector rows [m/s], shape (n_e,)."""
        parts = [c.jacobian(self.x) @ self.velocity.ravel()[c.dofs] for c in self.model.constraints["e"]]
        return np.concatenate([np.zeros(0), *parts])

    def energies(self) -> tuple[float, float]:
        """Kinetic and potential energy [J] of the current state."""
        potential = self.model.energy(self.x)
        if self.linearisation.contact is not None:
            potential += self.linearisation.contact.stored_energy(self.x)
        return 0.5 * float(np.vdot(self.velocity, self._mass.rows @ self.velocity)), potential

    def advance(
        self,
        target: Sequence[float] | np.ndarray,
        mode: str | Sequence[str] = "displacement",
        **applied: Unpack[AppliedLoads],
    ) -> Motion:
        """Advance by one time step; arguments as for `Statics.solve`, reached at the end of the step.

        A step that cannot be solved is divided into halves, along which commands are ramped.

        Raises:
            ConvergenceError: if the halves cannot be solved either; the state at the start of the step is kept.
            ValueError: as `Statics.solve`.
        """
        target = np.asarray(target, dtype=float)
        _, motion = self.advance_compiled(target[None], mode, **applied)
        if motion is not None:
            return motion
        start = self.snapshot
        first = self._current_command(mode)
        for cut in range(self.max_cuts + 1):
            count = 2**cut
            try:
                for k in range(count):
                    # The last step takes the target itself, to avoid round-off.
                    part = target if k == count - 1 else first + (k + 1) / count * (target - first)
                    found = self._advance(part, mode, self.step / count, applied)
                break
            except ConvergenceError as problem:
                self.snapshot = start
                if isinstance(problem, ImpossibleState):
                    raise
                if cut == self.max_cuts:
                    raise ConvergenceError(
                        f"cannot advance {self.step:g} s to actuators {target.tolist()}, even in {count} steps",
                        fraction=0.0,
                    ) from None
            except BaseException:
                # Any exception, such as an invalid command or Ctrl-C, leaves the body where it was.
                self.snapshot = start
                raise
        kinetic, potential = self.energies()
        return Motion(
            found, self.velocity.copy(), self.time, kinetic, potential, self._work, self._dissipated, substeps=count
        )

    def advance_compiled(
        self,
        targets: np.ndarray,
        mode: str | Sequence[str] = "displacement",
        *,
        largest_effort: np.ndarray | None = None,
        **applied: Unpack[AppliedLoads],
    ) -> tuple[int, Motion | None]:
        """Advance by time steps in one compiled call, as far as that can solve them.

        Args:
            targets: arguments of `advance` for each time step, shape (k, n_a).
            mode: as for `advance`.
            largest_effort: of each actuator, shape (n_a,): one whose commanded displacement needs more is driven by
                that effort, until the command asks for less. Default none.
            **applied: as for `advance`.

        Returns:
            How many of the time steps were taken, and the last one if all were.
        """
        special, load = self.compiled_solver(), applied.get("effector_force")
        modes = [mode] * self._actuators if isinstance(mode, str) else list(mode)
        known = len(modes) == self._actuators and all(m in ("displacement", "effort") for m in modes)
        if special is None or not known or applied.get("contact") is not None or targets.shape[1] != self._actuators:
            return 0, None
        is_driven = np.zeros(len(self.effort), dtype=bool)
        is_driven[: self._actuators] = [m == "displacement" for m in modes]
        pushed = self.unilateral & ~is_driven[: self._actuators]
        if (targets[:, pushed] < 0.0).any():
            return 0, None
        goals = np.zeros((len(targets), len(self.effort)))
        goals[:, : self._actuators] = targets
        if load is not None:
            if np.shape(load) != self._effectors.shape:
                return 0, None
            goals[:, self._effectors] = load
        if not np.isfinite(goals).all():
            return 0, None
        loads = self.model.loads
        found = special.march(
            self.x,
            self.velocity,
            self.effort,
            goals,
            is_driven,
            self.unilateral,
            limit=np.zeros(0) if largest_effort is None else largest_effort,
            loads=loads,
            step=self.step,
            mass_damping=self.mass_damping,
            stiffness_damping=self.stiffness_damping,
            tolerance=self.tolerance,
            cuts=self.max_cuts,
            memory=None if self.linearisation.contact is None else self.linearisation.contact.memory,
        )
        if not found.taken:
            return 0, None
        self.x, self.velocity, self.effort = found.x, found.velocity, found.effort
        self.linearisation.loads = loads
        self.linearisation.current = False
        if found.memory is not None:
            self._remember(found.memory)
        self.time += found.taken * self.step
        self._work += found.work
        self._dissipated += found.dissipated
        if not found.solved:
            return found.taken, None
        equilibrium = self._layout.equilibrium(
            found.x.copy(),
            found.effort.copy(),
            found.delta,
            found.compliance,
            self._layout.slack(found.effort, found.delta, targets[-1], np.flatnonzero(is_driven), self.unilateral),
            stable=found.stable,
            iterations=found.iterations,
            symmetric=not found.slides,
            contacts=found.contacts,
            memory=found.memory,
        )
        potential = found.elastic - float(np.vdot(loads, found.x - self.model.nodes))
        velocity = found.velocity.copy()
        return found.taken, Motion(
            equilibrium,
            velocity,
            self.time,
            found.kinetic,
            potential,
            self._work,
            self._dissipated,
            substeps=found.parts,
        )

    def _displacement_rows(self, mode: str | Sequence[str]) -> np.ndarray:
        """Actuator rows that are driven in displacement."""
        modes = [mode] * self._actuators if isinstance(mode, str) else list(mode)
        return np.array([i for i, m in enumerate(modes) if m == "displacement"], dtype=int)

    def _displacement(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        # Steps in time are short: warping them costs more than it saves.
        return self.model.kinematics.displacement(x, step)

    def _current_command(self, mode: str | Sequence[str]) -> np.ndarray:
        command, rows = self.effort[: self._actuators].copy(), self._displacement_rows(mode)
        command[rows] = self._values(self.x)[rows]
        return command

    def _advance(self, target: np.ndarray, mode: str | Sequence[str], h: float, applied: AppliedLoads) -> Equilibrium:
        """Take one time step of ``h`` [s]; after an exception the caller restores the state."""
        x, v, effort = self.x, self.velocity, self.effort
        body = self._body
        inertia: ImplicitEuler | GeneralisedAlpha
        if self.scheme == "euler":
            inertia = ImplicitEuler(x, v, h, body)
        else:
            if self._history is None:
                acceleration = self._starting_acceleration(target, mode)
                self._history = self.model.kinematics.equation_velocity(x, v), acceleration, acceleration
            inertia = GeneralisedAlpha(self.model.kinematics, x, *self._history, h, self.spectral_radius, body)
        before = self._values(x)
        found = self._solve_with(inertia, h, target, mode, applied)
        self.velocity = inertia.motion(self.x)[0]
        if isinstance(inertia, GeneralisedAlpha):
            self._history = inertia.equations(self.x)
        self.time += h
        rows = np.concatenate([np.arange(self._actuators), self._effectors, self._contacts])
        self._work += float(0.5 * (effort + self.effort)[rows] @ (found.delta - before)[rows])
        self._dissipated += h * self._assembly.dissipated_power(inertia, self.x)
        return found

    def _solve_with(
        self, inertia: Inertia, h: float, target: np.ndarray, mode: str | Sequence[str], applied: AppliedLoads
    ) -> Equilibrium:
        kinematics, start = self.model.kinematics, self.x
        # Start from where the current velocity leads, unless that inverts an element.
        drift = h * kinematics.equation_velocity(start, self.velocity)
        self.x = start + kinematics.displacement(start, drift)
        if self.linearisation.contact is not None and self.linearisation.contact.free_path(start, self.x) < 1.0:
            self.x = start
        try:
            with self._inertia_added(inertia):
                if not self._linearise():
                    self.x = start
                return self.solve(target, mode, **applied)
        except ConvergenceError:
            self.x = start
            raise

    @contextmanager
    def _inertia_added(self, inertia: Inertia) -> Iterator[None]:
        """Add inertia to the equilibrium, and apply dead loads in full: only statics ramps them."""
        self.linearisation.loads = self.model.loads
        self.linearisation.inertia = inertia
        self.linearisation.current = False
        try:
            yield
        finally:
            self.linearisation.inertia = None
            self.linearisation.current = False

    def _starting_acceleration(self, target: np.ndarray, mode: str | Sequence[str]) -> np.ndarray:
        """Accelerations of the equations (N,) at the start: efforts stay as they are, driven rows move steadily."""
        kinematics = self.model.kinematics
        h = 1e-3 * self.step
        speed = kinematics.equation_velocity(self.x, self.velocity)
        delta = self._values(self.x)
        rows = self._displacement_rows(mode)
        # A slack cable stays slack.
        slack = self.unilateral[rows] & (self.effort[rows] <= 0.0) & (delta[rows] > target[rows])
        driven = np.concatenate([rows[~slack], self._bonds])
        # Along a steady motion a driven value changes by h^2 times this; the acceleration compensates for it.
        before, after = (
            self._values(self.x + kinematics.displacement(self.x, s * self.step * speed)) for s in (-0.01, 0.01)
        )
        change = (before - 2.0 * delta + after) / (0.01 * self.step) ** 2
        goal = self.effort.copy()
        goal[driven] = -(h**2) * change[driven]
        with self._inertia_added(StartingAcceleration(kinematics, self.x, speed, h, self._body)):
            if not self._linearise():
                raise ConvergenceError("the starting state has inverted elements or a singular tangent", fraction=0.0)
            try:
                step, _ = self._correction(None, np.zeros_like(delta), self.effort, goal, driven)
            except NewtonFailure:
                raise ConvergenceError("the starting state has no unique acceleration", fraction=0.0) from None
        return step / h**2

    def _accept(self) -> None:
        contact = self.linearisation.contact
        if contact is None:
            super()._accept()
        else:
            self._dissipated += contact.commit(self.x)
