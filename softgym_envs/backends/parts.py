"""Backends of robots that consist of learned parts: the solvers of finite elements on a body with few unknowns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_matrix

from softgym_envs.backends.backend import PointForce, State
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.designs import Design
from softgym_envs.mechanics.elements.parts import PoseParts
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.dynamics import Motion
from softgym_envs.mechanics.solvers.equilibrium import SATURATED, Equilibrium
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.domain import LOADED, OUTSIDE, SOFT, SPREAD
from softgym_envs.surrogate.parts.weights import LearnedLeg

SOFTEST = 100.0
"""Smallest stiffness of a trusted state while its actuators are held, over that of a part: EI / L^3. Spins count as
motions of a point at the robot's `workspace_scale`."""


class Held(NamedTuple):
    """How a body resists while its actuators are held.

    Attributes:
        stiffness: smallest eigenvalue of its stiffness [N/m].
        error: how far the errors of its parts may put the effectors off [m], shape (n_e,).
    """

    stiffness: float
    error: np.ndarray


def held_body(statics: Statics, arm: float, x: np.ndarray, effort: np.ndarray, held: np.ndarray) -> Held:
    """Return how a body of parts resists at a state, whether it moves or not.

    Args:
        statics: solver of the body, which is not moved.
        arm: distance by which spins are counted as motions [m].
        x: rows, shape (n, 3).
        effort: of all constraints, shape (size,).
        held: which actuators are held, shape (n_a,).
    """
    model, linear = statics.model, statics.linearisation
    assembled = linear.assemble(x, effort)
    assert assembled is not None and assembled.tangent is not None
    n = len(assembled.residual)
    lower = csc_matrix((assembled.tangent, linear.assembly.indices, linear.assembly.indptr), shape=(n, n)).toarray()
    tangent = lower + np.tril(lower, -1).T
    scale = np.ones(n)
    spins = model.kinematics.spin_number
    scale[spins[spins >= 0]] = 1.0 / arm
    driven = np.flatnonzero(held)
    columns = scale[:, None] * assembled.gradients[:, driven]
    free = np.linalg.qr(columns, mode="complete")[0][:, len(driven) :] if len(driven) else np.eye(n)
    motions = scale[:, None] * free
    values, vectors = np.linalg.eigh(motions.T @ tangent @ motions)
    motions = motions @ vectors
    sizes = dict(model.roles)
    first = sizes.get("a", 0)
    effectors = slice(first, first + sizes.get("e", 0))
    unit = (motions / values) @ (motions.T @ assembled.gradients[:, effectors])
    fields = np.stack([model.kinematics.row_velocity(x, field) for field in unit.T])
    total = np.zeros(len(fields))
    for block in model.blocks:
        if block.learned:
            total += (block.possible_errors(x, fields) ** 2).sum(axis=0)
    return Held(float(values[0]), np.sqrt(total))


class PartsBackend(FEMBackend):
    """States of a robot of learned parts: static equilibria with exact ``W``, or motion in time.

    The equations are those of finite elements, and so are servos that saturate at their ``max_effort``. In motion the
    mass of a part is spread along the line between its ends, and damping is that of its stiffness at the start of each
    time step. A state is trusted if its parts are within the poses and loads that they learned, the body resists
    enough while its actuators are held, and the errors of the parts hardly move the effectors.

    Args:
        robot: the robot, which touches nothing.
        design: first design; missing variables take their baseline.
        weights: folder of the weights of the part; default the shipped ones.
        dynamics: as for `FEMBackend`.
        control_step: likewise [s].
        time_step: likewise [s].
        mass_damping: likewise [1/s].
        stiffness_damping: likewise [s].

    Raises:
        WeightsError: if the weights are missing, damaged or of another part.
        ValueError: for a robot that may touch something.
    """

    takes_touch = False

    def __init__(
        self,
        robot: Robot,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
        *,
        dynamics: bool = False,
        control_step: float = 0.05,
        time_step: float = 0.01,
        mass_damping: float = 0.0,
        stiffness_damping: float = 0.01,
    ) -> None:
        if robot.may_touch:
            raise ValueError(
                f"robot '{robot.name}': learned parts do not touch anything, got obstacles or self_contact; use "
                "backend='fem'"
            )
        self.part = LearnedLeg(weights)
        self._learned = robot.of_parts({"leg": self.part})
        super().__init__(
            robot, design, dynamics=dynamics, control_step=control_step, time_step=time_step,
            mass_damping=mass_damping, stiffness_damping=stiffness_damping,
        )  # fmt: skip

    @classmethod
    def batch_class(cls, robot: Robot, options: Mapping[str, object]) -> str | None:
        return None

    def _build(self, design: Design) -> MechanicalModel:
        return self._learned.build(design)

    def touch(self, load: PointForce | None) -> None:
        if load is not None:
            raise ValueError("learned parts take no forces on their surface; allowed: backend='fem'")
        super().touch(None)

    def _state(
        self, equilibrium: Equilibrium, command: np.ndarray, motion: Motion | None = None, *, still: bool = False
    ) -> State:
        state = super()._state(equilibrium, command, motion, still=still)
        held = np.abs(state.effort) < self.largest_efforts * SATURATED
        arm = self.robot.workspace_scale
        body = held_body(self._statics, arm, equilibrium.x, equilibrium.effort, held)
        parts = next(block for block in self.model.blocks if isinstance(block, PoseParts))
        uncertainty = float(np.linalg.norm(body.error[:3]))
        distrust = OUTSIDE if state.distrust & LOADED else 0
        if not body.stiffness > SOFTEST * parts.scale / parts.length**2:
            distrust |= SOFT
        if not uncertainty <= self.robot.goal_tolerance:
            distrust |= SPREAD
        return replace(state, uncertainty=uncertainty, distrust=distrust)
