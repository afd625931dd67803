"""Equilibria of the equations that no body has: walls that passed through each other, and cells turned inside out."""

from __future__ import annotations

import re

import numpy as np
import pytest

from softgym_envs.errors import ConvergenceError, ImpossibleState
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.cavity import Cavity
from softgym_envs.mechanics.contact.contact import ContactSettings
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.dynamics import Dynamics
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.mechanics.surfaces import CrossingWarning, ShapeCheck, self_intersection
from tests.helpers import box_mesh

INSIDE = [0.03, 0.03, 0.00275]


def pad(**options):
    """A plate of 60 x 60 x 5.5 mm with a chamber 1.5 mm high, clamped at both ends."""
    nodes, tetrahedra = box_mesh((0.06, 0.06, 3.0), (8, 8, 3))
    centre = nodes[tetrahedra].mean(axis=1)
    hollow = (np.abs(centre[:, :2] - 0.03) < 0.0225).all(axis=1) & (np.abs(centre[:, 2] - 1.5) < 0.5)
    heights = np.array([0.0, 2e-3, 3.5e-3, 5.5e-3])
    nodes[:, 2] = heights[np.rint(nodes[:, 2]).astype(int)]
    kept, local = np.unique(tetrahedra[~hollow], return_inverse=True)
    nodes = nodes[kept]
    fixed = (nodes[:, 0] < 1e-9) | (nodes[:, 0] > 0.06 - 1e-9)
    return MechanicalModel.from_mesh(
        nodes, local.reshape(-1, 4), fixed=fixed, young_modulus=2e5, element="averaged", check=True, **options
    )


def test_walls_of_a_driven_chamber_that_cross_are_no_equilibrium():
    model = pad()
    cavity = model.add_cavity("chamber", inside=INSIDE)
    solver = Statics(model)
    held = solver.solve([-50.0], "effort")
    assert self_intersection(held.x, cavity.flat_triangles) is None
    with pytest.raises(ImpossibleState, match=r"the walls of 'chamber' pass through each other near .* m, .*self_con"):
        solver.solve([-400.0], "effort")
    np.testing.assert_array_equal(solver.x, held.x)  # the last state is kept
    np.testing.assert_array_equal(solver.effort, held.effort)
    again = solver.solve([-55.0], "effort")
    assert again.effort[0] == -55.0


def test_a_step_in_time_stops_at_once_where_walls_cross():
    model = pad(density=1100.0)
    model.add_cavity("chamber", inside=INSIDE)
    motion = Dynamics(model, step=0.02, stiffness_damping=1e-3)
    with pytest.raises(ConvergenceError, match="the walls of 'chamber' pass through each other"):
        for _ in range(20):
            motion.advance([-400.0], "effort")


def test_walls_that_touch_are_left_to_contact():
    model = pad()
    cavity = model.add_cavity("chamber", inside=INSIDE)
    assert model.set_contact().self_contact
    assert not model.set_contact(settings=ContactSettings()).self_contact
    model.set_contact(settings=ContactSettings(self_contact=True, distance=4e-4))
    found = Statics(model).solve([-400.0], "effort")
    assert self_intersection(found.x, cavity.flat_triangles) is None
    assert found.contacts.self_force > 0.0


