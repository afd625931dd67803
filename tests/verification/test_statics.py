"""The validation cases on coarse meshes: errors, and the orders at which they fall."""

from __future__ import annotations

import numpy as np
import pytest
import skfem
from scipy.integrate import solve_bvp
from scipy.sparse import bmat
from skfem.helpers import ddot, div, sym_grad

from softgym_envs.extensions.beams.beam import Section
from tests.verification import statics as validation
from tests.verification.rows import with_orders


def by_element(rows):
    """Lists of rows by case and element, in the order of their meshes."""
    result = {}
    for row in rows:
        result.setdefault((row.case, row.element), []).append(row)
    for key, group in result.items():
        print(*key, [f"{r.error:.2e} ({r.order:.2f})" for r in group])
    return result


def errors(group):
    return np.abs([row.error for row in group])


def test_patch():
    rows = validation.patch((2, 3))
    assert len(rows) == 12
    assert max(row.error for row in rows) < 1e-12


def test_cantilever():
    """Shear locking of linear tetrahedra, averaged or not; quadratic ones and beams of order 2 have the deflection."""
    groups = by_element(validation.cantilever((1, 2), (1, 2, 4)))
    case = "cantilever"
    for element in ("linear", "averaged"):
        assert errors(groups[case, element])[-1] < 0.2
        assert 1.2 < groups[case, element][-1].order < 2.2
    assert groups[case, "linear"][0].value == pytest.approx(groups[case, "averaged"][0].value, rel=1e-9)  # nu = 0
    assert errors(groups[case, "quadratic"])[0] < 2e-3 and errors(groups[case, "quadratic"])[1] < 2e-4
    assert groups[case, "quadratic"][1].order > 3.0
    assert all(1.95 < row.order < 2.05 for row in groups[case, "beam of order 1"][1:])
    assert errors(groups[case, "beam of order 2"]).max() < 1e-10


@pytest.mark.parametrize("load", [1.0, 5.0, 10.0])
def test_the_elastica_by_its_differential_equation(load):
    """The elliptic integrals against the differential equation theta'' = -load cos(theta)."""
    s = np.linspace(0.0, 1.0, 200)
    solved = solve_bvp(
        lambda s, y: np.array([y[1], -load * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]),
        lambda a, b: np.array([a[0], b[1], a[2], a[3]]),
        s,
        np.array([1.2 * s, 1.2 - s, s, 0.5 * s]),
        tol=1e-10,
        max_nodes=100_000,
    )
    assert solved.success
    np.testing.assert_allclose(validation.elastica_tip(load), solved.y[2:, -1], rtol=0, atol=1e-9)


def test_elastica():
    groups = by_element(validation.elastica((4, 8), (1.0, 10.0)))
    assert len(groups) == 4
    for (case, element), group in groups.items():
        order = 2 if element == "beam of order 1" else 4
        assert order - 0.3 < group[-1].order < order + 0.4, case
        assert errors(group)[-1] < (0.01 if order == 2 else 4e-4)


def test_bending_to_a_circle():
    groups = by_element(validation.circle((8, 16)))
    for (_, element), group in groups.items():
        assert group[-1].order == pytest.approx(2.0 if element == "beam of order 1" else 4.0, abs=0.3)
    assert errors(groups["bending to a circle: gap", "beam of order 2"])[-1] < 3e-4


def test_45_degree_bend():
    """Published positions were computed with few elements: they differ by 0.4 % from converged ones."""
    groups = by_element(validation.bend((4, 8), (16, 32), (300.0,)))
    case = "45 degree bend, P = 300: height"
    assert errors(groups[case, "beam of order 2, published torsion"])[-1] < 0.005
    assert 1.9 < groups[case, "beam of order 1"][-1].order < 2.2
    assert 3.8 < groups[case, "beam of order 2"][-1].order < 4.2
    assert errors(groups[case, "beam of order 2"])[-1] < 1e-4
    assert errors(groups[case, "quadratic"])[-1] < 0.004


def test_published_torsion_is_the_polar_moment():
    square = Section.rectangle(1.0, 1.0)
    assert sum(square.inertia) == pytest.approx(1.0 / 6.0)
    assert square.torsion == pytest.approx(0.1406, abs=1e-4)


