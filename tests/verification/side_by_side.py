"""The same problems in other codes: error against CPU seconds.

    pip install "softgym-envs[compare]"
    python -m tests.verification side_by_side

Codes that are not installed are left out. Times are CPU seconds of one thread for assembly and solution; meshes,
imports and compilation are not counted (every case runs once on its smallest mesh first).

* cantilever: small deflection of a 10 : 1 bar under end shear, Poisson's ratio 0, against Timoshenko's beam. The rod of
  PyElastica is round, with the same area; its reference has its section and its shear factor.
* Cook's membrane: plane strain, small strain; see `tests.verification.statics.cook`.
* twisted column: 1 x 1 x 4, both ends held, one turned by 90 degrees in six steps; strain energy of one stable
  neo-Hookean material, whose compiled law all codes evaluate. Reference: our finest quadratic mesh.
* finger: deflection of the tip of the Soft Finger under a small force along y on it, by elements of the same meshes.
  Reference: quadratic elements on the halved mesh.

MuJoCo (flex) and PyElastica have no statics: their bodies are damped, critically for the lowest mode, until they rest.
No other code has the cables of the finger. Times of SOFA on the notched beam are in the table of the speed of statics.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from typing import Any

import numpy as np

from softgym_envs.extensions.beams.beam import Section
from softgym_envs.mechanics.materials import MATERIALS, lame_parameters
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.quantities import unchecked
from tests.helpers import box_mesh
from tests.verification.bodies import clamped_beam, halved, linear_response, solid, straight, traction
from tests.verification.statics import COOK

CODES = {"scikit-fem": "skfem", "FElupe": "felupe", "MuJoCo": "mujoco", "PyElastica": "elastica"}
"""Package and module of each other code."""


@dataclass(frozen=True)
class Row:
    """One solution: relative error of a value, and the CPU time that it took [s]."""

    case: str
    code: str
    element: str
    level: str
    unknowns: int
    value: float
    reference: float
    error: float
    seconds: float


@dataclass(frozen=True)
class Problem:
    """A linear problem on one mesh: displacements of a clamped solid under small nodal loads.

    Attributes:
        model: our model of it.
        young, nu: elasticity.
        loads: on the nodes, shape (n, 3).
        value: from displacements (n, 3) to the compared value.
    """

    model: MechanicalModel
    young: float
    nu: float
    loads: np.ndarray
    value: Callable[[np.ndarray], float]


# -- linear problems ------------------------------------------------------------------------------------------------


def cantilever_problem(cells: int, element: str) -> Problem:
    """10 : 1 bar with so many cells across."""
    model = solid(
        box_mesh(cells=(10 * cells, cells, cells)),
        element,
        lambda x: x[:, 0] == 0.0,
        lambda x: x * [10.0, 1.0, 1.0],
        young_modulus=1.0,
        poisson_ratio=0.0,
    )
    loads = traction(model, lambda x: np.isclose(x[:, 0], 10.0), np.array([0.0, 0.0, 1.0]))
    return Problem(model, 1.0, 0.0, loads, lambda u: float(np.vdot(loads, u)))


def cook_problem(cells: int, element: str, nu: float) -> Problem:
    """Cook's membrane with so many cells along each side."""
    thick = 48.0 / cells
    box, tetrahedra = box_mesh(cells=(cells, cells, 1))
    s, t, z = box.T
    nodes = np.column_stack([48.0 * s, 44.0 * s + t * (44.0 - 28.0 * s), thick * z])
    with unchecked("size", "modulus"):  # without dimensions
        model = MechanicalModel.from_mesh(
            nodes,
            tetrahedra,
            fixed=np.column_stack([s == 0.0, s == 0.0, np.ones(len(s), dtype=bool)]),
            element=element,
            young_modulus=250.0,
            poisson_ratio=nu,
        )
    loads = traction(model, lambda x: np.isclose(x[:, 0], 48.0), np.array([0.0, 100.0 * thick, 0.0]))
    corner = np.isclose(model.nodes[:, 0], 48.0) & np.isclose(model.nodes[:, 1], 60.0)
    return Problem(model, 250.0, nu, loads, lambda u: float(u[corner, 1].mean()))


