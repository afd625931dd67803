"""The Robot base class: what a user's robot must define, its options, and its error messages."""

from __future__ import annotations

import copy
import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.control import InverseQP
from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.errors import InfeasibleDesign
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots import ROBOTS, Actuator, Robot
from softgym_envs.robots.base import DEFAULTS_NOT_IN_KEY

CORNERS = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 1.0]])


class Spike(Robot):
    """One tetrahedron that a cable bends."""

    name = "spike"
    effectors = ("tip",)
    size = 0.05
    effector_rest = [0.0, 0.0, 0.05]
    effort_scale = [1.0]
    design_space = DesignSpace(DesignVariable("length", 0.03, 0.07, 0.05, "m", "height of the spike"))
    actuators = (Actuator("cable", 0.0, 0.005, 0.001),)

    def assemble(self, design):
        if design["length"] > 0.06:
            raise InfeasibleDesign("the spike breaks")
        nodes = CORNERS * [1.0, 1.0, design["length"]]
        fixed = np.array([True, True, True, False])
        model = MechanicalModel.from_mesh(
            nodes, np.array([[0, 1, 2, 3]]), fixed=fixed, young_modulus=1e5, element="linear"
        )
        model.add_cable("cable", nodes[3:], pull_point=np.array([0.02, 0.0, 0.0]))
        model.add_effector("tip", nodes[3])
        return model


class Optioned(Spike):
    """A robot whose options come through two constructors."""

    name = "optioned"
    non_mechanical_options = (*Robot.non_mechanical_options, "colour")

    def __init__(self, layers=None, *, colour="red", file=Path("a/b.msh"), **options):
        super().__init__(**options)
        self.layers = 3 if layers is None else layers


def test_class_attributes_and_one_method_are_enough():
    robot = Spike()
    assert robot.workspace_scale == 0.25 * 0.05
    assert robot.learning.weights == "spike"
    assert robot.mechanics_key == {"gravity": [0.0, 0.0, 0.0]}
    assert robot.effector_rest.shape == (3,)
    assert robot.effort_scale.dtype == float
    np.testing.assert_array_equal(robot.unilateral, [True])
    assert robot.build().equations == 3


# -- options --------------------------------------------------------------------------------------------------------


def test_the_key_holds_every_option_with_its_default():
    robot = Optioned(gravity=(0, 0, -9.81))
    assert robot.mechanics_key == {"layers": 3, "file": "a/b.msh", "gravity": [0, 0, -9.81]}
    assert json.loads(json.dumps(robot.mechanics_key)) == robot.mechanics_key


def test_equal_options_have_equal_keys_however_they_are_given():
    base = Optioned().mechanics_key
    assert Optioned(3).mechanics_key == base
    assert Optioned(layers=3, gravity=np.zeros(3)).mechanics_key == base
    assert Optioned(layers=np.int64(3), colour="blue").mechanics_key == base
    for other in (Optioned(4), Optioned(file="c.msh"), Optioned(gravity=(0.0, 0.0, 1.0))):
        assert other.mechanics_key != base


def test_an_option_that_a_key_cannot_store_is_named():
    robot = Optioned(layers=object())
    with pytest.raises(TypeError, match=r"option 'layers' of robot 'optioned' = .*'non_mechanical_options'"):
        robot.mechanics_key  # noqa: B018


def test_options_that_are_robots_or_functions():
    key = Optioned(layers=Spike(), file=np.linspace).mechanics_key
    assert key["layers"] == {"robot": "spike", "gravity": [0.0, 0.0, 0.0]}
    assert key["file"] == "numpy:linspace"


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda robot: pickle.loads(pickle.dumps(robot))])
def test_copies_keep_their_options(copied):
    robot = copied(Optioned(5))
    assert robot.mechanics_key == Optioned(5).mechanics_key


def test_registry_checks_options_of_base_constructors():
    with pytest.raises(ValueError, match=r"'optioned': unknown option 'colur'; did you mean 'colour'\? .*gravity"):
        make_robot(Optioned, colur="red")
    with pytest.raises(ValueError, match="option gravity = 'down' must be 3 numbers"):
        make_robot(Optioned, gravity="down")


