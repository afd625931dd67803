"""Learned chains in contact with obstacles: batches of bodies that keep their friction, and their condensed models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from softgym_envs.extensions.beams.contact_law import PARAMETERS, PLANE, table_of
from softgym_envs.extensions.beams.prism import RoundedPrism
from softgym_envs.extensions.grasping.chain.equilibrium import advance, clearances, condense, touching
from softgym_envs.extensions.grasping.chain.model import PreparedChains, carried_points
from softgym_envs.mechanics.contact.obstacles import Cylinder, Obstacle, Plane

DISTANCE = 5.0e-4
"""Gap at which contact forces vanish [m]."""

STIFFNESS = 0.1
"""Stiffness of the barrier, as a part of Young's modulus."""

STICK = 5.0
"""Stiffness of friction before sliding, in units of the barrier's stiffness over its distance."""

FOLDED = 2.0
"""Clearance below which a body is taken to touch itself, in units of the distance of contact.

In finite elements, folds of 0.1 to 0.5 mm more than the distance of contact already pressed.
"""

DEPTH_ROWS = 11
"""Rows of skin points across the thickness where obstacles change along z."""


def changes_along_z(obstacle: Obstacle, thickness: float) -> bool:
    """Return whether an obstacle looks different at different z within a body of this thickness [m]."""
    if isinstance(obstacle, Plane):
        return abs(obstacle.normal[2]) > 1e-9
    if isinstance(obstacle, Cylinder):
        return abs(obstacle.axis[2]) < 1.0 - 1e-9
    if isinstance(obstacle, RoundedPrism):
        along = abs(np.asarray(obstacle.rotation)[2, 2]) > 1.0 - 1e-9
        return not along or obstacle.half_height < abs(obstacle.centre[2]) + 0.5 * thickness
    return True


@dataclass(frozen=True)
class ChainStates:
    """Equilibria of B bodies with up to O obstacles; rows that were not found must not be used.

    Attributes:
        angle: of the servo [rad], shape (B,).
        torque: [N m], shape (B,).
        tip: [m], shape (B, 2).
        force: of each obstacle on the body, in the plane [N], shape (B, O, 2).
        points: number of points of the skin in contact, shape (B,).
        sliding: number of those whose friction has reached its limit, shape (B,).
        gap: smallest distance to an obstacle [m], shape (B,); inf without obstacles.
        clearance: smallest distance between parts of the body that a fold can bring together [m], shape (B,).
        folded: whether the body would touch itself, or has gone beyond the angle at which it did, shape (B,). Forces
            between parts of the body are not part of a chain, so such states are wrong.
        found: shape (B,).
    """

    angle: np.ndarray
    torque: np.ndarray
    tip: np.ndarray
    force: np.ndarray
    points: np.ndarray
    sliding: np.ndarray
    gap: np.ndarray
    clearance: np.ndarray
    folded: np.ndarray
    found: np.ndarray


class ChainContacts(NamedTuple):
    """What obstacles do to the points of the skin of B bodies; see `equilibrium.touching` for the shapes."""

    points: np.ndarray
    gaps: np.ndarray
    forces: np.ndarray
    pressing: np.ndarray
    sliding: np.ndarray


class Memory(NamedTuple):
    """All that a batch remembers; see `ChainBatch.memory`."""

    q: np.ndarray
    angle: np.ndarray
    torque: np.ndarray
    found: np.ndarray
    anchors: np.ndarray
    before: np.ndarray
    fold: np.ndarray


