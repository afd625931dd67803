"""Condensed models of robots that are rotated, tied to each other, or hold a rigid object (thesis, eq. 4.6-4.10).

Each part keeps its own model; ties couple them. With ``W`` the block-diagonal compliance of the parts, ``C`` the
tied rows, ``u`` the motion of the object, ``J`` the Jacobian of its tied points and ``f`` the load on it:

    delta = W (effort + C^T m) + free          every part, under actuator efforts and tie forces m
    C delta - J u = gap                        tied rows move together, or with the object
    J^T m + K u = f                            the object is in equilibrium

``K`` is the derivative of the tie forces' torque as the object rotates; with it, the coupled ``W`` is the exact
derivative of the coupled equilibrium. Eliminating ``m`` and ``u`` leaves a symmetric model of actuators and object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.frames import rotation_vector_matrix


def cross_matrix(vectors: np.ndarray) -> np.ndarray:
    """Return ``[v]x`` with ``[v]x w = v x w``, shape (k, 3, 3), for vectors (k, 3)."""
    x, y, z = np.moveaxis(np.asarray(vectors, dtype=float), -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)


def rotate(
    condensed: CondensedModel,
    rotation: np.ndarray,
    shift: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    *,
    points: str = "ec",
) -> CondensedModel:
    """Return the model of a copy of a robot, rotated about the origin and then shifted (thesis, sec. 4.3.1).

    Args:
        condensed: model of the original robot; leading batch shapes are kept.
        rotation: rotation matrix, shape (3, 3).
        shift: translation after the rotation [m], shape (3,).
        points: roles whose rows are coordinates of points; all other rows are scalars and do not change.

    Raises:
        ValueError: if ``rotation`` is not orthogonal, ``shift`` is malformed, or the number of rows of a role in
            ``points`` is not a multiple of three.
    """
    R, shift = np.asarray(rotation, dtype=float), np.asarray(shift, dtype=float)
    # Reflections are allowed: the condensed model of a mirrored robot follows the same rule.
    if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3), rtol=0.0, atol=1e-9):
        raise ValueError(f"rotation must be an orthogonal 3 x 3 matrix, got {R.tolist()}")
    if shift.shape != (3,) or not np.isfinite(shift).all():
        raise ValueError(f"shift must be three finite numbers, got {shift.tolist()}")
    turn = np.eye(condensed.compliance.shape[-1])
    move = np.zeros(len(turn))
    for role, size in condensed.roles:
        if role in points:
            if size % 3:
                raise ValueError(
                    f"role '{role}' has {size} rows, which is not a multiple of three, so they are not points"
                )
            rows = condensed.slices[role]
            turn[rows, rows] = np.kron(np.eye(size // 3), R)
            move[rows] = np.tile(shift, size // 3)
    compliance = turn @ condensed.compliance @ turn.T
    return CondensedModel(
        0.5 * (compliance + np.swapaxes(compliance, -1, -2)),
        condensed.free @ turn.T + move,
        condensed.effort @ turn.T,
        condensed.roles,
    )


@dataclass(frozen=True)
class HeldObject:
    """A rigid object held at points.

    Attributes:
        position: its centre [m], shape (3,).
        points: where it is held, relative to its centre and in its own axes [m], shape (k, 3).
        rotation: its orientation, shape (3, 3).
        load: external force [N] and torque about its centre [N m] (its weight, the spring of a button), shape (6,).
        free: which translations along x, y, z and rotations about them are free, six flags; the others are blocked.
    """

    position: np.ndarray
    points: np.ndarray
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    load: np.ndarray = field(default_factory=lambda: np.zeros(6))
    free: tuple[bool, bool, bool, bool, bool, bool] = (True,) * 6

    def __post_init__(self) -> None:
        for name, shape in (("position", (3,)), ("points", (-1, 3)), ("rotation", (3, 3)), ("load", (6,))):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.size == 0 or value.ndim != len(shape) or value.shape[-1] != shape[-1]:
                raise ValueError(f"{name} of a rigid body must have shape {shape}, got {value.shape}")
            if not np.isfinite(value).all():
                raise ValueError(f"{name} of a rigid body must be finite, got {value.tolist()}")
            object.__setattr__(self, name, value)
        if len(self.free) != 6 or not any(self.free):
            raise ValueError(f"free must be six flags, not all False, got {self.free}")

    @classmethod
    def around(cls, position: np.ndarray, contacts: np.ndarray, **options) -> HeldObject:
        """Return a body at ``position`` [m] (3,), in the world's axes, held at world points ``contacts`` [m] (k, 3)."""
        position = np.asarray(position, dtype=float)
        return cls(position, np.asarray(contacts, dtype=float).reshape(-1, 3) - position, **options)

    @property
    def arms(self) -> np.ndarray:
        """Where it is held, relative to its centre, in the world's axes [m], shape (k, 3)."""
        return self.points @ self.rotation.T

    @property
    def contacts(self) -> np.ndarray:
        """Where it is held [m], shape (k, 3)."""
        return self.position + self.arms

    @property
    def jacobian(self) -> np.ndarray:
        """``J_c``, shape (3 k, 6): motion of the points by translation and rotation vector of the body (eq. 4.9)."""
        k = len(self.points)
        return np.concatenate([np.tile(np.eye(3), (k, 1, 1)), -cross_matrix(self.arms)], axis=2).reshape(3 * k, 6)

    def moved(self, motion: np.ndarray) -> HeldObject:
        """Return the body after a translation and a rotation about its centre, shape (6,) [m, rad]."""
        motion = np.asarray(motion, dtype=float)
        return replace(
            self, position=self.position + motion[:3], rotation=rotation_vector_matrix(motion[3:]) @ self.rotation
        )

    def stiffness(self, forces: np.ndarray) -> np.ndarray:
        """``K = d (J^T m) / d u`` at fixed tie forces ``m`` [N] (3 k,), shape (6, 6).

        The lever arms of the forces rotate with the body. The matrix is symmetric when the forces have no torque about
        the centre; its antisymmetric part, which occurs during iterations and under a torque load, is dropped.
        """
        result = np.zeros((6, 6))
        turn = (cross_matrix(np.reshape(forces, (-1, 3))) @ cross_matrix(self.arms)).sum(axis=0)
        result[3:, 3:] = 0.5 * (turn + turn.T)
        return result


