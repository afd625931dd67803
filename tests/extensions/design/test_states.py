"""Metrics: each formula against an independent computation; both backends and torch agree."""

import math

import numpy as np
import pytest
import torch

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.codesign.metrics.metric import METRICS
from softgym_envs.errors import ConfigError, DesignError, InfeasibleDesign
from softgym_envs.extensions.design.bodies import LearnedBodies, StateEvaluator, full_command
from softgym_envs.extensions.design.box import Box
from softgym_envs.extensions.sensing import metrics as sensors
from softgym_envs.mechanics.solvers.statics import Statics

STATES = tuple(name for name, metric in METRICS.items() if metric.source.name == "states")
PULL = 0.01


@pytest.fixture(scope="module")
def finger():
    return make_robot("finger", cables=1)


@pytest.fixture(scope="module")
def on_fem(finger):
    return StateEvaluator(finger, (*STATES, "material_volume"), actuation=[PULL], steps=2).measure({})


def test_formulas_of_the_thesis_on_fem(finger, on_fem):
    backend = FEMBackend(finger)
    rest = backend.state.effector[0]
    half = backend.step(np.array([PULL / 2]))
    state = backend.step(np.array([PULL]))
    tip, W = state.effector[0], state.condensed.W
    assert on_fem["bending_angle"] == pytest.approx(math.acos(abs(tip[2]) / np.linalg.norm(rest)))
    assert on_fem["angular_displacement"] == pytest.approx(math.acos(abs(tip[2]) / np.linalg.norm(tip)))
    # Thesis, eq. 4.16 as printed, with delta_c measured from rest.
    free = state.condensed.delta_free
    B = W.ea @ np.linalg.inv(W.aa) @ W.ae - W.ee
    force = np.linalg.inv(B) @ (W.ea @ np.linalg.inv(W.aa) @ (np.array([PULL]) - free.a) + free.e - rest)
    assert on_fem["contact_force"] == pytest.approx(abs(force[1]), rel=1e-4)  # it moves along y
    assert on_fem["normal_force"] == pytest.approx(abs((tip - rest)[1] / B[1, 1]), rel=1e-4)
    assert on_fem["tip_stiffness"] == pytest.approx(1.0 / np.linalg.eigvalsh(-B)[-1])
    assert on_fem["effort"] == pytest.approx(state.effort[0])
    assert on_fem["work"] == pytest.approx(0.5 * PULL * (half.effort[0] + 0.5 * state.effort[0]))
    assert on_fem["material_volume"] == pytest.approx(finger.build().volume)


def test_normal_force_is_that_of_a_tip_blocked_sideways(finger, on_fem):
    """The force from the tangent against the equilibrium in which a force holds the tip in place."""
    backend = FEMBackend(finger)
    rest, force = backend.state.effector[0, 1], np.zeros(3)
    for _ in range(20):
        state = backend.step(np.array([PULL]), force=force)
        W = state.condensed.W
        held = (W.ee - W.ea @ np.linalg.solve(W.aa, W.ae))[1, 1]
        force = force - np.array([0.0, (state.effector[0, 1] - rest) / held, 0.0])
    assert abs(state.effector[0, 1] - rest) < 1e-9
    assert on_fem["normal_force"] == pytest.approx(-force[1], rel=0.15)


def test_surrogate_and_torch_agree_with_fem(finger, on_fem):
    surrogate = StateEvaluator(finger, STATES, backend="surrogate", actuation=[PULL], steps=2).measure({})
    learned = LearnedBodies(finger, STATES, actuation=[PULL], steps=2)
    values = learned(torch.tensor(finger.design_space.baseline.array[None]))[0]
    for name, value in zip(STATES, values.tolist(), strict=True):
        assert surrogate[name] == pytest.approx(on_fem[name], rel=0.02), name
        assert value == pytest.approx(surrogate[name], rel=1e-4), name


