"""Files of glTF hold the bodies that were logged, as another reader reads them."""

from __future__ import annotations

import json

import gymnasium
import numpy as np
import pytest

from softgym_envs.errors import ConfigError
from softgym_envs.extensions.recordings.gltf import FRAMES_PER_SECOND, GlbWriter, write_glb
from softgym_envs.robots.registry import make_robot
from softgym_envs.viewer.moment import watch_rollout
from softgym_envs.viewer.surface import BodySurface

pytest.importorskip("pyvista")


def read(path, seconds=None):
    """Return the meshes of a file by name at a time, as VTK reads them, with z up again."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOGeometry import vtkGLTFReader

    reader = vtkGLTFReader()
    reader.SetFileName(str(path))
    reader.ApplyDeformationsToGeometryOn()
    reader.UpdateInformation()
    if seconds is not None:
        reader.SetFrameRate(60)
        reader.EnableAnimation(0)
        reader.UpdateTimeStep(seconds)
    reader.Update()
    found, iterator = [], reader.GetOutput().NewIterator()
    while not iterator.IsDoneWithTraversal():
        points = vtk_to_numpy(iterator.GetCurrentDataObject().GetPoints().GetData()).astype(float)
        found.append(np.column_stack([points[:, 0], -points[:, 2], points[:, 1]]))
        iterator.GoToNextItem()
    return found


@pytest.fixture(scope="module")
def episode(tmp_path_factory):
    path = tmp_path_factory.mktemp("gltf") / "episode.glb"
    env = gymnasium.make("SoftGym/FingerReach-v0", backend="fem")
    states = []

    def agent(observation, body):
        states.append(body.state)
        return np.array([1.0, -0.2])

    with GlbWriter(env.unwrapped.robot, path) as writer:
        watch_rollout(env, agent, [writer], seed=0, steps=3)
    states.append(env.unwrapped.state)
    surface = BodySurface(env.unwrapped.backend.model)
    env.close()
    return path, states, surface


@pytest.mark.parametrize("step", range(4))
def test_an_episode_is_an_animation_of_its_states(episode, step):
    path, states, surface = episode
    body = read(path, step / FRAMES_PER_SECOND)[0]
    assert body.shape == (len(surface.nodes), 3)
    assert np.abs(body - surface.points(states[step].nodes)).max() < 1e-6


def test_effectors_and_goals_move_with_the_states(episode):
    path, states, _ = episode
    *_, effector, goal = read(path, 2 / FRAMES_PER_SECOND)
    assert np.abs(0.5 * (effector.min(axis=0) + effector.max(axis=0)) - states[2].effector[0]).max() < 1e-6
    assert goal.shape == effector.shape


def test_the_file_is_whole(episode):
    raw = episode[0].read_bytes()
    assert raw[:4] == b"glTF" and int.from_bytes(raw[8:12], "little") == len(raw)
    length = int.from_bytes(raw[12:16], "little")
    document = json.loads(raw[20 : 20 + length])
    assert [mesh["name"] for mesh in document["meshes"]] == ["body", "cable_1", "cable_2", "tip", "goal"]
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0 and view["byteOffset"] + view["byteLength"] <= len(raw) - 28 - length


def test_a_body_at_rest_has_its_size(tmp_path):
    path = write_glb(make_robot("finger"), tmp_path / "finger.glb", {"length": 0.041})
    body = read(path)[0]
    assert body[:, 2].min() == pytest.approx(-3 * 0.041, abs=1e-3)
    with pytest.raises(ConfigError, match=r"must end with \.glb"):
        write_glb(make_robot("finger"), tmp_path / "finger.gltf")