def finger_problem(level: int, element: str) -> Problem:
    """The Soft Finger of one cable on its own mesh, elements halved ``level`` times; value in mm/N."""
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.robots.soft_finger import in_flange

    robot = make_robot("finger", cables=1)
    mesh = robot.body()  # type: ignore[attr-defined]
    nodes, tetrahedra, fixed = mesh.nodes, mesh.tetrahedra, in_flange(mesh.nodes)
    for _ in range(level):
        nodes, tetrahedra, fixed = halved(nodes, tetrahedra, fixed)
    model = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=fixed, element=element, poisson_ratio=0.3)
    end = model.nodes[:, 2].min()
    loads = traction(model, lambda x: np.isclose(x[:, 2], end, atol=1e-7), np.array([0.0, 1.0, 0.0]))
    return Problem(model, 3.0e6, 0.3, loads, lambda u: 1e3 * float(np.vdot(loads, u)))


def ours(problem: Problem) -> np.ndarray:
    """Displacements (n, 3) by this package."""
    return linear_response(problem.model, problem.loads)


def scikit_fem(problem: Problem) -> np.ndarray:
    """Displacements (n, 3) by scikit-fem, with SciPy's default solver."""
    import skfem
    from skfem.models.elasticity import linear_elasticity

    basis, order = _skfem_basis(problem.model)
    mu, lame = lame_parameters(problem.young, problem.nu)
    stiffness = linear_elasticity(lame, mu).assemble(basis)
    fixed = np.flatnonzero(problem.model.kinematics.held[order])
    moved = skfem.solve(*skfem.condense(stiffness, problem.loads[order].ravel(), D=fixed))
    result = np.empty_like(problem.loads)
    result[order] = moved.reshape(-1, 3)
    return result


def _skfem_basis(model: MechanicalModel) -> tuple[Any, np.ndarray]:
    """Return the basis of the same elements, and our node at each of its places, shape (n,)."""
    import skfem
    from scipy.spatial import cKDTree

    (block,) = model.solids
    corners, cells = np.unique(block.connectivity[:, :4], return_inverse=True)
    mesh = skfem.MeshTet(model.nodes[corners].T, cells.reshape(-1, 4).T)
    quadratic = block.connectivity.shape[1] == 10
    element = skfem.ElementTetP2() if quadratic else skfem.ElementTetP1()
    basis = skfem.Basis(mesh, skfem.ElementVector(element), intorder=2 if quadratic else 0)
    return basis, cKDTree(model.nodes).query(basis.doflocs[:, ::3].T)[1]


def felupe(problem: Problem) -> np.ndarray:
    """Displacements (n, 3) by FElupe, with SciPy's default solver."""
    import felupe as fem

    field = _felupe_field(problem.model)
    body = fem.SolidBody(fem.LinearElastic(E=problem.young, nu=problem.nu), field)
    force = fem.PointLoad(field, np.arange(len(problem.loads)), problem.loads)
    moved = fem.newtonrhapson(items=[body, force], **_felupe_bounds(problem.model), verbose=0)
    return moved.x[0].values


def _felupe_field(model: MechanicalModel) -> Any:
    import felupe as fem

    (block,) = model.solids
    quadratic = block.connectivity.shape[1] == 10
    mesh = fem.Mesh(model.nodes, block.connectivity, "tetra10" if quadratic else "tetra")
    region = (fem.RegionQuadraticTetra if quadratic else fem.RegionTetra)(mesh)
    return fem.FieldContainer([fem.Field(region, dim=3)])


def _felupe_bounds(model: MechanicalModel, values: np.ndarray | None = None) -> dict[str, Any]:
    """Return which degrees of freedom are held, and at which displacements (n, 3), by default zero."""
    held = model.kinematics.held.ravel()
    fixed = np.flatnonzero(held)
    return {"dof0": fixed, "dof1": np.flatnonzero(~held), "ext0": 0.0 * fixed if values is None else values.flat[fixed]}


# -- twisted column -------------------------------------------------------------------------------------------------

YOUNG, NU = 1.0e6, 0.45
TURNS = np.linspace(0.0, 0.5 * np.pi, 7)[1:]


