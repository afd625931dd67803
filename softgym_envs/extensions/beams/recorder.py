"""Gradients of the steps that an environment takes: its motion is recorded as it goes, not computed again."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from softgym_envs.backends.fem import FEMBackend
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.beams.rollout import Rollout, empty_tape
from softgym_envs.extensions.beams.solver.adjoint import Tape, record
from softgym_envs.extensions.beams.solver.motion import BeamMotion, BeamState, Stepping, anchors_of, memory_of
from softgym_envs.extensions.beams.solver.newton import Drive
from softgym_envs.mechanics.contact.contact import ContactMemory
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.compiled import CompiledSolver, MarchedSteps
from softgym_envs.mechanics.solvers.dynamics import Dynamics


class Recorder(CompiledSolver):
    """Takes time steps as `BeamMotion` does and records them, under commanded displacements without limits of effort.

    The last step of a call is taken as without a record, because what is known of a state follows from it.

    Args:
        dynamics: of a body that compiled code can solve.

    Raises:
        ValueError: for another body.
    """

    def __init__(self, dynamics: Dynamics) -> None:
        beams = dynamics.compiled_solver()
        if not isinstance(beams, BeamMotion):
            raise ValueError(f"gradients need a body that compiled code can solve: {dynamics.not_compiled}")
        self.elasticity_version = beams.elasticity_version
        self._dynamics, self._beams = dynamics, beams
        self._tapes: list[Tape] | None = []
        self._drive: Drive | None = None
        self._stepping: Stepping | None = None

    @classmethod
    def reason_against(cls, model: MechanicalModel, *, moving: bool) -> str | None:
        return BeamMotion.reason_against(model, moving=moving)

    def balance(self, *arguments: Any, **options: Any) -> MarchedSteps:
        return self._beams.balance(*arguments, **options)

    def march(
        self,
        x: np.ndarray,
        velocity: np.ndarray,
        effort: np.ndarray,
        targets: np.ndarray,
        is_driven: np.ndarray,
        unilateral: np.ndarray,
        *,
        limit: np.ndarray,
        loads: np.ndarray,
        step: float,
        mass_damping: float,
        stiffness_damping: float,
        tolerance: float,
        cuts: int = 0,
        memory: ContactMemory | None = None,
    ) -> MarchedSteps:
        """Take time steps as `BeamMotion.march`; what cannot be recorded has no `rollout`."""
        options: dict[str, Any] = {"limit": limit, "loads": loads, "step": step, "tolerance": tolerance, "cuts": cuts}
        options |= {"mass_damping": mass_damping, "stiffness_damping": stiffness_damping}
        if self._tapes is not None and not unilateral.any() and not np.isfinite(limit).any():
            driven = np.flatnonzero(is_driven)
            self._drive = Drive(driven, np.flatnonzero(~is_driven), np.zeros(len(driven), dtype=bool))
            self._stepping = Stepping(loads, step, mass_damping, stiffness_damping, tolerance, cuts)
            start = x, velocity, effort
            count = len(targets) - 1
            tape, taken, state = self._record(start, targets[:count], memory)
            if taken >= 0:
                kept = self._memory(state, memory)
                found = self._beams.march(
                    state.x,
                    state.velocity,
                    state.effort,
                    targets[count:],
                    is_driven,
                    unilateral,
                    memory=kept,
                    **options,
                )
                if found.solved and found.parts > 1:
                    tape, taken, _ = self._record(start, targets, memory)
                elif found.solved:
                    self._add(tape, taken, found, count)
                    taken += 1
                if found.solved and taken > 0:
                    self._tapes.append(_cut(tape, taken))
                    _, _, work, dissipated, *_ = state.totals.tolist()
                    work, dissipated = work + found.work, dissipated + found.dissipated
                    return found._replace(taken=len(targets), work=work, dissipated=dissipated)
        self._tapes = None
        return self._beams.march(x, velocity, effort, targets, is_driven, unilateral, memory=memory, **options)

    def _record(
        self, start: tuple[np.ndarray, np.ndarray, np.ndarray], targets: np.ndarray, memory: ContactMemory | None
    ) -> tuple[Tape, int, BeamState]:
        """Return a tape with time steps, their number, negative if they cannot be taken, and the state at their end."""
        beams, contact, (x, velocity, effort) = self._beams, self._beams.body.contact, start
        anchors = None if contact is None or memory is None else anchors_of(contact, memory)
        tape = empty_tape(len(targets) + 1, x, len(effort), anchors)
        state = BeamState(x.copy(), velocity.copy(), effort.copy(), np.empty(len(effort)), anchors, np.zeros(7))
        return tape, record(beams.system, beams.strains, state, targets, self._drive, self._stepping, tape), state

    def _memory(self, state: BeamState, memory: ContactMemory | None) -> ContactMemory | None:
        contact = self._beams.body.contact
        if contact is None or memory is None or state.anchors is None:
            return memory
        return memory_of(contact, state.anchors, memory)

    def _add(self, tape: Tape, taken: int, found: MarchedSteps, number: int) -> None:
        """Add a time step that was taken in one part."""
        contact, stepping = self._beams.body.contact, self._stepping
        assert stepping is not None
        tape.x[taken + 1], tape.velocity[taken + 1], tape.effort[taken + 1] = found.x, found.velocity, found.effort
        if tape.anchors is not None and contact is not None and found.memory is not None:
            tape.anchors[taken + 1] = anchors_of(contact, found.memory)
        tape.h[taken], tape.number[taken], tape.share[taken], tape.last[taken] = stepping.h, number, 1.0, True

    def rollout(self) -> Rollout:
        """Return the motion so far as one, with an entry for each time step, for as long as its body does not change.

        Raises:
            ConvergenceError: if a step could not be recorded.
            ValueError: if nothing was recorded.
        """
        tapes = self._tapes
        if tapes is None:
            raise ConvergenceError("a time step cannot be recorded", fraction=0.0)
        if not tapes or self._drive is None or self._stepping is None:
            raise ValueError("no motion was recorded; allowed: rollout() after a step")
        begun = np.cumsum([0, *(int(tape.last.sum()) for tape in tapes[:-1])])

        def starts(name: str) -> np.ndarray:
            """Join what is kept at the start of each step and at the end of the last one."""
            return np.concatenate([*(getattr(tape, name)[:-1] for tape in tapes), getattr(tapes[-1], name)[-1:]])

        def steps(name: str) -> np.ndarray:
            return np.concatenate([getattr(tape, name) for tape in tapes])

        tape = Tape(
            x=starts("x"),
            velocity=starts("velocity"),
            effort=starts("effort"),
            anchors=None if tapes[0].anchors is None else starts("anchors"),
            h=steps("h"),
            number=np.concatenate([tape.number + first for tape, first in zip(tapes, begun, strict=True)]),
            share=steps("share"),
            last=steps("last"),
        )
        ends = 1 + np.flatnonzero(tape.last)
        return Rollout(
            self._dynamics,
            tape.x[ends],
            tape.velocity[ends],
            tape.effort[ends],
            tape,
            len(tape.h),
            self._drive,
            self._stepping,
        )


def _cut(tape: Tape, taken: int) -> Tape:
    """Return a tape without the room that is left."""
    own = ("x", "velocity", "effort", "anchors")
    kept = {name: array for name, array in tape._asdict().items() if array is not None}
    return tape._replace(**{name: array[: taken + (name in own)] for name, array in kept.items()})


@contextmanager
def recording(backend: FEMBackend) -> Iterator[Recorder]:
    """Record the steps that a backend takes in a ``with`` block, which gets the `Recorder`.

    Args:
        backend: finite elements in motion, whose body does not change.

    Raises:
        ValueError: without dynamics, or for a body that compiled code cannot solve.
    """
    if backend.dynamics is None:
        raise ValueError("recording() is that of a motion; make the backend with dynamics=True")
    recorder = Recorder(backend.dynamics)
    with backend.dynamics.solved_by(recorder):
        yield recorder
