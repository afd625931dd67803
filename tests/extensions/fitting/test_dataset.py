"""Datasets: reproducible states, generation that resumes without losing or repeating work, damaged files."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from filelock import FileLock
from hypothesis import given
from hypothesis import strategies as st

from softgym_envs import make_robot
from softgym_envs.errors import ConvergenceError, DataError, DesignError, InfeasibleDesign
from softgym_envs.extensions.beams.robots import stiff_flop
from softgym_envs.extensions.fitting.data import dataset, sampling
from softgym_envs.extensions.fitting.data.dataset import COLUMNS, generate_dataset, load_dataset
from softgym_envs.extensions.fitting.data.sampling import (
    SEQUENCES,
    Lost,
    SamplingPlan,
    may_be_joined,
    path_order,
    sample_group,
    select_states,
    solve_path,
)
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.surrogate.features import learned_variables
from tests.helpers import live_processes, wait_until

PLAN = SamplingPlan(groups=4, states=3, sequence="halton", seed=5)


def full(data, n):
    """Compliance matrices from their stored upper triangles."""
    W = np.zeros((len(data["rest"]), n, n))
    W[:, *np.triu_indices(n)] = data["compliance"]
    return W + np.triu(W, 1).swapaxes(1, 2)


def equal(a, b):
    return all(a[name].dtype == b[name].dtype and (a[name] == b[name]).all() for name in COLUMNS)


# -- plans ------------------------------------------------------------------------------------------------------------


def test_malformed_plans():
    with pytest.raises(ValueError, match=r"'grid' is unknown; allowed: 'halton', 'sobol', 'latin', 'random'"):
        SamplingPlan(1, 1, "grid")
    for groups, states, seed, message in (
        (0, 1, 0, "groups = 0 must be an integer of at least 1"),
        (2.5, 1, 0, "groups = 2.5 must be an integer"),
        (1, -1, 0, "states = -1"),
        (1, 1, -1, "seed = -1 must be an integer of at least 0"),
    ):
        with pytest.raises(ValueError, match=message):
            SamplingPlan(groups, states, seed=seed)
    with pytest.raises(ValueError, match="names a variable twice"):
        SamplingPlan(1, 1, vary=("length", "length"))
    for margin in (-0.1, 1.5, float("nan")):
        with pytest.raises(ValueError, match=r"margin = .* is out of bounds; allowed: \[0, 1\]"):
            SamplingPlan(1, 1, margin=margin)


@given(
    sequence=st.sampled_from(SEQUENCES),
    seed=st.integers(0, 2**32),
    dimension=st.integers(0, 8),
    total=st.integers(1, 70),
    stream=st.integers(0, 3),
    ends=st.tuples(st.floats(0, 1), st.floats(0, 1)),
)
def test_points_lie_in_the_unit_box_and_parts_equal_the_whole(sequence, seed, dimension, total, stream, ends):
    first, last = sorted(int(end * total) for end in ends)
    plan = SamplingPlan(total, 1, sequence, seed)
    whole = plan.unit_points(dimension, 0, total, total, stream)
    assert whole.shape == (total, dimension)
    assert ((whole >= 0) & (whole <= 1)).all()
    if last > first:
        part = SamplingPlan(total, 1, sequence, seed).unit_points(dimension, first, last - first, total, stream)
        np.testing.assert_array_equal(part, whole[first:last])


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_streams_and_seeds_differ(sequence):
    points = [
        SamplingPlan(8, 4, sequence, seed).unit_points(3, 0, 8, 8, stream) for seed in (3, 4) for stream in (0, 1)
    ]
    for k, a in enumerate(points):
        for b in points[:k]:
            assert (a != b).all(axis=1).any()


def test_sequences_spread_evenly():
    total = 64
    for sequence, share in (("latin", 1.0), ("sobol", 1.0), ("halton", 0.7), ("random", 0.0)):
        points = SamplingPlan(total, 1, sequence).unit_points(3, 0, total, total, 0)
        for column in points.T:  # strata of equal width that hold a point
            assert len(set((column * total).astype(int))) >= share * total


def test_designs_at_vertices():
    plan = SamplingPlan(20, 2, "vertices", seed=3, bounds={"joint_height": (0.0055, 0.007)})
    points = plan.unit_points(4, 0, 20, 20, 0)
    assert len(np.unique(points[:16], axis=0)) == 16 and np.isin(points, (0.0, 1.0)).all()
    robot = make_robot("finger")
    designs = plan.designs(robot, 0, 20)
    assert {design["joint_height"] for design in designs} == {0.0055, 0.007}
    assert {design["young_modulus"] for design in designs} == {robot.design_space["young_modulus"].baseline}
    assert not np.isin(plan.commands(robot, 0), (robot.lower[0], robot.upper[0])).any()


def test_designs():
    robot = make_robot("finger")
    space = robot.design_space
    assert learned_variables(robot) == ("length", "height", "joint_height", "poisson_ratio")
    designs = SamplingPlan(6, 1).designs(robot, 0, 6)
    for name, variable in space.variables.items():
        values = np.array([design[name] for design in designs])
        if name == robot.learning.stiffness_variable:
            assert (values == variable.baseline).all()
        else:
            assert len(set(values)) == 6 and values.min() >= variable.low and values.max() <= variable.high
    assert SamplingPlan(6, 1).designs(robot, 4, 2) == designs[4:]
    assert SamplingPlan(3, 1, vary=()).designs(robot, 0, 3) == [space.baseline] * 3

    plan = SamplingPlan(
        20, 1, vary=("length", "poisson_ratio"), design={"height": 0.021}, bounds={"length": (0.0395, 0.0400)}
    )
    designs = plan.designs(robot, 0, 20)
    assert {design["height"] for design in designs} == {0.021}
    assert {design["joint_height"] for design in designs} == {space["joint_height"].baseline}
    lengths, ratios = (np.array([design[name] for design in designs]) for name in ("length", "poisson_ratio"))
    assert 0.0395 <= lengths.min() < lengths.max() <= 0.0400
    assert np.ptp(ratios) > 0.8 * (space["poisson_ratio"].high - space["poisson_ratio"].low)


def test_variables_that_are_drawn_alike():
    robot = make_robot("contact_aided_finger")
    names = tuple(f"d{k}" for k in range(12))
    plan = SamplingPlan(40, 0, vary=("e1", *names), alike=names)
    values = np.array([[design[name] for name in names] for design in plan.designs(robot, 0, 40)])
    independent = SamplingPlan(40, 0, vary=("e1", *names)).designs(robot, 0, 40)
    spread = np.ptp(values, axis=1)
    assert spread.min() < 0.002 < 0.012 < spread.max()
    assert np.ptp(values[:, 0]) > 0.015
    assert min(np.ptp([design[name] for name in names]) for design in independent) > 0.008
    with pytest.raises(DesignError, match="'d1' is in `alike` but is not drawn; drawn: d0"):
        SamplingPlan(1, 0, vary=("d0",), alike=("d0", "d1")).designs(robot, 0, 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"vary": ("width",)}, "unknown design variable 'width'; allowed: length, height"),
        ({"bounds": {"width": (0.0, 1.0)}}, "unknown design variable 'width'"),
        ({"design": {"width": 1.0}}, "width"),
        ({"design": {"young_modulus": 1.0}}, "young_modulus"),
        (
            {"bounds": {"length": (0.030, 0.040)}},
            r"bounds of 'length' = \[0.03, 0.04\] must be inside \[0.038, 0.042\]",
        ),
        ({"bounds": {"length": (0.041, 0.040)}}, "bounds of 'length'"),
        ({"bounds": {"length": (0.039, float("nan"))}}, "bounds of 'length'"),
        ({"bounds": {"young_modulus": (1e6, 2e6)}}, "'young_modulus' has bounds but is not drawn; drawn: length"),
        ({"vary": (), "bounds": {"length": (0.039, 0.040)}}, "'length' has bounds but is not drawn; drawn: none"),
        ({"design": {"length": 0.039}}, "'length' is drawn and has a fixed value"),
    ],
)
def test_plans_that_do_not_fit_the_robot(tmp_path, options, message):
    plan = SamplingPlan(1, 1, **options)
    with pytest.raises(DesignError, match=message):
        plan.designs(make_robot("finger"), 0, 1)
    with pytest.raises(DesignError, match=message):
        generate_dataset(tmp_path / "data", "finger", plan, progress=False)
    assert not (tmp_path / "data").exists()


# -- paths and choices ------------------------------------------------------------------------------------------------


def length(points, start):
    return np.linalg.norm(np.diff(np.concatenate([[start], points]), axis=0), axis=1).sum()


@given(seed=st.integers(0, 2**32), count=st.integers(1, 40), dimension=st.integers(1, 6))
def test_paths_visit_every_point(seed, count, dimension):
    rng = np.random.default_rng(seed)
    points, start = rng.random((count, dimension)), rng.random(dimension)
    order = path_order(points, start)
    assert sorted(order) == list(range(count))
    assert order[0] == ((points - start) ** 2).sum(axis=1).argmin()


def test_paths_are_short(rng):
    for count, dimension in ((12, 2), (30, 4), (100, 2)):
        points = rng.random((count, dimension))
        start = np.zeros(dimension)
        assert length(points[path_order(points, start)], start) < 0.8 * length(points, start)


def test_paths_among_equal_points():
    assert sorted(path_order(np.zeros((4, 2)), np.zeros(2))) == [0, 1, 2, 3]
    assert path_order(np.zeros((0, 2)), np.zeros(2)).tolist() == []


def states_along(t):
    """Artificial states of one actuator and one effector, whose condensed model moves with ``t`` alone."""
    W = np.broadcast_to(np.eye(4), (len(t), 4, 4)).copy()
    W[:, 0, 3] = W[:, 3, 0] = 0.5 * t
    effector = np.stack([np.zeros_like(t), np.ones_like(t), t], axis=1)
    compliance = W[:, *np.triu_indices(4)]
    return {
        "displacement": np.zeros((len(t), 1)),
        "effort": np.zeros((len(t), 1)),
        "effector": effector,
        "compliance": compliance,
    }


@given(
    seed=st.integers(0, 2**32),
    rows=st.integers(1, 60),
    share=st.floats(0, 1),
    kinds=st.integers(1, 60),
)
def test_states_are_chosen_once(seed, rows, share, kinds):
    """Also if many states are equal."""
    data = states_along(np.random.default_rng(seed).integers(0, kinds, rows) / kinds)
    count = max(1, round(share * rows))
    chosen = select_states(data, count, seed)
    assert len(set(chosen)) == count and (np.diff(chosen) > 0).all()
    assert chosen[0] >= 0 and chosen[-1] < rows
    np.testing.assert_array_equal(select_states(data, count, seed), chosen)


def test_chosen_states_cover_better_than_random_ones(rng):
    t = np.concatenate([0.02 * rng.random(380), rng.random(20)])  # a dense cluster and a few distant points
    data = states_along(t)

    def uncovered(chosen):
        return np.abs(t[:, None] - t[chosen]).min(axis=1).max()

    by_chance = np.median([uncovered(rng.choice(len(t), 12, replace=False)) for _ in range(50)])
    for seed in range(3):
        assert uncovered(select_states(data, 12, seed)) < 0.5 * by_chance


def test_choice_of_states_with_contacts():
    data, _ = sample_group(make_robot("finger", contacts=True), SamplingPlan(1, 3, vary=()), 0)
    assert data["compliance"].shape == (4, 14 * 15 // 2)
    assert len(select_states(data, 2)) == 2


def test_counts_of_states_out_of_range_are_refused():
    data = states_along(np.arange(5.0))
    assert select_states(data, 5).tolist() == [0, 1, 2, 3, 4]
    for count in (0, 6):
        with pytest.raises(ValueError, match=f"count = {count} states cannot be chosen from 5; allowed: 1 to 5"):
            select_states(data, count)


# -- states -----------------------------------------------------------------------------------------------------------


def test_margin_lets_slack_cables_push_but_not_beyond_their_commands():
    robot = make_robot("finger")
    span = robot.upper - robot.lower
    results = {}
    for margin in (0.0, 0.05, 1.0):
        plan = SamplingPlan(1, 14, seed=2, margin=margin, vary=())
        data, lost = sample_group(robot, plan, 0)
        assert lost == Lost()
        fractions = plan.unit_points(2, 0, 14, 14, 1)
        order = path_order(fractions, -robot.lower / span)
        results[margin] = data, robot.lower + fractions[order] * span
    taut, commands = results[0.0]
    reached = taut["displacement"][1:]
    slack = reached > commands + 1e-5
    assert slack.any() and not slack.all(axis=1).any()
    np.testing.assert_allclose(reached[~slack], commands[~slack], atol=1e-8)
    assert taut["effort"].min() > -1e-6
    moved = {}
    for margin in (0.05, 1.0):
        data, again = results[margin]
        np.testing.assert_array_equal(again, commands)
        pulled = reached - data["displacement"][1:]
        moved[margin] = (pulled > 1e-6).any(axis=1)
        assert moved[margin].any() and not moved[margin].all()
        # Only slack cables are pulled back: by no more than the margin, and never below their command.
        np.testing.assert_allclose(pulled[~slack], 0.0, atol=1e-8)
        assert (pulled <= margin * span + 1e-8).all()
        assert (data["displacement"][1:] >= commands - 1e-8).all()
        assert data["effort"][1:][moved[margin]].min() < 0.0
        assert data["effort"][1:][~moved[margin]].min() > -1e-6
    assert results[1.0][0]["effort"].min() < results[0.05][0]["effort"].min()


def test_infeasible_designs_are_left_out(monkeypatch):
    robot = make_robot("trunk")

    def refuse(design):
        raise InfeasibleDesign("cannot be built")

    monkeypatch.setattr(robot, "build", refuse)
    assert sample_group(robot, PLAN, 0) == (None, Lost(bodies=1, commands=PLAN.states))


def test_bodies_with_meshes_of_their_own_are_left_out_on_request():
    robot = make_robot("sensorized_finger", touch=True, meshing="morph")
    bodies = {"morphed": {}, "remeshed": {"slope": 0.2}}
    for origin, design in bodies.items():
        assert robot.body(design).origin == origin
        for one_mesh in (False, True):
            plan = SamplingPlan(groups=1, states=0, vary=(), design=design, one_mesh=one_mesh)
            assert (sample_group(robot, plan, 0)[0] is None) == (one_mesh and origin == "remeshed")


# -- datasets ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    return folder, generate_dataset(folder, "finger", PLAN, groups_per_shard=2, progress=False)


@pytest.fixture(scope="module")
def trunk(tmp_path_factory):
    """A small dataset of three shards."""
    folder = tmp_path_factory.mktemp("trunk")
    return folder, generate_dataset(folder, "trunk", PLAN, groups_per_shard=2, progress=False)


@pytest.fixture
def copied(trunk, tmp_path):
    shutil.copytree(trunk[0], tmp_path / "data")
    return tmp_path / "data"


def test_columns_are_states_of_the_fem(made):
    _, data = made
    robot = make_robot("finger")
    assert set(data) == set(COLUMNS)
    assert data["rest"].sum() == 4 and len(data["rest"]) == 16
    assert (np.linalg.eigvalsh(full(data, 5))[:, 0] > 0).all()
    rest = data["rest"]
    assert np.abs(data["effort"][rest]).max() == 0.0
    assert np.abs(data["displacement"][rest]).max() < 1e-12
    bounds = [(v.low, v.high) for v in robot.design_space]
    for column, (low, high) in zip(data["design"].T, bounds, strict=True):
        assert (column >= low).all() and (column <= high).all()


def test_manifest_and_card(made):
    folder, data = made
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["columns"]["displacement"] == ["cable_1", "cable_2"]
    assert manifest["plan"]["sequence"] == "halton"
    card = (folder / "README.md").read_text()
    assert card.startswith("# States of robot `finger`\n\n16 states of 4 bodies, by `softgym dataset`")
    assert (
        "Left out: 0 bodies without a mesh or without an equilibrium at rest, 0 commands without an equilibrium, and "
        "0 states outside the ranges of the actuators." in card
    )
    column = data["effector"][:, 1]
    assert f"| effector: tip y | 16 | {column.min():.6g} | {column.max():.6g} |" in card
    for label in ("design: joint_height", "displacement: cable_2", "effort: cable_1", "compliance: upper triangle"):
        assert f"| {label}" in card


def test_a_finished_dataset_is_only_read(copied, trunk, monkeypatch):
    """Several trainings may therefore read it at the same time."""
    before = {path.name: path.stat().st_mtime_ns for path in copied.iterdir()}
    with FileLock(copied / ".lock"):
        again = generate_dataset(copied, "trunk", PLAN, groups_per_shard=2, progress=False)
        assert equal(again, trunk[1])
        assert {path.name for path in copied.iterdir()} == set(before)
    assert {path.name: path.stat().st_mtime_ns for path in copied.glob("[!.]*")} == {
        name: stamp for name, stamp in before.items() if name[0] != "."
    }


def test_a_missing_card_is_written(copied, trunk):
    card = copied / "README.md"
    content = card.read_text()
    card.unlink()
    generate_dataset(copied, "trunk", PLAN, groups_per_shard=2, progress=False)
    assert card.read_text() == content == (trunk[0] / "README.md").read_text()


def test_two_runs_at_once_are_refused(copied):
    (copied / "shard_00001.npz").unlink()
    with (
        FileLock(copied / ".lock"),
        pytest.raises(DataError, match=r"data' is being generated by another process; wait for it or use a new folder"),
    ):
        generate_dataset(copied, "trunk", PLAN, groups_per_shard=2, progress=False)
    assert not (copied / "shard_00001.npz").exists()
    generate_dataset(copied, "trunk", PLAN, groups_per_shard=2, progress=False)


def test_files_left_by_killed_writers_are_removed(copied, trunk):
    (copied / "shard_00001.npz").unlink()
    for name in (".shard_00001.npz.a1b2c3", ".README.md.x", ".manifest.json.y"):
        (copied / name).write_bytes(b"PK\x03\x04")
    (copied / ".mine").write_text("something else")
    again = generate_dataset(copied, "trunk", PLAN, groups_per_shard=2, progress=False)
    assert equal(again, trunk[1])
    assert {path.name for path in copied.iterdir()} == {
        *(".lock", ".mine", "README.md", "manifest.json"),
        *(f"shard_{k:05d}.npz" for k in range(2)),
    }


def rewritten(change):
    def damage(path):
        with np.load(path) as stored:
            columns = dict(stored)
        change(columns)
        np.savez_compressed(path, **columns)

    return damage


def set_nan(columns):
    columns["effort"][1, 0] = np.nan


DAMAGES = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "empty": lambda path: path.write_bytes(b""),
    "noise": lambda path: path.write_bytes(bytes(range(256)) * 20),
    "flipped bits": lambda path: path.write_bytes(
        bytes(255 - b if 300 < k < 320 else b for k, b in enumerate(path.read_bytes()))
    ),
    "folder": lambda path: (path.unlink(), path.mkdir()),
    "not finite": rewritten(set_nan),
    "column missing": rewritten(lambda columns: columns.pop("compliance")),
    "column shorter": rewritten(lambda columns: columns.update(effector=columns["effector"][:-1])),
    "column narrower": rewritten(lambda columns: columns.update(effector=columns["effector"][:, :-1])),
    "compliance narrower": rewritten(lambda columns: columns.update(compliance=columns["compliance"][:, :-1])),
    "no rest first": rewritten(lambda columns: columns.update(rest=1 - columns["rest"])),
    "column flat": rewritten(lambda columns: columns.update(compliance=columns["compliance"][:, 0])),
    "column of one number": rewritten(lambda columns: columns.update(rest=np.float64(1.0))),
    "column of words": rewritten(lambda columns: columns.update(rest=np.array(["rest"] * len(columns["rest"])))),
    "column of objects": rewritten(lambda columns: columns.update(rest=columns["rest"].astype(object))),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_damaged_shards_are_reported_renamed_and_generated_again(copied, trunk, damage, capsys):
    first, second = copied / "shard_00000.npz", copied / "shard_00001.npz"
    stamp, content = first.stat().st_mtime_ns, second.read_bytes()
    damage(second)
    with pytest.raises(DataError, match="shard_00001"):
        load_dataset(copied)
    again = generate_dataset(copied, "trunk", PLAN, groups_per_shard=2, progress=False)
    said = capsys.readouterr().out
    assert "shard_00001.npz" in said and "renamed to 'shard_00001.corrupt', generating it again" in said
    assert (copied / "shard_00001.corrupt").exists()
    assert first.stat().st_mtime_ns == stamp
    assert second.read_bytes() == content  # a shard has the same bytes whenever it is made
    assert equal(again, trunk[1])


def test_data_of_another_plan_are_refused(copied):
    for options, name in (
        ({"groups_per_shard": 3}, "groups_per_shard"),
        ({"robot_options": {"elements": 9}}, "mechanics_key, robot_options"),
    ):
        with pytest.raises(DataError, match=f"holds another dataset .different: {name}"):
            generate_dataset(copied, "trunk", PLAN, **{"groups_per_shard": 2, "progress": False, **options})
    with pytest.raises(DataError, match=r"different: plan\)"):
        generate_dataset(copied, "trunk", SamplingPlan(4, 3, "halton", 6), groups_per_shard=2, progress=False)
    with pytest.raises(DataError, match="different: .*robot"):
        generate_dataset(copied, "finger", PLAN, groups_per_shard=2, progress=False)


def test_data_of_other_bodies_are_refused(copied, monkeypatch):
    """An edited robot has the same name and options; what it builds tells."""
    monkeypatch.setattr(stiff_flop, "AREA_SHARE", 0.9 * stiff_flop.AREA_SHARE)
    with pytest.raises(DataError, match="holds states of other bodies of robot 'trunk': .* body was .*, now .*code"):
        generate_dataset(copied, "trunk", PLAN, groups_per_shard=2, progress=False)


@pytest.mark.parametrize("sequence", ["halton", "sobol", "random"])
def test_a_dataset_grows(tmp_path, sequence):
    """Adding groups keeps the existing ones and gives the same data as generating all at once."""

    def plan(groups):
        return SamplingPlan(groups, 2, sequence, 3)

    small = generate_dataset(tmp_path / "grown", "trunk", plan(2), groups_per_shard=1, progress=False)
    stamps = [path.stat().st_mtime_ns for path in sorted((tmp_path / "grown").glob("shard*"))]
    grown = generate_dataset(tmp_path / "grown", "trunk", plan(5), groups_per_shard=1, progress=False)
    shards = sorted((tmp_path / "grown").glob("shard*"))
    assert len(shards) == 5 and [path.stat().st_mtime_ns for path in shards[:2]] == stamps
    assert all((grown[name][: len(small[name])] == small[name]).all() for name in COLUMNS)
    assert equal(grown, generate_dataset(tmp_path / "whole", "trunk", plan(5), groups_per_shard=1, progress=False))
    assert "of 5 bodies" in (tmp_path / "grown" / "README.md").read_text()
    with pytest.raises(DataError, match=r"different: plan\)"):  # it does not shrink
        generate_dataset(tmp_path / "grown", "trunk", plan(4), groups_per_shard=1, progress=False)


def test_a_dataset_that_cannot_grow(tmp_path):
    """A Latin hypercube depends on its number of points; an incomplete last shard would have to be made again."""
    for sequence, first in (("latin", 2), ("halton", 1)):
        for groups in (first, 4):
            plan = SamplingPlan(groups, 2, sequence, 3)
            if groups == first:
                generate_dataset(tmp_path / sequence, "trunk", plan, groups_per_shard=2, progress=False)
                continue
            with pytest.raises(DataError, match=r"different: plan\)"):
                generate_dataset(tmp_path / sequence, "trunk", plan, groups_per_shard=2, progress=False)


@pytest.mark.parametrize("text", ['{"format": 2, "pl', "[]", '{"format": 1}', '{"format": 2, "plan": {}}'])
def test_broken_manifest(copied, text):
    (copied / "manifest.json").write_text(text)
    with pytest.raises(DataError, match=r"manifest\.json"):
        load_dataset(copied)
    with pytest.raises(DataError, match=r"manifest\.json|different"):
        generate_dataset(copied, "trunk", PLAN, groups_per_shard=2, progress=False)


def test_no_manifest(tmp_path):
    with pytest.raises(DataError, match="manifest"):
        load_dataset(tmp_path / "nowhere")


def test_infeasible_designs_are_counted(tmp_path, monkeypatch, trunk):
    original = dataset.sample_group

    def sample(robot, plan, group):
        return original(robot, plan, group) if group == 1 else (None, Lost(1, plan.states))

    monkeypatch.setattr(dataset, "sample_group", sample)
    # The second shard has no feasible design.
    data = generate_dataset(tmp_path / "one", "trunk", PLAN, groups_per_shard=2, progress=False)
    assert data["rest"].sum() == 1
    np.testing.assert_array_equal(data["effector"], trunk[1]["effector"][4:8])
    card = (tmp_path / "one" / "README.md").read_text()
    assert "4 states of 1 body," in card and "3 bodies without a mesh" in card
    monkeypatch.setattr(dataset, "sample_group", lambda robot, plan, group: (None, Lost(1, plan.states)))
    with pytest.raises(DataError, match="no design of dataset '.*none' is feasible"):
        generate_dataset(tmp_path / "none", "trunk", PLAN, groups_per_shard=2, progress=False)


def test_two_workers_make_the_same_data(tmp_path, made):
    data = generate_dataset(tmp_path, "finger", PLAN, groups_per_shard=2, workers=2, progress=False)
    assert equal(data, made[1])
    for shard in tmp_path.glob("shard_*"):
        assert shard.read_bytes() == (made[0] / shard.name).read_bytes()


# -- runs that are stopped --------------------------------------------------------------------------------------------


def test_interruption_loses_no_finished_shard(tmp_path, monkeypatch, trunk):
    """An interruption in the second shard keeps the first and leaves no half-written file."""
    original = dataset.sample_group

    def sample(robot, plan, group):
        if group == 3:
            raise KeyboardInterrupt
        return original(robot, plan, group)

    monkeypatch.setattr(dataset, "sample_group", sample)
    with pytest.raises(KeyboardInterrupt):
        generate_dataset(tmp_path, "trunk", PLAN, groups_per_shard=2, progress=False)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".lock", "manifest.json", "shard_00000.npz"]
    monkeypatch.setattr(dataset, "sample_group", original)
    assert equal(generate_dataset(tmp_path, "trunk", PLAN, groups_per_shard=2, progress=False), trunk[1])


LONG = SamplingPlan(groups=200, states=2, sequence="random", seed=1)

# Starts each run in its own session by a fork, so that imports are done once.
STARTER = f"""
import os, sys
import joblib.externals.loky.backend.resource_tracker
from softgym_envs.extensions.fitting.data.dataset import generate_dataset
from softgym_envs.extensions.fitting.data.sampling import SamplingPlan

