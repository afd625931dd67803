"""Recordings for the rerun viewer."""

import os

import gymnasium
import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.extensions.recordings.rerun_file import RolloutRecorder, recorder_of
from softgym_envs.viewer.moment import Moment, watch_rollout


def record(env, agent, path, **options):
    with recorder_of(env.unwrapped, path) as recorder:
        return watch_rollout(env, agent, [recorder], **options)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("recordings") / "new" / "rollout.rrd"
    env = gymnasium.make("SoftGym/FingerTrack-v0", backend="fem")
    seen = []

    def agent(observation, body):
        seen.append((observation, body.state.displacement))
        return np.array([1.0, -1.0])

    summary = record(env, agent, path, seed=3, steps=6)
    env.close()
    return path, summary, seen


class TestRecording:
    def test_summary(self, recorded):
        _, summary, seen = recorded
        assert summary["steps"] == 6 == len(seen)
        assert summary["final_distance"] > 0
        assert 0 < summary["return"] < 6
        assert summary["success"] is False
        assert seen[0][0].shape == (15,)

    def test_file_is_whole(self, recorded):
        path = recorded[0]
        assert [p.name for p in path.parent.iterdir()] == ["rollout.rrd"]
        assert path.read_bytes()[:3] == b"RRF"
        chunk = pytest.importorskip("rerun.chunk")
        rows = {}
        for part in chunk.RrdReader(path).stream():
            rows.setdefault(part.entity_path, []).append(part)
        steps = {entity: sum(p.num_rows for p in parts if "step" in p.timeline_names) for entity, parts in rows.items()}
        for entity in ("world/body", "world/cables/cable_1", "world/effectors", "world/goal", "plots/distance"):
            assert steps[f"/{entity}"] == 7
        for entity in ("plots/displacement/cable_2", "plots/effort/cable_1"):
            assert steps[f"/{entity}"] == 7
        assert steps["/plots/reward"] == 6
        assert steps["/world/path"] == 1
        columns = {name for part in rows["/world/body"] for name in part.to_record_batch().schema.names}
        assert {"Mesh3D:vertex_positions", "Mesh3D:triangle_indices", "Mesh3D:vertex_normals"} <= columns

    def test_two_rollouts_side_by_side(self, tmp_path):
        path = tmp_path / "both.rrd"
        backend = FEMBackend(make_robot("finger"))
        states = backend.reset(), backend.step(np.array([0.012, 0.012]))
        with RolloutRecorder(backend.robot, path, roles=("short", "long")) as recorder:
            for role in recorder.roles:
                recorder.begin(role)
                for step, state in enumerate(states):
                    recorder.log(Moment(step, backend.design, state, np.zeros(3)))
        chunk = pytest.importorskip("rerun.chunk")
        rows = {}
        for part in chunk.RrdReader(path).stream():
            rows[part.entity_path] = rows.get(part.entity_path, 0) + part.num_rows * ("step" in part.timeline_names)
        for role in ("short", "long"):
            assert rows[f"/{role}/world/body"] == rows[f"/{role}/plots/distance"] == 2
        assert "/world/body" not in rows

    def test_nothing_is_left_by_an_error(self, tmp_path):
        env = gymnasium.make("SoftGym/FingerReach-v0", backend="fem")

        def agent(observation, body):
            raise RuntimeError("agent failed")

        with pytest.raises(RuntimeError, match="agent failed"):
            record(env, agent, tmp_path / "rollout.rrd")
        env.close()
        assert os.listdir(tmp_path) == []
