"""Rods and tendons: constant curvature, the elastica, shapes published for SoroSim, loads by name, compliant drives."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_bvp

from softgym_envs.extensions.beams import Section, add_rod
from softgym_envs.mechanics import MechanicalModel, ModelBuilder, Statics
from softgym_envs.mechanics.solvers.dynamics import Dynamics

LENGTH, RADIUS, MODULUS, OFFSET = 0.2, 5e-4, 60e9, 4.5e-3
SECTION = Section.circle(RADIUS)
EI, EA = MODULUS * SECTION.inertia[0], MODULUS * SECTION.area
STEEL = {"section": Section.circle(8e-4), "young_modulus": 200e9, "poisson_ratio": 0.33, "density": 7870.0}


def rod_model(path, gravity=(0.0, 0.0, 0.0), **options):
    builder = ModelBuilder(gravity=gravity)
    rod = add_rod(builder, path, **options)
    return builder.build(), rod


def straight(elements=20, **options):
    """A rod along z, clamped at the origin, with d_2 along x."""
    given = {"section": SECTION, "young_modulus": MODULUS, "density": 6450.0, "up": [1, 0, 0], **options}
    return rod_model([[0, 0, 0], [0, 0, LENGTH]], elements=elements, **given)


def tip(model, rod, state):
    return rod.points(rod.length, (0.0, 0.0), model.nodes).positions(state.x)[0]


def with_tendons(discs=20, angles=(0.0, np.pi), **options):
    model, rod = straight(discs)
    for k, angle in enumerate(angles):
        offset = OFFSET * np.array([np.cos(angle), np.sin(angle)])
        rod.add_tendon(model, f"tendon_{k}", np.linspace(0.0, LENGTH, discs + 1)[1:], offset, **options)
    return model, rod


@pytest.mark.parametrize("tension", [0.5, 2.0, 5.0])
def test_a_tendon_bends_a_rod_to_a_circle(tension):
    """A tendon without friction beside the axis is a constant moment: the tip of an arc, to 0.5 % of the length.

    It runs straight from disc to disc, so it is farther from the axis between them: by 0.4 % with 40 discs.
    """
    model, rod = with_tendons(discs=40)
    state = Statics(model).solve([tension, 0.0], "effort")
    curvature = tension * OFFSET / EI
    angle = curvature * LENGTH
    length = LENGTH * (1.0 - tension / EA)
    arc = length / angle * np.array([1.0 - np.cos(angle), 0.0, np.sin(angle)])
    error = np.linalg.norm(tip(model, rod, state) - arc)
    print(f"{tension} N: {np.degrees(angle):.0f} degrees, {1e3 * error:.3f} mm of {1e3 * np.linalg.norm(arc):.0f} mm")
    assert error < 0.005 * LENGTH
    assert state.delta[0] == pytest.approx(angle * OFFSET + tension * LENGTH / EA, rel=6e-3)


def test_a_pulled_tendon_leaves_its_antagonist_slack():
    model, rod = with_tendons()
    state = Statics(model).solve([0.004, -0.010])
    assert state.effort[0] > 0.0 and state.effort[1] == 0.0
    np.testing.assert_array_equal(state.slack, [False, True])
    # Let out by what the bend needs, it is taut.
    taut = Statics(model).solve([0.004, -0.003])
    assert (taut.effort[:2] > 0.0).all()


@pytest.mark.parametrize("load", [1.0, 4.0])
def test_the_elastica(load):
    """A dead load across the tip, ``load`` = F L^2 / EI, against the differential equation, to 0.5 % of the length."""
    solved = solve_bvp(
        lambda s, y: np.vstack([y[1], -load * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]),
        lambda a, b: np.array([a[0], b[1], a[2], a[3]]),
        np.linspace(0.0, 1.0, 101),
        np.zeros((4, 101)),
        tol=1e-9,
    )
    assert solved.success
    model, rod = straight()
    end = rod.points(LENGTH, (0.0, 0.0), model.nodes)
    model.add_load("weight", [load * EI / LENGTH**2, 0.0, 0.0], end)
    found = tip(model, rod, Statics(model).solve([]))
    np.testing.assert_allclose(found, LENGTH * np.array([solved.y[3, -1], 0.0, solved.y[2, -1]]), atol=5e-4 * LENGTH)


# Gravity [m/s2]; moment [N m] and force [N] in the middle and at the tip; where middle and tip end up [m].
SOROSIM = [
    (
        (-5.8693, -6.145, -4.9017),
        (0.0117, 0.0724, 0.032, -0.0606, 0.0297, 0.1883),
        (-0.0582, 0.018, -0.0518, -0.1742, 0.0763, 0.0618),
        ((0.2951, -0.0046, -0.0445), (0.5669, -0.0666, -0.1519)),
    ),
    (
        (-4.8077, 8.1144, 2.6978),
        (-0.0102, -0.054, 0.0581, 0.0938, -0.1576, 0.0799),
        (0.0551, 0.0534, -0.0226, 0.0459, -0.1575, -0.1145),
        ((0.2969, -0.0327, -0.0207), (0.5708, -0.1012, -0.1165)),
    ),
    (
        (-7.9082, 5.8039, -0.1109),
        (-0.0385, -0.0701, -0.0014, 0.1793, -0.0506, -0.0727),
        (-0.0241, 0.007, 0.076, 0.0039, 0.1943, -0.0473),
        ((0.2789, 0.0958, 0.0083), (0.4701, 0.3233, -0.0002)),
    ),
]


@pytest.mark.parametrize("gravity, middle, end, shape", SOROSIM)
def test_shapes_that_sorosim_published(gravity, middle, end, shape):
    """A spring-steel rod of 0.6 m under gravity, forces and moments that keep their direction.

    From `data/reference/sorosim/sorosim_statics/SpringSteelRodMuJoCo_dataStatics.csv` of
    github.com/ContinuumRoboticsLab/opencr-mujoco (MIT), shapes 1 to 3, which have four digits.
    """
    model, rod = rod_model([[0, 0, 0], [0.6, 0, 0]], elements=20, up=[0, 1, 0], gravity=gravity, **STEEL)
    solver, chain = Statics(model), rod.beam.chain
    x = model.nodes
    # A moment M is the forces M x d_k / 2 on the directors, which turn with them: repeat until they rest.
    for k in range(1, 80):
        model.nodal_loads[:] = 0.0
        for row, wrench in ((chain[20], middle), (chain[-1], end)):
            part = min(1.0, k / 10)
            model.nodal_loads[row] += part * np.array(wrench[3:])
            for director in range(1, 4):
                model.nodal_loads[row + director] += 0.5 * part * np.cross(wrench[:3], x[row + director])
        before, x = x, solver.solve([]).x
        if k > 10 and np.abs(x - before).max() < 1e-8:
            break
    assert np.abs(x - before).max() < 1e-7
    np.testing.assert_allclose(x[chain[[20, -1]]], shape, atol=0.001 * 0.6)


def test_a_distributed_load_is_what_gravity_is():
    heavy, _ = straight(gravity=(9.81, 0.0, 0.0))
    loaded, rod = straight()
    loaded.add_load("weight", [9.81 * loaded.mass, 0.0, 0.0], rod.spread())
    np.testing.assert_allclose(Statics(loaded).solve([]).x, Statics(heavy).solve([]).x, atol=1e-9)
    loaded.add_load("weight", [0.0, 0.0, 0.0], rod.spread())  # the same name: changed, not added
    np.testing.assert_allclose(loaded.nodal_loads, 0.0, atol=1e-15)


def test_a_load_on_an_edge_follows_its_length(box):
    nodes, tetrahedra = box((0.1, 0.02, 0.02), (2, 2, 2))
    model = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=lambda x: x[:, 0] == x[:, 0].min(), element="quadratic")
    top = model.nodes[:, 2].max()
    far = model.nodes[:, 0].max()

    def edge(x):
        return (x[:, 0] == far) & (x[:, 2] == top)

    model.add_load("edge", [0.0, 0.0, -2.0], edge)
    rows = np.flatnonzero(edge(model.nodes))
    loads = model.nodal_loads[rows, 2]
    assert len(rows) == 5 and loads.sum() == pytest.approx(-2.0)
    ends = np.isin(model.nodes[rows, 1], [model.nodes[:, 1].min(), model.nodes[:, 1].max()])
    np.testing.assert_allclose(loads[ends], -0.25)
    np.testing.assert_allclose(loads[~ends], -0.5)
    with pytest.raises(ValueError, match="do not lie on a straight line"):
        model.add_load("face", [0.0, 0.0, -1.0], lambda x: x[:, 2] == top)
    with pytest.raises(ValueError, match="acts on no node"):
        model.add_load("nowhere", [0.0, 0.0, -1.0], lambda x: x[:, 2] > 2.0 * top)


def test_a_drive_that_stretches():
    """What a command lacks is compliance times tension, and the tendon is a spring in series with the body."""
    stretch = 2e-4
    (stiff, _), (soft, rod) = with_tendons(), with_tendons(compliance=stretch)
    found = Statics(soft).solve([0.006, 0.0015])
    np.testing.assert_allclose(found.delta[:2] + stretch * found.effort[:2], [0.006, 0.0015], atol=1e-10)
    same = Statics(stiff).solve(found.delta[:2])
    np.testing.assert_allclose(same.x, found.x, atol=1e-9)
    # The tip moves with the command by W_ea (W_aa + C)^-1.
    soft.add_effector("tip", rod.points(LENGTH, (0.0, 0.0), soft.nodes))
    solver, step = Statics(soft), 1e-6
    base = solver.solve([0.006, 0.0015])
    exact = base.condensed.W.ea @ np.linalg.inv(base.condensed.W.aa + stretch * np.eye(2))
    for k in range(2):
        moved = [solver.solve(np.array([0.006, 0.0015]) + sign * step * np.eye(2)[k]).delta[2:] for sign in (1, -1)]
        np.testing.assert_allclose((moved[0] - moved[1]) / (2.0 * step), exact[:, k], rtol=1e-5, atol=1e-7)
    with pytest.raises(ValueError, match="statics only"):
        Dynamics(soft, step=0.01)


def test_points_between_frames_and_tapered_sections():
    model, rod = straight(elements=8, section=lambda s: Section.circle(1e-3 * (1.0 - 0.5 * s / LENGTH)))
    between = rod.points([0.0137, 0.1], [[0.001, 0.002], [0.0, 0.0]], model.nodes)
    np.testing.assert_allclose(between.points, [[0.001, 0.002, 0.0137], [0.0, 0.0, 0.1]], atol=1e-12)
    # d_1 along z, d_2 along x: d_3 along y.
    beyond = rod.points(LENGTH, (0.008, 0.0, 0.0), model.nodes)
    np.testing.assert_allclose(beyond.points, [[0.0, 0.0, LENGTH + 0.008]], atol=1e-12)
    radii = [section.outline[0][0] for section in rod.beam.sections]
    np.testing.assert_allclose(radii, 1e-3 * (1.0 - (np.arange(8) + 0.5) / 16), rtol=1e-12)
    skin = model.skins[0].points.points
    assert np.linalg.norm(skin[0, :2]) == pytest.approx(1e-3) and np.linalg.norm(skin[-1, :2]) == pytest.approx(5e-4)
    with pytest.raises(ValueError, match="is not on the rod"):
        rod.points(0.21, (0.0, 0.0), model.nodes)


def test_a_curved_rod_is_free_of_stress():
    turns = np.linspace(0.0, np.pi / 2.0, 21)
    path = 0.1 * np.column_stack([np.sin(turns), np.zeros(21), 1.0 - np.cos(turns)])
    builder = ModelBuilder()
    rod = add_rod(builder, path, section=SECTION, young_modulus=MODULUS, held="both")
    model = builder.build()
    assert len(rod.frames) == 21 and rod.length == pytest.approx(0.05 * np.pi, rel=1e-3)
    assert model.elastic_energy(model.nodes) == pytest.approx(0.0, abs=1e-15)
    np.testing.assert_allclose(Statics(model).solve([]).x, model.nodes, atol=1e-12)


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"held": "left"}, "held = 'left' is unknown"),
        ({"elements": [0.0, 0.1]}, "ends of elements must rise from 0 to 0.2 m"),
        ({"up": [0, 0, 1]}, "must not be along the rod"),
    ],
)
def test_what_describes_no_rod(wrong, message):
    with pytest.raises(ValueError, match=message):
        straight(**wrong)
