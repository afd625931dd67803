"""Stiff-Flop: its published rest compliance, W against finite differences, symmetry, tracking, slack, designs."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.surrogate import SurrogateBackend
from softgym_envs.control import InverseQP
from softgym_envs.errors import DesignError, WeightsError
from softgym_envs.extensions.beams.fem_batch import FEMBatch
from softgym_envs.extensions.beams.robots.stiff_flop import StiffFlop
from softgym_envs.mechanics.solvers.statics import Statics

PUBLISHED_COMPLIANCE = {
    "W_aa base, same pair": 0.3057,
    "W_aa base, two pairs": 0.0640,
    "W_aa tip, same pair": 0.5293,
    "W_aa tip, two pairs": 0.1028,
    "W_xa base": 0.0429,
    "W_xa tip": 0.0734,
    "W_ya base": 1.0065,
    "W_ya tip": 0.7085,
    "W_za base": 1.162,
    "W_za tip": 0.818,
    "W_xx": 0.0393,
    "W_yy": 11.59,
}
"""Rest compliance of the Stiff-Flop in the authors' public data (the thesis has none), in mm3, mm, kPa and mN."""

UL = 1e-9  # a microlitre, mm3 [m3]
ACTUATED = UL * np.array([18.0, 4.0, 9.0, 6.0, 15.0, 2.0])
# Steps that move both kinds of rows by similar amounts: pressures [Pa], forces [N].
STEPS = np.array([30.0] * 6 + [3e-6] * 3)

# The entries of the first pair of chambers along z; the other two pairs have half of it, with the opposite sign.
PUBLISHED = {name: value for name, value in PUBLISHED_COMPLIANCE.items() if not name.startswith("W_za")}
for module in ("base", "tip"):
    first = -PUBLISHED_COMPLIANCE[f"W_za {module}"]
    PUBLISHED |= {f"W_za {module}, first pair": first, f"W_za {module}, other pairs": -0.5 * first}


@pytest.fixture(scope="module")
def rest():
    return Statics(StiffFlop().build()).solve(np.zeros(6), "effort")


@pytest.mark.parametrize("batched", [False, True])
def test_chambers_that_are_stretched_beyond_their_command_are_slack(batched):
    """Also by less than 1e-9 m3, which is much for a chamber of 3e-8 m3."""
    robot, rng = make_robot("trunk"), np.random.default_rng(0)
    backend = FEMBatch(robot, robot.design_space.baseline.array[None]) if batched else FEMBackend(robot)
    beyond, slack = [], []
    for _ in range(30):
        command = rng.uniform(robot.lower, robot.upper) * (rng.random(6) < 0.5)
        backend.step(command[None] if batched else command)
        state = backend.state.rows(np.zeros(1, dtype=int)) if batched else backend.state
        beyond.append((state.displacement - command).ravel())
        slack.append(state.slack.ravel())
    beyond, slack = np.array(beyond), np.array(slack)
    assert ((beyond > 1e-13) & (beyond < UL)).any()
    np.testing.assert_array_equal(slack, beyond > 1e-13)
    assert np.abs(beyond[~slack]).max() < 1e-15


def test_rest_compliance_is_the_published_one(rest):
    W = rest.condensed.W
    aa, ea, ee = 1e12 * W.aa, 1e6 * W.ea, W.ee
    pairs = ~np.eye(3, dtype=bool)
    found = {
        "W_aa base, same pair": np.diag(aa)[:3],
        "W_aa base, two pairs": aa[:3, :3][pairs],
        "W_aa tip, same pair": np.diag(aa)[3:],
        "W_aa tip, two pairs": aa[3:, 3:][pairs],
        "W_xa base": ea[0, :3],
        "W_xa tip": ea[0, 3:],
        "W_ya base": np.array([-ea[1, 1], ea[1, 2]]),
        "W_ya tip": np.array([-ea[1, 4], ea[1, 5]]),
        "W_za base, first pair": ea[2, :1],
        "W_za base, other pairs": ea[2, 1:3],
        "W_za tip, first pair": ea[2, 3:4],
        "W_za tip, other pairs": ea[2, 4:],
        "W_xx": ee[:1, 0],
        "W_yy": np.diag(ee)[1:],
    }
    assert set(found) == set(PUBLISHED)
    for name, values in found.items():
        np.testing.assert_allclose(values, PUBLISHED[name], rtol=0.15, err_msg=name)
    # Small compared with the others as published; exactly zero for beams in series.
    assert np.abs(aa[:3, 3:]).max() < 3e-3
    np.testing.assert_allclose(ea[1, [0, 3]], 0.0, atol=1e-9)
    np.testing.assert_allclose(ee[~np.eye(3, dtype=bool)], 0.0, atol=1e-9)