class ChainBatch:
    """Bodies that close on obstacles, each with its own obstacles and with the memory of friction.

    The law of contact is that of the finite elements (`softgym_envs.mechanics.contact.law`), on the points of the outer
    face of the zigzag leg and of the end of the top wall. The body does not touch itself: `ChainStates.folded`.

    Args:
        prepared: bodies; one row of points is enough for obstacles that do not change along z (`rows_for`).
        obstacles: of each of B rows.
        slot: body of each row, shape (B,); default row k is body k.
        distance: gap at which contact forces vanish [m].
        stiffness: of the barrier [Pa]; default a tenth of Young's modulus of each body.

    Raises:
        ValueError: for obstacles that chains cannot touch.
    """

    def __init__(
        self,
        prepared: PreparedChains,
        obstacles: Sequence[Sequence[Obstacle]],
        slot: np.ndarray | None = None,
        *,
        distance: float = DISTANCE,
        stiffness: float | None = None,
    ) -> None:
        self.prepared = prepared
        self.slot = np.arange(len(prepared)) if slot is None else np.asarray(slot, dtype=np.int64)
        if len(obstacles) != len(self.slot):
            raise ValueError(f"obstacles are given for {len(obstacles)} rows, but there are {len(self.slot)}")
        tables = [table_of(row) for row in obstacles]
        count = max((len(table) for table, _ in tables), default=0)
        width = max((edges.shape[1] for _, edges in tables), default=1)
        rows = len(self.slot)
        self._table, self._edges = np.zeros((rows, count, PARAMETERS)), np.zeros((rows, count, width, 7))
        # Rows with fewer obstacles are filled up with planes that are out of reach.
        self._table[:, :, 0], self._table[:, :, 5], self._table[:, :, 8] = PLANE, 1e3, -1.0
        for b, (table, edges) in enumerate(tables):
            self._table[b, : len(table)], self._edges[b, : len(edges), : edges.shape[1]] = table, edges
        self._relative = prepared.relative[self.slot]
        baseline = prepared.chain.robot.design_space["young_modulus"].baseline
        barrier = np.full(rows, STIFFNESS * baseline) if stiffness is None else stiffness / self._relative
        self._law = np.column_stack([np.full(rows, distance), barrier, STICK * barrier / distance])
        self._q = np.empty((rows, prepared.chain.count, 3))
        self._angle, self._torque, self._found = np.zeros(rows), np.zeros(rows), np.zeros(rows, dtype=bool)
        self._anchors = np.zeros((rows, count, len(prepared.chain.skin_heights), 3))
        self._before = np.zeros_like(self._anchors)
        # The angle at which each row began to touch itself.
        self._fold = np.full(rows, np.inf)
        self._reach = FOLDED * distance
        self.reset()

    # -- states -----------------------------------------------------------------------------------------------------

    def reset(self, index: np.ndarray | slice = slice(None)) -> None:
        """Put rows to rest and forget their friction. Rows whose obstacles contain a part of the body are not found."""
        rows = np.arange(len(self.slot))[index]
        self._q[rows] = self.prepared.at_rest[self.slot[rows]]
        self._angle[rows] = self._torque[rows] = 0.0
        self._fold[rows] = np.inf
        rest = self._touch(rows)
        self._anchors[rows] = self._before[rows] = rest.points[:, None]
        self._found[rows] = (rest.gaps > 0.0).all(axis=(1, 2))
        # Obstacles nearer than the distance of contact press already at rest.
        pressed = rows[self._found[rows] & (rest.pressing > 0.0).any(axis=(1, 2))]
        self._move(pressed, np.zeros(len(pressed)))

    def close(self, angles: np.ndarray) -> ChainStates:
        """Move the servos to angles [rad] (B,), in one increment of friction each, and return the states.

        Rows that are not found stay where they were.
        """
        self.move(angles)
        return self.states

    def move(self, angles: np.ndarray) -> None:
        """Move the servos as `close` does, without returning the states."""
        self._move(slice(None), np.asarray(angles, dtype=float))

    @property
    def found(self) -> np.ndarray:
        """Whether the present state of each row was found, shape (B,)."""
        return self._found.copy()

    @property
    def torque(self) -> np.ndarray:
        """Torques of the servos [N m], shape (B,)."""
        return self._torque * self._relative

    def _move(self, rows: np.ndarray | slice, angles: np.ndarray) -> None:
        # A slice moves the rows in place, chosen rows are copies.
        parts = [self._q[rows], self._anchors[rows], self._before[rows]]
        torque, found = np.zeros(len(angles)), np.zeros(len(angles), dtype=bool)
        advance(
            parts[0], self._angle[rows], angles, self.slot[rows], *self.prepared.segments, *self.prepared.skin,
            self._table[rows], self._edges[rows], parts[1], parts[2], self._law[rows], torque, found,
        )  # fmt: skip
        self._q[rows], self._anchors[rows], self._before[rows] = parts
        self._angle[rows] = np.where(found, angles, self._angle[rows])
        self._torque[rows] = np.where(found, torque, self._torque[rows])
        self._found[rows] = found
        now = self._angle[rows]
        fold = np.where(now >= self._fold[rows], self._fold[rows], np.inf)
        self._fold[rows] = np.where(self._clearance()[rows] < self._reach, np.minimum(fold, now), fold)

    @property
    def states(self) -> ChainStates:
        """The present states."""
        return self.states_of(self.touching())

    def states_of(self, touch: ChainContacts) -> ChainStates:
        """Return the present states, given what obstacles do to the skin."""
        near = touch.pressing > 0.0
        return ChainStates(
            angle=self._angle.copy(),
            torque=self.torque,
            tip=self._tips()[:, 0],
            force=touch.forces.sum(axis=2),
            points=near.any(axis=1).sum(axis=1),
            sliding=(near & touch.sliding).any(axis=1).sum(axis=1),
            gap=touch.gaps.min(axis=(1, 2), initial=np.inf),
            clearance=self._clearance(),
            folded=np.isfinite(self._fold),
            found=self._found.copy(),
        )

    def touching(self) -> ChainContacts:
        """Return what obstacles do to the points of the skin."""
        found = self._touch(np.arange(len(self.slot)))
        relative = self._relative[:, None, None]
        return found._replace(forces=found.forces * relative[..., None], pressing=found.pressing * relative)

    def _touch(self, rows: np.ndarray) -> ChainContacts:
        """Return what obstacles do to the points of chosen rows, at the baseline modulus."""
        count, obstacles, points, _ = self._anchors[rows].shape
        found = ChainContacts(
            np.zeros((count, points, 3)),
            np.zeros((count, obstacles, points)),
            np.zeros((count, obstacles, points, 2)),
            np.zeros((count, obstacles, points)),
            np.zeros((count, obstacles, points), dtype=bool),
        )
        touching(
            self._q[rows], self.slot[rows], *self.prepared.skin, self._table[rows], self._edges[rows],
            self._before[rows], self._law[rows], *found,
        )  # fmt: skip
        return found

    def _clearance(self) -> np.ndarray:
        chain, bodies, found = self.prepared.chain, self.prepared.bodies, np.empty(len(self.slot))
        clearances(self._q, self.slot, chain.fold_nodes, bodies.fold_arms, chain.folds, bodies.fold_sides, found)
        return found

    def _tips(self) -> np.ndarray:
        chain, bodies = self.prepared.chain, self.prepared.bodies
        return carried_points(self._q, chain.effectors, bodies.effector_arms[self.slot])

    def scene(self, row: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return copies of the obstacles of a row, as the solver takes them, and of its law of contact."""
        return self._table[row].copy(), self._edges[row].copy(), self._law[row].copy()

    @property
    def memory(self) -> Memory:
        """Copies of all that the batch remembers; assign it to go back."""
        parts = self._q, self._angle, self._torque, self._found, self._anchors, self._before, self._fold
        return Memory(*(part.copy() for part in parts))

    @memory.setter
    def memory(self, kept: Memory) -> None:
        (
            self._q, self._angle, self._torque, self._found, self._anchors, self._before, self._fold
        ) = (part.copy() for part in kept)  # fmt: skip

    # -- condensed models -------------------------------------------------------------------------------------------

    def compliance(self) -> tuple[np.ndarray, np.ndarray]:
        """Return W between the servo and the tip's x, y and z, and where it exists.

        Contact is part of the body: W (B, 4, 4) is the derivative of angle and tip by torque and forces on the tip, in
        the direction in which the last increment went. It is not symmetric where points slide. It exists, shape (B,),
        where the equilibrium is stable under a given torque.
        """
        chain, bodies = self.prepared.chain, self.prepared.bodies
        rows, size = len(self.slot), 2 * len(chain.effectors)
        torsion, jacobian, back = np.zeros(rows), np.zeros((rows, size)), np.zeros((rows, size))
        held, definite = np.zeros((rows, size, size)), np.zeros(rows, dtype=bool)
        condense(
            self._q, self._angle, self.slot, *self.prepared.segments, *self.prepared.skin, self._table, self._edges,
            self._before, self._law, chain.effectors, bodies.effector_arms, torsion, jacobian, back, held, definite,
        )  # fmt: skip
        stable = definite & (torsion > 0.0)
        torsion = np.where(stable, torsion, np.nan)[:, None]
        W = np.zeros((rows, 2 + size, 2 + size))
        W[:, 0, 0] = 1.0 / torsion[:, 0]
        W[:, 1:-1, 0], W[:, 0, 1:-1] = jacobian / torsion, back / torsion
        W[:, 1:-1, 1:-1] = held + jacobian[:, :, None] * back[:, None] / torsion[:, :, None]
        W[:, -1, -1] = self.prepared.depth[self.slot]
        return W / self._relative[:, None, None], stable


def rows_for(obstacles: Sequence[Sequence[Obstacle]], thickness: float) -> int:
    """Return how many rows of skin points across a thickness [m] obstacles need."""
    return DEPTH_ROWS if any(changes_along_z(o, thickness) for row in obstacles for o in row) else 1
