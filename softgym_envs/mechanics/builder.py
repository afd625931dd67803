"""ModelBuilder: combines solids, elements between frames, and rigid parts into one model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from softgym_envs.arguments import explained
from softgym_envs.mechanics.elements.block import ElementBlock
from softgym_envs.mechanics.frames import frame_rows
from softgym_envs.mechanics.mesh_checks import check_apart
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solids import Fixed, are_rows, described, solid_part


@explained
class ModelBuilder:
    """Collects parts and builds a `MechanicalModel` from them. Adding a part returns its first row.

    Args:
        gravity: acceleration [m/s2], shape (3,).
        floating: allow bodies without a fixed node.
        solver: name of the linear solver.
    """

    def __init__(
        self, *, gravity: Sequence[float] = (0.0, 0.0, 0.0), floating: bool = False, solver: str = "auto"
    ) -> None:
        self._gravity = gravity
        self._floating = floating
        self._solver = solver
        self._rows: list[np.ndarray] = []
        self._fixed: list[np.ndarray] = []
        self._frames: list[int] = []
        self._spins: list[np.ndarray] = []
        self._carried: dict[int, np.ndarray] = {}
        self._mounted: dict[int, list[int]] = {}
        self._parts: list[tuple[type[ElementBlock], np.ndarray, dict[str, object]]] = []
        self._solids: list[np.ndarray] = []  # corners of those that may not overlap
        self._finishes: list[Callable[[MechanicalModel], None]] = []
        self.size = 0

    def _append(self, rows: np.ndarray, fixed: np.ndarray) -> int:
        start = self.size
        self._rows.append(np.asarray(rows, dtype=float))
        self._fixed.append(fixed)
        self.size += len(rows)
        return start

    @property
    def nodes(self) -> np.ndarray:
        """Rest rows [m] of the parts added so far, shape (size, 3)."""
        return np.vstack(self._rows) if self._rows else np.empty((0, 3))

    def add_solid(self, nodes: np.ndarray, tetrahedra: np.ndarray, *, fixed: Fixed, **options: Any) -> int:
        """Add a solid body; arguments as for `MechanicalModel.from_mesh`, without gravity and solver.

        With ``check=False`` the body may also overlap other solids.
        """
        part = solid_part(nodes, tetrahedra, fixed=fixed, **options)
        start = self._append(part.nodes, part.fixed)
        if options.get("check", True):
            self._solids.append(part.connectivity[:, :4] + start)
        self._parts.append((part.kind, part.connectivity + start, part.options))
        return start

    def add_frame(
        self,
        position: np.ndarray | Sequence[float],
        rotation: np.ndarray | None = None,
        *,
        fixed: bool | Sequence[bool] = False,
        fixed_spin: bool | Sequence[bool] = False,
        on: int | None = None,
    ) -> int:
        """Add a frame: a rigid part, or a node of a beam.

        Args:
            position: [m], shape (3,).
            rotation: matrix (3, 3), default identity.
            fixed: whether the origin is held, entirely or per axis of space.
            fixed_spin: whether the rotation is held, entirely or per axis of space.
            on: first row of another frame on which this one is mounted.

        Returns:
            Its first row.
        """
        mask = np.zeros((4, 3), dtype=bool)
        mask[0] = fixed
        start = self._append(frame_rows(position, rotation), mask)
        if on is not None and on not in self._frames:
            raise ValueError(f"on = {on} is not the first row of a frame; frames start at rows {self._frames}")
        if on is not None:
            self._mounted.setdefault(self._frames.index(on), []).append(start)
            return start
        self._frames.append(start)
        self._spins.append(np.broadcast_to(np.asarray(fixed_spin, dtype=bool), (3,)))
        return start

    def carry(self, frame: int, rows: np.ndarray) -> None:
        """Attach mesh nodes to the frame at a row, so that they move with it.

        Args:
            frame: first row of the frame.
            rows: of the nodes, as numbers: those of a mask are ``start + np.flatnonzero(mask)``.
        """
        if frame not in self._frames:
            raise ValueError(f"frame = {frame} is not the first row of a frame; frames start at rows {self._frames}")
        rows = np.asarray(rows)
        if rows.size and not are_rows(rows, self.size):
            raise ValueError(
                f"rows that frame {frame} carries must be numbers from 0 to {self.size - 1}, got {described(rows)}"
            )
        index = self._frames.index(frame)
        self._carried[index] = np.concatenate(
            [self._carried.get(index, np.empty(0, dtype=np.int64)), rows.astype(np.int64)]
        )

    def add_element(
        self,
        kind: type[ElementBlock],
        frames: Sequence[int] | np.ndarray,
        *,
        own: Sequence[Sequence[bool]] = (),
        **options: Any,
    ) -> int:
        """Add an element of any class between frames, such as a `Beam` along them; return the number of its block.

        Args:
            kind: its class, made as ``kind(nodes, rows, **options)``.
            frames: first rows of the frames.
            own: for each row that the element has beside the frames, whether it is held, per axis; the rows come after
                the frames, and rest at zero.
            **options: of the class.
        """
        known = {*self._frames, *(row for rows in self._mounted.values() for row in rows)}
        for row in frames:
            if int(row) not in known:
                raise ValueError(f"row {row} is not the first row of a frame; frames start at rows {sorted(known)}")
        start = self._append(np.zeros((len(own), 3)), np.array(own, dtype=bool).reshape(-1, 3))
        self._parts.append((kind, np.array([*frames, *range(start, self.size)]), options))
        return len(self._parts) - 1

    def add_mass(self, frame: int, mass: float, inertia: np.ndarray, payload: float = 0.0) -> None:
        """Give the rigid part at a frame mass [kg], inertia along the directors [kg m2] (3, 3) and a payload [kg]."""
        from softgym_envs.mechanics.elements.rigid import RigidBody

        self._parts.append((RigidBody, np.array(frame), {"mass": mass, "inertia": inertia, "payload": payload}))

    def finish(self, change: Callable[[MechanicalModel], None]) -> None:
        """Have the finished model changed in `build`, for parts that add more to it than elements."""
        self._finishes.append(change)

    def build(self) -> MechanicalModel:
        """Return the model, with its blocks in the order in which they were added.

        Raises:
            InfeasibleDesign: if two solids overlap.
        """
        nodes = self.nodes
        check_apart(nodes, self._solids)
        blocks = [kind(nodes, topology, **options) for kind, topology, options in self._parts]  # type: ignore[call-arg]
        model = MechanicalModel(
            nodes,
            blocks,
            fixed=np.vstack(self._fixed),
            frames=self._frames,
            carried=self._carried,
            mounted={frame: np.array(rows) for frame, rows in self._mounted.items()},
            fixed_spin=np.array(self._spins) if self._spins else None,
            floating=self._floating,
            gravity=self._gravity,
            solver=self._solver,
        )
        for finish in self._finishes:
            finish(model)
        from softgym_envs.mechanics.locking import warn_of_locking

        warn_of_locking(model)
        return model