@pytest.mark.parametrize("name", ROBOTS)
def test_every_option_of_the_suite_is_in_the_key_or_left_out_on_purpose(name):
    robot = make_robot(name)
    known = set(robot.mechanics_key) | set(robot.non_mechanical_options) | set(DEFAULTS_NOT_IN_KEY)
    assert known >= set(robot._options)
    assert json.loads(json.dumps(robot.mechanics_key)) == robot.mechanics_key


# -- missing and malformed attributes -------------------------------------------------------------------------------


MISSING = r"'Bar' does not define: effectors, size, design_space, .*effort_scale \(see Robot\)"


def test_missing_attributes_are_named_when_the_class_is_made():
    with pytest.raises(TypeError, match=MISSING):

        class Bar(Robot):
            name = "bar"

            def assemble(self, design):
                raise NotImplementedError


def test_missing_attributes_are_named_after_a_constructor_that_may_set_them():
    class Bar(Robot):
        name = "bar"

        def __init__(self):
            super().__init__()

        def assemble(self, design):
            raise NotImplementedError

    with pytest.raises(TypeError, match=MISSING):
        Bar()


def test_an_abstract_robot_may_leave_attributes_to_its_subclasses():
    class Family(Robot):
        name = "family"

    assert not hasattr(Family, "effectors")


def test_attributes_may_be_set_after_the_base_constructor():
    class Late(Spike):
        name = "late"

        def __init__(self):
            super().__init__()
            self.actuators = (Actuator("a", 0.0, 0.1, 0.01), Actuator("b", 0.0, 0.1, 0.01, unilateral=False))
            self.effort_scale = np.ones(2)

    np.testing.assert_array_equal(Late().unilateral, [True, False])


@pytest.mark.parametrize(
    ("attributes", "error", "message"),
    [
        ({"effectors": "tip"}, TypeError, "effectors must be a tuple of names, got 'tip'"),
        ({"effort_scale": [1.0, 2.0]}, ValueError, r"effort_scale must have shape \(1,\), got \(2,\)"),
        ({"effector_rest": [0.0, 1.0]}, ValueError, r"effector_rest must have shape \(3,\), got \(2,\)"),
        (
            {"effector_rest": [0.0, 0.0, 50.0]},
            ValueError,
            r"effector_rest = 50 m is implausible.* did you mean 0.05 m \(50 mm\)\?",
        ),
        ({"size": 50.0}, ValueError, r"robot 'odd': size = 50 m is implausible, .* did you mean 0.05 m \(50 mm\)\?"),
        ({"size": -0.1}, ValueError, "robot 'odd': size must be positive and finite, got -0.1"),
        ({"effort_scale": [0.0]}, ValueError, r"effort_scale must be positive and finite, got \[0.0\]"),
        ({"goal_tolerance": np.nan}, ValueError, "goal_tolerance must be positive and finite, got nan"),
        ({"effector_rest": [0.0, np.nan, 0.0]}, ValueError, r"effector_rest must be finite, got \[0.0, nan, 0.0\]"),
        (
            {"actuators": (Actuator("cable", 0.0, 5.0, 1.0),)},
            ValueError,
            r"stroke of actuator 'cable' = 5 m is implausible, allowed: 0 to 0.1 m .*; did you mean 0.005 m \(5 mm\)\?",
        ),
        (
            {"design_space": DesignSpace(DesignVariable("length", 3.0, 7.0, 5.0, "m", "in centimetres"))},
            ValueError,
            r"design variable 'length' = 7 m is implausible, allowed: 0 to 0.5 m",
        ),
    ],
    ids=[
        *("effectors", "effort_scale", "effector_rest", "rest in millimetres", "size", "negative size", "no effort"),
        *("no tolerance", "no rest", "stroke", "variable"),
    ],
)
def test_malformed_attributes(attributes, error, message):
    with pytest.raises(error, match=message):
        type("Odd", (Spike,), {"name": "odd", **attributes})()


class Pair(Spike):
    """A robot with two cables, to be added in their order."""

    name = "pair"
    effort_scale = [1.0, 1.0]
    actuators = (Actuator("cable", 0.0, 0.005, 0.001), Actuator("other", 0.0, 0.005, 0.001))


