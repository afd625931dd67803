"""Grippers of rotated and shifted copies of one finger, from the finger's own model (thesis, sec. 4.3.1 and 4.3.2).

Eight coordinates describe a `ContactFinger`: its cables ``l`` and the pose ``z`` of its contact points in its own axes.
With ``U`` the energy of a finger, a rigid object that fingers ``k`` hold at the pose ``p`` has the energy

    E(l, p) = sum_k U(l_k, z_k(p)) - work of the load on the object,

so with ``J_k = dz_k / dp`` the tensions are ``dU / dl_k`` and the object is in equilibrium when the wrenches
``J_k^T dU / dz_k`` add up to the load. These are six equations besides those of the cables. Their tangent is the second
derivative of ``E``, including that of ``z_k``, because the lever arms of the forces rotate with the object. Its
inverse gives the condensed model of the gripper, the exact derivative of its equilibrium, whether the finger's model is
exact or learned. One learned finger thus serves any number of fingers in any placement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.grasping.control.coupling import cross_matrix
from softgym_envs.extensions.grasping.control.finger_models import FingerModel
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.frames import frame_rows, rotation_vector_matrix
from softgym_envs.mechanics.solvers.complementarity import solve_complementarity
from softgym_envs.robots.grippers import FingerRobot
from softgym_envs.wording import counted

#: Number of coordinates of a pose, and lever arm [m] by which norms convert rotations to displacements.
POSE, ARM = 6, 0.03


@dataclass(frozen=True)
class FingersState:
    """Equilibrium of fingers and the object that they hold.

    Attributes:
        command: commanded displacements [m] or tensions [N] of the cables, shape (n_a,).
        displacement: displacements of the cables [m], shape (n_a,); larger than commanded if slack.
        effort: tensions [N], shape (n_a,).
        slack: cables that are slack, shape (n_a,).
        position: centre of the object [m], shape (3,).
        rotation: its rotation from rest, shape (3, 3).
        coordinates: of each finger, in its own axes, shape (F, 8).
        wrenches: efforts on the pose of each finger in its own axes [N, N m], shape (F, 6).
        tips: of the fingers [m], shape (F, 3).
        condensed: model of all cables (role ``a``) and the object's centre (role ``e``).
        iterations: of Newton's method, summed over all increments.
        uncertainty: largest uncertainty of a tip [m]; 0 with finite elements.
        trusted: the states of all fingers are in the domain of the model.
    """

    command: np.ndarray
    displacement: np.ndarray
    effort: np.ndarray
    slack: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    coordinates: np.ndarray
    wrenches: np.ndarray
    tips: np.ndarray
    condensed: CondensedModel
    iterations: int
    uncertainty: float
    trusted: bool


@dataclass(frozen=True)
class _Point:
    """Cables (n_a,), position (3,) and rotation (3, 3) of the object."""

    cables: np.ndarray
    position: np.ndarray
    rotation: np.ndarray

    def moved(self, step: np.ndarray) -> _Point:
        """Return the point after a step in cables, position and spin, shape (n_a + 6,)."""
        cables, shift, spin = np.split(step, [-POSE, -3])
        rotation = rotation_vector_matrix(spin) @ self.rotation
        # Orthonormalise, so that round-off does not accumulate over a long motion.
        rotation = 1.5 * rotation - 0.5 * rotation @ rotation.T @ rotation
        return _Point(self.cables + cables, self.position + shift, rotation)


@dataclass(frozen=True)
class _Linear:
    """The system of equations, linearised at a point.

    Attributes:
        point: the point.
        coordinates, effort, tips: of the fingers, shapes (F, 8), (F, 8), (F, 3).
        jacobian: derivative of the fingers' poses with respect to position and spin of the object, shape (F, 6, 6).
        wrench: sum of the fingers' wrenches on position and spin [N, N m], shape (6,).
        stiffness: of cables and object without the load, shape (n_a + 6, n_a + 6).
    """

    point: _Point
    coordinates: np.ndarray
    effort: np.ndarray
    tips: np.ndarray
    jacobian: np.ndarray
    wrench: np.ndarray
    stiffness: np.ndarray

    @property
    def tension(self) -> np.ndarray:
        """Efforts of the cables [N], shape (n_a,)."""
        return self.effort[:, :-POSE].ravel()


class _NewtonFailed(Exception):
    """Newton's method failed on one increment."""


