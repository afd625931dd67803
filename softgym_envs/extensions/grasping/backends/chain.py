"""The learned chain of the contact-aided finger as a backend: contacts are solved, segments are learned.

States hold all that friction remembers, so that `restore` can go back to any of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from softgym_envs.backends.backend import Backend, State, check_numbers, refuse_force
from softgym_envs.designs import Design
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.extensions.grasping.chain.contact import ChainBatch, ChainContacts, Memory, rows_for
from softgym_envs.extensions.grasping.chain.model import ChainModel, load_chain
from softgym_envs.extensions.grasping.chain.rows import contact_rows
from softgym_envs.extensions.grasping.robots.contact_aided_finger import ContactAidedFinger
from softgym_envs.extensions.paths.hybrid import PathHybridBackend
from softgym_envs.mechanics.condensation import CondensedModel, Row, point_rows
from softgym_envs.mechanics.contact.contact import Contacts
from softgym_envs.surrogate.domain import SELF_CONTACT, SOFT

MAX_NEWTON_STEPS = 30
"""Newton steps in the search for the angle under a torque."""

ROLES = (("a", 1), ("e", 3))


class ChainBody:
    """One body on a learned chain, in front of its obstacles.

    Args:
        robot: the finger, with what it touches.
        model: the learned chain of the finger alone.
        design: the body.

    Raises:
        InfeasibleDesign: if the outline crosses itself, or the body at rest is inside an obstacle.
    """

    def __init__(self, robot: ContactAidedFinger, model: ChainModel, design: Design) -> None:
        robot.outline(design)
        obstacles = robot.surroundings(design)
        self.design = design
        self._names = tuple(each.name or f"obstacle {k + 1}" for k, each in enumerate(obstacles))
        own = design.array[None, : len(model.robot.design_space)]
        self._prepared = model.prepare(own, rows_for([obstacles], robot.thickness))
        self._distance = robot.contact_distance
        self._self_contact = robot.self_contact
        self._max_effort = robot.actuators[0].max_effort
        self._batch = ChainBatch(
            self._prepared, [obstacles], distance=robot.contact_distance, stiffness=robot.contact_stiffness
        )
        if not self._batch.found[0]:
            raise InfeasibleDesign(f"robot '{robot.name}' at rest: the body is inside obstacle {self._names[0]}")
        self._rest = self._state(np.zeros(1))

    def rest(self) -> State:
        """Return the state at rest."""
        return self._rest

    def solve(self, command: np.ndarray, mode: str, start: State) -> State:
        """Return the state under a command, one increment of friction after another state of this body.

        Raises:
            ConvergenceError: if it is not found.
            ValueError: for a malformed command.
        """
        command = check_numbers("command", command, 1)
        if mode == "effort":
            self._reach_torque(start, float(np.clip(command[0], -self._max_effort, self._max_effort)))
        elif mode == "displacement":
            torque = self._close(start, command[0])
            if abs(torque) > self._max_effort:
                self._reach_torque(start, np.copysign(self._max_effort, torque))
        else:
            raise ValueError(f"mode = {mode!r} is unknown; allowed: 'displacement', 'effort'")
        return self._state(command)

    def contact_model(self, state: State) -> CondensedModel:
        """Return the condensed model at a state with openings of contacts as rows ``c``, see `Backend.contact_model`.

        Raises:
            ConvergenceError: if the body has no stable equilibrium without its contacts.
        """
        self._go_to(state)
        rows = contact_rows(self._batch, 0)
        if rows is None:
            raise ConvergenceError("the body has no stable equilibrium without its contacts", fraction=0.0)
        effort = np.concatenate([state.effort, np.zeros(3), rows.force])
        delta = np.concatenate([state.displacement, state.effector[0], rows.opening])
        labels = tuple(Row(name, "m", "N") for name in self._names)
        return CondensedModel(
            rows.W, delta - rows.W @ effort, effort, (*ROLES, ("c", len(labels))), (*self._labels(), *labels)
        )

    def _go_to(self, state: State) -> None:
        assert isinstance(state.memory, Memory)
        self._batch.memory = state.memory

    def _close(self, start: State, angle: float) -> float:
        """Turn the servo to an angle [rad] in one increment from a state; return its torque [N m]."""
        self._go_to(start)
        self._batch.move(np.array([angle]))
        if not self._batch.found[0]:
            raise ConvergenceError(f"the learned chain finds no equilibrium at {angle:.4g} rad", fraction=0.0)
        return float(self._batch.torque[0])

    def _reach_torque(self, start: State, torque: float) -> None:
        """Turn the servo to the angle at which it has a torque [N m], in one increment from a state."""
        angle = float(start.displacement[0])
        for _ in range(MAX_NEWTON_STEPS):
            missing = torque - self._close(start, angle)
            W, stable = self._batch.compliance()
            if not stable[0]:
                break
            if abs(missing) <= 1e-9 * self._max_effort:
                return
            angle += float(np.clip(W[0, 0, 0] * missing, -0.1, 0.1))
        raise ConvergenceError(f"the learned chain finds no equilibrium at {torque:.4g} N m", fraction=0.0)

    def _state(self, command: np.ndarray) -> State:
        batch, memory = self._batch, self._batch.memory
        touch = batch.touching()
        states = batch.states_of(touch)
        compliance, stable = batch.compliance()
        effort, displacement = states.torque.copy(), states.angle.copy()
        effector = np.append(states.tip[0], 0.0)
        full = np.concatenate([effort, np.zeros(3)])
        W = compliance[0]
        free = np.concatenate([displacement, effector]) - W @ full
        distrust = int(self._prepared.distrust[0])
        if not stable[0]:
            distrust |= SOFT
        if self._self_contact and states.folded[0]:
            distrust |= SELF_CONTACT
        return State(
            command=command.copy(),
            displacement=displacement,
            effort=effort,
            effector=effector[None],
            slack=np.zeros(1, dtype=bool),
            condensed=CondensedModel(W, free, full, ROLES, self._labels()),
            stable=bool(stable[0]),
            uncertainty=float(self._prepared.tip_uncertainty[0]),
            distrust=distrust,
            contacts=self._contacts(touch, float(states.clearance[0])),
            memory=memory,
        )

    def _labels(self) -> tuple[Row, ...]:
        return (Row("servo", "rad", "N m"), *point_rows("tip"))

    def _contacts(self, touch: ChainContacts, clearance: float) -> Contacts:
        obstacle, point = np.nonzero(touch.pressing[0] > 0.0)
        force = np.column_stack([touch.forces[0, obstacle, point], np.zeros(len(point))])
        gap = touch.gaps[0, obstacle, point]
        nearest = min(gap.min(initial=np.inf), clearance if self._self_contact else np.inf)
        return Contacts(
            obstacles=self._names,
            obstacle=obstacle,
            point=touch.points[0, point],
            gap=gap,
            force=force,
            pressing=touch.pressing[0, obstacle, point],
            sliding=touch.sliding[0, obstacle, point],
            self_force=0.0,
            mesh_force=np.zeros((len(self._names), 3)),
            smallest_gap=float(nearest) if nearest < self._distance else np.inf,
        )


class ChainBackend(Backend):
    """States from a learned chain with contact and friction.

    The finger does not touch itself: states in which it would are not trusted.

    Args:
        robot: a contact-aided finger, with anything to touch.
        design: first design; missing variables take their baseline.
        weights: folder of weights; default the shipped ones.

    Attributes:
        model: the learned chain.

    Raises:
        WeightsError: if the weights are damaged, or belong to a finger with another mesh or material.
        InfeasibleDesign: if the body cannot exist.
    """

    robot: ContactAidedFinger

    def __init__(
        self,
        robot: ContactAidedFinger,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
    ) -> None:
        self.robot = robot
        self.model = load_chain(robot.alone, weights)
        self.design = None  # type: ignore[assignment]  # until the first reset
        self.reset(robot.design_space.complete(design))

    def reset(self, design: Mapping[str, float] | None = None) -> State:
        complete = self.design if design is None else self.robot.design_space.complete(design)
        if complete != self.design:
            self._body = ChainBody(self.robot, self.model, complete)
            self.design = complete
        self.state = self._body.rest()
        return self.state

    def step(self, command: np.ndarray, mode: str = "displacement", *, force: np.ndarray | None = None) -> State:
        refuse_force(force)
        self.state = self._body.solve(command, mode, self.state)
        return self.state

    def contact_model(self, *, friction: bool = False) -> CondensedModel:
        if friction:
            raise ValueError("the contact model of a learned chain has no friction: friction=False or backend='fem'")
        return self._body.contact_model(self.state)

    def restore(self, state: State) -> None:
        """Go back to a state of this backend.

        Raises:
            ValueError: for a state of another backend.
        """
        if not isinstance(state.memory, Memory):
            raise ValueError("the state was not computed by a learned chain, which can only restore its own states")
        self.state = state


class HybridChainBackend(PathHybridBackend):
    """A learned chain where it is trusted, elsewhere finite elements.

    The chain is not trusted for bodies outside its training, and where the finger would touch itself.

    The arguments and errors are those of `ChainBackend`.
    """

    def __init__(
        self,
        robot: ContactAidedFinger,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
    ) -> None:
        self._start(robot, ChainBackend(robot, design, weights))