def mixed_cook(cells, poisson_ratio=0.4999):
    """Tip deflection of Cook's membrane by Taylor-Hood elements (displacement of order 2, pressure of order 1)."""
    mu = 250.0 / (2.0 * (1.0 + poisson_ratio))
    lame = 2.0 * mu * poisson_ratio / (1.0 - 2.0 * poisson_ratio)
    square = skfem.MeshTri.init_tensor(np.linspace(0, 1, cells + 1), np.linspace(0, 1, cells + 1))
    s, t = square.p
    mesh = skfem.MeshTri(np.array([48.0 * s, 44.0 * s + t * (44.0 - 28.0 * s)]), square.t)
    element = skfem.ElementVector(skfem.ElementTriP2())
    basis, pressure = skfem.Basis(mesh, element, intorder=4), skfem.Basis(mesh, skfem.ElementTriP1(), intorder=4)
    A = skfem.BilinearForm(lambda u, v, _: 2 * mu * ddot(sym_grad(u), sym_grad(v))).assemble(basis)
    B = skfem.BilinearForm(lambda u, q, _: div(u) * q).assemble(basis, pressure)
    C = skfem.BilinearForm(lambda p, q, _: p * q / lame).assemble(pressure)
    edge = skfem.FacetBasis(mesh, element, facets=mesh.facets_satisfying(lambda x: np.isclose(x[0], 48.0)))
    load = skfem.LinearForm(lambda v, _: 100.0 / 16.0 * v[1]).assemble(edge)
    fixed = basis.get_dofs(lambda x: np.isclose(x[0], 0.0)).all()
    system = skfem.condense(bmat([[A, B.T], [B, -C]]).tocsc(), np.append(load, np.zeros(pressure.N)), D=fixed)
    corner = np.argmin(np.abs(mesh.p - [[48.0], [60.0]]).sum(axis=0))
    return skfem.solve(*system)[basis.nodal_dofs[1, corner]]


@pytest.mark.parametrize("poisson_ratio", validation.COOK)
def test_the_reference_of_cooks_membrane(poisson_ratio):
    """A mixed solution of another program, extrapolated from 8, 16 and 32 cells (the validation's from 128)."""
    coarse, middle, fine = (mixed_cook(cells, poisson_ratio) for cells in (8, 16, 32))
    ratio = (middle - coarse) / (fine - middle)
    extrapolated = fine + (fine - middle) / (ratio - 1.0)
    print(coarse, middle, fine, extrapolated)
    assert extrapolated == pytest.approx(validation.COOK[poisson_ratio], rel=2e-3)


def test_cooks_membrane():
    """At nu = 0.4999 linear elements lock and do not converge; averaged and quadratic ones do."""
    groups = by_element(validation.cook((4, 8, 16), (0.3, 0.4999)))
    case = "Cook's membrane, nu = 0.4999"
    assert errors(groups[case, "linear"]).min() > 0.7
    assert groups[case, "linear"][-1].order < 0.1
    for element, limit in (("averaged", 0.15), ("quadratic", 0.08)):
        assert errors(groups[case, element])[-1] < limit
        assert groups[case, element][-1].order > 1.1
    # Far from incompressible all converge.
    for element, limit in (("linear", 0.13), ("averaged", 0.1), ("quadratic", 0.02)):
        group = groups["Cook's membrane, nu = 0.3", element]
        assert errors(group)[-1] < limit
        assert group[-1].order > 1.2


def test_thick_sphere():
    groups = by_element(validation.sphere((2, 4)))
    for nu, locking in (("0.3", False), ("0.499", True)):
        case = f"thick sphere, nu = {nu}"
        assert (groups[case, "linear"][-1].order < 0.8) == locking
        assert groups[case, "averaged"][-1].order > 1.6
        assert errors(groups[case, "averaged"])[-1] < 0.035
        assert errors(groups[case, "quadratic"])[-1] < 0.006
        assert groups[case, "quadratic"][-1].order > 2.2
        # A cavity of split triangles makes quadratic elements inaccurate.
        assert errors(groups[case, "quadratic, split cavity"])[-1] > 2 * errors(groups[case, "quadratic"])[-1]


def test_work_of_a_cavity():
    """Simpson's rule is of fourth order: nothing else is missing from the work."""
    groups = by_element(validation.cavity_work((4, 8)))
    assert len(groups) == 12
    for group in groups.values():
        assert errors(group)[-1] < 2e-5
        assert 3.5 < group[-1].order < 4.5


def test_soft_finger():
    """On the robot's own mesh linear elements are stiffer than averaged ones, and these than quadratic ones."""
    groups = by_element(validation.finger(0, (0.47,)))
    values = [
        groups["soft finger, nu = 0.47: tip", element][0].value for element in ("linear", "averaged", "quadratic")
    ]
    assert values == sorted(values)
    assert values[0] < 0.8 * values[2]


def test_every_case_is_tested():
    assert set(validation.CASES) == {
        "patch", "cantilever", "elastica", "circle", "bend", "cook", "sphere", "cavity_work", "finger"
    }  # fmt: skip


def test_orders_are_those_of_halved_meshes():
    rows = [validation.Row("c", "e", "", 1, 0.0, 0.0, error) for error in (0.4, -0.1, 1e-13)]
    orders = [row.order for row in with_orders(rows, validation.ROUND_OFF)]
    assert np.isnan(orders[0]) and orders[1] == pytest.approx(2.0) and np.isnan(orders[2])
