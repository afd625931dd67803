"""Fingers that hold a rigid object, as elements: what a gripper knows of them is one finger's energy.

Eight coordinates describe a `ContactFinger`: the displacements ``l`` of its two cables and the pose ``z`` of its
contact points in its own axes. With ``U`` the energy of a finger, those that hold an object at the pose ``p`` store

    E(l, p) = sum_k U(l_k, z_k(p)),

so one model of one finger, learned or exact, serves any number of fingers in any placement (thesis, sec. 4.3.1 and
4.3.2). The coordinates are linear in the rows of the object's frame and of the cables: the frame makes the tangent
exact for large rotations (`softgym_envs.mechanics.frames`), and the solvers of finite elements find equilibria, slack
cables and ``W``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.grasping.robots.contact_finger import ContactFinger
from softgym_envs.mechanics.elements.block import Massless, add_entries, lower_pairs
from softgym_envs.mechanics.solvers.equilibrium import Equilibrium
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.surrogate.model import Context, SurrogateModel

POSE, CABLES = 6, 2
SIZE = CABLES + POSE
"""Coordinates of a finger: its cables [m], then displacements [m] and sines [1] of the pose, in its own axes."""


class Fingers(NamedTuple):
    """Fingers at coordinates.

    Attributes:
        effort: conjugate to the coordinates [N, N m], shape (F, 8).
        stiffness: its derivative, shape (F, 8, 8).
    """

    effort: np.ndarray
    stiffness: np.ndarray


class FingerEnergy(Protocol):
    """Energy of identical fingers, known by its derivatives.

    Attributes:
        origin: of the pose at rest, in the axes of a finger [m], shape (3,).
        learned: whether it has `errors`.
    """

    origin: np.ndarray
    learned: bool

    def evaluate(self, y: np.ndarray) -> Fingers | None:
        """Return the derivatives at coordinates (F, 8); None where they do not exist."""

    def knows(self, y: np.ndarray) -> bool:
        """Whether the energy is known at coordinates (F, 8)."""

    def errors(self, y: np.ndarray) -> np.ndarray:
        """Return independent errors that the efforts of all fingers may have at coordinates (F, 8), shape (k, F, 8)."""


class LearnedFingers:
    """The learned energy of the fingers of one body.

    Args:
        model: learned model of a `ContactFinger`.
        design: of the fingers; other variables are left out, and missing ones take their baseline.

    Raises:
        ValueError: for a model of another robot.
    """

    learned = True

    def __init__(self, model: SurrogateModel, design: Mapping[str, float] | None = None) -> None:
        robot = model.robot
        if not isinstance(robot, ContactFinger):
            raise ValueError(f"the model must be of robot 'contact_finger', got one of robot '{robot.name}'")
        own = {name: value for name, value in (design or {}).items() if name in robot.design_space.names}
        complete = robot.design_space.complete(own)
        self.origin = robot.object_frame(complete)
        self._model, self._context = model, model.context(complete.array[None])
        self._known = bool(self._context.arrays["known"].all())
        domain, calibration = model.card.get("domain", {}), model.card.get("calibration", {})
        # Of what the members differ by: such that it covers 95 % of the errors of objects that fingers hold.
        self._inflation = calibration.get("inflation", domain.get("inflation", np.inf))

    def evaluate(self, y: np.ndarray) -> Fingers | None:
        context = Context.shared(self._context, len(y))
        found = Fingers(self._model.effort(context, y), self._model.stiffness(context, y))
        return found if np.isfinite(found.effort).all() and np.isfinite(found.stiffness).all() else None

    def knows(self, y: np.ndarray) -> bool:
        domain = self._model.domain
        return self._known and bool(((y >= domain.low) & (y <= domain.high)).all())

    def errors(self, y: np.ndarray) -> np.ndarray:
        efforts = self._model.member_efforts(Context.shared(self._context, len(y)), y)
        return self._inflation / np.sqrt(len(efforts)) * (efforts - efforts.mean(axis=0))


class SolvedFingers:
    """Finite elements of the fingers of one body; each follows a path of its own.

    Args:
        robot: the finger.
        design: of the body; other variables are left out.
        tolerance: of the equilibria [m].

    Attributes:
        found: the equilibria at which the derivatives were asked for, in this order, by finger.
        patience: how many more coordinates may have no equilibrium; then `evaluate` raises ConvergenceError, since each
            costs a second.

    Raises:
        InfeasibleDesign: if the finger cannot be meshed.
    """

    learned = False

    def __init__(self, robot: ContactFinger, design: Mapping[str, float], *, tolerance: float = 1e-10) -> None:
        own = robot.design_space.complete({name: design[name] for name in robot.design_space.names})
        self.origin, self._model = robot.object_frame(own), robot.build(own)
        self._tolerance, self.patience = tolerance, np.inf
        self._solvers: list[Statics] = []
        self.found: list[list[Equilibrium]] = []

    def evaluate(self, y: np.ndarray) -> Fingers | None:
        while len(self._solvers) < len(y):
            statics = Statics(self._model, tolerance=self._tolerance, max_iterations=12, max_halvings=3)
            statics.unilateral = np.zeros(SIZE, dtype=bool)  # cables stay where they are, even if they push
            self._solvers.append(statics)
            self.found.append([])
        before = [statics.snapshot for statics in self._solvers]
        try:
            states = [statics.solve(row) for statics, row in zip(self._solvers, y, strict=True)]
        except ConvergenceError:
            for statics, snapshot in zip(self._solvers, before, strict=True):
                statics.snapshot = snapshot
            self.patience -= 1
            if self.patience < 0:
                raise
            return None
        for path, state in zip(self.found, states, strict=True):
            path.append(state)
        stiffness = [np.linalg.inv(state.condensed.W.aa) for state in states]
        return Fingers(np.stack([state.condensed.lambda_.a for state in states]), np.stack(stiffness))

    def knows(self, y: np.ndarray) -> bool:
        return True

    def errors(self, y: np.ndarray) -> np.ndarray:
        return np.zeros((0, *y.shape))


class HeldFingers(Massless):
    """Identical fingers around the frame of a rigid object, whose contact points they hold.

    Args:
        nodes: rest rows [m], shape (n, 3).
        rows: first row of the object's frame, and a row for each finger, whose x and y are its cables [m].
        energy: of the fingers.
        placements: rotation (3, 3) and shift [m] (3,) of each finger.

    Attributes:
        count: number of fingers.
    """

    def __init__(
        self,
        nodes: np.ndarray,
        rows: np.ndarray,
        *,
        energy: FingerEnergy,
        placements: Sequence[tuple[np.ndarray, Sequence[float] | np.ndarray]],
    ) -> None:
        self.energy, self.learned = energy, energy.learned
        frame, own = int(rows[0]), rows[1:]
        self.count = len(own)
        self.nodes_used = np.concatenate([frame + np.arange(4), own])
        # Over these rows the coordinates are linear: the cables, then the frame. Shapes (F, 14) and (F, 8, 14).
        held = 3 * frame + np.arange(12)
        self._dofs = np.array([[3 * row, 3 * row + 1, *held] for row in own])
        self._maps = np.zeros((len(own), SIZE, CABLES + 12))
        self._maps[:, :CABLES, :CABLES] = np.eye(CABLES)
        directors = nodes[frame + 1 : frame + 4]
        for to_coordinates, (turn, shift) in zip(self._maps, placements, strict=True):
            arm = directors @ (turn @ energy.origin + np.asarray(shift, dtype=float) - nodes[frame])
            to_coordinates[2:5, 2:5] = turn.T
            for k in range(3):
                here = slice(5 + 3 * k, 8 + 3 * k)
                to_coordinates[2:5, here] = arm[k] * turn.T
                # The sines of a rotation are half the sum of the products of directors at rest and now; see `Pose`.
                to_coordinates[5:8, here] = 0.5 * turn.T @ np.cross(np.eye(3), directors[k])
        self._rest = np.zeros((len(own), SIZE))
        self._rest = self.coordinates(nodes)
        self._last: tuple[np.ndarray, Fingers] | None = None

    def coordinates(self, x: np.ndarray) -> np.ndarray:
        """Return the coordinates of the fingers (F, 8) at rows ``x`` (n, 3)."""
        return (self._maps @ x.ravel()[self._dofs][:, :, None])[:, :, 0] - self._rest

    def _evaluate(self, x: np.ndarray) -> Fingers | None:
        y = self.coordinates(x)
        if self._last is None or not np.array_equal(y, self._last[0]):
            found = self.energy.evaluate(y)
            if found is None:
                return None
            self._last = y, found
        return self._last[1]

    def knows(self, x: np.ndarray) -> bool:
        return self.energy.knows(self.coordinates(x))

    def possible_errors(self, x: np.ndarray, fields: np.ndarray) -> np.ndarray:
        moves = np.einsum("fij,mfj->mfi", self._maps, fields.reshape(len(fields), -1)[:, self._dofs])
        return np.einsum("kfi,mfi->km", self.energy.errors(self.coordinates(x)), moves)

    def stencils(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return [lower_pairs(self._dofs)]

    def add(
        self, x: np.ndarray, gradient: np.ndarray, values: np.ndarray | None, scatter: list[np.ndarray] | None
    ) -> tuple[float, int]:
        """As `ElementBlock.add`; the energy is NaN, since only its derivatives are known."""
        found = self._evaluate(x)
        if found is None:
            return np.inf, 1
        back = self._maps.swapaxes(1, 2)
        np.add.at(gradient.reshape(-1), self._dofs, (back @ found.effort[:, :, None])[:, :, 0])
        if values is not None and scatter is not None:
            tangent = back @ found.stiffness @ self._maps
            r, s = np.tril_indices(tangent.shape[1])
            add_entries(values, scatter[0], 0.5 * (tangent[:, r, s] + tangent[:, s, r]))
        return np.nan, 0


class IdleCables(Massless):
    """Cables that pull nothing but a spring each: those of fingers that a body does not have.

    Args:
        nodes: rest rows [m], shape (n, 3).
        rows: whose x and y are two cables [m], shape (f,).
        stiffness: of a spring [N/m].
    """

    def __init__(self, nodes: np.ndarray, rows: np.ndarray, *, stiffness: float) -> None:
        self.nodes_used, self.stiffness = np.asarray(rows), stiffness
        self._dofs = (3 * self.nodes_used[:, None] + np.arange(CABLES)).ravel()

    def stencils(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return [(self._dofs[:, None], self._dofs[:, None])]

    def add(
        self, x: np.ndarray, gradient: np.ndarray, values: np.ndarray | None, scatter: list[np.ndarray] | None
    ) -> tuple[float, int]:
        length = x.ravel()[self._dofs]
        gradient.reshape(-1)[self._dofs] += self.stiffness * length
        if values is not None and scatter is not None:
            add_entries(values, scatter[0], np.full(len(length), self.stiffness))
        return 0.5 * self.stiffness * float(length @ length), 0


class LearnedFinger:
    """One learned finger as a part of `Robot.parts`.

    Args:
        model: learned model of a `ContactFinger`.
    """

    def __init__(self, model: SurrogateModel) -> None:
        self.model = model

    def __call__(self, design: Mapping[str, float], gravity: np.ndarray) -> dict[str, Any]:
        """Return the options of `HeldFingers` for a body."""
        return {"energy": LearnedFingers(self.model, design)}