def tie_points(
    models: Sequence[CondensedModel], first: tuple[int, str, int], second: tuple[int, str, int]
) -> np.ndarray:
    """Return the rows ``C``, shape (3, n), that tie two points: ``delta of second - delta of first = gap``.

    Args:
        models: the parts; ``n`` is the number of all their rows.
        first: part, role (``"e"`` or ``"c"``) and index of the first point within its role.
        second: the same for the second point.
    """
    starts = np.cumsum([0, *(len(model.free) for model in models)])
    C = np.zeros((3, starts[-1]))
    for sign, (part, role, index) in ((-1.0, first), (1.0, second)):
        rows = models[part].slices[role]
        if not 0 <= 3 * index <= rows.stop - rows.start - 3:
            raise ValueError(f"part {part} has no point {index} of role '{role}'")
        start = starts[part] + rows.start + 3 * index
        C[:, start : start + 3] += sign * np.eye(3)
    return C


@dataclass(frozen=True)
class Coupled:
    """A coupled model, and maps from its efforts back to the parts.

    Attributes:
        condensed: roles ``a`` (the actuators of all parts, in order) and ``e``: with an object, its centre [m] and, if
            requested, its rotation vector from the current orientation [rad]; then the effectors of the chosen parts.
        condition: condition number of the scaled system of ties that was solved.
        dropped: number of redundant directions of the ties, which carry no force.
        part_sizes: number of rows of each part.
        force_map: efforts on all rows of the parts as an affine function of the actuator efforts, shape (n, 1 + n_a).
        motion_map: motion of the object [m, rad] as an affine function of them, shape (6, 1 + n_a).
    """

    condensed: CondensedModel
    condition: float
    dropped: int
    part_sizes: tuple[int, ...]
    force_map: np.ndarray
    motion_map: np.ndarray

    def efforts(self, effort: np.ndarray) -> list[np.ndarray]:
        """Return the efforts of all rows of every part under actuator efforts (n_a,), including tie forces."""
        every = self.force_map @ np.append(1.0, effort)
        return np.split(every, np.cumsum(self.part_sizes)[:-1])

    def motion(self, effort: np.ndarray) -> np.ndarray:
        """Return the motion of the object from its current pose [m, rad], shape (6,), under actuator efforts (n_a,)."""
        return self.motion_map @ np.append(1.0, effort)


