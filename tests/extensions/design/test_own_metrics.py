"""Metrics of one's own by path or as objects, and robot options as variables of a search."""

from __future__ import annotations

import csv

import pytest

from softgym_envs import make_robot
from softgym_envs.codesign.metrics.metric import METRICS, Metric, find_metric, metric
from softgym_envs.config import check_config, load_config
from softgym_envs.errors import ConfigError
from softgym_envs.extensions.design.bodies import StateEvaluator
from softgym_envs.extensions.design.config import BodiesConfig, ObjectiveConfig, OptimiseConfig, SensitivityConfig
from softgym_envs.extensions.design.gradient_free import search
from softgym_envs.extensions.design.sensitivity import analyse_sensitivity

BODIES = {
    "robot": "finger",
    "robot_options": {"cables": 1},
    "variables": ["length", "height"],
    "actuation": [0.01],
}


@metric(unit="kg", direction="minimize", source="design")
def mass(design):
    """Return the mass of a silicone finger."""
    return 1.1e3 * 3.0 * design["length"] * design["height"] ** 2


def height_of_tip(course):
    """Return how high the tip is at the full command."""
    return course.effector[-1, :, 2]


tip_height = Metric("tip_height", height_of_tip, "m", "maximize", "states")


@pytest.fixture
def importable(monkeypatch):
    """This module under a path that a configuration can name."""
    import sys

    monkeypatch.setitem(sys.modules, "own_metrics", sys.modules[__name__])
    return "own_metrics"


def optimisation(objectives, **changes):
    solver = {"method": "search", "trials": 12}
    return check_config(
        OptimiseConfig, {"name": "x", "bodies": BODIES, "objectives": objectives, "solver": solver, **changes}, "test"
    )


def test_a_metric_of_the_design_and_one_of_the_states(importable):
    robot = make_robot("finger", cables=1)
    evaluator = StateEvaluator(robot, [mass, tip_height, "travel"], backend="surrogate", actuation=[0.01])
    found = evaluator.measure(robot.design_space.baseline)
    assert found["mass"] == pytest.approx(1.1e3 * 3.0 * 0.04 * 0.021**2)
    assert -0.12 < found["tip_height"] < 0.0 < found["travel"]
    assert find_metric("own_metrics:mass") is mass and find_metric(tip_height) is tip_height
    assert mass.description == "Return the mass of a silicone finger." and mass.axis == "Mass [kg]"
    assert tip_height.axis == "Tip height [mm]"


