"""Datasets: resumable, atomic, and honest about damage."""

import json

import numpy as np
import pytest

from softgym_envs.errors import DataError
from softgym_envs.robots import make_robot
from softgym_envs.surrogate import dataset
from softgym_envs.surrogate.dataset import COLUMNS, generate_dataset, load_dataset
from softgym_envs.surrogate.sampling import SamplingPlan, sample_group

PLAN = SamplingPlan(groups=4, states=3, sequence="halton", seed=5)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    return folder, generate_dataset(folder, "finger", PLAN, groups_per_shard=2, progress=False)


def test_columns_are_states_of_the_fem(made):
    _, data = made
    robot = make_robot("finger")
    assert set(data) == set(COLUMNS)
    assert data["rest"].sum() == 4 and len(data["rest"]) == 16
    n = 5
    for row in range(len(data["rest"])):
        W = np.zeros((n, n))
        W[np.triu_indices(n)] = data["compliance"][row]
        W = W + np.triu(W, 1).T
        assert np.linalg.eigvalsh(W)[0] > 0
    rest = data["rest"]
    assert np.abs(data["effort"][rest]).max() == 0.0
    assert np.abs(data["displacement"][rest]).max() < 1e-12
    bounds = [(v.low, v.high) for v in robot.design_space.variables.values()]
    for column, (low, high) in zip(data["design"].T, bounds, strict=True):
        assert (column >= low).all() and (column <= high).all()


def test_finished_shards_are_kept_and_damaged_ones_made_again(made, capsys):
    folder, data = made
    first, second = folder / "shard_00000.npz", folder / "shard_00001.npz"
    stamp = first.stat().st_mtime_ns
    content = second.read_bytes()
    second.write_bytes(content[: len(content) // 2])  # truncated
    with pytest.raises(DataError, match="shard_00001"):
        load_dataset(folder)
    again = generate_dataset(folder, "finger", PLAN, groups_per_shard=2, progress=False)
    assert "shard_00001" in capsys.readouterr().out
    assert (folder / "shard_00001.corrupt").exists()
    assert first.stat().st_mtime_ns == stamp
    for name in COLUMNS:
        assert (again[name] == data[name]).all()


def test_interruption_loses_no_finished_shard(tmp_path, monkeypatch, made):
    """A crash in the second shard leaves the first, and no half-written file."""
    calls = []
    original = dataset.sample_group

    def sample(robot, plan, group):
        calls.append(group)
        if group == 3:
            raise KeyboardInterrupt
        return original(robot, plan, group)

    monkeypatch.setattr(dataset, "sample_group", sample)
    with pytest.raises(KeyboardInterrupt):
        generate_dataset(tmp_path, "finger", PLAN, groups_per_shard=2, progress=False)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["manifest.json", "shard_00000.npz"]
    monkeypatch.setattr(dataset, "sample_group", original)
    data = generate_dataset(tmp_path, "finger", PLAN, groups_per_shard=2, progress=False)
    assert (data["effector"] == made[1]["effector"]).all()


def test_two_workers_make_the_same_data(tmp_path, made):
    data = generate_dataset(tmp_path, "finger", PLAN, groups_per_shard=2, workers=2, progress=False)
    for name in COLUMNS:
        assert (data[name] == made[1][name]).all()


def test_another_plan_does_not_mix(made):
    folder, _ = made
    with pytest.raises(DataError, match="plan"):
        generate_dataset(folder, "finger", SamplingPlan(4, 3, "halton", 6), groups_per_shard=2, progress=False)
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["columns"]["displacement"] == ["cable_1", "cable_2"]


def test_broken_manifest(tmp_path):
    (tmp_path / "manifest.json").write_text('{"format": 1, "pl')
    with pytest.raises(DataError, match=r"manifest\.json"):
        load_dataset(tmp_path)
    with pytest.raises(DataError, match="manifest"):
        load_dataset(tmp_path / "nowhere")


def test_plans():
    with pytest.raises(ValueError, match=r"sobol.*halton"):
        SamplingPlan(1, 1, "sobol")
    with pytest.raises(ValueError, match="groups = 0"):
        SamplingPlan(0, 1)
    for sequence in ("halton", "random"):
        plan = SamplingPlan(8, 4, sequence, 3)
        whole = plan.unit_points(3, 0, 8, 0)
        assert whole.min() >= 0 and whole.max() < 1
        assert (plan.unit_points(3, 5, 2, 0) == whole[5:7]).all()
        assert (plan.unit_points(3, 0, 8, 1) != whole).any()


def test_infeasible_designs_are_left_out(monkeypatch):
    from softgym_envs.errors import InfeasibleDesign

    robot = make_robot("finger")

    def refuse(design):
        raise InfeasibleDesign("cannot be meshed")

    monkeypatch.setattr(robot, "build", refuse)
    assert sample_group(robot, PLAN, 0) is None