def column(cells: int, element: str) -> MechanicalModel:
    """1 x 1 x 4 column whose ends are held."""
    return solid(
        box_mesh(cells=(cells, cells, 4 * cells)),
        element,
        lambda x: np.isclose(x[:, 2] % 1.0, 0.0),
        lambda x: x * [1.0, 1.0, 4.0],
        material="stable_neo_hookean",
        young_modulus=YOUNG,
        poisson_ratio=NU,
    )


def turned(nodes: np.ndarray, angle: float) -> np.ndarray:
    """Displacements (n, 3) of a column that is twisted evenly by an angle [rad]."""
    x, y, z = (nodes - [0.5, 0.5, 0.0]).T
    c, s = np.cos(angle * z / 4.0), np.sin(angle * z / 4.0)
    return np.column_stack([c * x - s * y, s * x + c * y, z]) + [0.5, 0.5, 0.0] - nodes


def law(F: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Energy (q,), stress (q, 9) and tangent (q, 9, 9) of the column's material at gradients (q, 3, 3)."""
    count = len(F)
    mu, lame = (np.full(count, value) for value in lame_parameters(YOUNG, NU))
    energy, stress, tangent = np.empty(count), np.empty((count, 9)), np.empty((count, 9, 9))
    if MATERIALS["stable_neo_hookean"].evaluate(F.reshape(-1, 9), mu, lame, energy, stress, tangent):
        raise FloatingPointError("an element of the column is inverted")
    return energy, stress, tangent


def our_column(model: MechanicalModel) -> float:
    """Strain energy [J] by this package."""
    statics = Statics(model)
    for before, angle in zip((0.0, *TURNS), TURNS, strict=False):
        x = statics.x + turned(model.nodes, angle) - turned(model.nodes, before)
        statics.restore(x, np.zeros(0))
        statics.solve([])
    return float(model.blocks[0].add(statics.x, np.zeros_like(model.nodes), None, None)[0])


def skfem_column(model: MechanicalModel) -> float:
    """Strain energy [J] by scikit-fem: our Newton iterations on its assembly, with SciPy's default solver."""
    import skfem

    basis, order = _skfem_basis(model)
    fixed = np.flatnonzero(model.kinematics.held[order])
    weights = basis.dx

    def state(u: np.ndarray) -> tuple[np.ndarray, ...]:
        gradient = np.moveaxis(basis.interpolate(u).grad, (0, 1), (2, 3))
        shape = gradient.shape[:2]
        parts = law((gradient + np.eye(3)).reshape(-1, 3, 3))
        return tuple(np.moveaxis(p.reshape(*shape, *p.shape[1:]), (0, 1), (-2, -1)) for p in parts)

    @skfem.LinearForm
    def residual(v, w):
        return np.einsum("ij...,ij...", w["stress"], v.grad)

    @skfem.BilinearForm
    def jacobian(u, v, w):
        return np.einsum("ij...,ijkl...,kl...", v.grad, w["tangent"], u.grad, optimize=True)

    u = np.zeros(basis.N)
    for before, angle in zip((0.0, *TURNS), TURNS, strict=False):
        u += (turned(model.nodes, angle) - turned(model.nodes, before))[order].ravel()
        for _ in range(20):
            _, P, A = state(u)
            shape = P.shape[1:]
            r = residual.assemble(basis, stress=P.reshape(3, 3, *shape))
            K = jacobian.assemble(basis, tangent=A.reshape(3, 3, 3, 3, *shape))
            step = skfem.solve(*skfem.condense(K, -r, D=fixed))
            u += step
            if np.abs(step).max() < 1e-8:
                break
    return float((state(u)[0] * weights).sum())


def felupe_column(model: MechanicalModel) -> float:
    """Strain energy [J] by FElupe."""
    import felupe as fem

    field = _felupe_field(model)
    shape = field.region.dV.shape

    def at(F: np.ndarray) -> np.ndarray:
        return np.moveaxis(F, (0, 1), (2, 3)).reshape(-1, 3, 3)

    def stress(x, **_):
        found = law(at(x[0]))[1]
        return [np.moveaxis(found.reshape(*shape, 3, 3), (2, 3), (0, 1)), x[-1]]

    def elasticity(x, **_):
        found = law(at(x[0]))[2]
        return [np.moveaxis(found.reshape(*shape, 3, 3, 3, 3), (2, 3, 4, 5), (0, 1, 2, 3))]

    body = fem.SolidBody(fem.Material(stress, elasticity), field)
    for before, angle in zip((0.0, *TURNS), TURNS, strict=False):
        field[0].values += turned(model.nodes, angle) - turned(model.nodes, before)
        bounds = _felupe_bounds(model, field[0].values)
        fem.newtonrhapson(items=[body], **bounds, verbose=0, tol=1e-6)
    return float((law(at(field.extract()[0]))[0].reshape(shape) * field.region.dV).sum())


# -- dynamic relaxation ---------------------------------------------------------------------------------------------


def mujoco_cantilever(cells: int) -> tuple[float, int]:
    """Deflection over the exact one and number of unknowns: linear tetrahedra of MuJoCo's flex, so many across."""
    import mujoco

    mujoco.set_mju_user_warning(lambda _: None)  # about its preconditioner; the body comes to rest all the same
    along, spacing, young, force = 10 * cells, 0.1 / cells, 1e4, 1e-3
    description = f"""
    <mujoco><option gravity="0 0 0" timestep="0.2" integrator="discrete" solver="CG" tolerance="1e-10"/>
      <size memory="1G"/><worldbody>
        <flexcomp name="bar" type="grid" dim="3" count="{along + 1} {cells + 1} {cells + 1}" mass="1" radius="1e-4"
          spacing="{spacing} {spacing} {spacing}"><elasticity young="{young}" poisson="0" damping="2"/>
          <contact selfcollide="none"/><pin gridrange="0 0 0 0 {cells} {cells}"/></flexcomp></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(description)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rest = data.flexvert_xpos.copy()
    end = np.flatnonzero(np.isclose(rest[:, 0], rest[:, 0].max()))
    edge = np.isclose(rest[end, 1:], rest[:, 1:].min(axis=0)) | np.isclose(rest[end, 1:], rest[:, 1:].max(axis=0))
    share = np.where(edge, 0.5, 1.0).prod(axis=1)
    share /= share.sum()
    np.add.at(data.xfrc_applied, (model.flex_vertbodyid[end], 2), force * share)
    before = np.inf
    for _ in range(100):
        mujoco.mj_step(model, data, 20)
        moved = float((data.flexvert_xpos[end, 2] - rest[end, 2]) @ share)
        if abs(moved - before) < 1e-8 * abs(moved):
            break
        before = moved
    exact = force * (4.0 / (young * 0.1**4) + 2.4 / (young * 0.1**2))
    return float(moved / exact), model.nv


def pyelastica_cantilever(elements: int) -> tuple[float, int]:
    """Deflection over the exact one and number of unknowns: Cosserat rod of PyElastica."""
    import elastica as ea

    class System(ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping):
        pass

    system, length, radius, force = System(), 10.0, np.pi**-0.5, 1e-6
    start, along, up = np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    rod = ea.CosseratRod.straight_rod(
        elements, start, along, up, length, radius, 1.0, youngs_modulus=1.0, shear_modulus=0.5
    )
    system.append(rod)
    system.constrain(rod).using(ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,))
    system.add_forcing_to(rod).using(ea.EndpointForces, np.zeros(3), force * up, ramp_up_time=1e-6)
    inertia = 0.25 * np.pi * radius**4
    step, damping = 0.3 * length / elements, 2.0 * 3.516 * inertia**0.5 / length**2
    system.dampen(rod).using(ea.AnalyticalLinearDamper, damping_constant=damping, time_step=step)
    system.finalize()
    stepper, now, before = ea.PositionVerlet(), np.float64(0.0), np.inf
    for _ in range(200):
        for _ in range(200):
            now = stepper.step(system, now, np.float64(step))
        moved = float(rod.position_collection[2, -1])
        if abs(moved - before) < 1e-6 * abs(moved):
            break
        before = moved
    exact = force * (length**3 / (3.0 * inertia) + length / rod.shear_matrix[0, 0, 0])
    return float(moved / exact), 6 * elements


def our_cantilever(elements: int) -> tuple[float, int]:
    """The same of this package's beam of order 2, with a square section."""
    section = Section.rectangle(1.0, 1.0)
    model = clamped_beam(straight(10.0), elements, 2, section, young_modulus=1.0, poisson_ratio=0.0)
    exact = 1000.0 / (3.0 * section.inertia[0]) + 10.0 / (0.5 * section.area * section.shear[0])
    return float(Statics(model).solve([]).condensed.W.ee[2, 2]) / exact, model.equations


# -- all of them ----------------------------------------------------------------------------------------------------

LINEAR = {"this package": ours, "scikit-fem": scikit_fem, "FElupe": felupe}
COLUMNS = {"this package": our_column, "scikit-fem": skfem_column, "FElupe": felupe_column}
RELAXED = {
    "this package": ("beam", our_cantilever, (1, 2, 4)),
    "PyElastica": ("Cosserat rod", pyelastica_cantilever, (10, 20, 40)),
    "MuJoCo": ("flex, linear", mujoco_cantilever, (1, 2, 4)),
}
CELLS = {"linear": (2, 4, 8), "quadratic": (1, 2, 4)}


def _installed(code: str) -> bool:
    return code not in CODES or find_spec(CODES[code]) is not None


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    start = time.process_time()
    return work(), time.process_time() - start


def _linear() -> Iterator[Row]:
    exact = 10.0**3 / (3.0 / 12.0) + 10.0 / (0.5 * 5.0 / 6.0)
    cases: list[tuple[str, Callable[[int, str], Problem], dict[str, tuple[int, ...]], float]] = [
        ("cantilever", cantilever_problem, CELLS, exact),
    ]
    for nu in (0.3, 0.499):
        make = lambda n, element, nu=nu: cook_problem(n, element, nu)  # noqa: E731
        sizes = {"linear": (8, 16, 32), "quadratic": (4, 8, 16)}
        cases.append((f"Cook's membrane, nu = {nu:g}", make, sizes, COOK[nu]))
    finest = finger_problem(1, "quadratic")
    cases.append(("finger", finger_problem, {"linear": (0, 1), "quadratic": (0, 1)}, finest.value(ours(finest))))
    for case, make, sizes, reference in cases:
        for element, levels in sizes.items():
            for code, solve in LINEAR.items():
                if not _installed(code):
                    continue
                solve(make(levels[0], element))
                for n in levels:
                    problem = make(n, element)
                    moved, seconds = _timed(lambda solve=solve, problem=problem: solve(problem))
                    value = problem.value(moved)
                    level = f"halved {n} times" if case == "finger" else f"{n} cells"
                    error = value / reference - 1.0
                    yield Row(case, code, element, level, problem.model.equations, value, reference, error, seconds)


def _columns() -> Iterator[Row]:
    reference = our_column(column(6, "quadratic"))
    for element, levels in {"linear": (2, 4), "quadratic": (1, 2)}.items():
        for code, solve in COLUMNS.items():
            if not _installed(code):
                continue
            solve(column(levels[0], element))
            for n in levels:
                model = column(n, element)
                value, seconds = _timed(lambda solve=solve, model=model: solve(model))
                error = value / reference - 1.0
                yield Row(
                    "twisted column", code, element, f"{n} cells", model.equations, value, reference, error, seconds
                )


def _relaxed() -> Iterator[Row]:
    for code, (element, solve, levels) in RELAXED.items():
        if not _installed(code):
            continue
        solve(levels[0])
        for n in levels:
            (value, unknowns), seconds = _timed(lambda solve=solve, n=n: solve(n))
            level = f"{n} cells" if code == "MuJoCo" else f"{n} elements"
            yield Row("cantilever", code, element, level, unknowns, value, 1.0, value - 1.0, seconds)


def side_by_side() -> dict[str, object]:
    """Cantilever, Cook's membrane, twisted column and finger in several codes: error and CPU seconds."""
    rows = [*_linear(), *_relaxed(), *_columns()]
    result: dict[str, object] = {"versions": {code: _version(code) for code in CODES}}
    return result | {
        f"{row.case} | {row.code} | {row.element} | {row.level}": {
            name: getattr(row, name) for name in ("unknowns", "value", "reference", "error", "seconds")
        }
        for row in rows
    }


def _version(code: str) -> str | None:
    try:
        return version(code)
    except PackageNotFoundError:
        return None