def test_at_rest_nothing_is_strained(rest):
    np.testing.assert_allclose(rest.delta[:6], 0.0, atol=1e-20)
    np.testing.assert_allclose(rest.delta[6:9], [0.11, 0.0, 0.0], atol=1e-15)
    assert rest.stable
    assert not rest.slack.any()


@pytest.mark.parametrize("mode", ["effort", "displacement"])
@pytest.mark.parametrize("volumes", [np.zeros(6), ACTUATED], ids=["rest", "actuated"])
def test_W_is_the_derivative_of_the_equilibrium(volumes, mode):
    """Pressures and tip forces one by one; driven by volume, tip forces at held volumes (W without the actuators)."""
    statics = Statics(StiffFlop(unilateral=False).build(), tolerance=1e-13)
    here = statics.solve(volumes)
    W, command = here.condensed.compliance, here.delta[:6] if mode == "displacement" else here.effort[:6]
    columns = []
    for i in range(9):
        ends = []
        for sign in (1, -1):
            if mode == "effort":
                target = np.append(command, np.zeros(3)) + sign * STEPS * np.eye(9)[i]
                end = statics.solve(target[:6], "effort", effector_force=target[6:])
            else:
                steps = np.append(np.full(6, 0.01 * UL), STEPS[6:]) * np.eye(9)[i]
                end = statics.solve(command + sign * steps[:6], effector_force=sign * steps[6:])
            ends.append(np.append(end.effort[:6] if mode == "displacement" else end.delta[:6], end.delta[6:9]))
        columns.append((ends[0] - ends[1]) / (2.0 * (STEPS[i] if mode == "effort" else np.abs(steps).max())))
    if mode == "displacement":
        stiffness = np.linalg.inv(here.condensed.W.aa)
        across = here.condensed.W.ea @ stiffness
        W = np.block([[stiffness, -across.T], [across, here.condensed.W.ee - across @ here.condensed.W.ea.T]])
    difference = np.array(columns).T
    for rows, others in itertools.product((slice(0, 6), slice(6, 9)), repeat=2):
        error = np.abs(W[rows, others] - difference[rows, others]).max() / np.abs(W[rows, others]).max()
        assert error < 1e-5, (rows, others, error)


def test_the_tip_converges_with_the_elements():
    tips = {}
    for elements in (1, 2, 4, 8, 16):
        tips[elements] = Statics(StiffFlop(elements=elements).build()).solve(ACTUATED).delta[6:9]
    errors = [np.linalg.norm(tips[k] - tips[16]) for k in (1, 2, 4, 8)]
    # Measured: 1.8, 0.11, 0.0066 and 0.0004 mm: fourth order, and 0.0027 mm with the default.
    assert (np.array(errors[1:]) < np.array(errors[:-1]) / 10.0).all()
    default = Statics(StiffFlop().build()).solve(ACTUATED).delta[6:9]
    assert np.linalg.norm(default - tips[16]) < 5e-6