def test_a_search_for_a_metric_of_ones_own(importable, tmp_path):
    config = optimisation(["own_metrics:mass", {"metric": "bending_angle"}])
    result = search(config, tmp_path, progress=False)
    masses = [row.metrics["mass"] for row in result.front]
    assert masses == sorted(masses)
    with (tmp_path / "trials.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert min(float(row["mass"]) for row in rows) == masses[0] < max(float(row["mass"]) for row in rows)
    assert load_config(tmp_path / "config.yaml", OptimiseConfig) == config


def test_sensitivity_of_a_metric_of_ones_own(importable, tmp_path):
    config = check_config(SensitivityConfig, {"name": "x", "bodies": BODIES, "metrics": ["own_metrics:mass"]}, "t")
    shares = analyse_sensitivity(config, tmp_path, progress=False).indices["mass"]
    low, high = 1.1e3 * 3.0 * 0.04 * 0.020**2, 1.1e3 * 3.0 * 0.04 * 0.022**2
    assert shares["height"]["low"] == pytest.approx(low) and shares["height"]["high"] == pytest.approx(high)


def test_metrics_as_objects_become_names():
    assert ObjectiveConfig(metric=METRICS["travel"]).metric == "travel"
    assert ObjectiveConfig(metric=mass).metric == f"{mass.function.__module__}:mass"
    with pytest.raises(ValueError, match="cannot be imported by workers"):
        ObjectiveConfig(
            metric=Metric("tip_height", lambda course: course.effector[-1, :, 2], "m", "maximize", "states")
        )


def test_a_robot_option_as_a_variable(tmp_path):
    option = {"low": 0.5, "high": 4.0, "baseline": 2.0, "unit": "N"}
    bodies = {
        "robot": "press_finger",
        "variables": ["length", "robot.button_force"],
        "ranges": {"robot.button_force": option},
        "backend": "fem",
        "actuation": [0.006, 0.006],
    }
    box = check_config(BodiesConfig, bodies, "test").box()
    assert box.names == ("length", "robot.button_force") and box.reference["robot.button_force"] == 2.0
    assert box.design(box.unit({**box.reference, "robot.button_force": 3.0}))["robot.button_force"] == pytest.approx(
        3.0
    )
    starts = [{"robot.button_force": force} for force in (0.5, 2.0, 4.0)]
    config = optimisation(["effort"], bodies=bodies, solver={"method": "search", "trials": 3, "starts": starts})
    search(config, tmp_path, progress=False)
    with (tmp_path / "trials.csv").open() as stream:
        efforts = [float(row["effort"]) for row in csv.DictReader(stream)]
    robot = make_robot("press_finger", button_force=4.0)
    direct = StateEvaluator(robot, ["effort"], actuation=[0.006, 0.006]).measure(robot.design_space.baseline)["effort"]
    assert efforts[2] == pytest.approx(direct) and len({round(effort, 6) for effort in efforts}) == 3


WRONG_METRICS = [
    ("bending_angel", r"unknown metric 'bending_angel'; did you mean 'bending_angle'\?"),
    ("beauty", "unknown metric 'beauty'; allowed: .*bending_angle.*, or one of your own as 'module:attribute'"),
    ("own_metrics:weight", "metric 'own_metrics:weight': module 'own_metrics' has no 'weight'"),
    ("no_such_module:mass", "metric 'no_such_module:mass': there is no module 'no_such_module'"),
    ("own_metrics:height_of_tip", "metric 'height_of_tip' needs episodes of a controller, which only a study has"),
]
WRONG_BODIES = [
    ({"robot": "fingr"}, r"unknown robot 'fingr'; did you mean 'finger'\?"),
    ({"robot_options": {"cabels": 1}}, "unknown option 'cabels'; did you mean 'cables'"),
    ({"variables": ["lenght"]}, "unknown design variable 'lenght'; did you mean 'length'"),
    ({"bounds": {"length": [38.0, 42.0]}}, "'length' = 38 m is out of bounds"),
    ({"actuation": [10.0]}, r"actuation \[10.0\] is out of range; allowed: cable_1 0 to 0.02 m"),
    ({"variables": ["robot.mesh_size"]}, "'robot.mesh_size' is an option: give its low"),
]
WRONG_SOLVERS = [
    ({"method": "gradient"}, "metric 'mass' has no derivative by the design"),
    ({"method": "serach"}, "'serach'"),
    ({"method": "search", "sampler": {"name": "tpr"}}, "'tpe'"),
]


def one_line(error):
    return "\n" not in str(error.value) and "more problem" not in str(error.value)


@pytest.mark.parametrize(("name", "message"), WRONG_METRICS)
def test_wrong_metrics(importable, name, message):
    with pytest.raises(ConfigError, match=message) as error:
        optimisation([name])
    assert one_line(error)
    with pytest.raises(ConfigError, match="metric 'mass' is named twice"):
        optimisation(["own_metrics:mass", "own_metrics:mass"])


@pytest.mark.parametrize(("bodies", "message"), WRONG_BODIES)
def test_wrong_bodies(bodies, message):
    with pytest.raises(ConfigError, match=message) as error:
        optimisation(["travel"], bodies={**BODIES, **bodies})
    assert one_line(error)


@pytest.mark.parametrize(("solver", "message"), WRONG_SOLVERS)
def test_wrong_solvers(importable, solver, message):
    with pytest.raises(ConfigError, match=message) as error:
        optimisation(["own_metrics:mass"], solver=solver)
    assert one_line(error)


def test_no_metric():
    with pytest.raises(ConfigError, match="name at least one metric"):
        optimisation([])


def test_options_need_a_search_and_a_robot():
    option = {"low": 0.006, "high": 0.010, "baseline": 0.008, "unit": "m"}
    bodies = {**BODIES, "variables": ["robot.mesh_size"], "ranges": {"robot.mesh_size": option}}
    with pytest.raises(ConfigError, match="solver 'gradient' cannot vary the option 'robot.mesh_size'"):
        optimisation(["travel"], bodies=bodies, solver={"method": "gradient"})
    bodies = {**BODIES, "variables": ["task.spread"], "ranges": {"task.spread": option}}
    with pytest.raises(ConfigError, match="design tools have no task"):
        optimisation(["travel"], bodies=bodies)
    bodies = {**BODIES, "variables": ["robot.cables"], "ranges": {"robot.cables": {**option, "baseline": 0.007}}}
    with pytest.raises(ConfigError, match="option cables = 0.007 must be an integer"):
        optimisation(["travel"], bodies=bodies)
