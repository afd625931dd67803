"""Elastic parts between two frames, known by an energy over coordinates of the relative pose of their ports.

A port is a point and three axes that are fixed to a frame. Each coordinate is a polynomial of second degree in the rows
of both ports, ``y_i = z . A_i z / 2 + B_i . z``, for each axis of space: distances along axes and cosines between axes
are. This gives exact tangents for any twice differentiable energy, which may be learned. No rigid motion of a part
without weight changes them.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, NamedTuple, Protocol

import numpy as np

from softgym_envs.extensions.beams.beam import warp_lines
from softgym_envs.extensions.beams.skins import BRIDGE_SECTIONS, swept_triangles
from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.elements.block import ElementBlock, StrainRates, lower_pairs
from softgym_envs.mechanics.skins import Skin

ROWS = 8
"""Rows of both ports: the middle and the three axes of the near one, and of the far one."""


class Port(NamedTuple):
    """Where a part is joined to a frame, at rest.

    Attributes:
        frame: first row of the frame.
        middle: of the port [m], shape (3,).
        axes: matrix whose columns are its axes, shape (3, 3).
    """

    frame: int
    middle: np.ndarray
    axes: np.ndarray


@njit(cache=True, error_model="numpy")
def _slopes(forms, linear, z, slopes):
    """Write the derivatives of the coordinates by the rows ``z`` (k, 8, 3), shape (k, m, 8, 3)."""
    for p in range(z.shape[0]):
        for i in range(forms.shape[1]):
            for a in range(ROWS):
                for d in range(3):
                    total = linear[p, i, a, d]
                    for b in range(ROWS):
                        total += forms[p, i, a, b] * z[p, b, d]
                    slopes[p, i, a, d] = total


@njit(cache=True, error_model="numpy")
def _add_tangent(forms, slopes, force, stiffness, scatter, values):
    """Add the tangents of energies with derivatives (k, m) and (k, m, m) where ``scatter`` (k, 300) says."""
    m = forms.shape[1]
    row = np.empty(m)
    for part in range(forms.shape[0]):
        entry = 0
        for r in range(3 * ROWS):
            a, d = r // 3, r % 3
            for q in range(m):
                row[q] = 0.0
                for p in range(m):
                    row[q] += slopes[part, p, a, d] * stiffness[part, p, q]
            for s in range(r + 1):
                target = scatter[part, entry]
                entry += 1
                if target < 0:
                    continue
                b, e = s // 3, s % 3
                total = 0.0
                for q in range(m):
                    total += row[q] * slopes[part, q, b, e]
                    if d == e:
                        total += force[part, q] * forms[part, q, a, b]
                values[target] += total


class Energies(NamedTuple):
    """Energies of k parts with their derivatives by the coordinates.

    Attributes:
        value: [J], shape (k,).
        gradient: shape (k, m).
        hessian: shape (k, m, m).
    """

    value: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray


class Parts(ElementBlock):
    """Parts of one kind; a subclass has their energy.

    Args:
        nodes: rest rows [m], shape (n, 3).
        ports: near and far port of each part.
        forms: ``A`` of the coordinates over the rows of ports, symmetric, shape (m, 8, 8).
        linear: ``B`` of the coordinates, shape (m, 8, 3).
        length: of each part, over which its mass and its warping are spread [m].
        inertia: kinetic energy ``1/2 sum M_ab v_a . v_b`` of the rows of the ports [kg, kg m, kg m2], shape (8, 8).
        weight: mass [kg] on which gravity acts at each row of the ports, shape (8,); default that of the inertia.
        young_modulus: of the material, from which the stiffness of contact is chosen [Pa].

    Attributes:
        port_rows: rows of the frames of both ports of each part, shape (k, 8).
        forms: ``A`` of each part over these rows, shape (k, m, 8, 8).
        linear: ``B`` likewise, shape (k, m, 8, 3).
    """

    volume = 0.0

    def __init__(
        self,
        nodes: np.ndarray,
        ports: list[tuple[Port, Port]],
        *,
        forms: np.ndarray,
        linear: np.ndarray,
        length: float,
        inertia: np.ndarray,
        weight: np.ndarray | None = None,
        young_modulus: float = 0.0,
    ) -> None:
        if not (np.isfinite(length) and length > 0.0):
            raise ValueError(f"length = {length} m of a superelement must be positive and finite")
        self.length, self._young_modulus = float(length), float(young_modulus)
        starts = np.array([[near.frame, far.frame] for near, far in ports])
        self.port_rows = (starts[:, :, None] + np.arange(4)).reshape(len(ports), ROWS)
        self.nodes_used = np.unique(self.port_rows)
        maps = np.zeros((len(ports), ROWS, ROWS))
        for k, pair in enumerate(ports):
            for slot, port in zip((0, 4), pair, strict=True):
                directors = nodes[port.frame + 1 : port.frame + 4]
                maps[k, slot, slot] = 1.0
                maps[k, slot, slot + 1 : slot + 4] = directors @ (port.middle - nodes[port.frame])
                maps[k, slot + 1 : slot + 4, slot + 1 : slot + 4] = (directors @ port.axes).T
        back = maps.transpose(0, 2, 1)
        self.forms = np.ascontiguousarray(back[:, None] @ forms @ maps[:, None])
        self.linear = np.ascontiguousarray(back[:, None] @ linear)
        self._inertia = back @ inertia @ maps
        # The axes of each port share the inertia of its own motion; middles move by their weights in every point.
        middles = np.zeros(ROWS)
        middles[[0, 4]] = 1.0
        self._weights = back @ (inertia @ middles if weight is None else weight)
        self.mass = len(ports) * float(middles @ inertia @ middles)
        self._rest = np.zeros((len(ports), len(forms)))
        share = np.broadcast_to(np.array([[[-1.0, 1.0]]]) / length, (len(ports), 1, 2))
        self._line = (starts, np.full((1, 2), 0.5), share)

    @property
    def largest_young_modulus(self) -> float:
        return self._young_modulus

    @abstractmethod
    def energies(self, y: np.ndarray) -> Energies | None:
        """Return the energies at coordinates (k, m); None where they are not defined."""

    def slopes(self, x: np.ndarray) -> np.ndarray:
        """Return the derivatives (k, m, 8, 3) of the coordinates by `port_rows` at rows ``x`` (n, 3)."""
        slopes = np.empty((*self.forms.shape[:3], 3))
        _slopes(self.forms, self.linear, x[self.port_rows], slopes)
        return slopes

    def coordinates(self, x: np.ndarray, slopes: np.ndarray | None = None) -> np.ndarray:
        """Return the coordinates (k, m) at rows ``x`` (n, 3), with their `slopes` if they are known."""
        slopes = self.slopes(x) if slopes is None else slopes
        return 0.5 * np.einsum("kiad,kad->ki", slopes + self.linear, x[self.port_rows]) - self._rest

    def stencils(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return [lower_pairs((3 * self.port_rows[:, :, None] + np.arange(3)).reshape(-1, 3 * ROWS))]

    def add(
        self, x: np.ndarray, gradient: np.ndarray, values: np.ndarray | None, scatter: list[np.ndarray] | None
    ) -> tuple[float, int]:
        slopes = self.slopes(x)
        found = self.energies(self.coordinates(x, slopes))
        if found is None:
            return np.inf, 1
        self._spread(slopes, found.gradient, found.hessian, gradient, values, scatter)
        return float(found.value.sum()), 0

    def _spread(
        self,
        slopes: np.ndarray,
        force: np.ndarray,
        stiffness: np.ndarray,
        gradient: np.ndarray,
        values: np.ndarray | None,
        scatter: list[np.ndarray] | None,
    ) -> None:
        """Add forces and tangents for derivatives of energies by the coordinates, (k, m) and (k, m, m)."""
        np.add.at(gradient, self.port_rows, np.einsum("ki,kiad->kad", force, slopes))
        if values is not None and scatter is not None:
            _add_tangent(self.forms, slopes, force, stiffness, scatter[0], values)

    @abstractmethod
    def viscosity(self, start: np.ndarray) -> np.ndarray:
        """Return the stiffness (k, m, m) by which rates of the coordinates are damped, at rows ``start`` (n, 3)."""

    def add_damping(
        self,
        x: np.ndarray,
        rates: StrainRates,
        gradient: np.ndarray,
        values: np.ndarray | None,
        scatter: list[np.ndarray] | None,
    ) -> float:
        # As for beams: coordinates are quadratic in the rows, so this difference is exactly their rate over the factor.
        factor = rates.factor or 1.0
        half = 0.5 / factor * rates.velocity
        change = self.coordinates(rates.middle + half) - self.coordinates(rates.middle - half)
        viscosity = rates.damping * factor * self.viscosity(rates.start)
        force = np.einsum("kij,kj->ki", viscosity, change)
        # The slopes of the rates: of the elastic coordinates for parts without weight, whose B is zero.
        self._spread(self.slopes(x), force, viscosity, gradient, values, scatter)
        return factor * float(np.vdot(change, force))

    def nodal_masses(self, count: int) -> np.ndarray:
        masses = np.zeros(count)
        np.add.at(masses, self.port_rows, self._weights)
        return masses

    def mass_entries(self, lumped: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Entries between all rows of both ports: there is no lumped mass of a part."""
        i, j = np.tril_indices(ROWS)
        return self.port_rows[:, i].ravel(), self.port_rows[:, j].ravel(), self._inertia[:, i, j].ravel()

    def add_warped(self, x: np.ndarray, step: np.ndarray, out: np.ndarray) -> None:
        warp_lines(x, step, *self._line, np.full((len(self.port_rows), 1), self.length), out)

    def laplacian_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        ends, share = self._line[0], 1.0 / self.length
        values = np.tile(share * np.array([1.0, -1.0, -1.0, 1.0]), len(ends))
        return np.repeat(ends, 2, axis=1).ravel(), np.tile(ends, (1, 2)).ravel(), values