def _sine_jacobian(rotation: np.ndarray) -> np.ndarray:
    """Derivative of ``sin(angle) * axis`` of a rotation (3, 3) by its spin, shape (3, 3)."""
    return 0.5 * (np.trace(rotation) * np.eye(3) - rotation)


def _sine_curvature(rotation: np.ndarray, effort: np.ndarray) -> np.ndarray:
    """Second derivative of ``effort . sin(angle) * axis`` by the spin, shape (3, 3), at a rotation (3, 3)."""
    half = 0.5 * cross_matrix(effort) @ rotation.T
    return 0.5 * (half + half.T) - np.trace(half) * np.eye(3)


class CoupledFingers:
    """Quasi-static model of fingers that hold a free rigid object; each state is found from the last one.

    Contact is that of `FingerRobot`: the contact points are tied to the object, in tension as in compression.

    Args:
        fingers: finite-element or learned model of one finger.
        placements: rotation (3, 3) and shift [m] (3,) of each finger. Under gravity, rotations must preserve its
            direction, because the model of the finger includes its weight.
        centre: centre of the object at rest [m], shape (3,). The placements determine where the fingers hold it.
        load: force on the centre [N] and torque [N m] on the object from outside, shape (6,). Like the efforts of
            `Pose`, the torque is conjugate to the sines of the rotation. A torque of constant direction in space has no
            energy, and its condensed model would not be symmetric.
        unilateral: cables cannot push.
        tolerance: largest remaining correction at convergence [m].
        max_iterations: limit on Newton iterations per increment.
        max_halvings: the smallest increment is ``0.5 ** max_halvings`` of the whole step.

    Raises:
        ValueError: for malformed placements, centre or load.
    """

    def __init__(
        self,
        fingers: FingerModel,
        placements: Sequence[tuple[np.ndarray, Sequence[float] | np.ndarray]],
        centre: np.ndarray | Sequence[float],
        *,
        load: np.ndarray | Sequence[float] = (0.0,) * 6,
        unilateral: bool = True,
        tolerance: float = 1e-7,
        max_iterations: int = 30,
        max_halvings: int = 8,
    ) -> None:
        if not placements:
            raise ValueError("placements are empty: a gripper needs at least one finger")
        for turn, shift in placements:
            frame_rows(shift, turn)  # rejects reflections: a mirrored finger has a different model
        self.fingers = fingers
        self.turns = np.array([turn for turn, _ in placements], dtype=float)
        self.shifts = np.array([shift for _, shift in placements], dtype=float)
        self.centre, self.load = np.asarray(centre, dtype=float), np.asarray(load, dtype=float)
        for name, value, shape in (
            ("shifts", self.shifts, (len(placements), 3)),
            ("centre", self.centre, (3,)),
            ("load", self.load, (POSE,)),
        ):
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"{name} must be finite with shape {shape}, got {value.tolist()}")
        #: Where the fingers hold the object, relative to its centre and in its own axes [m], shape (F, 3).
        self.offsets = self.turns @ fingers.origin + self.shifts - self.centre
        self.cables = len(fingers.span) - POSE
        self.count = self.cables * len(placements)
        self.unilateral = np.full(self.count, unilateral)
        self.tolerance, self.max_iterations, self.max_halvings = tolerance, max_iterations, max_halvings
        self._limit = 0.25 * fingers.span
        self.reset()

    @classmethod
    def for_robot(
        cls, robot: FingerRobot, fingers: FingerModel, design: Mapping[str, float] | None = None, **options
    ) -> CoupledFingers:
        """Return the coupled fingers of a gripper; ``options`` are ``load`` and other arguments of the class.

        Raises:
            ValueError: for a gripper without an object.
        """
        centre = robot.object_frame(robot.design_space.complete(design))
        if centre is None:
            raise ValueError(f"the fingers of robot '{robot.name}' do not hold a rigid object")
        return cls(fingers, robot.placements, centre, **{"unilateral": bool(robot.finger.unilateral.all()), **options})

    def reset(self) -> None:
        """Return to the undeformed shape without load; `solve` applies the load."""
        self._point = _Point(np.zeros(self.count), self.centre.copy(), np.eye(3))
        self._current_load = np.zeros(POSE)
        self._current: _Linear | None = None

    def restore(self, state: FingersState) -> None:
        """Start the next call of `solve` from an earlier state of these fingers."""
        self._point = _Point(state.displacement, state.position, state.rotation)
        self._current_load = self.load
        self._current = None

    # -- one linearisation ------------------------------------------------------------------------------------------

    def _linearise(self, point: _Point) -> _Linear | None:
        """Linearise at a point; None if a finger has no state there or the object has rotated too far."""
        R = point.rotation
        # Sines determine a rotation only up to 90 degrees.
        if not np.trace(R) > 1.0 + 2.0 * 0.05:
            return None
        arms = self.offsets @ R.T
        moved = point.position - self.centre + arms - self.offsets
        sines = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        F, m = len(self.turns), self.cables
        coordinates = np.concatenate(
            [point.cables.reshape(F, m), np.einsum("fji,fj->fi", self.turns, moved), sines @ self.turns], axis=1
        )
        try:
            effort, W, tips = self.fingers.evaluate(coordinates)
            S = np.linalg.inv(W[:, : m + POSE, : m + POSE])
        except (ConvergenceError, np.linalg.LinAlgError):
            return None
        if not (np.isfinite(effort).all() and np.isfinite(S).all()):
            return None
        back = np.swapaxes(self.turns, 1, 2)
        J = np.zeros((F, POSE, POSE))
        J[:, :3, :3] = back
        J[:, :3, 3:] = -back @ cross_matrix(arms)
        J[:, 3:, 3:] = back @ _sine_jacobian(R)
        forces = np.einsum("fij,fj->fi", self.turns, effort[:, m : m + 3])
        twists = np.einsum("fij,fj->i", self.turns, effort[:, m + 3 :])
        K = np.zeros((self.count + POSE, self.count + POSE))
        for k in range(F):
            rows = slice(k * m, (k + 1) * m)
            K[rows, rows] = S[k, :m, :m]
            K[rows, -POSE:] = S[k, :m, m:] @ J[k]
            K[-POSE:, rows] = K[rows, -POSE:].T
        K[-POSE:, -POSE:] = np.einsum("fji,fjk,fkl->il", J, S[:, m:, m:], J)
        mixed = forces.T @ arms
        K[-3:, -3:] += 0.5 * (mixed + mixed.T) - np.trace(mixed) * np.eye(3) + _sine_curvature(R, twists)
        tips = np.einsum("fij,fj->fi", self.turns, tips) + self.shifts
        wrench = np.einsum("fji,fj->i", J, effort[:, m:])
        return _Linear(point, coordinates, effort, tips, J, wrench, 0.5 * (K + K.T))

    def _compliance(self, here: _Linear, load: np.ndarray) -> np.ndarray:
        """Return the compliance of cables, position and spin under a load, shape (n_a + 6, n_a + 6)."""
        K = here.stiffness.copy()
        K[-3:, -3:] -= _sine_curvature(here.point.rotation, load[3:])
        # Cables and rotations differ in units: scaling the diagonal to one preserves accuracy.
        scale = 1.0 / np.sqrt(np.abs(np.diag(K)))
        C = scale[:, None] * np.linalg.inv(scale[:, None] * K * scale) * scale
        return 0.5 * (C + C.T)

    def _correction(
        self, C: np.ndarray, here: _Linear, target: np.ndarray, load: np.ndarray, forced: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the Newton step of cables, position and spin with compliance ``C``, and the tensions after it."""
        external = np.concatenate([load[:3], _sine_jacobian(here.point.rotation).T @ load[3:]])
        missing = np.append(np.zeros(self.count), external - here.wrench)
        tension, a = here.tension, slice(0, self.count)
        goal = target
        if not forced:
            offset = here.point.cables + (C @ missing)[a] - C[a, a] @ tension - target
            if self.unilateral.any():
                goal = solve_complementarity(C[None, a, a], offset[None], self.unilateral)[0]
            else:
                goal = np.linalg.solve(C[a, a], -offset)
        missing[a] = goal - tension
        return C @ missing, goal

    # -- Newton -----------------------------------------------------------------------------------------------------

    @staticmethod
    def _norm(step: np.ndarray) -> float:
        return float(max(np.abs(step[:-3]).max(), ARM * np.abs(step[-3:]).max()))

    def _newton(
        self, start: _Linear, target: np.ndarray, load: np.ndarray, forced: bool
    ) -> tuple[_Linear, np.ndarray, np.ndarray, int]:
        """Solve one load level; return the state, its compliance, the tensions and the number of iterations.

        A step is shortened until the simplified correction after it is smaller (Deuflhard 2004), as in `Statics`.
        """
        here = start
        C = self._compliance(here, load)
        step, tension = self._correction(C, here, target, load, forced)
        for iteration in range(1, self.max_iterations + 1):
            norm = self._norm(step)
            if not np.isfinite(norm):
                raise _NewtonFailed
            poses = np.einsum("fij,j->fi", here.jacobian, step[-POSE:])
            change = np.concatenate([step[:-POSE].reshape(-1, self.cables), poses], axis=1)
            # Stay within the range in which the model is valid.
            length = float(min(1.0, 1.0 / max((np.abs(change) / self._limit).max(), 1e-12)))
            while True:
                there = self._linearise(here.point.moved(length * step))
                if there is not None:
                    remaining = self._norm(self._correction(C, there, target, load, forced)[0])
                    # Below the tolerance, round-off dominates.
                    if remaining <= (1.0 - 0.25 * length) * norm or remaining <= self.tolerance:
                        break
                length *= 0.5
                if length < 1e-3:
                    raise _NewtonFailed
            here = there
            C = self._compliance(here, load)
            step, tension = self._correction(C, here, target, load, forced)
            if self._norm(step) <= self.tolerance:
                return here, C, tension, iteration
        raise _NewtonFailed

    def solve(self, command: np.ndarray | Sequence[float], mode: str = "displacement") -> FingersState:
        """Return the equilibrium under commanded cables, starting from the current one.

        Args:
            command: displacements [m] or tensions [N] of all cables, finger by finger, shape (n_a,).
            mode: ``"displacement"`` or ``"effort"``.

        Raises:
            ConvergenceError: if no equilibrium is found; the current state is then unchanged.
            ValueError: for a malformed command, an unknown mode, or a negative tension of cables that cannot push.
        """
        command = np.asarray(command, dtype=float)
        if command.shape != (self.count,) or not np.isfinite(command).all():
            raise ValueError(f"command must be {counted(self.count, 'finite number')}, got {command.tolist()}")
        if mode not in ("displacement", "effort"):
            raise ValueError(f"mode = {mode!r} is unknown; allowed: 'displacement', 'effort'")
        forced = mode == "effort"
        if forced and (command[self.unilateral] < 0.0).any():
            raise ValueError(f"tensions {command.tolist()} N must not be negative: the cables cannot push")
        here = self._linearise(self._point) if self._current is None else self._current
        if here is None:
            raise ConvergenceError("the model of the fingers has no equilibrium at the starting point")
        start, start_load = (here.tension if forced else here.point.cables), self._current_load
        done, size, iterations = 0.0, 1.0, 0
        while done < 1.0:
            level = min(1.0, done + size)
            target, load = start + level * (command - start), start_load + level * (self.load - start_load)
            try:
                here, C, tension, spent = self._newton(here, target, load, forced)
            except (_NewtonFailed, np.linalg.LinAlgError):
                size = 0.5 * (level - done)
                if size < 0.5**self.max_halvings:
                    raise ConvergenceError(
                        f"the fingers find no equilibrium for cables {command.tolist()} ({mode}): "
                        f"stopped at {100 * done:.1f} % of the increment",
                        fraction=done,
                    ) from None
                continue
            done, size, iterations = level, 1.5 * size, iterations + spent
        self._point, self._current, self._current_load = here.point, here, self.load
        return self._state(here, C, command, tension, iterations, forced)

    def _state(
        self, here: _Linear, C: np.ndarray, command: np.ndarray, tension: np.ndarray, iterations: int, forced: bool
    ) -> FingersState:
        point, n = here.point, self.count
        slack = np.zeros(n, dtype=bool)
        if not forced:
            slack = self.unilateral & (tension <= 0.0) & (point.cables > command + self.tolerance)
        effort = np.where(slack, 0.0, np.where(self.unilateral, np.maximum(here.tension, 0.0), here.tension))
        W = C[: n + 3, : n + 3].copy()
        full = np.append(effort, np.zeros(3))
        uncertainty, trusted = self.fingers.trust(here.coordinates)
        return FingersState(
            command=command.copy(),
            displacement=point.cables,
            effort=effort,
            slack=slack,
            position=point.position,
            rotation=point.rotation,
            coordinates=here.coordinates,
            wrenches=here.effort[:, self.cables :],
            tips=here.tips,
            condensed=CondensedModel(
                W, np.concatenate([point.cables, point.position]) - W @ full, full, (("a", n), ("e", 3))
            ),
            iterations=iterations,
            uncertainty=float(uncertainty.max()),
            trusted=bool(trusted.all()),
        )
