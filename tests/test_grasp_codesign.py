"""The comparison of a co-designed finger with design A on scenes that no study saw."""

import numpy as np
import pytest

from benchmarks.grasp_codesign import Episode, Scene, compare, difference, draw_scenes, table_of
from softgym_envs import make_robot
from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.errors import DataError
from softgym_envs.robots.grasping import KINDS

COARSE = {"control_points": 7, "element": "linear"}


def test_scenes_are_the_same_for_every_body_and_within_the_design_space():
    scenes = draw_scenes(8, (0.3, 2.0))
    assert [scene.kind for scene in scenes] == [*KINDS, *KINDS]
    assert scenes == draw_scenes(8, (0.3, 2.0))
    for scene in scenes:
        make_robot("grasping_finger", object=scene.kind).design_space.complete(scene.place)
        assert 0.3 <= scene.force <= 2.0


def test_bodies_are_compared_scene_by_scene_and_episodes_are_kept(tmp_path):
    """A body, and one that cannot exist: its zigzag is inside the object."""
    environment = EnvironmentConfig(
        id="SoftGym/FingerGrasp-v0", robot_options=COARSE, task_options={"forces": [0.3, 2.0]}
    )
    (drawn,) = draw_scenes(1, (0.3, 0.5))
    scenes = [Scene(drawn.kind, {**drawn.place, "object_gap": 0.012}, drawn.force)]
    wide = {"e1": 0.015, "e3": 0.010} | {f"d{k}": 0.028 for k in range(7)}
    bodies = {"A": {}, "impossible": wide}
    found = compare(environment, bodies, scenes, (0.015,), tmp_path)
    assert [episode.simulated for episode in found] == [True, False]
    assert found[0].total > 3.0
    assert (found[1].total, found[1].success) == (0.0, False)
    (tmp_path / "A_15mm_scene0.json").write_text((tmp_path / "impossible_15mm_scene0.json").read_text())
    assert compare(environment, bodies, scenes, (0.015,), tmp_path) == [found[1], found[1]]


def test_the_interval_contains_the_scatter_of_meshes_and_scenes():
    gains = np.array([[1.0, 2.0, 3.0, 4.0], [3.0, 4.0, 5.0, 6.0]])
    episodes = [
        Episode(body, mesh, k, True, gains[m, k] if body != "A" else 0.0, True, 0.0, 0.0)
        for m, mesh in enumerate((0.02, 0.012))
        for k in range(4)
        for body in ("A", "co-designed")
    ]
    change = difference(episodes, "total")
    assert change.value == 3.5
    assert change.low < 2.5
    assert change.high > 4.5
    with pytest.raises(DataError, match=r"'A' has \[4, 3\] scenes"):
        table_of(episodes[:-2], "A", "total")