class PoseEnergy(Protocol):
    """Energy over poses of parts, each of 15 coordinates without dimensions.

    They are the place of the far port in the near axes over the length (3,), the cosines ``n_i . f_j`` between near and
    far axes, row by row (9,), and the weight in the near axes (3,).
    """

    def evaluate(self, y: np.ndarray, *, second: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return energies (k,), gradients (k, 15) and Hessians (k, 15, 15) at poses (k, 15)."""

    def knows(self, y: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Whether the energies are known at poses (k, 15) where they have gradients (k, 15), shape (k,)."""

    def errors(self, y: np.ndarray) -> np.ndarray:
        """Return how far tips at poses (k, 15) may move under the errors of their wrenches, over the length, (k,)."""


POSE = 15
SMALLEST = 2.0
"""Stiffness of a part, over its scale, below which errors of its wrench do not become smaller."""


def _pose_forms(length: float, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``A`` and ``B`` of the coordinates of a pose, for a weight (3,) in the axes of space."""
    forms, linear = np.zeros((POSE, ROWS, ROWS)), np.zeros((POSE, ROWS, 3))
    for i in range(3):
        forms[i, 4, 1 + i], forms[i, 0, 1 + i] = 1.0 / length, -1.0 / length
        for j in range(3):
            forms[3 + 3 * i + j, 1 + i, 5 + j] = 1.0
        linear[12 + i, 1 + i] = weight
    return forms + forms.transpose(0, 2, 1), linear


def tip_stiffness(y: Any, gradient: Any, hessian: Any) -> tuple[Any, Any]:
    """Return the stiffness of parts against motions of their far ports, see `PoseParts.tip_stiffness`.

    Args:
        y: poses, shape (k, 15); NumPy arrays or tensors.
        gradient: of the energies, shape (k, 15).
        hessian: of the energies, shape (k, 15, 15).
    """
    k, R = len(y), y[:, 3:12].reshape(-1, 3, 3)
    new = np.zeros if isinstance(y, np.ndarray) else y.new_zeros
    moves, turned = new((k, POSE, 6)), new((k, 3, 3, 3))
    for i in range(3):
        moves[:, i, i] = 1.0
        # A spin w turns the far axes, the columns of R: dR = w x R.
        j, m = (i + 1) % 3, (i + 2) % 3
        turned[:, m, :, i], turned[:, j, :, i] = R[:, j], -R[:, m]
    moves[:, 3:12, 3:] = turned.reshape(k, 9, 3)
    stiffness = moves.swapaxes(1, 2) @ hessian @ moves
    # The second derivative of a rotation: (w w^T - |w|^2) R.
    G = gradient[:, 3:12].reshape(-1, 3, 3) @ R.swapaxes(1, 2)
    stiffness[:, 3:, 3:] += 0.5 * (G + G.swapaxes(1, 2))
    for i in range(3):
        stiffness[:, 3 + i, 3 + i] -= G[:, 0, 0] + G[:, 1, 1] + G[:, 2, 2]
    back = 1.0 * moves.swapaxes(1, 2)
    back[:, 3:] *= 0.5
    return 0.5 * (stiffness + stiffness.swapaxes(1, 2)), back


class PoseParts(Parts):
    """Parts whose energy depends on the whole relative pose of their ports, and on their weight.

    Their mass is spread evenly along the line between the ports, when it moves.

    Args:
        nodes: as for `Parts`.
        ends: first rows of the frames at the near and far ports of all parts, in turn.
        ports: near and far port of each part.
        energy: over the poses.
        length: of each part [m].
        scale: energy of which the parts' is a multiple [J].
        weight: of a part in the axes of space, without dimensions, shape (3,).
        mass: of a part [kg].
        young_modulus: as for `Parts`.
    """

    learned = True

    def __init__(
        self,
        nodes: np.ndarray,
        ends: np.ndarray,
        *,
        ports: list[tuple[Port, Port]],
        energy: PoseEnergy,
        length: float,
        scale: float,
        weight: np.ndarray,
        mass: float,
        young_modulus: float,
    ) -> None:
        forms, linear = _pose_forms(length, weight)
        inertia = np.zeros((ROWS, ROWS))
        inertia[np.ix_([0, 4], [0, 4])] = mass / 6.0 * np.array([[2.0, 1.0], [1.0, 2.0]])
        # The energy knows the weight about the near port, which carries the whole of it.
        carried = np.zeros(ROWS)
        carried[0] = mass
        super().__init__(
            nodes, ports, forms=forms, linear=linear, length=length, inertia=inertia, weight=carried,
            young_modulus=young_modulus,
        )  # fmt: skip
        self.energy, self.scale = energy, float(scale)
        self.stiffness = 12.0 * self.scale / length**2
        self._last: tuple[np.ndarray, Energies] | None = None

    def energies(self, y: np.ndarray) -> Energies | None:
        if self._last is not None and np.array_equal(y, self._last[0]):
            return self._last[1]
        if not (np.isfinite(y).all() and (np.abs(y[:, :3]) < 2.0).all()):
            return None
        value, gradient, hessian = self.energy.evaluate(y)
        found = Energies(self.scale * value, self.scale * gradient, self.scale * hessian)
        if not np.isfinite(found.value).all():
            return None
        self._last = y, found
        return found

    def knows(self, x: np.ndarray) -> bool:
        y = self.coordinates(x)
        found = self.energies(y)
        return found is not None and bool(self.energy.knows(y, found.gradient / self.scale).all())

    def tip_stiffness(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the stiffness of each part against motions of its far port.

        Args:
            y: poses, shape (k, 15).

        Returns:
            Stiffness against places over the length and spins in the near axes [J] (k, 6, 6), and the map from changes
            of the coordinates to these motions (k, 6, 15).
        """
        found = self.energies(y)
        assert found is not None
        return tip_stiffness(y, found.gradient, found.hessian)

    def possible_errors(self, x: np.ndarray, fields: np.ndarray) -> np.ndarray:
        """As `ElementBlock.possible_errors`: of wrenches on the far ports, equal in the metric in which parts learn.

        That is the motion that a wrench would cause, in size, if its port were let go.
        """
        slopes = self.slopes(x)
        y = self.coordinates(x, slopes)
        stiffness, back = self.tip_stiffness(y)
        values, vectors = np.linalg.eigh(stiffness)
        motions = np.einsum("kiad,fkad->kfi", slopes, fields[:, self.port_rows]) @ back.transpose(0, 2, 1)
        roots = vectors * np.sqrt(self.scale * np.maximum(np.abs(values), SMALLEST * self.scale))[:, None]
        wrong = self.energy.errors(y)[:, None, None] * (motions @ roots)
        return np.concatenate(wrong.transpose(0, 2, 1))

    def viscosity(self, start: np.ndarray) -> np.ndarray:
        """Damp motions of the far port against the near one by the positive part of their stiffness at the start."""
        stiffness, back = self.tip_stiffness(self.coordinates(start))
        values, vectors = np.linalg.eigh(stiffness)
        positive = (vectors * np.maximum(values, 0.0)[:, None]) @ vectors.transpose(0, 2, 1)
        return back.transpose(0, 2, 1) @ positive @ back


def curve_skin(near: Port, far: Port, length: float, outline: np.ndarray, nodes: np.ndarray) -> Skin:
    """Sweep an outline along the cubic curve between two ports that leaves each along its first axis, to be drawn.

    Args:
        near: where the curve begins.
        far: where it ends.
        length: of the part [m], by which the curve bulges.
        outline: corners [m] along the second and third axes, counter-clockwise, shape (k, 2).
        nodes: rest rows [m], shape (n, 3).
    """
    s = np.linspace(0.0, 1.0, BRIDGE_SECTIONS)
    shares = ((1.0 - s) ** 2 * (1.0 + 2.0 * s), length * s * (1.0 - s) ** 2, 1.0 - s)
    others = (s**2 * (3.0 - 2.0 * s), length * s**2 * (s - 1.0), s)
    weights = []
    for port, (stay, leave, share) in ((near, shares), (far, others)):
        directors = nodes[port.frame + 1 : port.frame + 4]
        axes = directors @ port.axes  # in the directors of the frame, as columns
        arm = directors @ (port.middle - nodes[port.frame])
        places = (
            stay[:, None, None] * arm
            + leave[:, None, None] * axes[:, 0]
            + share[:, None, None] * (outline @ axes[:, 1:].T)
        )
        weights += [np.broadcast_to(stay[:, None, None], (*places.shape[:2], 1)), places]
    ids = np.tile(np.concatenate([near.frame + np.arange(4), far.frame + np.arange(4)]), (len(s) * len(outline), 1))
    points = EmbeddedPoints.from_weights(ids, np.concatenate(weights, axis=2).reshape(-1, 8), nodes)
    return Skin(points, swept_triangles(len(s), len(outline)), touches=False)
