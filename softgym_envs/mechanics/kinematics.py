"""Degrees of freedom of a body: which components of its rows are unknown, and how the unknowns move all rows.

The state of a body is one array ``x`` of rows (n, 3), see `frames`. Its *equations* are the independent degrees of
freedom: first the free components of rows, then the free spins of frames. Fixed components do not move, and carried
rows follow their frame.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from softgym_envs.mechanics.frames import Frames, KinematicMap


class Kinematics:
    """Numbering of the equations, and the motions of the rows that belong to them.

    Args:
        nodes: rest rows [m], shape (n, 3).
        held: components of rows that do not move, mask of shape (n, 3). Carried rows follow their frame anyway.
        frames: frames and the rows they carry.
        held_spin: spin components (about the axes of space) that do not move, mask of shape (f, 3).

    Attributes:
        equations: number of independent degrees of freedom, N.
        total: equations plus components of carried rows.
        free_dofs: components of rows (3 * row + axis) that are equations of their own; spins come after them.
        number: number of each component of the rows, shape (3 n,): equations first, then components of carried
            rows; -1 if fixed.
        spin_number: equation of each spin component, -1 if fixed, shape (f, 3).
        dof_scale: length [m] that a unit of each equation moves: 1 for nodes, an arm for spins, shape (N,).
        fixed: rows that cannot move at all, mask of shape (n,).
        held: components that do not move and are not carried, mask of shape (n, 3).
        map: motion of carried rows, or None without frames.
    """

    def __init__(self, nodes: np.ndarray, held: np.ndarray, frames: Frames, held_spin: np.ndarray) -> None:
        n = len(nodes)
        self.frames = frames
        carried = np.zeros(n, dtype=bool)
        carried[frames.carried] = True
        self.fixed = held.all(axis=1) & ~carried
        self.held = held & ~carried[:, None]
        self.free_dofs = np.flatnonzero(~(held | carried[:, None]).ravel())
        free_spins = np.flatnonzero(~held_spin.ravel())
        self.equations = len(self.free_dofs) + len(free_spins)
        self.number = np.full(3 * n, -1, dtype=np.int64)
        self.number[self.free_dofs] = np.arange(len(self.free_dofs))
        carried_dofs = (3 * frames.carried[:, None] + np.arange(3)).ravel()
        self.number[carried_dofs] = self.equations + np.arange(len(carried_dofs))
        self.total = self.equations + len(carried_dofs)
        spin = np.full(held_spin.size, -1, dtype=np.int64)
        spin[free_spins] = len(self.free_dofs) + np.arange(len(free_spins))
        self.spin_number = spin.reshape(-1, 3)
        self.map: KinematicMap | None = None
        if len(frames):
            origin = self.number[3 * frames.rows[:, None] + np.arange(3)]
            self.map = KinematicMap(frames, origin, self.spin_number, self.equations)
        points = np.ones(n, dtype=bool)
        points[frames.carried[frames.moves == 0.0]] = False
        extent = float(np.linalg.norm(np.ptp(nodes[points], axis=0))) or 1.0
        self.dof_scale = np.ones(self.equations)
        self.dof_scale[len(self.free_dofs) :] = 0.1 * extent
        self._shape = nodes.shape
        self._directors = frames.rows[:, None] + np.arange(1, 4)

    def _rows(self, values: np.ndarray) -> np.ndarray:
        """Rows (n, 3) with the values of the equations (N,) at the free components and zero elsewhere."""
        out = np.zeros(self._shape)
        out.ravel()[self.free_dofs] = values[: len(self.free_dofs)]
        return out

    def _equations(self, rows: np.ndarray, spin: np.ndarray) -> np.ndarray:
        """Equations (N,) from the free components of rows (n, 3) and the spins of the frames (f, 3)."""
        out = np.zeros(self.equations)
        out[: len(self.free_dofs)] = rows.ravel()[self.free_dofs]
        free = self.spin_number >= 0
        out[self.spin_number[free]] = spin[free]
        return out

    def _spins(self, values: np.ndarray) -> np.ndarray:
        """Spins of the frames (f, 3) in values of the equations (N,)."""
        spins = np.zeros(self.spin_number.shape)
        free = self.spin_number >= 0
        spins[free] = values[self.spin_number[free]]
        return spins

    def displacement(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Displacement of all rows (n, 3) by a finite step of the equations (N,) from rows ``x`` (n, 3).

        Frames turn by the exponential of their spin; all other rows move along straight lines.
        """
        full = self._rows(step)
        if self.map is not None:
            self.frames.displace(x, full[self.frames.rows], self._spins(step), full)
        return full

    def row_velocity(self, x: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Velocity of all rows (n, 3) at ``x`` (n, 3) for velocities of the equations (N,)."""
        out = self._rows(velocity)
        if self.map is not None:
            self.map.linearise(x)
            out[self.frames.carried] = (self.map.matrix @ velocity).reshape(-1, 3)
        return out

    def row_acceleration(self, x: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        """Acceleration of all rows (n, 3) at ``x`` (n, 3) for velocities and accelerations of the equations (N,)."""
        out = self.row_velocity(x, acceleration)
        if self.map is not None:
            spin = self._spins(velocity)[self.frames.owner]
            # w x (w x r)
            out[self.frames.carried] += np.cross(spin, np.cross(spin, self.frames.arms(x)))
        return out

    def equation_velocity(self, x: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Velocities of the equations (N,) that give the rows at ``x`` (n, 3) the velocities (n, 3)."""
        return self._equations(velocity, 0.5 * np.cross(x[self._directors], velocity[self._directors]).sum(axis=1))

    def equation_force(self, x: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Forces on the equations (N,) of forces on all rows at ``x``, both (n, 3): the transpose of `row_velocity`."""
        out = np.zeros(self.equations)
        out[: len(self.free_dofs)] = force.ravel()[self.free_dofs]
        if self.map is not None:
            self.map.linearise(x)
            out += self.map.matrix.T @ force[self.frames.carried].ravel()
        return out

    def increment(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Displacements and rotation vectors of the equations (N,) that lead from rows ``start`` to ``end``, (n, 3)."""
        turn = np.einsum("fki,fkj->fij", end[self._directors], start[self._directors])
        spin = Rotation.from_matrix(turn).as_rotvec() if len(turn) else np.empty((0, 3))
        return self._equations(end - start, spin)
