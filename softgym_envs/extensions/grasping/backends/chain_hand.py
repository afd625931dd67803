"""Two learned fingers with a free box as a backend: the fingers follow equilibria, the box has inertia.

The model is plane: the box moves along x and z and tips about y. In finite elements the fingers have inertia too, which
hardly matters at the speed of the servos.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from softgym_envs.backends.backend import Backend, State, check_numbers, refuse_force
from softgym_envs.designs import Design
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.extensions.beams.contact_law import table_of
from softgym_envs.extensions.beams.prism import RoundedPrism
from softgym_envs.extensions.beams.skins import box_skin
from softgym_envs.extensions.grasping.chain.contact import FOLDED, STICK, STIFFNESS
from softgym_envs.extensions.grasping.chain.equilibrium import clearances, touching
from softgym_envs.extensions.grasping.chain.hand import (
    FINGERS,
    commit_hand,
    eliminate,
    find_hand,
    place_ends,
    pose_of,
    table_point,
)
from softgym_envs.extensions.grasping.chain.kernels import touch
from softgym_envs.extensions.grasping.chain.model import ChainModel, load_chain
from softgym_envs.extensions.grasping.robots.carried_objects import ROUNDING
from softgym_envs.extensions.grasping.robots.grasping_hands import (
    ON_TABLE,
    TABLE_MASS,
    TABLE_STIFFNESS,
    ContactAidedGripper,
)
from softgym_envs.extensions.paths.hybrid import PathHybridBackend
from softgym_envs.mechanics.condensation import CondensedModel, Row, point_rows
from softgym_envs.mechanics.contact.contact import Contacts
from softgym_envs.mechanics.contact.obstacles import Plane
from softgym_envs.mechanics.contact.surface import surface_of
from softgym_envs.surrogate.domain import SELF_CONTACT

ROLES = (("a", 3), ("e", 3))
MAX_CUTS = 5
"""A time step that fails is cut in halves this many times."""


@dataclass(frozen=True)
class HandMemory:
    """All that a hand remembers.

    Attributes:
        q: nodes of the chains in the frame of the box, shape (2, N, 3).
        box: its pose (x, z, turn), shape (3,) [m, m, rad].
        velocity: its velocity, shape (3,).
        drives: angles of the servos [rad] and height of the hand [m], shape (3,).
        efforts: shape (3,) [N m, N m, N].
        anchors: of the friction springs of the fingers [m], shape (2, 1, P, 3).
        before: those from which the last increment began.
        table: anchors of the springs of the table [m], shape (T, 3).
        table_before: those from which the last increment began.
        free: pose that the box would have reached without forces, shape (3,).
        masses: of the pose over the square of the time step, shape (3,); zero in statics.
        fold: angle at which each finger began to touch itself [rad], shape (2,); inf where it does not.
    """

    q: np.ndarray
    box: np.ndarray
    velocity: np.ndarray
    drives: np.ndarray
    efforts: np.ndarray
    anchors: np.ndarray
    before: np.ndarray
    table: np.ndarray
    table_before: np.ndarray
    free: np.ndarray
    masses: np.ndarray
    fold: np.ndarray


class _FingerData(NamedTuple):
    """A finger of a hand, in the order in which the compiled solver takes it.

    Attributes:
        place: distance of the feet from the middle of the hand, and their height above the table [m], shape (2,).
        held: the clamped node [m, m, rad], shape (3,).
        drive: axis of the servo, and the first node from it [m], shape (4,).
        length: of the segments [m], shape (N - 1,).
        along: their directions at rest, shape (N - 1, 2).
        stiffness: of the segments, shape (N - 1, 3, 3).
        weights: of the nodes [N], shape (N,).
    """

    place: np.ndarray
    held: np.ndarray
    drive: np.ndarray
    length: np.ndarray
    along: np.ndarray
    stiffness: np.ndarray
    weights: np.ndarray


class _Skin(NamedTuple):
    """The P points of a finger that touch the box, in the order in which the compiled solver takes them.

    Attributes:
        nodes: of the chain beside each point, shape (P, 2).
        shares: where the point lies between them, shape (P,).
        arms: from both nodes to the ends of the edge on which it lies [m], shape (P, 4).
        heights: of the points across the plane [m], shape (P,).
        areas: [m2], shape (P,).
    """

    nodes: np.ndarray
    shares: np.ndarray
    arms: np.ndarray
    heights: np.ndarray
    areas: np.ndarray


class _Underside(NamedTuple):
    """The T points of the box over the table.

    Attributes:
        offsets: from the middle of the box along x and z [m], shape (T, 2).
        areas: [m2], shape (T,).
        plane: the table as an obstacle, shape (17,).
    """

    offsets: np.ndarray
    areas: np.ndarray
    plane: np.ndarray


class ChainHand:
    """One hand of two equal learned fingers, with its box on the table.

    Args:
        robot: the hand.
        model: the learned chain of its finger.
        design: the body, the box and its place.

    Raises:
        InfeasibleDesign: if the outline of a finger crosses itself, or nothing is in equilibrium at rest.
    """

    def __init__(self, robot: ContactAidedGripper, model: ChainModel, design: Design) -> None:
        finger, names = robot.finger, robot.finger.design_space.names
        finger.outline({name: design[name] for name in names})
        self.design = design
        own = np.array([[design[name] for name in names]])
        prepared = self._prepared = model.prepare(own, 1)
        self._self_contact = robot.self_contact
        self._chain, self._bodies = prepared.chain, prepared.bodies
        modulus = design["young_modulus"]
        stiffness = STIFFNESS * modulus if robot.contact_stiffness is None else robot.contact_stiffness
        distance = robot.contact_distance
        self._law = np.array([distance, stiffness, STICK * stiffness / distance])
        half = np.array([0.5 * length for length in robot.box])
        friction = design["friction"]
        # In the plane of a finger the box is a prism along z of that plane.
        flat = RoundedPrism.box((half[0], half[2], half[1]), ROUNDING, friction=friction)
        self._obstacles, self._edges = table_of([flat])
        plane, _ = table_of([Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), friction=friction)])
        frame = np.concatenate([np.zeros((1, 3)), np.eye(3)])
        weights, areas = surface_of(frame, (), (box_skin(0, half.tolist(), frame),)).points
        places = weights.toarray()[:, 1:]
        below = places[:, 2] < -half[2] + 1e-9
        self._underside = _Underside(places[below][:, [0, 2]].copy(), areas[below], plane[0])
        drive, length, along, segments = (each[0] for each in prepared.segments)
        nodes, shares, arms, heights, skin_areas = prepared.skin
        rest = prepared.at_rest[0]
        place = np.array([finger.width + design["object_gap"] + half[0], robot.clearance + finger.length])
        gravity = -robot.gravity[2]
        mass = 0.5 * finger.density * finger.thickness * length * prepared.bodies.thickness[0]
        node_weights = gravity * (np.append(mass, 0.0) + np.append(0.0, mass))
        segments = segments * prepared.relative[0]
        self._finger = _FingerData(place, rest[-1].copy(), drive, length, along, segments, node_weights)
        self._skin = _Skin(nodes, shares, arms[0], heights, skin_areas[0])
        mass_of_box = design["object_mass"]
        self._masses = np.array([mass_of_box, mass_of_box, mass_of_box * (half[0] ** 2 + half[2] ** 2) / 3.0])
        self._weight = mass_of_box * gravity
        self._table_weight = TABLE_MASS * gravity
        self._reach = FOLDED * distance
        self._height = half[2]
        self.memory = self._at_rest(rest)

    # -- states -----------------------------------------------------------------------------------------------------

    def _at_rest(self, nodes: np.ndarray) -> HandMemory:
        box, pose = np.array([0.0, self._height + ON_TABLE, 0.0]), np.empty(3)
        q = np.empty((FINGERS, *nodes.shape))
        finger = self._finger
        for f in range(FINGERS):
            pose_of(box, finger.place, f, pose)
            c, s = np.cos(pose[2]), np.sin(pose[2])
            q[f, :, :2] = (nodes[:, :2] - pose[:2]) @ np.array([[c, -s], [s, c]])
            q[f, :, 2] = nodes[:, 2] - pose[2]
            place_ends(q[f], finger.held, finger.drive, 0.0, pose)
        zero = np.zeros(3)
        shape, below = (FINGERS, 1, len(self._skin.areas), 3), (len(self._underside.areas), 3)
        memory = HandMemory(
            q, box, zero, zero, zero, np.zeros(shape), np.zeros(shape), np.zeros(below), np.zeros(below), box, zero,
            np.full(FINGERS, np.inf),
        )  # fmt: skip
        touch_at = self._touching(memory)
        if not (touch_at[1] > 0.0).all():
            raise InfeasibleDesign("at rest, a finger is inside the box")
        memory.anchors[:, 0] = memory.before[:, 0] = touch_at[0]
        memory.table[:] = memory.table_before[:] = self._table_points(memory)
        settled = self._increment(memory, zero, None)
        if settled is None:
            raise InfeasibleDesign("the box finds no equilibrium on the table")
        return replace(settled, velocity=zero)

    def advance(self, targets: np.ndarray, duration: float | None) -> None:
        """Move the drives to targets (3,) within a duration [s], or from equilibrium to equilibrium (None).

        Raises:
            ConvergenceError: if the motion is not found; the memory is kept.
        """
        start = self.memory
        for cut in range(MAX_CUTS + 1):
            parts, memory = 1 << cut, start
            for part in range(parts):
                goal = start.drives + (part + 1) / parts * (targets - start.drives)
                found = self._increment(memory, goal, None if duration is None else duration / parts)
                if found is None:
                    break
                memory = found
            else:
                self.memory = memory
                return
        raise ConvergenceError(f"the learned hand finds no motion to {targets.tolist()}", fraction=0.0)

    def _increment(self, start: HandMemory, targets: np.ndarray, duration: float | None) -> HandMemory | None:
        masses = np.zeros(3) if duration is None else self._masses / duration**2
        free = start.box + (0.0 if duration is None else duration) * start.velocity
        q, box, efforts = start.q.copy(), start.box.copy(), np.zeros(3)
        anchors, table = start.anchors.copy(), start.table.copy()
        finger, below = self._parts(anchors, table)
        if not find_hand(q, box, start.drives, targets, finger, below, (masses, free, self._weight), efforts):
            return None
        commit_hand(q, box, targets[2], finger, below)
        efforts[2] += TABLE_STIFFNESS * targets[2] - self._table_weight
        velocity = np.zeros(3) if duration is None else (box - start.box) / duration
        folded = self._clearance(q) < self._reach
        fold = np.where(targets[:2] >= start.fold, start.fold, np.inf)
        return HandMemory(
            q, box, velocity, targets.copy(), efforts, anchors, start.anchors, table, start.table, free, masses,
            np.where(folded, np.minimum(fold, targets[:2]), fold),
        )  # fmt: skip

    def _parts(self, anchors: np.ndarray, table: np.ndarray) -> tuple[tuple, tuple]:
        """Return fingers and table as the compiled solver takes them."""
        offsets, areas, plane = self._underside
        finger = (*self._finger, tuple(self._skin), self._obstacles, self._edges, anchors, self._law)
        return finger, (offsets, areas, table, plane, self._law)

    # -- what is measured -------------------------------------------------------------------------------------------

    @property
    def effector(self) -> np.ndarray:
        """Place of the box over the table [m], shape (3,)."""
        x, z, _ = self.memory.box
        return np.array([x, 0.0, z + self.memory.drives[2]])

    @property
    def distrust(self) -> int:
        """Why the present state is not trusted, 0 if it is (`softgym_envs.surrogate.domain.DISTRUST_REASONS`)."""
        folded = self._self_contact and np.isfinite(self.memory.fold).any()
        return int(self._prepared.distrust[0]) | (SELF_CONTACT if folded else 0)

    @property
    def uncertainty(self) -> float:
        """Bound on 95 % of the errors of a fingertip [m]."""
        return float(self._prepared.tip_uncertainty[0])

    def compliance(self) -> tuple[np.ndarray, bool]:
        """Return W (6, 6) between the drives and the box, for the loading direction and with the inertia of the step.

        Its rows for y are zero, because nothing moves across the plane. Second value: whether the matrix exists.
        """
        memory = self.memory
        finger, below = self._parts(memory.before.copy(), memory.table_before.copy())
        count = memory.q.shape[1]
        reduced, gradient = np.empty((6, 6)), np.empty(6)
        _, definite = eliminate(
            memory.q, memory.box, memory.drives[:2], memory.drives[2], finger, below,
            (memory.masses, memory.free, self._weight), False, np.zeros(memory.anchors.shape[:3]),
            np.zeros(len(self._underside.areas)), reduced, gradient, np.empty((FINGERS, count, 3, 5)),
            np.empty((FINGERS, 3)),
        )  # fmt: skip
        reduced[2, 2] += TABLE_STIFFNESS
        rows = np.zeros((6, 6))
        rows[[0, 1, 2, 3, 5, 5], [0, 1, 2, 3, 4, 2]] = 1.0
        stable = bool(definite) and bool(np.linalg.eigvalsh(0.5 * (reduced + reduced.T))[0] > 0.0)
        if abs(np.linalg.det(reduced)) == 0.0:
            return np.full((6, 6), np.nan), False
        return rows @ np.linalg.solve(reduced, rows.T), stable

    def contacts(self) -> Contacts:
        """Return where table and box press, in the frame of the hand."""
        memory = self.memory
        points, gaps, forces, pressing, sliding = self._touching(memory)
        found: list[tuple[int, np.ndarray, float, np.ndarray, float, bool]] = []
        c, s = np.cos(memory.box[2]), np.sin(memory.box[2])
        turn, middle = np.array([[c, -s], [s, c]]), memory.box[:2]
        for f, k in np.argwhere(pressing > 0.0):
            # From the frame of the box as the finger sees it (x towards it, y down) to that of the hand.
            signs = np.array([1.0 - 2.0 * f, -1.0])
            place, force = turn @ (signs * points[f, k, :2]) + middle, turn @ (signs * forces[f, k])
            found.append((1, place, gaps[f, k], force, pressing[f, k], bool(sliding[f, k])))
        places = self._table_points(memory)
        _, areas, plane = self._underside
        pull, tangent, edges = np.empty(2), np.empty((2, 2)), np.empty((1, 7))
        for k, place in enumerate(places):
            _, gap, normal, slides = touch(
                place, areas[k], plane, edges, memory.table_before[k], self._law, False, pull, tangent
            )
            if normal > 0.0:
                found.append((0, place[:2] - [0.0, memory.drives[2]], gap, -pull, normal, bool(slides)))
        nearest = min([each[2] for each in found], default=np.inf)
        clearance = float(self._clearance(memory.q).min()) if self._self_contact else np.inf
        count = len(found)

        def spatial(column: int) -> np.ndarray:
            flat = np.array([each[column] for each in found]).reshape(count, 2)
            return np.column_stack([flat[:, 0], np.zeros(count), flat[:, 1]])

        return Contacts(
            obstacles=("table", "box"),
            obstacle=np.array([each[0] for each in found], dtype=np.int64),
            point=spatial(1),
            gap=np.array([each[2] for each in found]),
            force=spatial(3),
            pressing=np.array([each[4] for each in found]),
            sliding=np.array([each[5] for each in found], dtype=bool),
            self_force=0.0,
            mesh_force=np.zeros((2, 3)),
            smallest_gap=min(nearest, clearance) if min(nearest, clearance) < self._law[0] else np.inf,
        )

    def _touching(self, memory: HandMemory) -> tuple[np.ndarray, ...]:
        """Return points, gaps, forces, pressing and sliding of the skins of both fingers, in the frame of the box."""
        nodes, shares, arms, heights, areas = self._skin
        shape = (FINGERS, 1, len(areas))
        points, gaps, forces = np.zeros((FINGERS, len(areas), 3)), np.zeros(shape), np.zeros((*shape, 2))
        pressing, sliding = np.zeros(shape), np.zeros(shape, dtype=bool)
        touching(
            memory.q, np.zeros(FINGERS, dtype=np.int64), nodes, shares, arms[None], heights, areas[None],
            np.stack([self._obstacles] * FINGERS), np.stack([self._edges] * FINGERS), memory.before,
            np.stack([self._law] * FINGERS), points, gaps, forces, pressing, sliding,
        )  # fmt: skip
        return points, gaps[:, 0], forces[:, 0], pressing[:, 0], sliding[:, 0]

    def _table_points(self, memory: HandMemory) -> np.ndarray:
        offsets = self._underside.offsets
        points, arm = np.zeros((len(offsets), 3)), np.empty(2)
        for point, offset in zip(points, offsets, strict=True):
            table_point(memory.box, memory.drives[2], offset, point, arm)
        return points

    def _clearance(self, q: np.ndarray) -> np.ndarray:
        found = np.empty(FINGERS)
        chain, bodies = self._chain, self._bodies
        slot = np.zeros(FINGERS, dtype=np.int64)
        clearances(q, slot, chain.fold_nodes, bodies.fold_arms, chain.folds, bodies.fold_sides, found)
        return found


class ChainHandBackend(Backend):
    """States of a hand of learned fingers that holds a free box.

    A servo whose torque would exceed its largest one stops where it has that torque. Fingers do not touch themselves:
    states in which they would are not trusted.

    Args:
        robot: a hand of two contact-aided fingers.
        design: first design; missing variables take their baseline.
        weights: folder of weights of its finger; default the shipped ones.
        control_step: duration of one `step` [s].

    Attributes:
        model: the learned chain of the fingers.

    Raises:
        WeightsError: if the weights are damaged, or belong to a finger with another mesh or material.
        InfeasibleDesign: if the body cannot exist.
    """

    robot: ContactAidedGripper
    moving = True

    def __init__(
        self,
        robot: ContactAidedGripper,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
        control_step: float = 0.05,
    ) -> None:
        if not (np.isfinite(control_step) and control_step > 0.0):
            raise ValueError(f"control_step = {control_step} s must be positive and finite")
        if robot.obstacles:
            raise ValueError(f"robot '{robot.name}' touches further obstacles, which needs backend='fem'")
        if robot.object != "box":
            raise ValueError(f"object = {robot.object!r}: a learned hand can hold a box only; use backend='fem'")
        if robot.gravity[0] != 0.0 or robot.gravity[1] != 0.0:
            raise ValueError(f"gravity = {robot.gravity} m/s2 must be along z on a learned hand; or use backend='fem'")
        self.robot, self.control_step = robot, control_step
        self.model = load_chain(robot.finger, weights)
        self._max_effort = np.array([actuator.max_effort for actuator in robot.actuators])
        self.design = None  # type: ignore[assignment]  # until the first reset
        self.reset(robot.design_space.complete(design))

    def reset(self, design: Mapping[str, float] | None = None) -> State:
        complete = self.design if design is None else self.robot.design_space.complete(design)
        if complete != self.design:
            self._hand = ChainHand(self.robot, self.model, complete)
            self._rest = self._state(np.zeros(3), still=True)
            self.design = complete
        self.restore(self._rest)
        return self.state

    def step(self, command: np.ndarray, mode: str = "displacement", *, force: np.ndarray | None = None) -> State:
        refuse_force(force)
        command = self._checked(command, mode)
        self._drive(command, self.control_step)
        self.state = self._state(command)
        return self.state

    def probe(self, command: np.ndarray, mode: str = "displacement") -> State:
        """Return the equilibrium under a command without going there."""
        kept = self._hand.memory
        try:
            command = self._checked(command, mode)
            self._drive(command, None)
            return self._state(command, still=True)
        finally:
            self._hand.memory = kept

    def restore(self, state: State) -> None:
        """Go back to a state of this backend, with its velocity.

        Raises:
            ValueError: for a state of another backend.
        """
        if not isinstance(state.memory, HandMemory):
            raise ValueError("the state was not computed by a learned hand, which can only restore its own states")
        self._hand.memory = state.memory
        self.state = state

    def _checked(self, command: np.ndarray, mode: str) -> np.ndarray:
        if mode != "displacement":
            raise ValueError(f"mode = {mode!r} is not possible on a learned hand; allowed: 'displacement'")
        return check_numbers("command", command, 3)

    def _drive(self, command: np.ndarray, duration: float | None) -> None:
        """Move the drives, and take back servos whose torque is too large."""
        hand, start, targets = self._hand, self._hand.memory, command
        for _ in range(20):
            hand.memory = start
            try:
                hand.advance(targets, duration)
            except ConvergenceError:
                hand.memory = start
                raise
            over = np.abs(hand.memory.efforts) - self._max_effort
            held = (over > 0.0) | ((targets != command) & (over < -1e-6 * self._max_effort))
            if not held.any():
                return
            W, stable = hand.compliance()
            if not stable:
                break
            index = np.flatnonzero(held)
            efforts = hand.memory.efforts[index]
            # A servo stops short of its command, whether it closes or opens.
            wanted, aimed = command[index], targets[index]
            closes = np.where(aimed == wanted, efforts > 0.0, aimed < wanted)
            # Slightly below the limit, so that rounding does not count as more.
            missing = np.copysign(self._max_effort[index] * (1.0 - 5e-7), efforts) - efforts
            targets = targets.copy()
            aimed = aimed + np.linalg.solve(np.linalg.inv(W[:3, :3])[np.ix_(index, index)], missing)
            targets[index] = np.where(closes, np.minimum(aimed, wanted), np.maximum(aimed, wanted))
        hand.memory = start
        raise ConvergenceError("the learned hand finds no motion with the largest torque of a servo", fraction=0.0)

    def _state(self, command: np.ndarray, *, still: bool = False) -> State:
        hand, memory = self._hand, self._hand.memory
        W, stable = hand.compliance()
        delta = np.concatenate([memory.drives, hand.effector])
        effort = np.concatenate([memory.efforts, np.zeros(3)])
        labels = (Row("servo_1", "rad", "N m"), Row("servo_2", "rad", "N m"), Row("lift", "m", "N"), *point_rows("box"))
        velocity = np.zeros((1, 3))
        if not still:
            lift = (memory.drives[2] - self.state.displacement[2]) / self.control_step
            velocity = np.array([[memory.velocity[0], 0.0, memory.velocity[1] + lift]])
        return State(
            command=command.copy(),
            displacement=memory.drives.copy(),
            effort=memory.efforts.copy(),
            effector=hand.effector[None],
            slack=np.zeros(3, dtype=bool),
            condensed=CondensedModel(W, delta - W @ effort, effort, ROLES, labels),
            velocity=velocity,
            stable=stable,
            uncertainty=hand.uncertainty,
            distrust=hand.distrust,
            contacts=hand.contacts(),
            memory=memory,
        )


class HybridHandBackend(PathHybridBackend):
    """A hand of two learned fingers with a free box where it is trusted, elsewhere finite elements in motion.

    A step of finite elements is one implicit time step with the damping of `FEMBackend`.

    The arguments and errors are those of `ChainHandBackend`.
    """

    moving = True

    def __init__(
        self,
        robot: ContactAidedGripper,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
        control_step: float = 0.05,
    ) -> None:
        self.control_step = control_step
        learned = ChainHandBackend(robot, design, weights, control_step)
        self._start(robot, learned, dynamics=True, control_step=control_step, time_step=control_step)