def test_a_third_of_a_turn_is_a_symmetry():
    """Pairs moved on by one turn the tip and all of W about the axis by 120 degrees."""
    statics = Statics(StiffFlop().build(), tolerance=1e-12)
    first = statics.solve(ACTUATED)
    second = statics.solve(ACTUATED.reshape(2, 3)[:, [2, 0, 1]].ravel())
    # Pairs are numbered from +z towards +y.
    c, s = np.cos(2.0 * np.pi / 3.0), np.sin(2.0 * np.pi / 3.0)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
    order = np.array([2, 0, 1, 5, 3, 4])
    np.testing.assert_allclose(second.delta[6:9], turn @ first.delta[6:9], atol=1e-12)
    np.testing.assert_allclose(second.effort[:6], first.effort[order], rtol=1e-8)
    for name, expected in (
        ("aa", first.condensed.W.aa[np.ix_(order, order)]),
        ("ea", turn @ first.condensed.W.ea[:, order]),
        ("ee", turn @ first.condensed.W.ee @ turn.T),
    ):
        found = getattr(second.condensed.W, name)
        np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_equal_volumes_stretch_it_straight():
    state = Statics(StiffFlop().build()).solve(np.full(6, 20.0 * UL))
    np.testing.assert_allclose(state.delta[7:9], 0.0, atol=1e-12)
    area = 2.0 * np.pi * StiffFlop().design_space.baseline["chamber_radius"] ** 2
    # Each module grows by volume over area; the chambers pull on nothing else.
    assert state.delta[6] == pytest.approx(0.11 + 2.0 * 20.0 * UL / area, rel=1e-6)
    np.testing.assert_allclose(state.effort[:3], state.effort[0], rtol=1e-9)
    assert state.effort[0] / state.effort[3] == pytest.approx(125.0 / 70.0, rel=1e-6)


# -- slack chambers -------------------------------------------------------------------------------------------------


def test_a_chamber_that_others_stretch_is_slack():
    statics = Statics(StiffFlop().build())
    volumes = np.array([30.0, 0.0, 0.0, 0.0, 0.0, 0.0]) * UL
    state = statics.solve(volumes)
    assert state.slack.tolist() == [False, True, True, False, False, False]
    assert (state.effort[1:3] == 0.0).all()
    assert (state.delta[1:3] > UL).all()
    assert state.delta[0] == pytest.approx(volumes[0], abs=1e-15)
    # The same pressures from outside lead to the same state.
    same = statics.solve(state.effort[:6], "effort")
    np.testing.assert_allclose(same.delta, state.delta, atol=1e-10)
    # Chambers that keep their volume are under suction: they keep the inside of the bend short, so it bends more.
    held = Statics(StiffFlop(unilateral=False).build()).solve(volumes)
    assert (held.effort[1:3] < -1e3).all()
    assert not held.slack.any()
    assert held.delta[6] < state.delta[6] - 0.02


def test_pressures_cannot_be_negative():
    with pytest.raises(ValueError, match="actuator row 2 must not be negative"):
        Statics(StiffFlop().build()).solve([0.0, 0.0, -1.0, 0.0, 0.0, 0.0], "effort")


# -- tracking -------------------------------------------------------------------------------------------------------


def test_follows_the_published_circle():
    """The circle of radius 40 mm in 60 goals after 20 to reach it, one step of the QP for each."""
    robot = StiffFlop()
    backend = FEMBackend(robot)
    controller = InverseQP.for_robot(robot)
    circle = robot.reference_path(60)
    np.testing.assert_allclose(np.hypot(circle[:, 1], circle[:, 2]), 0.040)
    approach = np.linspace(robot.effector_rest, circle[0], 21)[1:]
    command, errors = np.zeros(6), []
    for goal in np.vstack([approach, circle]):
        state = backend.state
        command = controller.solve(state.condensed, goal, command, state.slack)
        errors.append(np.linalg.norm(backend.step(command).effector[0] - goal))
        assert (command <= robot.upper).all()
    # Measured: 0.58 mm on the way there, 0.11 mm on the circle.
    assert max(errors) < 1e-3
    assert max(errors[20:]) < 0.2e-3


@pytest.mark.parametrize(("volume", "misses"), [(30.0, (3.881, 0.0, 0.0)), (40.0, (0.0, 0.0, 0.0))])
def test_targets_of_the_thesis(volume, misses):
    """Figure 4.11 [mm]: one pair of the first target grows to 35 mm3, more than the default allows."""
    robot = StiffFlop(largest_volume=volume * UL)
    controller = InverseQP.for_robot(robot)
    for goal, miss in zip(1e-3 * np.array([[57, -5, -70], [106, 26, 32.5], [92.5, -58.5, 9]]), misses, strict=True):
        backend, command = FEMBackend(robot), np.zeros(6)
        for _ in range(30):
            state = backend.state
            command = controller.solve(state.condensed, goal, command, state.slack)
            backend.step(command)
        assert 1e3 * np.linalg.norm(backend.state.effector[0] - goal) == pytest.approx(miss, abs=0.01)