def _stack_parts(
    models: Sequence[CondensedModel],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, np.ndarray]]]:
    """Return block-diagonal W, delta_free and current efforts of the parts, and the rows of each role of each part."""
    if not models or any(model.free.ndim != 1 for model in models):
        raise ValueError("couple needs at least one model, and models without a batch dimension")
    starts = np.cumsum([0, *(len(model.free) for model in models)])
    W, free, current = np.zeros((starts[-1], starts[-1])), np.zeros(starts[-1]), np.zeros(starts[-1])
    rows = []
    for start, model in zip(starts, models, strict=False):
        here = slice(start, start + len(model.free))
        W[here, here], free[here], current[here] = model.compliance, model.free, model.effort
        rows.append({role: start + np.arange(at.start, at.stop) for role, at in model.slices.items()})
    if not (np.isfinite(W).all() and np.isfinite(free).all() and np.isfinite(current).all()):
        raise ValueError("a condensed model contains values that are not finite")
    return W, free, current, rows


@dataclass(frozen=True)
class _Saddle:
    """Inverse of ``[[G, -J], [-J^T, -K]]`` without its redundant ties, and those ties, shape (m, dropped)."""

    inverse: np.ndarray
    redundant: np.ndarray
    condition: float


def _solve_saddle(G: np.ndarray, J: np.ndarray, K: np.ndarray, tolerance: float) -> _Saddle:
    m = len(G)
    # Scale rows and columns of G to a largest entry of one (Ruiz 2001) and columns of J to length one, which
    # cancels units. G may be indefinite: a part that is unstable alone can be stable when it is tied.
    ties = np.ones(m)
    for _ in range(10):
        largest = np.abs(ties[:, None] * G * ties).max(axis=1)
        if (largest == 0.0).any():
            raise ValueError("a tied row has no compliance, so no force can move it")
        ties /= np.sqrt(largest)
    lengths = np.linalg.norm(ties[:, None] * J, axis=0)
    scale = np.concatenate([ties, 1.0 / np.where(lengths > 0.0, lengths, 1.0)])
    system = scale[:, None] * np.block([[G, -J], [-J.T, -K]]) * scale
    if J.shape[1]:
        hold = np.linalg.svd(system[:m, m:], compute_uv=False)
        if len(hold) < J.shape[1] or not hold[-1] > 1e-6 * hold[0]:
            raise ValueError(
                "the points do not hold the object: it can move freely; block directions with its flags 'free'"
            )
    values, vectors = np.linalg.eigh(system)
    size = np.abs(values)
    regular = size > tolerance * size.max()
    vectors = scale[:, None] * vectors
    inverse = (vectors[:, regular] / values[regular]) @ vectors[:, regular].T
    return _Saddle(inverse, vectors[:m, ~regular], float(size.max() / size[regular].min()))


