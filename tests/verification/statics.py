"""Statics compared with exact and published solutions, each on refined meshes.

``python -m tests.verification statics`` computes all cases; studies/validation shows them. Every case is a function
that returns rows, one for each element and mesh; the tests run them on coarse meshes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import brentq
from scipy.special import ellipeinc, ellipk, ellipkinc

from softgym_envs.extensions.beams.beam import Section
from softgym_envs.extensions.beams.chamber import Chamber
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.materials import MATERIALS
from softgym_envs.mechanics.solids import SOLIDS
from softgym_envs.mechanics.solvers.statics import Statics
from tests.helpers import box_mesh
from tests.verification.bodies import clamped_beam, halved, linear_response, solid, sphere_octant, straight, traction
from tests.verification.rows import MeshRow as Row
from tests.verification.rows import as_results, with_orders

ROUND_OFF = 1e-10
"""Relative errors below this have no order."""

# -- patch test -----------------------------------------------------------------------------------------------------


def patch(levels: Sequence[int] = (2, 3, 4)) -> list[Row]:
    """Inner nodes of an irregular block whose boundary follows a large linear map; error: largest offset / size."""
    F = np.array([[1.2, 0.3, -0.1], [0.05, 0.9, 0.2], [-0.15, 0.1, 1.1]])
    rows = []
    for element in SOLIDS:
        for material in MATERIALS:
            for cells in levels:
                model = solid(
                    box_mesh(cells=(cells, cells, cells), jitter=0.25),
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

    Without lateral contraction, the clamps of solids and beams constrain the same motions.
    """
    length, width, young = 10.0, 1.0, 1.0
    section = Section.rectangle(width, width)
    exact = length**3 / (3 * young * section.inertia[0]) + length / (young / 2 * section.area * section.shear[0])
    rows = []
    for element in SOLIDS:
        found = []
        for cells in solids if element == "quadratic" else [2 * n for n in solids]:
            model = solid(
                box_mesh(cells=(10 * cells, cells, cells)),
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
        rows += with_orders(found, ROUND_OFF)
    for order in (1, 2):
        found = []
        for elements in beams:
            model = clamped_beam(straight(length), elements, order, section, young_modulus=young, poisson_ratio=0.0)
            value = float(Statics(model).solve([]).condensed.W.ee[2, 2])
            level, name = f"{elements} elements", f"beam of order {order}"
            found.append(Row("cantilever", name, level, model.equations, value, exact, value / exact - 1.0))
        rows += with_orders(found, ROUND_OFF)
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
    1 are half as long, so both orders have the same number of frames.
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
            rows += with_orders(found, floor=1e-6)
    return rows


def circle(levels: Sequence[int] = (8, 16, 32)) -> list[Row]:
    """Pure bending of a straight beam to a full circle; value and error: distance between its ends / L.

    The moment comes from two chambers at opposite sides of the axis under opposite pressures, p A (y - (-y)). Elements
    of order 1 are half as long, so both orders have the same number of frames.
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
        rows += with_orders(found, floor=1e-8)
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
            rows += with_orders(found, floor=1e-8)
        found = []
        for along in solids:
            across = along // 16
            model = solid(
                box_mesh(cells=(along, across, across)), "quadratic", lambda x: x[:, 0] == 0.0, _bend_of_box, **options
            )
            model.nodal_loads[:] = traction(model, _is_end_of_bend, np.array([0.0, 0.0, load]))
            x = Statics(model, tolerance=1e-7).solve([]).x
            tip = model.nodal_loads[:, 2] @ x / load
            level = f"{along} x {across} x {across} cells"
            found.append(row("quadratic", level, model.equations, tip, true, float(true[2])))
        rows += with_orders(found, ROUND_OFF)
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
            box_mesh(cells=(cells, cells, 1)),
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
    return with_orders(found, ROUND_OFF)


# -- sphere ---------------------------------------------------------------------------------------------------------


def sphere(levels: Sequence[int] = (2, 4, 8), ratios: Sequence[float] = (0.3, 0.499)) -> list[Row]:
    """Lamé's thick sphere under internal pressure in small strain: radii 1 and 2, E = 1.

    Value: mean radial displacement of the inner surface per unit pressure, by the growth of the cavity. For comparison,
    quadratic elements whose cavity consists of split triangles. Linear elements are half as large, for about as many
    unknowns.
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
            rows += with_orders(found, ROUND_OFF)
    return rows


# -- work of a cavity -----------------------------------------------------------------------------------------------


def cavity_work(levels: Sequence[int] = (2, 4, 8), count: int = 2) -> list[Row]:
    """Integral of p dV along a path (Simpson's rule) against the elastic energy; the sphere's volume grows by 60 %.

    Levels: steps of the path. If pressure-driven, the integral is p V minus that of V dp.
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
                rows += with_orders(found, ROUND_OFF)
    return rows


# -- soft finger ----------------------------------------------------------------------------------------------------


def finger(halvings: int = 1, ratios: Sequence[float] = (0.3, 0.47, 0.499)) -> list[Row]:
    """The Soft Finger with one cable on other elements; value: deflection of its tip per tension at rest [mm/N].

    On the robot's own mesh and on the same mesh with halved elements: its faceted shape stays as it is. Reference:
    quadratic elements on the finest one.
    """
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.robots.soft_finger import in_flange

    robot = make_robot("finger", cables=1)
    rows = []
    for nu in ratios:
        design = robot.design_space.complete({"poisson_ratio": nu})
        mesh = robot.body(design)
        nodes, tetrahedra, fixed = mesh.nodes, mesh.tetrahedra, in_flange(mesh.nodes)
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


# -- all cases ------------------------------------------------------------------------------------------------------

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


def validation() -> dict[str, object]:
    """Exact and published solutions on refined meshes."""
    rows = [row for case in CASES.values() for row in case()]
    return as_results(rows, "case", "element", "level")
