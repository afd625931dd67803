"""The mechanics against exact and published solutions, each on refined meshes.

``softgym bench validation`` computes all cases, prints them, and writes the table of ``docs/validation.md``. Every
case is a function that returns `Row`s, one for each element and mesh; the tests run them on coarse meshes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import brentq
from scipy.special import ellipeinc, ellipk, ellipkinc

from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints import Cavity, Chamber, EmbeddedPoints, Point
from softgym_envs.mechanics.elements.beams import Section
from softgym_envs.mechanics.elements.quadratic import add_midside_nodes, quadratic_triangles, split_triangles
from softgym_envs.mechanics.materials import MATERIALS
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solids import SOLIDS
from softgym_envs.mechanics.solvers.linearisation import Linearisation
from softgym_envs.mechanics.solvers.statics import Statics

__all__ = ["CASES", "Row", "validation"]

DOCUMENT = Path(__file__).parents[1] / "docs" / "validation.md"
START, END = "<!-- table: start -->", "<!-- table: end -->"

Mapping = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Row:
    """One computed value.

    Args:
        case: what is computed.
        element: element, and material where it matters.
        level: the mesh, in words.
        unknowns: number of equations.
        value: computed.
        reference: exact or published; NaN where the reference is another of our own solutions.
        error: relative to the reference, or as the case says.
        order: of the error since the mesh before, whose elements are twice as large; NaN for the first.
    """

    case: str
    element: str
    level: str
    unknowns: int
    value: float
    reference: float
    error: float
    order: float = float("nan")


def _orders(rows: list[Row], floor: float = 1e-10) -> list[Row]:
    """Fill in the observed orders of rows of one element, each mesh twice as fine; none below round-off."""
    result = rows[:1]
    for before, row in zip(rows, rows[1:], strict=False):
        first, second = abs(before.error), abs(row.error)
        known = first > floor and second > floor
        result.append(replace(row, order=float(np.log2(first / second)) if known else float("nan")))
    return result


# -- meshes ---------------------------------------------------------------------------------------------------------


def box(cells: Sequence[int], jitter: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Unit cube cut into boxes of six tetrahedra: nodes (n, 3), inner ones moved by ``jitter`` cells, and corners."""
    counts = np.array(cells)
    grid = np.stack(np.meshgrid(*(np.arange(n + 1) for n in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    inside = ((grid > 0) & (grid < counts)).all(axis=1)
    noise = np.random.default_rng(0).uniform(-jitter, jitter, grid.shape) * inside[:, None]
    strides = np.array([(cells[1] + 1) * (cells[2] + 1), cells[2] + 1, 1])
    first = grid[(grid < counts).all(axis=1)] @ strides
    orders = ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))
    paths = [first[:, None] + np.concatenate([[0], np.cumsum(strides[list(order)])]) for order in orders]
    return (grid + noise) / counts, np.concatenate(paths)


def shell_octant(count: int, layers: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Octant of the region 1 <= |x| + |y| + |z| <= 2: nodes (n, 3), tetrahedra (m, 4), triangles of the inner face."""
    ids, face = {}, []
    for i in range(count + 1):
        for j in range(count + 1 - i):
            ids[i, j] = len(face)
            face.append([i, j, count - i - j])
    triangles = [[ids[i, j], ids[i + 1, j], ids[i, j + 1]] for i, j in ids if i + j < count]
    triangles += [[ids[i + 1, j], ids[i + 1, j + 1], ids[i, j + 1]] for i, j in ids if i + j < count - 1]
    surface = np.sort(np.array(triangles), axis=1)
    points = np.array(face) / count
    nodes = np.concatenate([points * (1.0 + layer / layers) for layer in range(layers + 1)])
    tetrahedra = []
    for layer in range(layers):
        low, high = surface + layer * len(points), surface + (layer + 1) * len(points)
        # Prisms whose sides are cut from the lower node of lowest number: neighbours agree.
        for k in range(3):
            tetrahedra.append(np.column_stack([low[:, : k + 1], high[:, k:]]))
    return nodes, np.concatenate(tetrahedra), np.array(triangles)


def to_sphere(points: np.ndarray) -> np.ndarray:
    """Move points (n, 3) along their rays so that |x| + |y| + |z| becomes their distance."""
    lengths = np.linalg.norm(points, axis=1)
    return points * (np.abs(points).sum(axis=1) / lengths)[:, None]


def solid(
    mesh: tuple[np.ndarray, np.ndarray],
    element: str,
    fixed: Callable[[np.ndarray], np.ndarray],
    mapping: Mapping,
    **options,
) -> MechanicalModel:
    """A body of one element on a mapped mesh; midside nodes are mapped, too, so edges may be curved.

    Args:
        mesh: nodes (n, 3) and tetrahedra (m, 4) before the mapping.
        element: a name of `SOLIDS`.
        fixed: mask (n,) or (n, 3) of clamped nodes, from the nodes before the mapping.
        mapping: nodes before -> nodes [m].
        **options: of the element block.
    """
    nodes, tetrahedra = mesh
    if element == "quadratic":
        nodes, tetrahedra = add_midside_nodes(nodes, tetrahedra)
    mapped = mapping(nodes)
    return MechanicalModel(mapped, [SOLIDS[element](mapped, tetrahedra, **options)], fixed=fixed(nodes))


def traction(model: MechanicalModel, selected: Callable[[np.ndarray], np.ndarray], force: np.ndarray) -> np.ndarray:
    """Nodal loads (n, 3) of a uniform traction with a total ``force`` [N] on the outer faces of selected nodes (n,)."""
    connectivity = model.solids[0].connectivity
    corners = connectivity[:, :4]
    faces = corners[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
    _, first, counts = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer = faces[first[counts == 1]]
    outer = outer[selected(model.nodes)[outer].all(axis=1)]
    x = model.nodes[outer]
    areas = 0.5 * np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1)
    if connectivity.shape[1] == 10:  # corners carry nothing of a uniform traction, midside nodes a third each
        outer = quadratic_triangles(outer, connectivity)[:, 3:]
    loads = np.zeros_like(model.nodes)
    np.add.at(loads, outer, areas[:, None, None] / (3.0 * areas.sum()) * force)
    return loads


def linear_response(model: MechanicalModel, loads: np.ndarray) -> np.ndarray:
    """Displacements [m] (n, 3) under small loads [N] (n, 3): one solve with the tangent at rest."""
    tangent = Linearisation(model)
    assert tangent.update(model.nodes, np.zeros(model.assembly.size))
    free = model.kinematics.free_dofs
    moved = np.zeros(model.nodes.size)
    moved[free] = tangent.solve(loads.ravel()[free])
    return moved.reshape(-1, 3)


def clamped_beam(
    curve: Callable[[float], tuple[np.ndarray, np.ndarray]], elements: int, order: int, section: Section, **options
) -> MechanicalModel:
    """A beam along a curve on [0, 1] (position, rotation), clamped at 0, with an effector at 1."""
    body = ModelBuilder()
    places = np.linspace(0.0, 1.0, order * elements + 1)
    frames = [body.add_frame(*curve(t), fixed=t == 0.0, fixed_spin=t == 0.0) for t in places]
    body.add_beam(frames, section=section, order=order, **options)
    model = body.build()
    model.add("e", Point("tip", EmbeddedPoints.in_frame(frames[-1], np.zeros(3), model.nodes)))
    return model


def straight(length: float) -> Callable[[float], tuple[np.ndarray, np.ndarray]]:
    """A line along x, for `clamped_beam`."""
    return lambda t: (np.array([length * t, 0.0, 0.0]), np.eye(3))


# -- patch test -----------------------------------------------------------------------------------------------------


def patch(levels: Sequence[int] = (2, 3, 4)) -> list[Row]:
    """Inner nodes of an irregular block whose boundary follows a large linear map; error: largest offset / size."""
    F = np.array([[1.2, 0.3, -0.1], [0.05, 0.9, 0.2], [-0.15, 0.1, 1.1]])
    rows = []
    for element in SOLIDS:
        for material in MATERIALS:
            for cells in levels:
                model = solid(
                    box((cells, cells, cells), jitter=0.25),
                    element,
                    lambda x: (np.isclose(x, 0.0, atol=1e-12) | np.isclose(x, 1.0)).any(axis=1),
                    lambda x: x,
                    material=material,
                    young_modulus=1.0,
                    poisson_ratio=0.45,
                )
                exact = model.nodes @ F.T
                noise = 0.02 / cells * np.random.default_rng(1).standard_normal(exact.shape)
                statics = Statics(model, tolerance=1e-13)
                statics.restore(np.where(model.fixed[:, None], exact, exact + noise), np.zeros(0))
                error = float(np.abs(statics.solve([]).x - exact).max())
                name = f"{element}, {material}"
                rows.append(Row("patch test", name, f"{cells}^3 cells", model.equations, error, 0.0, error))
    return rows


# -- cantilever -----------------------------------------------------------------------------------------------------


def cantilever(solids: Sequence[int] = (1, 2, 4), beams: Sequence[int] = (1, 2, 4)) -> list[Row]:
    """Small deflection of a 10 : 1 bar under end shear against Timoshenko's beam; Poisson's ratio 0.

    Without lateral contraction the clamp of a solid holds what the clamp of a beam holds.
    """
    length, width, young = 10.0, 1.0, 1.0
    section = Section.rectangle(width, width)
    exact = length**3 / (3 * young * section.inertia[0]) + length / (young / 2 * section.area * section.shear[0])
    rows = []
    for element in SOLIDS:
        found = []
        for cells in solids if element == "quadratic" else [2 * n for n in solids]:
            model = solid(
                box((10 * cells, cells, cells)),
                element,
                lambda x: x[:, 0] == 0.0,
                lambda x: x * [length, width, width],
                young_modulus=young,
                poisson_ratio=0.0,
            )
            loads = traction(model, lambda x: np.isclose(x[:, 0], length), np.array([0.0, 0.0, 1.0]))
            value = float(np.vdot(loads, linear_response(model, loads)))
            level = f"{cells} cells across"
            found.append(Row("cantilever", element, level, model.equations, value, exact, value / exact - 1.0))
        rows += _orders(found)
    for order in (1, 2):
        found = []
        for elements in beams:
            model = clamped_beam(straight(length), elements, order, section, young_modulus=young, poisson_ratio=0.0)
            value = float(Statics(model).solve([]).condensed.W.ee[2, 2])
            level, name = f"{elements} elements", f"beam of order {order}"
            found.append(Row("cantilever", name, level, model.equations, value, exact, value / exact - 1.0))
        rows += _orders(found)
    return rows


# -- elastica -------------------------------------------------------------------------------------------------------


def elastica_tip(load: float) -> tuple[float, float]:
    """Tip (x, deflection) / L of an inextensible cantilever under a dead end load P with P L^2 / (E I) = ``load``.

    With the slope ``phi`` at the tip, k^2 = (1 + sin phi) / 2 and sin t = 1 / (k sqrt 2):
    sqrt(load) = K(k) - F(t, k); deflection = 1 - 2 / sqrt(load) (E(k) - E(t, k)); x = sqrt(2 sin phi / load).
    """

    def amplitude(m: float) -> float:
        return float(np.arcsin(np.sqrt(0.5 / m)))

    m = brentq(lambda m: ellipk(m) - ellipkinc(amplitude(m), m) - np.sqrt(load), 0.5 + 1e-14, 1.0 - 1e-14, xtol=1e-16)
    arc = ellipeinc(0.5 * np.pi, m) - ellipeinc(amplitude(m), m)
    return float(np.sqrt(2.0 * (2.0 * m - 1.0) / load)), float(1.0 - 2.0 * arc / np.sqrt(load))


def elastica(levels: Sequence[int] = (4, 8, 16), loads: Sequence[float] = (1.0, 5.0, 10.0)) -> list[Row]:
    """Tip of a cantilever under a dead end load against the elastica; error: distance of the tip / L.

    A round section with r = L / 2000: at P L^2 / (E I) = 10 it stretches by 6e-7 and shears by 2e-6. Elements of order
    1 are half as long, so that both orders have as many frames.
    """
    length, radius = 1.0, 0.5e-3
    section = Section.circle(radius)
    young = 1.0 / section.inertia[0]
    rows = []
    for load in loads:
        exact = np.array(elastica_tip(load))
        for order in (1, 2):
            found = []
            for elements in levels if order == 2 else [2 * n for n in levels]:
                model = clamped_beam(straight(length), elements, order, section, young_modulus=young)
                tip = Statics(model).solve([], effector_force=[0.0, 0.0, -load]).delta[:3]
                error = float(np.hypot(tip[0] - exact[0], -tip[2] - exact[1]))
                name, case = f"beam of order {order}", f"elastica, PL2/EI = {load:g}: deflection"
                level = f"{elements} elements"
                found.append(Row(case, name, level, model.equations, float(-tip[2]), float(exact[1]), error))
            rows += _orders(found, floor=1e-6)
    return rows


def circle(levels: Sequence[int] = (8, 16, 32)) -> list[Row]:
    """Pure bending of a straight beam to a full circle; value and error: distance between its ends / L.

    The moment comes from two chambers at opposite sides of the axis under opposite pressures, p A (y - (-y)). Elements
    of order 1 are half as long, so that both orders have as many frames.
    """
    length, radius, offset, area = 1.0, 1e-2, 0.05, 1e-4
    section = Section.circle(radius)
    young = 1.0 / section.inertia[0]
    pressure = 2.0 * np.pi / length / (2.0 * offset * area)
    rows = []
    for order in (1, 2):
        found = []
        for elements in levels if order == 2 else [2 * n for n in levels]:
            model = clamped_beam(straight(length), elements, order, section, young_modulus=young)
            for side in (1.0, -1.0):
                line = model.blocks[0].line(range(elements), (side * offset, 0.0), model.nodes)  # type: ignore[attr-defined]
                model.add("a", Chamber(f"{side:+.0f}", [line], area))
            tip = Statics(model).solve([pressure, -pressure], "effort").delta[2:5]
            gap = float(np.linalg.norm(tip))
            level, name = f"{elements} elements", f"beam of order {order}"
            found.append(Row("bending to a circle: gap", name, level, model.equations, gap, 0.0, gap))
        rows += _orders(found, floor=1e-8)
    return rows


# -- curved beam ----------------------------------------------------------------------------------------------------

PUBLISHED_BEND = {
    300.0: {"Bathe and Bolourchi 1979": (22.5, 59.2, 39.5), "Simo and Vu-Quoc 1986": (22.33, 58.84, 40.08)},
    600.0: {"Bathe and Bolourchi 1979": (15.9, 47.2, 53.4), "Simo and Vu-Quoc 1986": (15.79, 47.23, 53.37)},
}
"""Tip positions of the 45 degree bend under a load out of its plane."""


def _bend(t: float) -> tuple[np.ndarray, np.ndarray]:
    angle, radius = 0.25 * np.pi * t, 100.0
    tangent, inward = np.array([np.sin(angle), np.cos(angle), 0.0]), np.array([np.cos(angle), -np.sin(angle), 0.0])
    position = radius * np.array([1.0 - np.cos(angle), np.sin(angle), 0.0])
    return position, np.column_stack([tangent, inward, np.cross(tangent, inward)])


def _bend_of_box(nodes: np.ndarray) -> np.ndarray:
    """Unit cube to the bend with a 1 x 1 section."""
    result = np.empty_like(nodes)
    for k, (t, across, up) in enumerate(nodes):
        position, rotation = _bend(t)
        result[k] = position + (across - 0.5) * rotation[:, 1] + (up - 0.5) * rotation[:, 2]
    return result


def _is_end_of_bend(nodes: np.ndarray) -> np.ndarray:
    return np.isclose(np.arctan2(nodes[:, 1], 100.0 - nodes[:, 0]), 0.25 * np.pi)


def bend(
    beams: Sequence[int] = (4, 8, 16), solids: Sequence[int] = (16, 32, 64), loads: Sequence[float] = (300.0, 600.0)
) -> list[Row]:
    """Bathe's 45 degree bend (R = 100, section 1 x 1, E = 1e7, nu = 0); value: height of the tip.

    Error: distance of the tip from the published position of Simo and Vu-Quoc over the tip's displacement. The
    published torsion constant is the polar moment, 1/6; a square has 0.1406, which the solids show: their error and
    that of the beams with the true constant is relative to the finest beam with the true constant.
    """
    square = Section.rectangle(1.0, 1.0)
    polar = replace(square, torsion=sum(square.inertia))
    options = {"young_modulus": 1e7, "poisson_ratio": 0.0}
    start = _bend(1.0)[0]
    rows = []
    for load in loads:
        case = f"45 degree bend, P = {load:g}: height"
        published = np.array(PUBLISHED_BEND[load]["Simo and Vu-Quoc 1986"])
        size = float(np.linalg.norm(published - start))

        def beam_tip(elements: int, order: int, section: Section, load: float = load) -> tuple[np.ndarray, int]:
            model = clamped_beam(_bend, elements, order, section, **options)
            statics = Statics(model, tolerance=1e-7)
            return statics.solve([], effector_force=[0.0, 0.0, load]).delta[:3], model.equations

        def row(name: str, level: str, unknowns: int, tip: np.ndarray, goal: np.ndarray, reference: float) -> Row:
            return Row(case, name, level, unknowns, float(tip[2]), reference, float(np.linalg.norm(tip - goal)) / size)  # noqa: B023

        for order in (1, 2):
            for elements in beams if order == 2 else [2 * n for n in beams]:
                tip, unknowns = beam_tip(elements, order, polar)
                name = f"beam of order {order}, published torsion"
                rows.append(row(name, f"{elements} elements", unknowns, tip, published, float(published[2])))
        true = beam_tip(64, 2, square)[0]
        for order in (1, 2):
            found = []
            for elements in beams if order == 2 else [2 * n for n in beams]:
                tip, unknowns = beam_tip(elements, order, square)
                found.append(row(f"beam of order {order}", f"{elements} elements", unknowns, tip, true, float(true[2])))
            rows += _orders(found, floor=1e-8)
        found = []
        for along in solids:
            across = along // 16
            model = solid(box((along, across, across)), "quadratic", lambda x: x[:, 0] == 0.0, _bend_of_box, **options)
            model.nodal_loads[:] = traction(model, _is_end_of_bend, np.array([0.0, 0.0, load]))
            x = Statics(model, tolerance=1e-7).solve([]).x
            tip = model.nodal_loads[:, 2] @ x / load
            level = f"{along} x {across} x {across} cells"
            found.append(row("quadratic", level, model.equations, tip, true, float(true[2])))
        rows += _orders(found)
    return rows


# -- Cook's membrane ------------------------------------------------------------------------------------------------

COOK = {0.3: 9.222, 0.45: 8.222, 0.49: 7.865, 0.499: 7.779, 0.4999: 7.771}
"""Vertical displacement of the upper right corner by Poisson's ratio: our mixed (Taylor-Hood) plane-strain solutions in
scikit-fem, extrapolated from 32, 64 and 128 cells. The last digit is uncertain: the corner is a singularity."""


def cook(levels: Sequence[int] = (4, 8, 16, 32), ratios: Sequence[float] = tuple(COOK)) -> list[Row]:
    """Cook's membrane in plane strain, small strain: E = 250, F = 100 on the right edge.

    Corners (0, 0), (48, 44), (48, 60), (0, 44); one layer of cells with z held. Quadratic elements on meshes of twice
    the cell size, for about as many nodes.
    """
    rows = []
    for poisson_ratio in ratios:
        for element in SOLIDS:
            rows += _cook(levels, element, poisson_ratio)
    return rows


def _cook(levels: Sequence[int], element: str, poisson_ratio: float) -> list[Row]:
    reference, found = COOK[poisson_ratio], []
    for cells in [n // 2 for n in levels] if element == "quadratic" else levels:
        thick = 48.0 / cells

        def mapping(x: np.ndarray, thick: float = thick) -> np.ndarray:
            s, t = x[:, 0], x[:, 1]
            return np.column_stack([48.0 * s, 44.0 * s + t * (44.0 - 28.0 * s), thick * x[:, 2]])

        model = solid(
            box((cells, cells, 1)),
            element,
            lambda x: np.column_stack([x[:, 0] == 0.0, x[:, 0] == 0.0, np.ones(len(x), dtype=bool)]),
            mapping,
            young_modulus=250.0,
            poisson_ratio=poisson_ratio,
        )
        loads = traction(model, lambda x: np.isclose(x[:, 0], 48.0), np.array([0.0, 100.0 * thick, 0.0]))
        moved = linear_response(model, loads)
        corner = np.isclose(model.nodes[:, 0], 48.0) & np.isclose(model.nodes[:, 1], 60.0)
        value = float(moved[corner, 1].mean())
        case, level = f"Cook's membrane, nu = {poisson_ratio:g}", f"{cells} x {cells} cells"
        found.append(Row(case, element, level, model.equations, value, reference, value / reference - 1.0))
    return _orders(found)


# -- sphere ---------------------------------------------------------------------------------------------------------


def sphere_octant(count: int, element: str, *, split: bool = False, **options) -> MechanicalModel:
    """An octant of a thick sphere (radii 1 and 2) on its planes of symmetry.

    Actuator: the pressure in the cavity, closed by flat triangles between the inner edge and the centre.

    Args:
        count: cells along an edge, and through the wall.
        element: a name of `SOLIDS`.
        split: whether the cavity of quadratic elements is of split triangles, not of quadratic ones.
        **options: of the element block.
    """
    nodes, tetrahedra, inner = shell_octant(count, count)
    if element == "quadratic":
        nodes, tetrahedra = add_midside_nodes(nodes, tetrahedra)
        inner = split_triangles(inner, tetrahedra) if split else quadratic_triangles(inner, tetrahedra)
    nodes = to_sphere(nodes)
    quadratic = inner.shape[1] == 6
    inward = np.linalg.det(nodes[inner[:, :3]]) < 0.0
    inner[inward] = inner[inward][:, [0, 2, 1, 5, 4, 3] if quadratic else [0, 2, 1]]
    # Edges of one triangle only, from corner to corner, with the midside node.
    sides = (
        [inner[:, [0, 1, 3]], inner[:, [1, 2, 4]], inner[:, [2, 0, 5]]]
        if quadratic
        else [inner, inner[:, [1, 2, 0]], inner[:, [2, 0, 1]]]
    )
    edges = {(a, b): middle for a, b, middle in np.concatenate(sides).tolist()}
    rim = {edge: middle for edge, middle in edges.items() if edge[::-1] not in edges}
    # The centre and the middles of its spokes belong to no element: such nodes are held.
    centre, corners = len(nodes), sorted({a for a, _ in rim})
    spoke = {a: centre + 1 + k for k, a in enumerate(corners)}
    nodes = np.vstack([nodes, np.zeros((1, 3)), 0.5 * nodes[corners]])
    closing = [[b, a, centre, middle, spoke[a], spoke[b]] for (a, b), middle in rim.items()]
    block = SOLIDS[element](nodes, tetrahedra, **options)
    model = MechanicalModel(nodes, [block], fixed=np.isclose(nodes, 0.0, atol=1e-12))
    surface = np.vstack([inner, np.array(closing)[:, : inner.shape[1]]])
    model.add("a", Cavity("cavity", surface, nodes))
    return model


def sphere(levels: Sequence[int] = (2, 4, 8), ratios: Sequence[float] = (0.3, 0.499)) -> list[Row]:
    """Lame's thick sphere under internal pressure in small strain: radii 1 and 2, E = 1.

    Value: mean radial displacement of the inner surface per unit pressure, by the growth of the cavity. For comparison,
    quadratic elements whose cavity is of split triangles. Linear elements are half as large, for as many unknowns.
    """
    rows = []
    for nu in ratios:
        exact = 1.0 / 7.0 * ((1.0 - 2.0 * nu) + (1.0 + nu) * 8.0 / 2.0)
        for name in (*SOLIDS, "quadratic, split cavity"):
            element, _, split = name.partition(",")
            found = []
            for count in levels if element == "quadratic" else [2 * n for n in levels]:
                model = sphere_octant(count, element, split=bool(split), young_modulus=1.0, poisson_ratio=nu)
                cavity = model.constraints["a"][0]
                loads = np.zeros_like(model.nodes)
                loads.ravel()[cavity.dofs] = cavity.jacobian(model.nodes)[0]  # of unit pressure
                moved = linear_response(model, loads)
                # The gradient times positions is three times the volume: the area, for a radius of 1.
                value = float(np.vdot(loads, moved) / np.vdot(loads, model.nodes))
                case, level = f"thick sphere, nu = {nu:g}", f"{count} cells"
                found.append(Row(case, name, level, model.equations, value, exact, value / exact - 1.0))
            rows += _orders(found)
    return rows


# -- work of a cavity -----------------------------------------------------------------------------------------------


def cavity_work(levels: Sequence[int] = (2, 4, 8), count: int = 2) -> list[Row]:
    """Integral of p dV along a path (Simpson's rule) against the elastic energy; the sphere's volume grows by 60 %.

    Levels: steps of the path. Pressure-driven, the integral is p V less that of V dp.
    """
    rows = []
    for element in SOLIDS:
        for material in MATERIALS:
            model = sphere_octant(count, element, material=material, young_modulus=1.0, poisson_ratio=0.45)
            cavity = model.constraints["a"][0]
            growth = 0.6 * cavity.rest_volume  # type: ignore[attr-defined]
            statics = Statics(model, tolerance=1e-12)
            end = statics.solve([growth])
            energy = model.energy(end.x)
            for mode, target in (("displacement", growth), ("effort", float(end.effort[0]))):
                found = []
                for steps in levels:
                    statics.reset()
                    path = [statics.solve([t * target], mode) for t in np.linspace(0.0, 1.0, steps + 1)]
                    other = [float((s.effort if mode == "displacement" else s.delta)[0]) for s in path]
                    weights = np.array([1.0, *([4.0, 2.0] * (steps // 2))])
                    weights[-1] = 1.0
                    work = float(weights @ other) * target / (3.0 * steps)
                    if mode == "effort":
                        work = target * growth - work
                    name = f"{element}, {material}"
                    case = f"work of a cavity, {'volume' if mode == 'displacement' else 'pressure'}-driven"
                    found.append(Row(case, name, f"{steps} steps", model.equations, work, energy, work / energy - 1.0))
                rows += _orders(found)
    return rows


# -- soft finger ----------------------------------------------------------------------------------------------------


def halved(nodes: np.ndarray, tetrahedra: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut every tetrahedron into eight at the middles of its edges; new nodes are marked where both ends are."""
    finer, ten = add_midside_nodes(nodes, tetrahedra)
    marked = np.append(mask, np.zeros(len(finer) - len(nodes), dtype=bool))
    for slot, (a, b) in enumerate([(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]):
        marked[ten[:, 4 + slot]] = mask[ten[:, a]] & mask[ten[:, b]]
    corners = [(0, 4, 6, 7), (4, 1, 5, 8), (6, 5, 2, 9), (7, 8, 9, 3)]
    middle = [(6, 8, 4, 5), (6, 8, 5, 9), (6, 8, 9, 7), (6, 8, 7, 4)]
    return finer, ten[:, corners + middle].reshape(-1, 4), marked


def finger(halvings: int = 1, ratios: Sequence[float] = (0.3, 0.47, 0.499)) -> list[Row]:
    """The Soft Finger with one cable on other elements; value: deflection of its tip per tension at rest [mm/N].

    On the robot's own mesh and on the same mesh with halved elements: its faceted shape stays as it is. Reference:
    quadratic elements on the finest one.
    """
    from softgym_envs.robots import make_robot

    robot = make_robot("finger", cables=1)
    rows = []
    for nu in ratios:
        design = robot.design_space.complete({"poisson_ratio": nu})
        mesh = robot.body(design)
        nodes, tetrahedra, fixed = mesh.nodes, mesh.tetrahedra, robot.clamped(mesh)
        found: dict[str, list[Row]] = {element: [] for element in SOLIDS}
        for level in range(halvings + 1):
            if level:
                nodes, tetrahedra, fixed = halved(nodes, tetrahedra, fixed)
            for element in SOLIDS:
                body = ModelBuilder()
                young = design["young_modulus"]
                body.add_solid(nodes, tetrahedra, fixed=fixed, element=element, young_modulus=young, poisson_ratio=nu)
                model = body.build()
                for pull_point, points in robot.routes(design):  # type: ignore[attr-defined]
                    model.add_cable("cable", points, pull_point)
                model.add_effector("tip", robot.tip(design))  # type: ignore[attr-defined]
                value = 1e3 * float(Statics(model).solve([0.0]).condensed.W.ea[1, 0])
                name = f"its own mesh, {len(tetrahedra)} cells" if level == 0 else f"{len(tetrahedra)} cells"
                found[element].append(
                    Row(f"soft finger, nu = {nu:g}: tip", element, name, model.equations, value, np.nan, np.nan)
                )
        reference = found["quadratic"][-1].value
        for group in found.values():
            rows += [replace(row, reference=reference, error=row.value / reference - 1.0) for row in group]
    return rows


# -- all of it ------------------------------------------------------------------------------------------------------

CASES: dict[str, Callable[[], list[Row]]] = {
    "patch": patch,
    "cantilever": cantilever,
    "elastica": elastica,
    "circle": circle,
    "bend": bend,
    "cook": cook,
    "sphere": sphere,
    "cavity_work": cavity_work,
    "finger": finger,
}
"""Registry of cases."""


def table(rows: Sequence[Row]) -> str:
    """Rows as a Markdown table."""
    lines = [
        "| case | element | mesh | unknowns | value | reference | error | order |",
        "|---|---|---|--:|--:|--:|--:|--:|",
    ]
    for row in rows:
        order = "" if np.isnan(row.order) else f"{row.order:.1f}"
        lines.append(
            f"| {row.case} | {row.element} | {row.level} | {row.unknowns} | {row.value:.6g} | {row.reference:.6g} "
            f"| {row.error:.2g} | {order} |"
        )
    return "\n".join(lines)


def validation() -> dict[str, object]:
    """Exact and published solutions on refined meshes; writes the table of docs/validation.md."""
    rows = [row for case in CASES.values() for row in case()]
    text = DOCUMENT.read_text()
    before, after = text.split(START)[0], text.split(END)[1]
    DOCUMENT.write_text(f"{before}{START}\n\n{table(rows)}\n\n{END}{after}")
    return {
        f"{row.case} | {row.element} | {row.level}": {
            key: None if isinstance(value, float) and np.isnan(value) else value
            for key, value in asdict(row).items()
            if key not in ("case", "element", "level")
        }
        for row in rows
    }
