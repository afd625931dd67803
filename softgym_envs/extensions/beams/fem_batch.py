"""Finite elements of many bodies of beams at once: one compiled call for each control step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from softgym_envs.backends.batch import BatchBackend, BatchState, condensed_gradient
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.designs import Design
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.extensions.beams.beam import are_folded
from softgym_envs.extensions.beams.solver.batch import BeamBatch, BeamStates
from softgym_envs.extensions.beams.solver.motion import BeamMotion, anchors_of, memory_of
from softgym_envs.extensions.beams.solver.points import ContactPoints
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.contact.contact import ContactMemory
from softgym_envs.mechanics.solvers.equilibrium import RowLayout
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.domain import FOLDED


class FEMBatch(BatchBackend):
    """The states of `FEMBackend` for many bodies made of beams.

    Rows with the same body share its model. A step that the compiled solver cannot take is taken by the general one,
    row by row.

    Args:
        robot: a robot with ``made_of_beams``; one that touches something can only move in time.
        designs: bodies, shape (B, number of design variables).
        threads: how many share the rows of a step, see `BeamBatch`.
        **options: those of `FEMBackend`.

    Raises:
        InfeasibleDesign: if a body cannot exist.
        ValueError: for an option of another kind.
    """

    def __init__(self, robot: Robot, designs: np.ndarray, *, threads: int | None = None, **options: Any) -> None:
        self.robot = robot
        self._options, self._threads = options, threads
        self._designs = [self._design(values) for values in designs]
        self._build()
        first = self._first
        self.moving = first.moving
        count, size = len(designs), len(_rest(first)[1])
        self._slices = first.state.condensed.slices
        self._slack_tolerance = RowLayout.of(first.model).slack_tolerance
        self._by_effort = robot.by_effort
        self._is_driven = np.append(~self._by_effort, np.zeros(size - len(robot.actuators), dtype=bool))
        body = _beams(first).body
        self._present = BeamStates.of(body, size, count, factors=self.moving)
        self._balanced = BeamStates.of(body, size, count, factors=False) if self.moving else self._present
        self._is_balanced = np.ones(count, dtype=bool)
        self.command = np.zeros((count, len(robot.actuators)))
        self._converged = np.ones(count, dtype=bool)
        self._stable = np.ones(count, dtype=bool)
        self.rest(np.arange(count))

    def _build(self) -> None:
        """Make the finite elements of all bodies."""
        self._owners = {
            design: FEMBackend(self.robot, design, **self._options) for design in dict.fromkeys(self._designs)
        }
        self._first = self._owners[self._designs[0]]
        self._stack()

    def __getstate__(self) -> dict[str, Any]:
        # Factors of matrices cannot be pickled: a copy makes its finite elements anew.
        made = ("_owners", "_first", "_numbers", "_frames", "_beams")
        return {name: value for name, value in self.__dict__.items() if name not in made}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        self.__dict__.update(kept)
        self._build()

    def _design(self, values: np.ndarray) -> Design:
        return self.robot.design_space.complete(dict(zip(self.robot.design_space.names, values, strict=True)))

    def _stack(self) -> None:
        """Put the arrays of all bodies in use beside each other."""
        used = list(dict.fromkeys(self._designs))
        self._owners = {design: self._owners[design] for design in used}
        numbers = {design: k for k, design in enumerate(used)}
        self._numbers = np.array([numbers[design] for design in self._designs])
        solvers = [_beams(owner) for owner in self._owners.values()]
        self._frames = solvers[0].body.elements.frames
        loads = [owner.model.loads for owner in self._owners.values()]
        self._beams = BeamBatch([s.body for s in solvers], loads, threads=self._threads)

    @property
    def rest_sizes(self) -> np.ndarray:
        return np.stack([self._owners[design].rest_sizes for design in self._designs])

    def begin(self, index: np.ndarray, designs: np.ndarray) -> Mapping[int, InfeasibleDesign]:
        impossible: dict[int, InfeasibleDesign] = {}
        found: dict[int, Design] = {}
        for i, values in zip(index.tolist(), designs, strict=True):
            design = self._design(values)
            try:
                if design not in self._owners:
                    self._owners[design] = FEMBackend(self.robot, design, **self._options)
            except InfeasibleDesign as error:
                impossible[i] = error
            else:
                found[i] = design
        for i, design in found.items():  # now that no error can leave some of them changed
            self._designs[i] = design
        self._stack()
        self.rest(index)
        return impossible

    def rest(self, index: np.ndarray) -> None:
        self.command[index] = 0.0
        self._converged[index] = True
        for i in index.tolist():
            owner = self._owners[self._designs[i]]
            x, effort, delta, compliance = _rest(owner)
            if self._present.anchors is not None:
                self._present.anchors[i] = anchors_of(self._points(i), _memory(owner))
            for states in (self._present, self._balanced):
                states.x[i], states.effort[i], states.delta[i], states.compliance[i] = x, effort, delta, compliance
                states.velocity[i] = 0.0
                states.is_factored[i] = False
        self._stable[index] = True
        self._is_balanced[index] = True

    def step(self, command: np.ndarray) -> None:
        first, present = self._first, self._present
        step = first.step_options
        if self.moving:
            targets = self._targets(first.steps.ramp(self.command, command).swapaxes(0, 1))
        else:
            targets = self._targets(command[:, None])
        solved, stable = self._beams.march(
            self._numbers,
            present,
            targets,
            self._is_driven,
            self.robot.unilateral,
            limit=first.largest_efforts,
            step=step["step"] if self.moving else np.inf,
            mass_damping=step["mass_damping"] if self.moving else 0.0,
            stiffness_damping=step["stiffness_damping"] if self.moving else 0.0,
            tolerance=first.tolerance,
            cuts=first.cuts,
        )
        self._stable[:] = stable
        self._converged = solved.copy()
        for i in np.flatnonzero(~solved).tolist():
            self._converged[i] = self._step_alone(i, command[i])
        self.command = np.where(self._converged[:, None], command, self.command)

    def _targets(self, commands: np.ndarray) -> np.ndarray:
        """Values of driven rows and efforts of all others, shape (B, k, size), for commands (B, k, n_a)."""
        targets = np.zeros((*commands.shape[:2], len(self._is_driven)))
        targets[:, :, : commands.shape[2]] = commands
        return targets

    def _points(self, i: int) -> ContactPoints:
        """Return the points of a row's body that may touch something."""
        contact = _beams(self._owners[self._designs[i]]).body.contact
        assert contact is not None
        return contact

    def _step_alone(self, i: int, command: np.ndarray) -> bool:
        """Step one row with the general solver; whether that finds the state."""
        owner, present = self._owners[self._designs[i]], self._present
        memory = None
        if present.anchors is not None:
            memory = memory_of(self._points(i), present.anchors[i], _memory(owner))
        now = present.x[i], present.effort[i], present.delta[i], present.velocity[i]
        owner.go_to(*now, self.command[i], memory)
        try:
            state = owner.step(command)
        except ConvergenceError:
            return False
        assert state.nodes is not None
        if present.anchors is not None:
            present.anchors[i] = anchors_of(self._points(i), _memory(owner))
        present.x[i], present.effort[i] = state.nodes, state.condensed.effort
        present.velocity[i] = 0.0 if state.motion is None else state.motion.velocity
        present.delta[i], present.compliance[i] = state.condensed.delta.array, state.condensed.compliance
        present.is_factored[i] = False
        self._stable[i] = state.stable
        return True

    def effectors(self, index: np.ndarray, commands: np.ndarray) -> np.ndarray:
        found = np.full((len(index), 3), np.nan)
        for k, i in enumerate(index.tolist()):
            owner = self._owners[self._designs[i]]
            owner.reset()
            try:
                found[k] = owner.probe(commands[k]).effector[0]
            except ConvergenceError:
                pass
        return found

    @property
    def state(self) -> BatchState:  # type: ignore[override]
        return self._state_of(self._present, self._converged)

    def _state_of(self, states: BeamStates, converged: np.ndarray) -> BatchState:
        a, e = self._slices["a"], self._slices["e"]
        displacement, effort = states.delta[:, a], states.effort[:, a]
        # The sign of the effort alone does not suffice: at rest it is round-off.
        slack = (
            self.robot.unilateral
            & ~self._by_effort
            & (effort <= 0.0)
            & (displacement > self.command + self._slack_tolerance)
        )
        count = len(effort)
        return BatchState(
            displacement.copy(),
            effort.copy(),
            states.delta[:, e].copy(),
            slack,
            converged,
            np.zeros(count),
            np.where(are_folded(states.x, self._frames), FOLDED, 0),
        )

    @property
    def velocity(self) -> np.ndarray | None:
        if not self.moving:
            return None
        points = _beams(self._first).body.points
        return np.einsum("k,bkd->bd", points.weights[0], self._present.velocity[:, points.rows[0]])

    @property
    def stable(self) -> np.ndarray:
        return self._stable.copy()

    @property
    def condensed(self) -> CondensedModel:
        present, like = self._present, self._first.state.condensed
        free = present.delta - np.einsum("bij,bj->bi", present.compliance, present.effort)
        return CondensedModel(present.compliance.copy(), free, present.effort.copy(), like.roles, like.rows)

    def settled(self) -> BatchState:
        # A body in contact may have no equilibrium, or one that depends on how it got there.
        if self.moving and self._present.anchors is None:
            # From the equilibria under the last commands, or from the present shapes where these were not found.
            states = self._balanced
            for name in ("x", "effort"):
                getattr(states, name)[~self._is_balanced] = getattr(self._present, name)[~self._is_balanced]
            self._is_balanced, _ = self._beams.march(
                self._numbers,
                states,
                self._targets(self.command[:, None]),
                self._is_driven,
                self.robot.unilateral,
                limit=self._first.largest_efforts,
                step=np.inf,
                mass_damping=0.0,
                stiffness_damping=0.0,
                tolerance=self._first.tolerance,
            )
            return self._state_of(states, self._is_balanced.copy())
        return self.state

    def gradient(self, effector: np.ndarray, effort: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self._present.anchors is not None:
            raise ValueError(f"robot '{self.robot.name}' touches obstacles: its equilibria have no gradient")
        states, a, e = self._balanced, self._slices["a"], self._slices["e"]
        follows = np.abs(states.delta[:, a] - self.command) < 1e-6 * self.robot.rates
        return condensed_gradient(states.compliance, a, e, follows, effector, effort, self._by_effort)


def _beams(owner: FEMBackend) -> BeamMotion:
    """Return the compiled solver of a body.

    Raises:
        ValueError: for a body that has none.
    """
    found = owner.compiled
    if not isinstance(found, BeamMotion):
        raise ValueError(f"bodies of robot '{owner.robot.name}' cannot be stepped together: {owner.not_compiled}")
    return found


def _rest(owner: FEMBackend) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, efforts, values of the constraints and ``W`` of a body at rest."""
    state = owner.reset()
    assert state.nodes is not None
    return state.nodes, state.condensed.effort, state.condensed.delta.array, state.condensed.compliance


def _memory(owner: FEMBackend) -> ContactMemory:
    """Return what friction remembers at the present state of a body."""
    memory = owner.state.memory
    assert isinstance(memory, ContactMemory)
    return memory