class Swapped(Pair):
    """The same cables, added in another order."""

    def assemble(self, design):
        model = super().assemble(design)
        model.add_cable("other", model.nodes[3:], pull_point=np.array([0.0, 0.02, 0.0]))
        model.constraints["a"].reverse()
        return model


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        (Pair, "robot 'pair': assemble must add the actuators cable, other in this order, got cable"),
        (Swapped, "robot 'pair': assemble must add the actuators cable, other in this order, got other, cable"),
        (
            type("Other", (Spike,), {"name": "other", "effectors": ("top",)}),
            "robot 'other': assemble must add the effectors top in this order, got tip",
        ),
        (
            type("Nothing", (Spike,), {"name": "nothing", "assemble": lambda self, design: None}),
            "robot 'nothing': assemble must return a MechanicalModel, got None",
        ),
    ],
    ids=["missing cable", "order of cables", "effector", "no model"],
)
def test_a_model_has_the_rows_that_its_robot_declares(robot, message):
    with pytest.raises(ValueError, match=f"^{message}\nwhile assembling"):
        robot().build()


# -- infeasible designs and bugs ------------------------------------------------------------------------------------


def test_a_bug_in_a_robot_surfaces_as_itself():
    class Buggy(Spike):
        name = "buggy"

        def assemble(self, design):
            return np.zeros((2, 3)) @ np.zeros((2, 3))

    with pytest.raises(ValueError, match="matmul") as caught:
        Buggy().build()
    assert not isinstance(caught.value, InfeasibleDesign)
    assert caught.traceback[-1].name == "assemble"
    assert caught.value.__notes__ == ["while assembling robot 'buggy' for Design(length=0.05)"]


def test_infeasible_designs_raised_by_a_robot_are_passed_on():
    assert Spike().build({"length": 0.04}).nodes[3, 2] == pytest.approx(0.04)
    with pytest.raises(InfeasibleDesign, match="the spike breaks"):
        Spike().build({"length": 0.065})


# -- points and controllers -----------------------------------------------------------------------------------------


def test_points_in_millimetres_are_rejected():
    robot = make_robot("finger")
    np.testing.assert_array_equal(robot.check_point("goal", [0.0, 0.05, -0.09]), [0.0, 0.05, -0.09])
    assert robot.check_point("goal", robot.reference_path()).shape == (25, 3)
    with pytest.raises(ValueError, match=r"goal = \[0.0, 66.0, -72.0\] m is 97.* m away from .*did you mean metres\?"):
        robot.check_point("goal", [0, 66, -72])
    with pytest.raises(ValueError, match=r"path = \[0.0, 50.0, -0.1\] m"):
        robot.check_point("path", [[0.0, 0.05, -0.1], [0.0, 50.0, -0.1]])


@pytest.mark.parametrize("name", ROBOTS)
def test_reference_paths_are_near_their_robots(name):
    robot = make_robot(name)
    try:
        path = robot.reference_path()
    except ValueError:
        pytest.skip("has no reference path")
    robot.check_point("path", path)


@pytest.mark.parametrize("name", ["finger", "press_finger", "contact_finger"])
def test_controllers_of_robots(name):
    robot = make_robot(name)
    controller = InverseQP.for_robot(robot, effort_weight=1e-3)
    for attribute in ("lower", "upper", "rates", "unilateral"):
        np.testing.assert_array_equal(getattr(controller, attribute), getattr(robot, attribute))
    assert controller.effort_weight == 1e-3
    assert (controller.goal_weights is None) == bool(np.all(robot.goal_axes))
    if controller.goal_weights is not None:
        np.testing.assert_array_equal(controller.goal_weights, robot.goal_axes)
    faster = InverseQP.for_robot(robot, rates=2.0 * robot.rates)
    np.testing.assert_array_equal(faster.rates, 2.0 * robot.rates)


# -- what a built body says of its robot -----------------------------------------------------------------------------


def heavy(self, design):
    """Assemble a spike whose weight no option gives."""
    model = Spike.assemble(self, design)
    model.set_gravity((0.0, 0.0, -9.81))
    return model


