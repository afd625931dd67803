"""Geometrically exact beams for slender parts.

The director formulation of the Simo-Reissner beam (Romero and Armero 2002; Betsch and Steinmann 2002): origin and
directors of the cross-sections are interpolated along the axis, and the strains are computed from them in the material
frame,

    Gamma_i = d_i . r' - (d_i . r')_0,      K_1 = (d_3 . d_2' - d_2 . d_3') / 2 - (...)_0   (and cyclic),

with d_1 along the axis. They are objective (a rigid motion causes no strain), independent of the path, and quadratic in
the rows of ``x``, so that energy, forces and exact tangent are polynomials of low degree; the frames replace directors
by rotations. Reduced integration (one Gauss point for two nodes, two for three) avoids shear locking. An element
resists a limited moment, beyond which it folds: see `are_folded`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgym_envs.extensions.beams.beam_kernels import interpolate, pull_back, strains
from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.elements.block import ElementBlock, StrainRates, lower_pairs
from softgym_envs.mechanics.elements.tetrahedra import check_density, element_masses
from softgym_envs.quantities import finite_number, numbers


@dataclass(frozen=True)
class Section:
    """Cross-section of a beam: areas and second moments about its directors d_2 and d_3.

    Args:
        area: [m2].
        inertia: second moments of area about d_2 and d_3 [m4].
        torsion: torsion constant [m4].
        shear: shear correction factors along d_2 and d_3.
        mass_area: area that has mass [m2], if it is larger than ``area``.
        outline: corners [m] along d_2 and d_3, counter-clockwise, of the surface that is drawn; not used by mechanics.
    """

    area: float
    inertia: tuple[float, float]
    torsion: float
    shear: tuple[float, float] = (1.0, 1.0)
    mass_area: float | None = None
    outline: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        values = (self.area, *self.inertia, self.torsion, *self.shear, self.material_area)
        if not (numbers(values, "section values") > 0.0).all() or not np.isfinite(values).all():
            raise ValueError(f"section values must be positive and finite, got {self}")

    @property
    def material_area(self) -> float:
        """Area of the material [m2], from which mass and volume follow."""
        return self.area if self.mass_area is None else self.mass_area

    @classmethod
    def rectangle(cls, width: float, thickness: float) -> Section:
        """A rectangle with a width [m] along d_2 and a thickness [m] along d_3 (Timoshenko's torsion series)."""
        width, thickness = finite_number(width, "width", "m"), finite_number(thickness, "thickness", "m")
        if not (width > 0.0 and thickness > 0.0):
            raise ValueError(f"a section of {width} m by {thickness} m must have positive sides")
        area = width * thickness
        long, short = max(width, thickness), min(width, thickness)
        k = np.arange(1, 40, 2)
        series = float((np.tanh(k * np.pi * long / (2.0 * short)) / k**5).sum())
        torsion = long * short**3 / 3.0 * (1.0 - 192.0 * short / (np.pi**5 * long) * series)
        x, y = 0.5 * width, 0.5 * thickness
        corners = ((x, y), (-x, y), (-x, -y), (x, -y))
        inertia = width * thickness**3 / 12.0, thickness * width**3 / 12.0
        return cls(area, inertia, torsion, (5.0 / 6.0, 5.0 / 6.0), outline=corners)

    @classmethod
    def circle(cls, radius: float, inner: float = 0.0) -> Section:
        """A circle or, with an ``inner`` radius, a tube [m]."""
        radius, inner = finite_number(radius, "radius", "m"), finite_number(inner, "inner radius", "m")
        if not 0.0 <= inner < radius:
            raise ValueError(f"radii of a section must be 0 <= inner < radius, got {inner} and {radius} m")
        area = np.pi * (radius**2 - inner**2)
        inertia = 0.25 * np.pi * (radius**4 - inner**4)
        shear = 0.9 if inner == 0.0 else 0.5
        turns = 2.0 * np.pi * np.arange(24) / 24
        corners = tuple((float(radius * np.cos(turn)), float(radius * np.sin(turn))) for turn in turns)
        return cls(area, (inertia, inertia), 2.0 * inertia, (shear, shear), outline=corners)

    def stiffness(self, young_modulus: float, poisson_ratio: float) -> np.ndarray:
        """Diagonal stiffness (6,): EA, GA_2, GA_3 [N], GJ, EI_2, EI_3 [N m2]."""
        shear_modulus = young_modulus / (2.0 * (1.0 + poisson_ratio))
        return np.array(
            [
                young_modulus * self.area,
                shear_modulus * self.area * self.shear[0],
                shear_modulus * self.area * self.shear[1],
                shear_modulus * self.torsion,
                young_modulus * self.inertia[0],
                young_modulus * self.inertia[1],
            ]
        )


LARGEST_TURNS = {1: 0.25 * np.pi, 2: np.pi / 3.0}
"""Angle between neighbouring frames [rad], by order of the element, up to which its moment grows. Directors between
frames are interpolated and become shorter, so bending counts less and less: with one Gauss point the moment of frames
that are an angle t apart is as sin(2 t); with two it is largest at 62 degrees."""


def are_folded(x: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return whether neighbouring frames of an element are farther apart than `LARGEST_TURNS`.

    Such an element has yielded: the farther it bends, the less it resists. A finer mesh does not fold there.

    Args:
        x: rows of one or many bodies [m], shape (..., n, 3).
        rows: first rows of the frames of each element, shape (m, order + 1).

    Returns:
        Shape (...).
    """
    directors = x[..., rows[:, :, None] + np.arange(1, 4), :]
    cosines = 0.5 * np.einsum("...mkid,...mkid->...mk", directors[..., :-1, :, :], directors[..., 1:, :, :]) - 0.5
    return (cosines < np.cos(LARGEST_TURNS[rows.shape[1] - 1])).any(axis=(-2, -1))


# Quantities of a cross-section that are linear in the rows: r', d1..d3, d1'..d3'; which row of a frame each belongs to.
_ROW = np.array([0, 1, 2, 3, 1, 2, 3])
_SLOPE = np.array([True, False, False, False, True, True, True])


@njit(cache=True, error_model="numpy")
def _evaluate(x, rows, shape, slope, weights, rest, stiffness, row_of, is_slope, forces, matrix):
    """Energy; forces (m, k, 4, 3) and, unless ``matrix`` is empty, element matrices (m, 12 k, 12 k)."""
    m, k = rows.shape
    z, unit, column, gradient = np.empty((7, 3)), np.zeros((7, 3)), np.empty((7, 3)), np.empty((7, 3))
    stress, alone = np.empty(6), np.zeros(6)
    first = np.empty((6, 7, 3))
    hessian = np.empty((21, 21))
    coefficient = np.empty((k, 7))
    energy = 0.0
    forces[:] = 0.0
    matrix[:] = 0.0
    for e in range(m):
        for q in range(weights.shape[1]):
            for a in range(k):
                for v in range(7):
                    coefficient[a, v] = slope[e, q, a] if is_slope[v] else shape[q, a]
            interpolate(x, rows[e], shape[q], slope[e, q], z)
            strains(z, stress)
            w = weights[e, q]
            for s in range(6):
                strain = stress[s] - rest[e, q, s]
                stress[s] = w * stiffness[e, s] * strain
                energy += 0.5 * stress[s] * strain
            gradient[:] = 0.0
            pull_back(z, stress, gradient)
            for a in range(k):
                for v in range(7):
                    for d in range(3):
                        forces[e, a, row_of[v], d] += coefficient[a, v] * gradient[v, d]
            if matrix.shape[0] == 0:
                continue
            hessian[:] = 0.0
            first[:] = 0.0
            for s in range(6):
                alone[s] = 1.0
                pull_back(z, alone, first[s])
                alone[s] = 0.0
                c = w * stiffness[e, s]
                g = first[s].ravel()
                for i in range(21):
                    if g[i] != 0.0:
                        ci = c * g[i]
                        for j in range(21):
                            hessian[i, j] += ci * g[j]
            for v in range(7):
                # Strains are products of rows, so their second derivative is the gradient of a unit state.
                unit[v, 0] = 1.0
                column[:] = 0.0
                pull_back(unit, stress, column)
                unit[v, 0] = 0.0
                for u in range(7):
                    for d in range(3):
                        hessian[3 * u + d, 3 * v + d] += column[u, 0]
            for a in range(k):
                for v in range(7):
                    i = 12 * a + 3 * row_of[v]
                    for b in range(k):
                        for u in range(7):
                            j = 12 * b + 3 * row_of[u]
                            if j > i + 2:
                                continue
                            c = coefficient[a, v] * coefficient[b, u]
                            for d in range(3):
                                for f in range(3):
                                    matrix[e, i + d, j + f] += c * hessian[3 * v + d, 3 * u + f]
    return energy


@njit(cache=True, error_model="numpy")
def _drag(start, velocity, factor, rows, shape, slope, weights, drag, forces, matrix):
    """Power of the fluid; forces (m, k, 4, 3) and, unless ``matrix`` is empty, element matrices (m, 12 k, 12 k).

    The resistance per length is ``c_n + (c_t - c_n) t t^T`` with the tangent ``t`` of the axis at rows ``start``.
    """
    m, k = rows.shape
    tangent, speed, pull, D, power = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3)), 0.0
    forces[:] = 0.0
    matrix[:] = 0.0
    for e in range(m):
        for q in range(weights.shape[1]):
            tangent[:] = 0.0
            speed[:] = 0.0
            for a in range(k):
                for d in range(3):
                    tangent[d] += slope[e, q, a] * start[rows[e, a], d]
                    speed[d] += shape[q, a] * velocity[rows[e, a], d]
            square = tangent[0] ** 2 + tangent[1] ** 2 + tangent[2] ** 2
            for i in range(3):
                for j in range(3):
                    D[i, j] = weights[e, q] * (drag[0] - drag[1]) * tangent[i] * tangent[j] / square
                D[i, i] += weights[e, q] * drag[1]
            for i in range(3):
                pull[i] = D[i, 0] * speed[0] + D[i, 1] * speed[1] + D[i, 2] * speed[2]
                power += pull[i] * speed[i]
                for a in range(k):
                    forces[e, a, 0, i] += shape[q, a] * pull[i]
            if matrix.shape[0] == 0:
                continue
            for a in range(k):
                for b in range(k):
                    for i in range(3):
                        for j in range(3):
                            matrix[e, 12 * a + i, 12 * b + j] += factor * shape[q, a] * shape[q, b] * D[i, j]
    return power


@njit(cache=True)
def _strains_at(x, rows, shape, slope, out):
    """Fill ``out`` (m, q, 6) with the strains at the Gauss points, those at rest included."""
    z = np.empty((7, 3))
    for e in range(out.shape[0]):
        for q in range(out.shape[1]):
            interpolate(x, rows[e], shape[q], slope[e, q], z)
            strains(z, out[e, q])


@njit(cache=True)
def _scatter(rows, forces, matrix, gradient, values, scatter):
    m, k = rows.shape
    for e in range(m):
        for a in range(k):
            for r in range(4):
                for d in range(3):
                    gradient[rows[e, a] + r, d] += forces[e, a, r, d]
    for e in range(matrix.shape[0]):
        t = 0
        for i in range(12 * k):
            for j in range(i + 1):
                target = scatter[e, t]
                t += 1
                if target >= 0:
                    values[target] += matrix[e, i, j]


@njit(cache=True, error_model="numpy")
def _cross(a, b, factor, out):
    """Add ``factor a x b`` to ``out``."""
    out[0] += factor * (a[1] * b[2] - a[2] * b[1])
    out[1] += factor * (a[2] * b[0] - a[0] * b[2])
    out[2] += factor * (a[0] * b[1] - a[1] * b[0])


@njit(cache=True, error_model="numpy")
def warp_lines(x, step, rows, shape, slope, weights, out):
    """Rotate the tangent by the exponential of the spin, and strain it by the remainder of the step."""
    spin = np.empty(3)
    tangent = np.empty(3)
    strained = np.empty(3)
    turned = np.empty(3)
    for e in range(rows.shape[0]):
        for q in range(weights.shape[1]):
            spin[:] = 0.0
            tangent[:] = 0.0
            strained[:] = 0.0
            for a in range(rows.shape[1]):
                row = rows[e, a]
                for k in range(1, 4):
                    _cross(x[row + k], step[row + k], 0.5 * shape[q, a], spin)
                for d in range(3):
                    tangent[d] += slope[e, q, a] * x[row, d]
                    strained[d] += slope[e, q, a] * (x[row, d] + step[row, d])
            _cross(spin, tangent, -1.0, strained)
            # Rodrigues' formula: R v = v + sin(t) / t w x v + (1 - cos(t)) / t^2 w x (w x v).
            squared = spin[0] ** 2 + spin[1] ** 2 + spin[2] ** 2
            angle = np.sqrt(squared)
            if angle < 1e-4:
                first, second = 1.0 - squared / 6.0, 0.5 - squared / 24.0
            else:
                first, second = np.sin(angle) / angle, (1.0 - np.cos(angle)) / squared
            turned[:] = 0.0
            _cross(spin, strained, 1.0, turned)
            tangent[:] = strained - tangent + first * turned
            _cross(spin, turned, second, tangent)
            for a in range(rows.shape[1]):
                for d in range(3):
                    out[rows[e, a], d] += weights[e, q] * slope[e, q, a] * tangent[d]


class Beam(ElementBlock):
    """A chain of beam elements between frames.

    Args:
        nodes: rest rows [m], shape (n, 3); the directors d_1 of the frames point along the axis.
        chain: first rows of the frames along the axis, shape (c,). With order 2 every second one is a middle node, so c
            is odd.
        section: `Section` of all elements, or one for each.
        young_modulus: [Pa], scalar or one for each element.
        poisson_ratio: scalar or one for each element.
        density: [kg/m3].
        order: 1 or 2, degree of the interpolation.
        stress_free: rows of the chain's frames in the stress-free shape [m], shape (c, 4, 3); default: as in ``nodes``,
            which may be curved.
        drag: resistance of a still fluid per length along and across the axis [N s/m2], see `fluid.slender_drag`. It
            acts in motion alone, on the axis as it lies at the start of each time step.

    Attributes:
        rows: first rows of the frames of each element, shape (m, order + 1).
        shape: shape functions at the Gauss points, shape (q, order + 1).
        slope: their slopes along the axis [1/m], shape (m, q, order + 1).
        weights: of the Gauss points [m], shape (m, q).
        rest: strains at rest, shape (m, q, 6).
        element_stiffness: of the cross-sections, shape (m, 6), see `Section.stiffness`.
        drag: as given, shape (2,).

    Raises:
        ValueError: if the chain has the wrong length, two frames coincide, or a number is out of bounds.
    """

    def __init__(
        self,
        nodes: np.ndarray,
        chain: np.ndarray,
        *,
        section: Section | list[Section],
        young_modulus: float | np.ndarray,
        poisson_ratio: float | np.ndarray = 0.3,
        density: float = 1100.0,
        order: int = 2,
        stress_free: np.ndarray | None = None,
        drag: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        if order not in (1, 2):
            raise ValueError(f"order = {order!r} of the beam is unknown; allowed: 1, 2")
        chain = np.asarray(chain, dtype=np.int64)
        if len(chain) < order + 1 or (len(chain) - 1) % order:
            raise ValueError(f"a beam of order {order} needs {order} k + 1 frames, got {len(chain)}")
        m = (len(chain) - 1) // order
        self.chain = chain
        self.order = order
        self.rows = chain[order * np.arange(m)[:, None] + np.arange(order + 1)]
        points, gauss = np.polynomial.legendre.leggauss(order)
        self.shape, local = lagrange(order, points)
        sections = [section] * m if isinstance(section, Section) else list(section)
        if len(sections) != m:
            raise ValueError(f"the beam has {m} elements, got {len(sections)} sections")
        natural = nodes[chain[:, None] + np.arange(4)] if stress_free is None else np.asarray(stress_free, dtype=float)
        if natural.shape != (len(chain), 4, 3):
            raise ValueError(f"stress_free must have shape ({len(chain)}, 4, 3), got {natural.shape}")
        rest = np.zeros_like(nodes)
        rest[chain[:, None] + np.arange(4)] = natural
        tangents = np.einsum("qa,mad->mqd", local, rest[self.rows])
        speed = np.linalg.norm(tangents, axis=2)
        if not (speed > 1e-12).all():
            raise ValueError("two frames of a beam coincide")
        self.slope = local / speed[:, :, None]
        self.weights = gauss * speed
        for name, value in (("young_modulus", young_modulus), ("poisson_ratio", poisson_ratio)):
            if numbers(value, name).size not in (1, m):
                raise ValueError(f"{name} must be one number, or one for each of the {m} elements, got {value!r}")
        young = np.broadcast_to(np.asarray(young_modulus, dtype=float), (m,))
        poisson = np.broadcast_to(np.asarray(poisson_ratio, dtype=float), (m,))
        if not (np.isfinite(young).all() and (young > 0.0).all()):
            raise ValueError(f"young_modulus = {young_modulus} Pa must be positive and finite")
        if not ((poisson > -1.0) & (poisson < 0.5)).all():
            raise ValueError(f"poisson_ratio = {poisson_ratio} must be inside (-1, 0.5)")
        self.sections = sections
        self._largest_young_modulus = float(young.max())
        self.element_stiffness = np.array(
            [s.stiffness(e, nu) for s, e, nu in zip(sections, young, poisson, strict=True)]
        )
        self.drag = np.asarray(drag, dtype=float)
        if self.drag.shape != (2,) or not (np.isfinite(self.drag) & (self.drag >= 0.0)).all():
            raise ValueError(f"drag = {drag!r} N s/m2 must be two finite numbers that are not negative")
        self.damped = bool(self.drag.any())
        self.density = check_density(density)
        areas = np.array([s.material_area for s in sections])
        length = float(self.weights.sum())
        if np.sqrt(areas.max()) > length:
            raise ValueError(
                f"a beam {length:g} m long has a section of {areas.max():g} m2, which is wider than it is long; "
                "did you mean metres?"
            )
        self.lengths = self.weights.sum(axis=1)
        self.nodes_used = np.unique(chain[:, None] + np.arange(4))
        self.volume = float(areas @ self.lengths)
        self.mass = self.density * self.volume
        self.stiffness = float(np.mean(self.element_stiffness[:, 1] / self.lengths))
        self._forces = np.empty((m, order + 1, 4, 3))
        self._matrix = np.empty((m, 12 * (order + 1), 12 * (order + 1)))
        self._none = np.empty((0, 12 * (order + 1), 12 * (order + 1)))
        self.rest = np.zeros((m, order, 6))
        self.rest = self.strains(rest)
        if not (self.rest[..., 0] > 0.5).all():
            raise ValueError("the directors d_1 of a beam's frames must point along its axis")

    @property
    def largest_young_modulus(self) -> float:
        return self._largest_young_modulus

    def strains(self, x: np.ndarray) -> np.ndarray:
        """Strains (Gamma, K) beyond those at rest at the Gauss points, shape (m, q, 6) [1, 1/m]."""
        return self._total_strains(x) - self.rest

    def _total_strains(self, x: np.ndarray) -> np.ndarray:
        """Strains at the Gauss points, those at rest included, shape (m, q, 6)."""
        out = np.empty((*self.weights.shape, 6))
        _strains_at(x, self.rows, self.shape, self.slope, out)
        return out

    def is_folded(self, x: np.ndarray) -> bool:
        return bool(are_folded(x, self.rows))

    def stencils(self) -> list[tuple[np.ndarray, np.ndarray]]:
        rows = self.rows[:, :, None] + np.arange(4)
        return [lower_pairs((3 * rows[..., None] + np.arange(3)).reshape(len(rows), -1))]

    def add(
        self, x: np.ndarray, gradient: np.ndarray, values: np.ndarray | None, scatter: list[np.ndarray] | None
    ) -> tuple[float, int]:
        energy = self._add(x, self.rest, self.element_stiffness, gradient, values, scatter)
        return (energy, 0) if np.isfinite(energy) else (np.inf, len(self.rows))

    def add_damping(
        self,
        x: np.ndarray,
        rates: StrainRates,
        gradient: np.ndarray,
        values: np.ndarray | None,
        scatter: list[np.ndarray] | None,
    ) -> float:
        power = self._add_drag(rates, gradient, values, scatter) if self.damped else 0.0
        if not rates.damping:
            return power
        # Damping acts like elasticity of stiffness `viscosity` with a strain at rest that lies `change` behind. The
        # factor is zero where velocities are given; the tangent does not matter there.
        factor = rates.factor or 1.0
        half = 0.5 / factor * rates.velocity
        # Strains are quadratic in the rows, so this difference is exactly their rate over the factor.
        change = self._total_strains(rates.middle + half) - self._total_strains(rates.middle - half)
        viscosity = rates.damping * factor * self.element_stiffness
        stored = self._add(x, self._total_strains(x) - change, viscosity, gradient, values, scatter)
        return power + 2.0 * factor * stored

    def _add_drag(
        self,
        rates: StrainRates,
        gradient: np.ndarray,
        values: np.ndarray | None,
        scatter: list[np.ndarray] | None,
    ) -> float:
        """Add the forces of the fluid and their tangent, and return their power [W]."""
        matrix = self._none if values is None else self._matrix
        power = _drag(
            rates.start, rates.velocity, rates.factor, self.rows, self.shape, self.slope, self.weights, self.drag,
            self._forces, matrix,
        )  # fmt: skip
        places = np.empty((0, 0), dtype=np.int32) if scatter is None else scatter[0]
        _scatter(self.rows, self._forces, matrix, gradient, np.empty(0) if values is None else values, places)
        return float(power)

    def _add(
        self,
        x: np.ndarray,
        rest: np.ndarray,
        stiffness: np.ndarray,
        gradient: np.ndarray,
        values: np.ndarray | None,
        scatter: list[np.ndarray] | None,
    ) -> float:
        """Add forces and tangent for strains at rest (m, q, 6) and a stiffness (m, 6), and return the energy."""
        matrix = self._none if values is None else self._matrix
        energy = _evaluate(
            x,
            self.rows,
            self.shape,
            self.slope,
            self.weights,
            rest,
            stiffness,
            _ROW,
            _SLOPE,
            self._forces,
            matrix,
        )
        if np.isfinite(energy):
            empty = np.empty(0)
            places = np.empty((0, 0), dtype=np.int32) if scatter is None else scatter[0]
            _scatter(self.rows, self._forces, matrix, gradient, empty if values is None else values, places)
        return float(energy)

    def add_warped(self, x: np.ndarray, step: np.ndarray, out: np.ndarray) -> None:
        warp_lines(x, step, self.rows, self.shape, self.slope, self.weights, out)

    def laplacian_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        k = self.order + 1
        values = np.einsum("mq,mqa,mqb->mab", self.weights, self.slope, self.slope)
        return np.repeat(self.rows, k, axis=1).ravel(), np.tile(self.rows, (1, k)).ravel(), values.ravel()

    def nodal_masses(self, count: int) -> np.ndarray:
        shares = np.array([0.5, 0.5]) if self.order == 1 else np.array([1.0, 4.0, 1.0]) / 6.0
        areas = np.array([s.material_area for s in self.sections])
        masses = (self.density * areas * self.lengths)[:, None] * shares
        return np.bincount(self.rows.ravel(), weights=masses.ravel(), minlength=count)

    def mass_entries(self, lumped: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        # Kinetic energy of a cross-section per unit length: rho / 2 (A |p'|^2 + I_3 |d_2'|^2 + I_2 |d_3'|^2).
        points, gauss = np.polynomial.legendre.leggauss(self.order + 1)
        shape, _ = lagrange(self.order, points)
        shares = 0.5 * np.einsum("q,qa,qb->ab", gauss, shape, shape)
        parts = []
        for row, values in (
            (0, [s.material_area for s in self.sections]),
            (2, [s.inertia[1] * s.material_area / s.area for s in self.sections]),
            (3, [s.inertia[0] * s.material_area / s.area for s in self.sections]),
        ):
            masses = self.density * np.array(values) * self.lengths
            parts.append(element_masses(self.rows + row, masses, shares, lumped))
        rows, columns, entries = (np.concatenate(part) for part in zip(*parts, strict=True))
        return rows, columns, entries

    def point(self, index: int, offset: np.ndarray, nodes: np.ndarray) -> EmbeddedPoints:
        """A point fixed to the cross-section of a frame of the chain, at an offset [m] (3,) along its directors."""
        return EmbeddedPoints.in_frame(int(self.chain[index]), offset, nodes)

    def line(self, elements: range, offset: tuple[float, float], nodes: np.ndarray) -> EmbeddedPoints:
        """A line along some elements at an offset [m] along d_2 and d_3, as its weighted tangents at the Gauss points.

        Returns:
            One row for each Gauss point; the norms of ``positions(x)`` add up to the length of the line.
        """
        ids, weights = [], []
        for e in elements:
            for q in range(self.order):
                factors = np.array([1.0, 0.0, offset[0], offset[1]])
                ids.append((self.rows[e][:, None] + np.arange(4)).ravel())
                weights.append((self.weights[e, q] * self.slope[e, q][:, None] * factors).ravel())
        return EmbeddedPoints.from_weights(np.array(ids), np.array(weights), nodes)


def lagrange(order: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shape functions and their slopes at points of [-1, 1], each (q, order + 1), for equally spaced nodes."""
    t = points[:, None]
    if order == 1:
        return np.hstack([0.5 * (1 - t), 0.5 * (1 + t)]), np.hstack([-0.5 + 0 * t, 0.5 + 0 * t])
    shape = np.hstack([0.5 * t * (t - 1), 1 - t**2, 0.5 * t * (t + 1)])
    return shape, np.hstack([t - 0.5, -2 * t, t + 0.5])
