"""States that a leg is learned from: end poses from random bodies in motion, and the equilibria of legs held there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from softgym_envs.designs import Design, DesignSpace
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.beams.beam import Beam
from softgym_envs.extensions.beams.parts.leg import VARIABLES, LegScale
from softgym_envs.extensions.beams.robots.tetrapod import MESHES, Tetrapod
from softgym_envs.extensions.fitting.data.sampling import pushed
from softgym_envs.extensions.fitting.parts.held_leg import HeldLeg
from softgym_envs.mechanics.solvers.dynamics import Dynamics
from softgym_envs.mechanics.solvers.statics import Statics

SWING, PATIENCE = np.pi / 20, 8
"""Largest turn of a servo in a control step [rad], and control steps until a new random command."""
SHIFT, TURN, AS_FOUND = 0.02, 0.10, 0.3
"""How far poses are moved (over the length) and turned [rad] in the mean, and the share that stays as it was found."""
TAUT = 5e-4
"""How far poses reach beyond the length of the leg: longer ones are drawn back to at most this."""


def draw_body(space: DesignSpace, boundary: float, rng: np.random.Generator) -> Design:
    """Return a random body; with the probability ``boundary`` some of its variables are at their bounds."""
    unit = rng.random((1, len(space)))
    return space.from_unit(2.0 * (pushed(unit, rng) if rng.random() < boundary else unit)[0] - 1.0)


class Poses(NamedTuple):
    """End poses of legs in motion.

    Attributes:
        body: number of the body, shape (n,).
        leg: number of the leg, shape (n,).
        design: its `VARIABLES`, shape (n, 7).
        place: of the tip in the axes of the root over the length, shape (n, 3).
        turn: rotation from the root to the tip, shape (n, 3, 3).
        down: direction of gravity in the axes of the root, shape (n, 3).
    """

    body: np.ndarray
    leg: np.ndarray
    design: np.ndarray
    place: np.ndarray
    turn: np.ndarray
    down: np.ndarray


def swing_poses(bodies: int, steps: int, seed: int, boundary: float) -> Poses:
    """Return the end poses of the legs of random Tetrapods that swing between random commands.

    Args:
        bodies: number of random bodies; one without equilibrium at rest is passed over.
        steps: control steps of 50 ms for each.
        seed: of bodies and commands.
        boundary: share of bodies at the boundary of the design box.
    """
    robot, rng = Tetrapod(mesh="accurate"), np.random.default_rng(seed)
    rows: list[tuple[np.ndarray, ...]] = []
    for body in range(bodies):
        design = draw_body(robot.design_space, boundary, rng)
        goals = rng.uniform(robot.lower, robot.upper, (1 + steps // PATIENCE, 4)) * rng.choice(
            [0.4, 1.0], (1 + steps // PATIENCE, 1)
        )
        model = robot.build(design)
        legs = [block.chain[[0, -1]] for block in model.blocks if isinstance(block, Beam)]
        values = np.array([design[name] for name in VARIABLES])
        try:
            statics = Statics(model)
            statics.solve(np.zeros(4))
            motion = Dynamics(model, step=0.01, stiffness_damping=0.01, tolerance=1e-9)
            motion.restore(statics.x, statics.effort)
            command = np.zeros(4)
            for step in range(steps):
                change = np.clip(goals[step // PATIENCE] - command, -SWING, SWING)
                for part in np.linspace(0.2, 1.0, 5):
                    motion.advance(command + part * change)
                command = command + change
                for number, (root, tip) in enumerate(legs):
                    axes = motion.x[root + 1 : root + 4]
                    place = axes @ (motion.x[tip] - motion.x[root]) / design["leg_length"]
                    turn = axes @ motion.x[tip + 1 : tip + 4].T
                    rows.append((np.array(body), np.array(number), values, place, turn, -axes[:, 2]))
        except ConvergenceError:
            continue
    return Poses(*(np.stack(column) for column in zip(*rows, strict=True)))


class LegStates(NamedTuple):
    """Equilibria of held legs, without dimensions; see `pose` for the coordinates.

    Attributes:
        body: number of the body whose pose it was, shape (n,).
        y: coordinates, shape (n, 15).
        shape: of the legs, shape (n, 5).
        energy: shape (n,).
        wrench: on the tip in the axes of the root, shape (n, 6).
        middle: place of the middle of mass, shape (n, 3).
        compliance: of a free tip, shape (n, 6, 6); NaN where it is not known.
    """

    body: np.ndarray
    y: np.ndarray
    shape: np.ndarray
    energy: np.ndarray
    wrench: np.ndarray
    middle: np.ndarray
    compliance: np.ndarray


def held_states(
    poses: Poses, copies: int, seed: int, boundary: float, *, elements: int = MESHES["accurate"]
) -> LegStates:
    """Return equilibria of legs held at poses: of their own dimensions and, every second copy, of others.

    A path is on one branch of equilibria until it is unstable: what comes after is left out.

    Args:
        poses: end poses; those of one leg in turn are followed as a path.
        copies: how many times each is used.
        seed: of dimensions and shifts.
        boundary: share of other dimensions at the boundary of the design box.
        elements: of each leg.
    """
    space, rng = Tetrapod().design_space, np.random.default_rng(seed)
    found: list[tuple[np.ndarray, ...]] = []
    order = rng.permutation(np.unique(4 * poses.body + poses.leg))
    for key in order:
        path = np.flatnonzero(4 * poses.body + poses.leg == key)
        for copy in range(copies):
            values = poses.design[path[0]]
            if copy % 2:
                drawn = draw_body(space, boundary, rng)
                values = np.array([drawn[name] for name in VARIABLES])
            scale = LegScale.of(dict(zip(VARIABLES, values, strict=True)))
            moved = 0.0 if rng.random() < AS_FOUND else 1.0
            place = poses.place[path] + moved * SHIFT * rng.standard_normal((len(path), 3))
            spin = moved * TURN * rng.standard_normal((len(path), 3))
            turn = Rotation.from_rotvec(spin).as_matrix() @ poses.turn[path]
            far = np.linalg.norm(place, axis=1)
            place *= np.where(far > 1.0, (1.0 + TAUT * rng.random(len(path))) / far, 1.0)[:, None]
            weight = 9.81 * float(scale.weight) * poses.down[path]
            targets = np.concatenate([place[:, None], turn.transpose(0, 2, 1)], axis=1)
            states = HeldLeg(scale.shape, elements).follow(targets, weight)
            stable = np.cumsum(states.negative != 0) == 0
            y = np.concatenate([place, turn.reshape(-1, 9), weight], axis=1)
            shape = np.broadcast_to(scale.shape, (len(path), 5))
            parts = (poses.body[path], y, shape, states.energy, states.wrench, states.middle, states.compliance)
            found.append(tuple(part[stable] for part in parts))
    return LegStates(*(np.concatenate(column) for column in zip(*found, strict=True)))
