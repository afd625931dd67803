"""Motions of bodies of beams that are recorded, and the gradients of what follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from softgym_envs.backends.fem import FEMBackend
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.beams.solver.adjoint import Adjoint, Tape, go_back, record
from softgym_envs.extensions.beams.solver.design import Neighbours, by_bodies
from softgym_envs.extensions.beams.solver.motion import BeamMotion, BeamState, Stepping, anchors_of, memory_of
from softgym_envs.extensions.beams.solver.newton import Drive
from softgym_envs.mechanics.contact.contact import ContactMemory
from softgym_envs.mechanics.solvers.dynamics import Dynamics

ROOM = 4
"""Time steps that can be recorded for each command: more are needed where steps are divided."""


class Gain(NamedTuple):
    """What a motion is worth to a task whose method ``gain`` rates motions.

    Attributes:
        way: what is to be large [m].
        value: the same less what is charged [m].
        by_x: derivative of the value by the rows after each time step, shape (k, n, 3).
        by_velocity: by their velocities [s], shape (k, n, 3).
    """

    way: float
    value: float
    by_x: np.ndarray
    by_velocity: np.ndarray


class Gradient(NamedTuple):
    """Derivatives of a scalar that depends on the states of a rollout.

    Attributes:
        commands: by the commands, shape (k, n_a).
        x: by the rows at the start, shape (n, 3). Only its product with motions that the body can make has a meaning.
        velocity: by the velocities of the rows at the start, shape (n, 3).
        design: by design variables, shape (d,); none where no neighbours of the body were given.
    """

    commands: np.ndarray
    x: np.ndarray
    velocity: np.ndarray
    design: np.ndarray


@dataclass(frozen=True)
class Rollout:
    """Time steps that were taken under commands.

    Attributes:
        dynamics: the solver, whose body has not changed since.
        x: rows after each command [m], shape (k, n, 3).
        velocity: their velocities [m/s], shape (k, n, 3).
        effort: efforts of all constraint rows, shape (k, size).
    """

    dynamics: Dynamics
    x: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    _tape: Tape
    _count: int
    _drive: Drive
    _stepping: Stepping

    def gradient(
        self,
        *,
        by_x: np.ndarray | None = None,
        by_velocity: np.ndarray | None = None,
        by_effort: np.ndarray | None = None,
        neighbours: Neighbours | None = None,
    ) -> Gradient:
        """Return the derivatives of a scalar, through contact and friction, at about the cost of the rollout.

        They are exact but where an event happens at exactly one of the times: where a point begins to touch or to
        slide, the scalar has a kink.

        Args:
            by_x: derivatives of the scalar by the rows after each command, shape (k, n, 3), or by the last ones alone,
                shape (n, 3); default zero.
            by_velocity: by the velocities of the rows, likewise.
            by_effort: by the efforts, shape (k, size) or (size,).
            neighbours: of the body, for derivatives by its design. A motion that began with `Statics.reset` begins with
                the shape at rest of any body; one that began elsewhere, with the frames where they were: how gravity
                bends other bodies before they move is left out, which is 6 % for a whip that hangs.

        Raises:
            ConvergenceError: if a tangent is singular.
            ValueError: for another shape, or neighbours of another body.
        """
        beams = self.dynamics.compiled_solver()
        assert isinstance(beams, BeamMotion)
        targets = np.zeros_like(self.effort)
        anchors = None if self._tape.anchors is None else np.zeros_like(self._tape.anchors[0])
        start = np.zeros_like(self.x[0]), np.zeros_like(self.x[0]), anchors
        steps = 0 if neighbours is None else self._count
        adjoint = Adjoint(
            np.zeros((steps, *beams.system.factor.step.shape)),
            np.zeros((steps, self.effort.shape[1])),
            None if anchors is None else np.zeros((steps, *anchors.shape)),
        )
        given = _over_time("by_x", by_x, self.x.shape), _over_time("by_velocity", by_velocity, self.x.shape)
        found = go_back(
            beams.system,
            beams.strains,
            self._tape,
            self._count,
            self._drive,
            self._stepping,
            *given,
            _over_time("by_effort", by_effort, self.effort.shape),
            targets,
            start,
            adjoint,
        )
        if not found:
            raise ConvergenceError("the tangent of a recorded time step is singular", fraction=0.0)
        actuators = sum(c.size for c in self.dynamics.model.constraints["a"])
        design = np.empty(0) if neighbours is None else self._by_design(neighbours, adjoint, given, start)
        return Gradient(targets[:, :actuators], start[0], start[1], design)

    def _by_design(
        self,
        neighbours: Neighbours,
        adjoint: Adjoint,
        given: tuple[np.ndarray, np.ndarray],
        start: tuple[np.ndarray, np.ndarray, np.ndarray | None],
    ) -> np.ndarray:
        """Return derivatives by design variables (d,) from the adjoint of the steps and derivatives by the start."""
        beams = self.dynamics.compiled_solver()
        assert isinstance(beams, BeamMotion)
        own, at_rest = self.dynamics.model.nodes, 1.0 if self._began_at_rest() else 0.0
        neighbours.check_like(beams.body)
        out = np.empty(len(neighbours.loads))
        found = by_bodies(
            neighbours.bodies,
            neighbours.loads,
            neighbours.nodes,
            own,
            beams.equations,
            beams.strains,
            self._tape,
            self._count,
            self._drive,
            self._stepping,
            adjoint,
            given,
            (start[0], start[2], at_rest),
            out,
        )
        if not found:
            raise ConvergenceError("a neighbour of the body is inside an obstacle on the recorded motion", fraction=0.0)
        return (out[::2] - out[1::2]) / neighbours.spans

    def _began_at_rest(self) -> bool:
        """Whether the motion began with the undeformed body, at rest, with relaxed springs of friction."""
        dynamics, tape = self.dynamics, self._tape
        nodes, touching = dynamics.model.nodes, dynamics.linearisation.contact
        if not np.array_equal(tape.x[0], nodes) or tape.velocity[0].any():
            return False
        beams = dynamics.compiled_solver()
        if touching is None or tape.anchors is None or not isinstance(beams, BeamMotion) or beams.body.contact is None:
            return True
        return np.array_equal(
            tape.anchors[0], anchors_of(beams.body.contact, ContactMemory(touching.relaxed(nodes), None))
        )


def _over_time(name: str, values: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    """Return derivatives by the states after each command; given at the end alone, they are zero before."""
    out = np.zeros(shape)
    if values is None:
        return out
    given = np.asarray(values, dtype=float)
    if given.shape == shape:
        return given
    if given.shape != shape[1:]:
        raise ValueError(f"{name} must have shape {shape} or {shape[1:]}, got {given.shape}")
    out[-1] = given
    return out


def empty_tape(steps: int, x: np.ndarray, size: int, anchors: np.ndarray | None) -> Tape:
    """Return a tape with room for time steps of a body with rows ``x`` (n, 3), ``size`` constraint rows and anchors."""
    room = ROOM * steps + 64
    return Tape(
        x=np.empty((room + 1, *x.shape)),
        velocity=np.empty((room + 1, *x.shape)),
        effort=np.empty((room + 1, size)),
        anchors=None if anchors is None else np.empty((room + 1, *anchors.shape)),
        h=np.empty(room),
        number=np.empty(room, dtype=np.int64),
        share=np.empty(room),
        last=np.zeros(room, dtype=bool),
    )


def roll_out(
    dynamics: Dynamics,
    commands: np.ndarray,
    mode: str | Sequence[str] = "displacement",
    forces: np.ndarray | None = None,
) -> Rollout:
    """Move a body under commands, one for each time step, and record the motion for gradients.

    Args:
        dynamics: implicit Euler steps of a body that compiled code can solve; it ends where the motion ends. Work and
            dissipation are not counted.
        commands: shape (k, n_a).
        mode: as for `Dynamics.advance`.
        forces: on the effector rows in each of these time steps [N], shape (k, n_e); default none.

    Raises:
        ConvergenceError: if a time step cannot be taken; the dynamics stay where they were.
        ValueError: for a body that compiled code cannot solve, another shape, or an actuator that cannot push.
    """
    beams = dynamics.compiled_solver()
    if not isinstance(beams, BeamMotion):
        raise ValueError(f"gradients need a body that compiled code can solve: {dynamics.not_compiled}")
    commands = np.asarray(commands, dtype=float)
    count = sum(c.size for c in dynamics.model.constraints["a"])
    if commands.ndim != 2 or commands.shape[1] != count or not np.isfinite(commands).all():
        raise ValueError(f"commands must be finite numbers of shape (k, {count}), got shape {commands.shape}")
    modes = [mode] * count if isinstance(mode, str) else list(mode)
    if len(modes) != count or any(m not in ("displacement", "effort") for m in modes):
        raise ValueError(f"mode must be 'displacement' or 'effort' (one, or {count} of them), got {mode!r}")
    size = len(dynamics.effort)
    is_driven = np.zeros(size, dtype=bool)
    is_driven[:count] = [m == "displacement" for m in modes]
    if dynamics.unilateral.any():
        raise ValueError("gradients need actuators that can push: one that hangs slack does not follow its command")
    targets = np.zeros((len(commands), size))
    targets[:, :count] = commands
    if forces is not None:
        # Rows of effectors follow those of actuators.
        targets[:, count : count + sum(c.size for c in dynamics.model.constraints["e"])] = forces
    contact, touching = beams.body.contact, dynamics.linearisation.contact
    anchors = None if contact is None or touching is None else anchors_of(contact, touching.memory)
    tape = empty_tape(len(commands), dynamics.x, size, anchors)
    state = BeamState(
        dynamics.x.copy(), dynamics.velocity.copy(), dynamics.effort.copy(), np.empty(size), anchors, np.zeros(7)
    )
    drive = Drive(np.flatnonzero(is_driven), np.flatnonzero(~is_driven), np.zeros(int(is_driven.sum()), dtype=bool))
    stepping = Stepping(
        dynamics.model.loads,
        dynamics.step,
        dynamics.mass_damping,
        dynamics.stiffness_damping,
        dynamics.tolerance,
        dynamics.max_cuts,
    )
    taken = record(beams.system, beams.strains, state, targets, drive, stepping, tape)
    if taken < 0:
        raise ConvergenceError(f"cannot record {len(commands)} time steps of {dynamics.step:g} s", fraction=0.0)
    dynamics.x, dynamics.velocity, dynamics.effort = state.x, state.velocity, state.effort
    dynamics.linearisation.loads = dynamics.model.loads
    dynamics.time += len(commands) * dynamics.step
    if contact is not None and touching is not None and anchors is not None:
        dynamics.linearisation.remember(dynamics.x, memory_of(contact, anchors, touching.memory))
    dynamics.linearisation.current = False
    ends = 1 + np.flatnonzero(tape.last[:taken])
    return Rollout(dynamics, tape.x[ends], tape.velocity[ends], tape.effort[ends], tape, taken, drive, stepping)


def roll_out_backend(backend: FEMBackend, commands: np.ndarray, forces: np.ndarray | None = None) -> Rollout:
    """Move the present body of a backend under commanded displacements without changing its present state.

    Args:
        backend: finite elements in motion.
        commands: one for each control step, shape (k, n_a).
        forces: on the first effector in each of them [N], shape (k, 3); default none.

    Returns:
        The motion, with one entry for each time step, and its gradients; it holds the solver until the next step.

    Raises:
        ConvergenceError: if a time step cannot be computed.
        ValueError: without dynamics, or for a body that compiled code cannot solve.
    """
    dynamics = backend.dynamics
    if dynamics is None:
        raise ValueError("roll_out_backend() is that of a motion; make the backend with dynamics=True")
    kept, start = dynamics.snapshot, backend.state.command
    try:
        before = np.vstack([start[None], commands[:-1]])
        loads = None
        if forces is not None:
            loads = np.zeros((len(commands), backend.state.effector.size))
            loads[:, :3] = forces
            loads = loads.repeat(backend.steps.count, axis=0)
        ramps = np.concatenate([*map(backend.steps.ramp, before, commands)])
        return roll_out(dynamics, ramps, forces=loads)
    finally:
        backend.restore(backend.state)
        dynamics.snapshot = kept