for folder in sys.stdin:
    process = os.fork()
    if process == 0:
        os.setsid()
        os.write(1, b"%d\\n" % os.getpid())
        os.dup2(2, 1)  # other output must not mix with the process IDs
        generate_dataset(folder.strip(), "trunk", {LONG!r}, groups_per_shard=1, workers=2, progress=False)
        os._exit(0)
"""


def test_ten_kills_lose_no_finished_shard_and_repeat_none(tmp_path, rng):
    """Kill the run alone or with its workers, at its start or between any of its shards; then start another run."""
    folder = tmp_path / "data"

    def shards():
        """Return name -> (i-node, time, bytes) of the finished shards."""
        return {p.name: (p.stat().st_ino, p.stat().st_mtime_ns, p.read_bytes()) for p in folder.glob("shard_*")}

    finished, sessions, survivors, gained = {}, [], 0, []
    with (
        (tmp_path / "errors").open("wb") as errors,
        subprocess.Popen(
            [sys.executable, "-c", STARTER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors
        ) as starter,
    ):
        try:

            def start():
                starter.stdin.write(f"{folder}\n".encode())
                starter.stdin.flush()
                line = b"\n"
                while line == b"\n":
                    line = starter.stdout.readline()
                sessions.append(int(line))
                return sessions[-1]

            for number in range(10):
                session = start()
                before = len(finished)
                if number % 5 == 4:  # anywhere before the first shard
                    time.sleep(rng.uniform(0.0, 1.0))
                else:
                    goal = before + int(rng.integers(1, 4))
                    wait_until(
                        lambda goal=goal: sum(1 for _ in folder.glob("shard_*")) >= goal,
                        interval=0.002,
                        failed=lambda s=session: (
                            None if live_processes(s) else (tmp_path / "errors").read_text()[-2000:]
                        ),
                    )
                    time.sleep(rng.uniform(0.0, 0.03))
                if number % 2:
                    os.killpg(session, signal.SIGKILL)
                else:
                    os.kill(session, signal.SIGKILL)
                    survivors += len(live_processes(session)) > 0
                    # The next run starts while orphans are still at their shards. Killed earlier, a worker between
                    # its fork and its exec would still hold the lock.
                    if number % 4 or number % 5 == 4:
                        wait_until(lambda session=session: not live_processes(session))
                now = shards()
                assert now.items() >= finished.items()
                gained.append(len(now) - before)
                finished = now
            assert survivors >= 3  # workers outlived their killed run
            assert sum(n > 0 for n in gained) >= 8 and len(finished) < LONG.groups, gained

            start()
            wait_until(lambda: (folder / "README.md").exists())
            wait_until(lambda: not any(live_processes(session) for session in sessions))
        finally:
            starter.stdin.close()
            for session in sessions:
                for process in live_processes(session):
                    os.kill(process, signal.SIGKILL)
                # Nobody removes the semaphores of a killed process group.
                for left in Path("/dev/shm").glob(f"*[-_]{session}[-_]*"):
                    shutil.rmtree(left) if left.is_dir() else left.unlink()

    # Nothing is lost, repeated, left behind or different from an uninterrupted run.
    final = shards()
    assert final.items() >= finished.items()
    assert {path.name for path in folder.iterdir()} == {".lock", "README.md", "manifest.json", *final}
    whole = tmp_path / "whole"
    data = generate_dataset(whole, "trunk", LONG, groups_per_shard=1, progress=False)
    assert {p.name: p.read_bytes() for p in whole.glob("shard_*")} == {name: s[2] for name, s in final.items()}
    assert equal(load_dataset(folder), data)
    assert (folder / "README.md").read_text() == (whole / "README.md").read_text()


def test_a_gripper_is_not_turned_inside_out():
    robot = make_robot("two_finger_gripper")
    statics = Statics(robot.build({"length": 0.038, "joint_height": 0.005, "bar_length": 0.030}))
    rest, command = statics.solve(np.zeros(4)), np.array([0.0, 0.02, 0.0, 0.02])
    found = dict(solve_path(robot, statics, rest, np.array([command, 0.25 * command])))
    for state in found.values():
        assert may_be_joined(rest, state) and state.condensed.delta.e[2] < -0.05  # on the side of the tips at rest
        assert not state.slack[[1, 3]].any()


@pytest.mark.parametrize("end", [0.009, np.inf])
def test_a_solve_that_leaves_the_branch_is_repeated_slowly(end):
    robot = make_robot("finger", cables=1)  # its cable moves by 1 mm in a step
    places = []

    class Statics:
        place = 0.0

        def solve(self, command):
            moved, self.place = abs(command[0] - self.place), command[0]
            places.append(round(1e3 * self.place, 6))
            return state(self.place, effort=self.place if moved < 0.0011 and self.place < end else 0.0)

        def restore(self, x, effort):
            self.place = x

    def state(place, effort):
        W = SimpleNamespace(aa=np.eye(1))
        rows = SimpleNamespace(
            delta=SimpleNamespace(a=np.array([place])), lambda_=SimpleNamespace(a=np.array([effort]))
        )
        return SimpleNamespace(x=place, effort=effort, condensed=SimpleNamespace(W=W, **vars(rows)))

    rest, commands = state(0.0, 0.0), np.array([[0.008], [0.0101]])
    found = dict(solve_path(robot, Statics(), rest, commands))
    assert places[:9] == [8.0, *range(1, 9)] and found[0].effort == 0.008
    assert places[9:13] == [10.1, 8.7, 9.4, 10.1] if end > 1.0 else places[9:12] == [10.1, 8.7, 9.4]
    assert found[1].effort == 0.0101 if end > 1.0 else found[1] is None


def test_a_solve_that_began_at_rest_is_not_repeated_from_rest(monkeypatch):
    class Statics:
        calls = 0
        fails = True

        def solve(self, command):
            self.calls += 1
            if self.fails or command[0] > 0.01:
                raise ConvergenceError("no equilibrium")
            return SimpleNamespace(x=None, effort=None)

        def restore(self, x, effort):
            pass

    monkeypatch.setattr(sampling, "may_be_joined", lambda first, second: True)
    robot, rest = make_robot("finger", cables=1), SimpleNamespace(x=None, effort=None)
    commands, statics = np.array([[0.005], [0.015], [0.018]]), Statics()
    assert [found for _, found in solve_path(robot, statics, rest, commands)] == [None] * 3 and statics.calls == 3
    statics.calls, statics.fails = 0, False
    assert [found is None for _, found in solve_path(robot, statics, rest, commands)] == [False, True, True]
    assert statics.calls == 4  # only the second command began elsewhere
    statics.calls, again = 0, np.array([[0.018], [0.005], [0.018], [0.018]])
    assert {k: found is None for k, found in solve_path(robot, statics, rest, again)} == {
        0: True,
        1: False,
        2: True,
        3: True,
    }
    assert statics.calls == 3  # the same command is tried from the first state and from rest, and not again