def couple(
    models: Sequence[CondensedModel],
    ties: np.ndarray | None = None,
    gap: np.ndarray | None = None,
    *,
    body: HeldObject | None = None,
    orientation: bool = False,
    effectors: Sequence[int] | None = None,
    tolerance: float = 1e-10,
) -> Coupled:
    """Tie robots to each other, or to a rigid object that their contact points hold.

    Rows that are neither actuators nor tied keep the effort in their model as a dead load. Like the contacts of the
    thesis, ties act in tension, compression and shear.

    Coupling amplifies errors of the parts: held parts are far stiffer than free ones, so the compliance of a gripper is
    a small difference of large numbers. Random relative errors in W of three fingers grow about a thousandfold in W_ea
    of the cube that they hold (1e-5 becomes 1.5 %).

    Args:
        models: models of the parts at their current states (roles ``a`` and ``e``, ``c``, ...), unbatched.
        ties: rows ``C``, shape (m, n), over all rows of the parts, see `tie_points`.
        gap: ``C delta`` to hold, shape (m,); for two points, their distance as a vector [m].
        body: object whose points are tied to all rows of role ``c``, part by part.
        orientation: include the rotation of the object.
        effectors: parts whose effector rows are kept; default the first, or none with an object.
        tolerance: tie directions with a relative compliance below this count as rigid and, unless the object needs
            them, as redundant: they carry no force.

    Raises:
        ValueError: for malformed or non-finite input, an object that its points do not hold, or redundant ties that
            contradict each other.
    """
    W, free, current, rows = _stack_parts(models)
    actuators = np.concatenate([part["a"] for part in rows])
    C = np.zeros((0, len(free))) if ties is None else np.atleast_2d(np.asarray(ties, dtype=float))
    d = np.zeros(len(C)) if gap is None else np.asarray(gap, dtype=float).ravel()
    if C.shape != (len(d), len(free)) or not (np.isfinite(C).all() and np.isfinite(d).all()):
        raise ValueError(f"ties and gap must be finite, of shapes (m, {len(free)}) and (m,), got {C.shape}, {d.shape}")
    J, K, load, pose = np.zeros((len(C), 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    moving = np.zeros(0, dtype=int)
    if body is not None:
        held = np.concatenate([part.get("c", actuators[:0]) for part in rows])
        if len(held) != body.points.size:
            raise ValueError(f"the object has {len(body.points)} points, but the parts have {len(held)} contact rows")
        C, d = np.concatenate([C, np.eye(len(free))[held]]), np.concatenate([d, body.contacts.ravel()])
        J, K, load = np.concatenate([J, body.jacobian]), body.stiffness(current[held]), body.load
        pose[:3] = body.position
        moving = np.flatnonzero(body.free)
    if len(C) == 0:
        raise ValueError("nothing to couple: pass ties or a body")
    tied = np.any(C != 0.0, axis=0)
    if tied[actuators].any():
        raise ValueError("actuator rows cannot be tied: tie effector or contact rows")
    CW = C @ W
    saddle = _solve_saddle(CW @ C.T, J[:, moving], K[np.ix_(moving, moving)], tolerance)

    # Everything is affine in the efforts on the kept rows (actuators first), then on the object.
    # Column 0 is the constant.
    chosen = ([0] if body is None else []) if effectors is None else effectors
    kept = np.concatenate([actuators, *(rows[part].get("e", actuators[:0]) for part in chosen)])
    count = 0 if body is None else 6 if orientation else 3
    forces = np.zeros((len(free), 1 + len(kept) + count))
    forces[:, 0] = np.where(tied, 0.0, current)
    forces[actuators, 0] = 0.0
    forces[kept, np.arange(1, 1 + len(kept))] = 1.0
    loads = np.zeros((6, forces.shape[1]))
    loads[:, 0] = load
    loads[np.arange(count), 1 + len(kept) + np.arange(count)] = 1.0
    right = np.concatenate([-CW @ forces, -loads[moving]])
    right[: len(C), 0] += d - C @ free
    unmet = saddle.redundant.T @ right[: len(C), 0]
    # The gap that cannot be closed is compared with a motion of the ties by a millionth of the parts' size.
    if (np.abs(unmet) > 1e-6 * np.abs(C @ free).max() * np.abs(saddle.redundant).sum(axis=0)).any():
        raise ValueError("redundant ties contradict each other: no force closes their gap")
    solved = saddle.inverse @ right
    forces += C.T @ solved[: len(C)]
    motion = np.zeros((6, forces.shape[1]))
    motion[moving] = solved[len(C) :]
    motion_of_rows = W[kept] @ forces
    motion_of_rows[:, 0] += free[kept]
    place = motion.copy()
    place[:, 0] += pose
    answer = np.concatenate([motion_of_rows, place[:count]])

    # The object comes first among the effectors.
    n_a, size = len(actuators), len(answer)
    order = np.concatenate([np.arange(n_a), np.arange(len(kept), size), np.arange(n_a, len(kept))])
    compliance = answer[:, 1:][np.ix_(order, order)]
    effort = np.append(current[actuators], np.zeros(size - n_a))
    return Coupled(
        CondensedModel(0.5 * (compliance + compliance.T), answer[order, 0], effort, (("a", n_a), ("e", size - n_a))),
        condition=saddle.condition,
        dropped=saddle.redundant.shape[1],
        part_sizes=tuple(len(model.free) for model in models),
        force_map=forces[:, : 1 + n_a],
        motion_map=motion[:, : 1 + n_a],
    )