def in_other_unit(self, design):
    """Assemble a spike whose actuator measures another quantity than the class declares."""
    model = Spike.assemble(self, design)
    model.constraints["a"][0].unit = ("rad", "N m")
    return model


@pytest.mark.parametrize(
    ("attributes", "options", "message"),
    [
        (
            {},
            {"gravity": (0.0, 0.0, -9.81)},
            r"option gravity = \(0.0, 0.0, -9.81\) m/s2 has no effect: assemble builds",
        ),
        ({"assemble": heavy}, {}, r"option gravity = .*\(0.0, 0.0, -9.81\); pass gravity=self.gravity"),
        ({"assemble": in_other_unit}, {}, "actuator 'cable' is declared in m, but assemble adds one in rad"),
        (
            {"effector_rest": [0.0, 0.0, 0.0]},
            {},
            "effector 'tip' of the baseline body .* 0.05 m away from effector_rest",
        ),
    ],
    ids=["ignored gravity", "own gravity", "unit of an actuator", "effector"],
)
def test_a_body_must_be_what_its_robot_says(attributes, options, message):
    robot = type("Said", (Spike,), {"name": "said", **attributes})(**options)
    with pytest.raises(ValueError, match=message):
        robot.build()


def test_design_variables_that_assemble_never_reads_are_named_once():
    misspelt = DesignSpace(*Spike.design_space, DesignVariable("widht", 0.01, 0.02, 0.01, "m", "never read"))
    robot = type("Unread", (Spike,), {"name": "unread", "design_space": misspelt})()
    with pytest.warns(UserWarning, match="robot 'unread': assemble never reads the design variable widht: it changes"):
        robot.build()
    robot.build({"widht": 0.02})  # told once
    make_robot(Spike).build()  # nothing to tell


def _as_keywords(design):
    return (lambda **values: values)(**design)


@pytest.mark.parametrize(
    "copy",
    [dict, _as_keywords, lambda design: {**design}, lambda design: dict(design.items())]
    + [lambda design: dict(zip(design, design.values(), strict=True))]
    + [lambda design: design.space.complete(design.space.from_unit(design.space.to_unit(dict(design))))]
    + [lambda design: dict(zip(design.space.names, design.array, strict=True))],
)
@pytest.mark.parametrize("unused", [None, "widht"])
def test_variables_that_are_passed_on_together_are_watched(copy, unused):
    space = DesignSpace(*Spike.design_space, DesignVariable("widht", 0.01, 0.02, 0.01, "m", "never read"))

    def assemble(self, design):
        values = copy(design)
        model = Spike.assemble(self, {name: values[name] for name in Spike.design_space.names})
        if unused is None:
            model.nodal_loads[-1] += values["widht"]
        return model

    robot = type("Whole", (Spike,), {"name": "whole", "design_space": space, "assemble": assemble})()
    if unused:
        with pytest.warns(UserWarning, match="never reads the design variable widht: it"):
            robot.build()
    else:
        robot.build()


@pytest.mark.parametrize(
    ("attributes", "meant"),
    [
        ({"stiffness_variable": "young_modulus"}, "learning = Learning(stiffness_variable=...)"),
        ({"sensor_scale": np.ones(1)}, "sensing = Sensing(scale=...)"),
        ({"picture_axes": (0, 1, 2)}, "view = View(axes=...)"),
        ({"goal_tolerence": 1e-3}, "goal_tolerance"),
        ({"referense_path": lambda self: None}, "reference_path"),
        ({"workspace_scales": 0.1, "sizes": (1, 2), "helper": 3}, "workspace_scale"),
        ({"sizes": (1, 2), "_goal_tolerence": 1, "middle": 3}, None),
    ],
)
def test_attributes_that_nothing_reads_are_named_once(attributes, meant):
    cls = type("Old", (Spike,), {"name": "old", **attributes})
    if meant is None:
        cls()
        return
    with pytest.warns(UserWarning) as caught:
        cls()
    assert [str(each.message) for each in caught] == [
        f"robot 'old': nothing reads its attribute '{next(iter(attributes))}'; did you mean '{meant}'?"
    ]
    cls()  # told once