@pytest.mark.parametrize(
    ("role", "moved", "walls"),
    [
        ("a", 7.0e-3, "walls of 'chamber' and the outside of the body"),
        ("a", 3.1e-3, "outer walls of the body"),
        ("s", 7.0e-3, "walls of 'chamber' and the outside of the body"),
        ("s", 3.1e-3, None),
    ],
)
def test_a_chamber_crosses_nothing_else(role, moved, walls):
    """A block comes down on the pad, from 3 mm above it: onto it, and then into the chamber."""
    builder, chambers = ModelBuilder(), pad()
    block, cells = box_mesh((0.021, 0.022, 0.02), (2, 2, 2), jitter=0.1)
    for nodes, tetrahedra, fixed in (
        (chambers.nodes, chambers.solids[0].connectivity, chambers.fixed),
        (block + [0.0193, 0.0187, 8.5e-3], cells, block[:, 2] > 0.0199),
    ):
        builder.add_solid(nodes, tetrahedra, fixed=fixed, young_modulus=2e5, element="averaged")
    model = builder.build()
    model.add(role, model.cavity("chamber", chambers.add_cavity("c", inside=INSIDE).triangles))
    x = model.nodes.copy()
    x[len(chambers.nodes) :, 2] -= moved
    found = ShapeCheck.of(model).problem(x)
    assert ShapeCheck.of(model).problem(model.nodes) is None
    assert (found is None) == (walls is None)
    if walls:
        assert str(found).startswith(f"{walls} pass through each other near [")


def two_bars(gap=0.002):
    """Two bars of 60 x 5 x 10 mm side by side, clamped at one end; effectors at the other."""
    builder = ModelBuilder()
    nodes, tetrahedra = box_mesh((0.06, 0.005, 0.01), (8, 1, 2))
    for y in (0.0, 0.005 + gap):
        builder.add_solid(
            nodes + [0.0, y, 1e-4 * (y > 0.0)],
            tetrahedra,
            fixed=nodes[:, 0] < 1e-9,
            young_modulus=3e5,
            element="averaged",
            check=gap > 0.0,
        )
    model = builder.build()
    for number, y in enumerate((0.0025, 0.0075 + gap)):
        model.add_effector(f"tip_{number}_{gap}", [0.06, y, 0.0043], block=number)
    return model


def test_outer_walls_that_cross_without_pressure_are_told_once():
    model, push = two_bars(), np.array([0.0, 0.02, 0.01, 0.0, -0.02, 0.0])
    solver = Statics(model)
    solver.solve([], effector_force=0.1 * push)
    with pytest.warns(CrossingWarning, match=r"outer walls of the body pass through .* near .* m, .*self_contact=True"):
        crossed = solver.solve([], effector_force=push)
    assert crossed.stable
    Statics(two_bars()).solve([], effector_force=push)  # the same body again
    touching = two_bars(0.0021)
    touching.set_contact(settings=ContactSettings(self_contact=True, distance=5e-4))
    assert Statics(touching).solve([], effector_force=push).contacts.self_force > 0.0
    Statics(two_bars(-0.001)).solve([], effector_force=push)  # bars that overlap on purpose


def test_few_states_are_looked_at(monkeypatch):
    """Those farther from rest than all before them, and one of sixteen others."""
    model, looked = two_bars(0.0022), []
    monkeypatch.setattr("softgym_envs.mechanics.surfaces._crossing", lambda *each: looked.append(each))
    check = ShapeCheck.of(model)
    for k in range(40):
        x = model.nodes.copy()
        x[-1] += 1e-3 if k == 3 else 0.5e-3
        check.warn(x)
    assert len(looked) == 4  # states 0, 3, 19 and 35


def test_two_chambers_that_cross():
    first, second = pad(), pad()
    nodes = np.vstack([first.nodes, second.nodes + [0.0, 0.0, 0.01]])
    triangles = first.add_cavity("c", inside=INSIDE).triangles
    cavities = [Cavity(name, triangles + k * len(first.nodes), nodes) for k, name in enumerate(("low", "high"))]
    check = ShapeCheck(cavities, np.empty((0, 3), dtype=np.int64), [])
    assert check.problem(nodes) is None
    nodes[len(first.nodes) :] -= [0.002, 0.003, 0.0093]
    assert str(check.problem(nodes)).startswith("walls of 'low' and those of 'high' pass through each other near")


