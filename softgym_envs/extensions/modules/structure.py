"""Structures of modules: ports that modules connect, solved with the modules' compliances alone.

A wrench on a module's far port moves it relative to its near port by ``C w`` (`Module.compliance`). A rigid motion
``(u, theta)`` of the near port takes the far one, at the arm ``r``, along by ``G = [[I, -[r]x], [0, I]]``, so a module
stores the energy

    1/2 e . C^-1 e,    e = u_far - G u_near,

which no rigid motion of the whole changes. The sum over all modules is the stiffness between the ports; its inverse,
with some ports held, is their compliance. It is exact for small motions about rest: the same equations as those of the
whole body's finite elements, with the nodes between the ports eliminated (static condensation).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from softgym_envs.extensions.modules.base import POSE
from softgym_envs.mechanics.condensation import CondensedModel, Row


@dataclass(frozen=True)
class Link:
    """A module between two ports of a structure.

    Attributes:
        near: number of the port at the module's near end.
        far: number of the port at its far end.
        compliance: of the module, in its own axes, shape (6, 6).
        rotation: matrix whose columns are the axes of the module, shape (3, 3).
    """

    near: int
    far: int
    compliance: np.ndarray
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))


class Structure:
    """Modules between rigid ports.

    Args:
        ports: middles of the ports [m], shape (n, 3).
        links: the modules; see `Link`.
        held: numbers of the ports that cannot move.

    Raises:
        ValueError: for a port that does not exist, a compliance that is not positive definite, or ports that no modules
            connect to a held one.
    """

    def __init__(
        self, ports: np.ndarray | Sequence[Sequence[float]], links: Sequence[Link], held: Sequence[int]
    ) -> None:
        self.ports = np.asarray(ports, dtype=float).reshape(-1, 3)
        self.links = tuple(links)
        count = len(self.ports)
        for number in [*held, *(end for link in self.links for end in (link.near, link.far))]:
            if not 0 <= number < count:
                raise ValueError(f"port {number} does not exist; ports are numbered 0 to {count - 1}")
        self.free = [port for port in range(count) if port not in set(held)]
        loose = set(self.free) - self._reached(held)
        if loose:
            raise ValueError(f"no modules connect port {min(loose)} to a held port; held: {sorted(held)}")
        moving = (6 * np.asarray(self.free, dtype=np.int64)[:, None] + np.arange(6)).ravel()
        self._compliance = np.linalg.inv(self.stiffness()[np.ix_(moving, moving)])

    def _reached(self, held: Sequence[int]) -> set[int]:
        """Return the ports that modules connect to held ones."""
        reached, waiting = set(held), list(held)
        while waiting:
            port = waiting.pop()
            for link in self.links:
                if port in (link.near, link.far):
                    new = {link.near, link.far} - reached
                    reached |= new
                    waiting += new
        return reached

    def stiffness(self) -> np.ndarray:
        """Return the stiffness between all ports, held ones included, shape (6 n, 6 n), in the order of `POSE`."""
        size = 6 * len(self.ports)
        total = np.zeros((size, size))
        for link in self.links:
            turn = np.kron(np.eye(2), link.rotation)
            try:
                root = np.linalg.cholesky(turn @ link.compliance @ turn.T)
            except np.linalg.LinAlgError:
                raise ValueError(
                    f"the compliance of the module from port {link.near} to port {link.far} is not positive definite"
                ) from None
            x, y, z = self.ports[link.far] - self.ports[link.near]
            motion = np.zeros((6, size))
            motion[:, 6 * link.far : 6 * link.far + 6] = np.eye(6)
            near = motion[:, 6 * link.near : 6 * link.near + 6]
            near -= np.eye(6)
            near[:3, 3:] += [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
            strained = np.linalg.solve(root, motion)
            total += strained.T @ strained
        return total

    def condensed(self, ports: Sequence[int] | None = None) -> CondensedModel:
        """Return the condensed model of some free ports, default all; its rows are actuators, six for each port.

        Raises:
            ValueError: for a port that is held.
        """
        ports = self.free if ports is None else list(ports)
        held = [port for port in ports if port not in self.free]
        if held:
            raise ValueError(f"port {held[0]} is held; free: {self.free}")
        rows = (6 * np.array([self.free.index(port) for port in ports])[:, None] + np.arange(6)).ravel()
        units = (("m", "N"),) * 3 + (("1", "N m"),) * 3
        names = tuple(Row(f"port {p} {name}", *unit) for p in ports for name, unit in zip(POSE, units, strict=True))
        none = np.zeros(len(rows))
        return CondensedModel(self._compliance[np.ix_(rows, rows)], none, none, (("a", len(rows)),), names)
