"""The comparison of a co-designed finger with design A on scenes that no study saw."""

import numpy as np

from benchmarks.grasp_codesign import Scene, compare, draw_scenes
from softgym_envs import make_robot
from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.robots.grasping import KINDS

COARSE = {"control_points": 7, "element": "linear"}


def test_scenes_are_the_same_for_every_body_and_within_the_design_space():
    scenes = draw_scenes(8, (0.3, 2.0))
    assert [scene.kind for scene in scenes] == [*KINDS, *KINDS]
    assert scenes == draw_scenes(8, (0.3, 2.0))
    for scene in scenes:
        make_robot("grasping_finger", object=scene.kind).design_space.complete(scene.place)
        assert 0.3 <= scene.force <= 2.0


def test_bodies_are_compared_scene_by_scene():
    """A body against itself, and against one that cannot exist: its zigzag is inside the object."""
    environment = EnvironmentConfig(
        id="SoftGym/FingerGrasp-v0", robot_options=COARSE, task_options={"forces": [0.3, 2.0]}
    )
    (drawn,) = draw_scenes(1, (0.3, 0.5))
    scenes = [Scene(drawn.kind, {**drawn.place, "object_gap": 0.012}, drawn.force)]
    wide = {"e1": 0.015, "e3": 0.010} | {f"d{k}": 0.028 for k in range(7)}
    found = compare(environment, {"impossible": wide, "A": {}, "same": {}}, scenes, (0.015,))
    assert found["differences"]["return"]["difference"] == 0.0
    assert np.array(found["episodes"]["A"]["return"]).shape == (1, 1)
    assert found["means"]["impossible"] == {"return": 0.0, "success": 0.0}
    assert found["means"]["A"]["return"] > 3.0
