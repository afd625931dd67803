"""Options of contact that all robots share, and what keys, backends and environments do with them."""

from __future__ import annotations

import json

import gymnasium
import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.registry import make_backend
from softgym_envs.backends.surrogate import SurrogateBackend
from softgym_envs.errors import InfeasibleDesign, WeightsError
from softgym_envs.mechanics.contact.obstacles import Plane, Sphere
from softgym_envs.robots import ROBOTS
from softgym_envs.surrogate.pretrained import ships_weights

WALL = Plane((0.0, 0.0, 0.1263), (0.0, 0.0, -1.0), friction=0.3, name="ceiling")
"""0.3 mm above the top of the Diamond: so near that it presses at rest."""


@pytest.mark.parametrize("name", ROBOTS)
def test_every_robot_takes_obstacles(name):
    ball = Sphere((0.0, 0.0, 3.0), 0.1, name="far away")
    robot = make_robot(name, obstacles=[ball])
    key = robot.mechanics_key
    assert json.loads(json.dumps(key)) == key
    assert key["obstacles"][-1]["name"] == "far away"
    assert key | {"obstacles": []} == make_robot(name).mechanics_key | {"obstacles": []}
    again = make_robot(name, obstacles=key["obstacles"])  # from a configuration file
    assert again.obstacles == robot.obstacles and again.mechanics_key == key


def test_robots_without_contact_keep_their_key_and_model():
    robot = make_robot("diamond", obstacles=[], self_contact=False)
    assert robot.mechanics_key == make_robot("diamond").mechanics_key
    assert "obstacles" not in robot.mechanics_key and not robot.touches
    assert robot.build().contact is None


def test_body_inside_an_obstacle_is_infeasible():
    robot = make_robot("diamond", obstacles=[Plane((0.0, 0.0, 0.12), (0.0, 0.0, -1.0), name="ceiling")])
    with pytest.raises(InfeasibleDesign, match="robot 'diamond' at rest: .*ceiling"):
        robot.build()
    robot.build({"top_height": 0.116})


def test_clamped_nodes_touch_nothing():
    """A table in the plane of the finger's flange is not crossed by it."""
    table = Plane((0.0, 0.0, -1e-3), (0.0, 0.0, -1.0), name="table")
    make_robot("finger", obstacles=[table]).build()
    with pytest.raises(InfeasibleDesign, match="table"):
        make_robot("finger", obstacles=[Plane((0.0, 0.0, -0.06), (0.0, 0.0, -1.0), name="table")]).build()


def test_own_stiffness_does_not_scale_with_the_body():
    assert make_robot("finger", obstacles=[WALL]).learning.stiffness_variable == "young_modulus"
    assert make_robot("finger", obstacles=[WALL], contact_stiffness=1e5).learning.stiffness_variable is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"obstacles": [{"kind": "wall"}]}, "unknown kind of obstacle 'wall'"),
        ({"obstacles": WALL}, r"obstacles = Plane\(.* must be a list"),
        ({"self_contact": 1}, "option self_contact = 1 must be true or false"),
        ({"obstacle": [WALL]}, "unknown option 'obstacle'; did you mean 'obstacles'"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        make_robot("diamond", **options)


@pytest.mark.parametrize("options", [{"obstacles": [WALL]}, {"self_contact": True}])
def test_shipped_weights_refuse_contact(options):
    with pytest.raises(WeightsError, match="weights of 'diamond' know no contact: use backend='fem'"):
        make_backend("surrogate", make_robot("diamond", **options))


@pytest.mark.parametrize("options", [{"obstacles": [WALL]}, {"self_contact": False}, {"self_friction": 0.3}])
def test_weights_of_a_robot_that_touches_itself_refuse_other_contact(options):
    assert ships_weights(make_robot("finger", mesh="accurate"))
    robot = make_robot("finger", mesh="accurate", **options)
    assert not ships_weights(robot)
    with pytest.raises(WeightsError, match="know self_contact without obstacles: use backend='fem'"):
        make_backend("surrogate", robot)


def test_the_accurate_finger_runs_on_weights_that_know_its_contact():
    env = gymnasium.make("SoftGym/FingerReach-v0", robot_options={"mesh": "accurate"})
    assert isinstance(env.get_wrapper_attr("backend"), SurrogateBackend)
    env.reset(seed=0, options={"design": {"length": 0.041, "joint_height": 0.0055}})
    for _ in range(6):
        *_, info = env.step(np.ones(2, dtype=np.float32))
    assert info["converged"] and info["trusted"] and (info["effort"] > 0.0).all()


def test_contact_in_environments():
    """Records of obstacles go through ``gymnasium.make``; the default backend becomes FEM; info names the forces."""
    options = {"obstacles": [WALL.as_dict()]}
    env = gymnasium.make("SoftGym/Reach-v0", robot="diamond", robot_options=options, action_mode="absolute")
    env.reset(seed=0)
    *_, info = env.step(np.full(4, -0.99, dtype=np.float32))
    force, gap = info["contact_force"], info["smallest_gap"]
    assert force.shape == (1, 3)
    state = env.unwrapped.state
    np.testing.assert_array_equal(force, state.contacts.total)
    assert state.memory is not None
    assert force[0, 2] < 0.0 and 0.0 < gap < 5e-4
    assert 0.0 <= info["sliding"] <= 1.0
    plain = gymnasium.make("SoftGym/Reach-v0", robot="diamond", backend="fem")
    assert "contact_force" not in plain.reset(seed=0)[1]