@pytest.mark.parametrize("name", STATES)
def test_gradients_are_derivatives(finger, name):
    learned = LearnedBodies(finger, [name], actuation=[PULL], steps=2)
    box = Box(finger.design_space)
    point = torch.tensor([[0.3, -0.4, 0.2, 0.1, -0.3]], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(learned(box.values(point)).sum(), point)
    with torch.no_grad():
        for k in range(5):
            h = torch.zeros(1, 5, dtype=torch.float64)
            h[0, k] = 1e-5
            difference = (learned(box.values(point + h)) - learned(box.values(point - h)))[0, 0] / 2e-5
            assert float(gradient[0, k]) == pytest.approx(
                float(difference), rel=1e-5, abs=1e-7 * float(gradient.norm())
            )


def test_sensorized_finger_reads_what_the_robot_reads():
    robot = make_robot("sensorized_finger")
    names = ("volume_change", "relative_volume_change", "cavity_volume", "angular_displacement")
    found, readings = StateEvaluator(robot, names, actuation=[PULL]).measure({}), robot.readings()
    assert found["volume_change"] == pytest.approx(readings.volume_change)
    assert found["relative_volume_change"] == pytest.approx(readings.relative_volume_change)
    assert found["cavity_volume"] == pytest.approx(readings.initial_volume)
    assert found["angular_displacement"] == pytest.approx(readings.bending_angle)


def test_a_cavity_whose_walls_pass_through_each_other_is_infeasible():
    """They do not touch each other; its relative change would be the best of all."""
    robot = make_robot("sensorized_finger")
    lengths = {"outer_radius": 0.009046666, "joint_height": 0.006523373, "bellow_height": 0.008001691}
    lengths |= {"wall_thickness": 0.003899209, "cork_thickness": 0.004741054, "plateau_height": 0.003413125}
    design = {"slope": 0.5589782, **lengths}
    for name in ("relative_volume_change", "volume_change", "angular_displacement"):
        with pytest.raises(InfeasibleDesign, match="walls of 'cavity_\\d' pass through each other"):
            StateEvaluator(robot, [name], actuation=[PULL]).measure(design)
    with pytest.raises(InfeasibleDesign, match="walls of 'cavity_\\d' pass through each other"):
        robot.readings(design)


def test_four_cavities_have_a_pressure_sensitivity():
    robot = make_robot("sensorized_finger", cavities=4)
    found = StateEvaluator(robot, ["pressure_sensitivity"], actuation=[PULL]).measure({})
    assert found["pressure_sensitivity"] == robot.readings().pressure_sensitivity > 0.0


def test_information_is_what_a_reading_takes_from_the_uncertainty():
    """Slopes against differences of equilibria, and the metric against determinants of covariances."""
    robot = make_robot("sensorized_finger")
    evaluator = StateEvaluator(robot, ["information"], actuation=[PULL])
    slopes = sensors.TOUCHES.read(evaluator.body({}))
    assert slopes.shape == (10, 2, 2)
    model = robot.build()
    model.add_contact("touch", [3.75e-3, 0.0, -0.085], radius=2.5e-3)
    statics = Statics(model)

    def volumes(pull, force):
        return statics.solve([pull], contact=[0.0, force, 0.0]).condensed.delta.s

    by_pull = (volumes(PULL + 1e-6, 0.0) - volumes(PULL - 1e-6, 0.0)) / 2e-6
    by_force = (volumes(PULL, 1e-3) - volumes(PULL, -1e-3)) / 2e-3
    np.testing.assert_allclose(slopes[7], np.column_stack([by_pull, by_force]), rtol=1e-3)
    gained = []
    for slope in slopes:
        before = np.diag([sensors.CABLE_ERROR, sensors.TOUCH_FORCE]) ** 2
        after = np.linalg.inv(np.linalg.inv(before) + slope.T @ slope / sensors.VOLUME_NOISE**2)
        gained.append(0.5 * np.log(np.linalg.det(before) / np.linalg.det(after)))
    assert evaluator.measure({})["information"] == pytest.approx(np.mean(gained))
    assert gained[0] < gained[8]  # near the flange a touch hardly changes a volume


def test_unavailable_metrics_and_wrong_actuations(finger):
    for names, options, words in (
        (["beauty"], {}, "unknown metric 'beauty'; allowed: .*bending_angle"),
        (["volume_change"], {}, "needs a robot with sensing cavities, got 'finger'"),
        (["information"], {}, "needs robot 'sensorized_finger', got 'finger'"),
        (["information"], {"backend": "surrogate"}, "needs backend 'fem', got 'surrogate'"),
        (["mean_distance"], {}, "needs episodes of a controller"),
        (["travel"], {"actuation": [0.03]}, "allowed: cable_1 0 to 0.02 m"),
        (["travel"], {"actuation": [0.01, 0.01]}, "allowed: cable_1 0 to 0.02 m"),
    ):
        with pytest.raises(ConfigError, match=words):
            StateEvaluator(finger, names, **options)


def test_two_cavities_have_no_pressure_sensitivity():
    with pytest.raises(ConfigError, match="robot_options cavities: 4"):
        StateEvaluator(make_robot("sensorized_finger"), ["pressure_sensitivity"])


@pytest.mark.parametrize("name", ["finger", "diamond", "tetrapod"])
def test_the_default_actuation_is_not_rest(name):
    robot = make_robot(name)
    command = full_command(robot, None)
    assert (command > 0.0).all() and command == pytest.approx(0.5 * robot.upper)


def test_box(finger):
    space = finger.design_space
    box = Box(space, ["height", "young_modulus"], {"height": (0.0205, 0.0215)}, {"length": 0.041})
    assert box.reference["length"] == 0.041 and len(box.corners()) == 4 and len(box.grid(30)) == 36
    for point in (np.array([-1.0, 1.0]), np.array([0.25, -0.5])):
        design = box.design(point)
        assert design["length"] == 0.041
        row = box.values(torch.as_tensor(point[None]))[0].numpy()
        assert row == pytest.approx(np.array([design[name] for name in space.names]))
        assert box.unit(design) == pytest.approx(point)
    assert box.design(np.array([-1.0, 0.0]))["height"] == 0.0205
    with pytest.raises(DesignError, match="out of bounds"):
        Box(space, ["height"], {"height": (0.0, 0.021)})
    with pytest.raises(ConfigError, match="is not a free design variable; free: height"):
        Box(space, ["height"], {"length": (0.039, 0.04)})
    with pytest.raises(ConfigError, match="twice"):
        Box(space, ["height", "height"])
