"""Coarse elements lock: the default is right near a Poisson's ratio of 0.5, and others say how much they miss."""

from __future__ import annotations

import warnings
from contextvars import ContextVar

import numpy as np
import pytest
from scipy.optimize import brentq

from softgym_envs import make_robot
from softgym_envs.mechanics import locking
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.locking import LockingWarning, missing_compliance
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.statics import Statics
from tests.helpers import box_mesh

skfem = pytest.importorskip("skfem")
from skfem.helpers import ddot, eye, sym_grad, trace  # noqa: E402

SIZE, YOUNG = (0.1, 0.02, 0.02), 3e5
BAR = box_mesh(SIZE, (10, 2, 2))


@pytest.fixture(autouse=True)
def nothing_accepted(monkeypatch):
    """The other tests accept coarse elements; see conftest.py."""
    monkeypatch.setattr(locking, "_accepted", ContextVar("accepted", default=False))


def work(basis, poisson):
    """Work of a unit load per volume across the bar, by scikit-fem in linear elasticity [J]."""
    mu, lame = YOUNG / (2 * (1 + poisson)), YOUNG * poisson / ((1 + poisson) * (1 - 2 * poisson))

    @skfem.BilinearForm
    def stiffness(u, v, _):
        strain = sym_grad(u)
        return ddot(2 * mu * strain + lame * eye(trace(strain), 3), sym_grad(v))

    @skfem.LinearForm
    def load(v, _):
        return v[2]

    f = load.assemble(basis)
    clamped = basis.get_dofs(lambda x: x[0] < 1e-9).all()
    return float(f @ skfem.solve(*skfem.condense(stiffness.assemble(basis), f, D=clamped)))


def basis(mesh, element, order):
    nodes, tetrahedra = mesh
    return skfem.Basis(skfem.MeshTet(nodes.T.copy(), tetrahedra.T.copy()), skfem.ElementVector(element), intorder=order)


def model(poisson, element=None, mesh=BAR):
    options = {} if element is None else {"element": element}
    return MechanicalModel.from_mesh(
        *mesh, fixed=mesh[0][:, 0] == 0.0, young_modulus=YOUNG, poisson_ratio=poisson, **options
    )


@pytest.mark.parametrize("poisson", [0.3, 0.45, 0.49])
def test_the_default_converges_near_incompressibility(poisson):
    """The default is scikit-fem's quadratic element, and 4 of them across the bar are right to 3 %.

    The reference is extrapolated from 2, 3 and 4 elements across with the order that these show. Measured with 2 and 4
    elements across: 1.4 and 0.4 % at a ratio of 0.3, 4.5 and 1.3 % at 0.45, 7.9 and 2.4 % at 0.49.
    """
    body = model(poisson)
    volumes = body.solids[0].nodal_masses(len(body.nodes)) / body.solids[0].density
    body.nodal_loads[:, 2] = 1e-3 * volumes
    found = Statics(body, tolerance=1e-14).solve([])
    computed = 1e3 * float(volumes @ (found.x - body.nodes)[:, 2])
    coarse, middle, fine = (
        work(basis(box_mesh(SIZE, (5 * n, n, n)), skfem.ElementTetP2(), 4), poisson) for n in (2, 3, 4)
    )
    assert computed == pytest.approx(coarse, rel=1e-5)

    def mismatch(order):
        h = [n**-order for n in (2.0, 3.0, 4.0)]
        return (h[0] - h[1]) / (h[1] - h[2]) - (middle - coarse) / (fine - middle)

    order = brentq(mismatch, 0.5, 5.0)
    reference = fine + (fine - middle) * 4.0**-order / (3.0**-order - 4.0**-order)
    print(f"ratio {poisson}: order {order:.2f}, missing {1 - coarse / reference:.4f} and {1 - fine / reference:.4f}")
    assert order > 1.4
    assert 0.0 < 1.0 - fine / reference < 0.03


@pytest.mark.parametrize(("element", "poisson"), [("linear", 0.3), ("linear", 0.49), ("averaged", 0.49)])
def test_a_coarser_element_warns_once_with_the_figure(element, poisson):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        body = model(poisson, element)
    if element == "linear":
        lacking = 1.0 - work(basis(BAR, skfem.ElementTetP1(), 2), poisson) / work(
            basis(BAR, skfem.ElementTetP2(), 4), poisson
        )
        assert missing_compliance(body) == pytest.approx(lacking, abs=0.02)
        assert lacking > 0.3
    missing = missing_compliance(body)
    assert [warning.category for warning in caught] == [LockingWarning] * (missing > 0.05)
    if caught:
        assert f"{element} elements lock on this mesh: " in str(caught[0].message)
        assert f"{100 * missing:.0f} % less than with element='quadratic'" in str(caught[0].message)
        assert caught[0].filename == __file__


def test_the_default_does_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model(0.49)


def caught_by(make):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make()
    return [str(warning.message) for warning in caught if warning.category is LockingWarning]


@pytest.mark.parametrize("density", [1100.0, 0.0])
@pytest.mark.parametrize("held", ["clamped", "carried", "floating"])
def test_a_builder_warns_too(held, density):
    """However a solid is held, and whether it has a mass."""

    def make():
        builder = ModelBuilder(floating=held == "floating")
        clamped = BAR[0][:, 0] == 0.0
        fixed = clamped & (held == "clamped")
        builder.add_solid(*BAR, fixed=fixed, element="linear", poisson_ratio=0.45, density=density)
        if held == "carried":
            builder.carry(builder.add_frame([0.0, 0.0, 0.0], fixed=True, fixed_spin=True), np.flatnonzero(clamped))
        builder.build()

    (message,) = caught_by(make)
    assert message.startswith("linear elements lock on this mesh: under a uniform load the body gives way by ")


def test_large_bodies_warn_without_the_figure(monkeypatch):
    monkeypatch.setattr(locking, "MOST_NODES", 100)
    assert caught_by(lambda: model(0.49, "linear")) == [
        "linear elements lock near a Poisson's ratio of 0.5, here 0.49, and in thin walls"
    ]
    assert not caught_by(lambda: model(0.3, "linear"))


def test_robots_warn_once_unless_they_reproduce_a_scene():
    assert not caught_by(make_robot("finger").build)
    robot = make_robot("finger", mesh_size=15e-3)
    assert len(caught_by(robot.build)) == 1
    assert not caught_by(lambda: robot.build({"young_modulus": 4e6}))
    assert len(caught_by(make_robot("two_finger_friction_gripper").build)) == 1