def test_the_shipped_surrogate_stands_for_the_published_range_only():
    wide = StiffFlop(largest_volume=40.0 * UL)
    assert wide.mechanics_key == StiffFlop().mechanics_key
    with pytest.raises(WeightsError, match="'trunk' have actuators"):
        SurrogateBackend(wide)


# -- designs and options --------------------------------------------------------------------------------------------


def test_corners_of_the_design_space_build_and_solve():
    robot = StiffFlop(elements=2)
    names = robot.design_space.names
    # All corners of the shape; moduli and Poisson's ratio alternate.
    for k, signs in enumerate(itertools.product((-1.0, 1.0), repeat=4)):
        unit = np.array([*signs, *((-1.0) ** (k // 2**i) for i in range(3))])
        design = robot.design_space.from_unit(unit)
        statics = Statics(robot.build(design))
        # Half of the range: in the shortest module thin chambers grow to half as long again.
        state = statics.solve(0.5 * robot.upper * np.array([1.0, 0.3, 0.0, 0.0, 0.6, 1.0]))
        assert state.stable, design
        assert np.linalg.eigvalsh(state.condensed.compliance * np.outer(STEPS, STEPS))[0] > 0.0
        assert state.delta[0] == pytest.approx(15.0 * UL, rel=1e-6)
        rest = statics.solve(np.zeros(6), "effort")
        np.testing.assert_allclose(rest.delta[6:9], [2.0 * design["module_length"], 0.0, 0.0], atol=1e-9)
    assert names[:4] == ("module_length", "outer_radius", "chamber_offset", "chamber_radius")


@pytest.mark.parametrize(
    ("variable", "entry", "power"),
    [("base_modulus", (0, 0), -1.0), ("tip_modulus", (3, 3), -1.0), ("chamber_radius", (6, 0), 2.0)],
)
def test_compliance_scales_as_it_should(rest, variable, entry, power):
    baseline = StiffFlop().design_space.baseline[variable]
    W = Statics(StiffFlop().build({variable: 1.1 * baseline})).solve(np.zeros(6), "effort").condensed.compliance
    assert W[entry] / rest.condensed.compliance[entry] == pytest.approx(1.1**power, rel=1e-9)


def test_gravity_bends_it():
    robot = StiffFlop(gravity=(0.0, 0.0, -9.81))
    model = robot.build()
    state = Statics(model).solve(np.zeros(6), "effort")
    assert model.loads[:, 2].sum() == pytest.approx(-9.81 * model.mass)
    assert state.delta[8] < -1e-4
    assert state.delta[7] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("volume", [0.0, 30.0, np.nan])
def test_wrong_volume(volume):
    with pytest.raises(ValueError, match="largest_volume = .* m3 is out of bounds"):
        make_robot("trunk", largest_volume=volume)


@pytest.mark.parametrize("elements", [0, -1, 2.5, "5"])
def test_wrong_elements(elements):
    with pytest.raises(ValueError, match=r"elements = .* (is out of bounds|must be an integer)"):
        make_robot("trunk", elements=elements)


def test_wrong_options_and_designs():
    with pytest.raises(ValueError, match=r"robot 'trunk'.*segments"):
        make_robot("trunk", segments=2)
    with pytest.raises(ValueError, match="gravity must be three finite numbers"):
        make_robot("trunk", gravity=(0.0, np.nan, 0.0))
    with pytest.raises(DesignError, match=r"'module_length' = 0.1 m is out of bounds"):
        StiffFlop().build({"module_length": 0.1})
    with pytest.raises(DesignError, match="unknown design variable 'tip_modulas'"):
        StiffFlop().build({"tip_modulas": 1e5})