@pytest.mark.parametrize("role", ["s", "sealed"])
def test_measured_and_sealed_chambers_are_checked_too(role):
    model = pad()
    found = model.cavity("chamber", pad().add_cavity("c", inside=INSIDE).triangles)
    if role == "s":
        model.add("s", found)
    else:
        model.seal(found)
    x = model.nodes.copy()
    upper = np.isclose(x[:, 2], 3.5e-3) & (np.abs(x[:, :2] - 0.03) < 0.02).all(axis=1)
    x[upper] += [7e-4, 4e-4, -2.5e-3]
    check = ShapeCheck.of(model)
    assert check.problem(model.nodes) is None
    assert "the walls of 'chamber' pass through each other" in str(check.problem(x))


def test_a_quadratic_cell_that_is_inside_out_is_no_state():
    nodes, tetrahedra = box_mesh((0.04, 0.02, 0.02), (2, 1, 1))
    model = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=lambda x: x[:, 0] < 1e-9, element="quadratic")
    check = ShapeCheck.of(model)
    turned = model.nodes @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert check.problem(turned) is None
    assert check.problem(1.3 * model.nodes) is None
    x = model.nodes.copy()
    x[0] = [0.021, 0.021, 0.021]  # a corner pushed through its opposite faces
    assert re.match(r"an element near .* m has turned inside out; refine the mesh there", str(check.problem(x)))


def test_a_curved_cell_is_not_judged_by_the_tetrahedron_of_its_corners():
    """A shear (x, y, z + q(x, y)) keeps every volume, and quadratic cells represent it exactly."""
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.5, 0.5, 0.2]])
    edges = [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]
    nodes = np.concatenate([corners, [corners[[i, j]].mean(axis=0) for i, j in edges]])
    check = ShapeCheck([], np.empty((0, 3), dtype=np.int64), [np.arange(10)[None]])
    bent = nodes.copy()
    bent[:, 2] -= 8.0 * 0.2 * nodes[:, 0] * nodes[:, 1]
    assert np.linalg.det(bent[1:4] - bent[0]) < 0.0 < np.linalg.det(nodes[1:4] - nodes[0])
    assert check.problem(nodes) is None and check.problem(bent) is None
    assert check.problem(bent * [1.0, 1.0, -1.0]) is not None  # mirrored
    for node in range(4, 10):  # a midside node beyond a quarter of its edge
        folded = nodes.copy()
        i, j = edges[node - 4]
        folded[node] = 0.8 * nodes[i] + 0.2 * nodes[j]
        assert check.problem(folded) is not None


def test_crossings_by_brute_force():
    """The search along one axis finds a crossing exactly where a comparison of all pairs does."""
    rng = np.random.default_rng(0)
    for _ in range(40):
        points = rng.standard_normal((18, 3)) * [1.0, 2.0, 3.0]
        triangles = np.arange(18).reshape(6, 3)
        crossing = False
        for i in range(6):
            for j in range(6):
                a, b, c = points[triangles[j]]
                for k in range(3):
                    p, q = points[triangles[i, k]], points[triangles[i, (k + 1) % 3]]
                    try:
                        u, v, t = np.linalg.solve(np.column_stack([b - a, c - a, p - q]), p - a)
                    except np.linalg.LinAlgError:
                        continue
                    crossing |= i != j and min(u, v, 1 - u - v, t, 1 - t) > 0.0
        assert (self_intersection(points, triangles) is not None) == crossing


def test_a_guide_outside_the_body():
    nodes, tetrahedra = box_mesh((0.1, 0.02, 0.02), (10, 2, 2))
    model = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=nodes[:, 0] == 0.0)
    far = [[0.02, 0.01, 0.015], [0.09, 0.01, 0.05]]
    with pytest.raises(
        ValueError, match=r"a guide of cable 'c' at \[0.09, .* m lies 0.03\d* m outside the body; pass 'h"
    ):
        model.add_cable("c", far, [0, 0.01, 0.05])
    assert not model.rows
    model.add_cable("lug", [[0.02, 0.01, 0.024], [0.09, 0.01, 0.024]], [0, 0.01, 0.024])
    model.add_cable("meant", far, [0, 0.01, 0.05], hint=np.array([0, len(tetrahedra) - 1]))
