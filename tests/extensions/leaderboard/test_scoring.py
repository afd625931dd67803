"""Scores, hypervolumes, statistics and tables."""

from dataclasses import replace

import numpy as np
import pytest

from softgym_envs.errors import DataError
from softgym_envs.extensions.leaderboard import board, regret, runs
from softgym_envs.extensions.leaderboard import table as table_module
from softgym_envs.extensions.leaderboard.frozen import load_problem
from softgym_envs.extensions.leaderboard.problem import JudgedScore
from softgym_envs.extensions.leaderboard.scoring import Reference, front, hypervolume, improvement, normalised
from softgym_envs.extensions.leaderboard.search import make_optimiser, solve
from softgym_envs.extensions.leaderboard.table import Table, TableSearch, tabulate


def test_hypervolume_of_known_sets():
    worst = np.array([2.0, 2.0])
    assert hypervolume(np.array([[1.0, 1.0]]), worst) == 1.0
    assert hypervolume(np.array([[0.0, 1.0], [1.0, 0.0], [1.5, 1.5]]), worst) == 3.0
    assert hypervolume(np.array([[3.0, 0.0]]), worst) == 0.0
    cube = np.array([[0.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 0.0]])
    assert hypervolume(cube, np.full(3, 2.0)) == 4.0


def test_hypervolume_against_counting():
    rng = np.random.default_rng(0)
    points, samples = rng.random((6, 3)), rng.random((200_000, 3))
    counted = (samples[:, None] >= points).all(axis=2).any(axis=1).mean()
    assert hypervolume(points, np.ones(3)) == pytest.approx(counted, abs=5e-3)


def test_normalised_scores():
    known = Reference("p-v1", "0", [-4.0])
    assert normalised(known, [[-3.0]]) is None
    known.best = [[-2.0]]
    assert [normalised(known, [[s]]) for s in (-4.0, -3.0, -2.0, -1.0)] == [0.0, 0.5, 1.0, 1.5]
    both = Reference("p-v1", "0", [-1.0, -10.0], [[-0.5, -5.0]])
    assert normalised(both, [[-1.0, -10.0]]) == 0.0 and normalised(both, [[-0.5, -5.0]]) == 1.0
    assert normalised(both, [[-0.5, -10.0]]) == pytest.approx((1.5 - 1.0) / (2.25 - 1.0))


def test_front_leaves_out_what_is_dominated():
    rows = [
        JudgedScore("qp", design={"x": i}, scores=list(s))
        for i, s in enumerate([(1.0, 0.0), (0.0, 1.0), (0.0, 0.5), (1.0, 0.0)])
    ]
    assert [row.design["x"] for row in front(rows)] == [0, 1]


def test_probability_of_improvement():
    low, high = np.zeros((4, 2)), np.ones((5, 2))
    assert improvement(high, low).value == 1.0 and improvement(low, high).value == 0.0
    same = improvement(low, low)
    assert (same.value, same.low, same.high) == (0.5, 0.5, 0.5)
    mixed = improvement(np.array([[0.0], [2.0]]), np.array([[1.0], [1.0]]))
    assert mixed.value == 0.5 and mixed.low == 0.0 and mixed.high == 1.0


SPENT = {"environment_steps": 15_000}


def make_run(method, seed, curve):
    return runs.Run(
        "finger-zone-v1",
        "0",
        method,
        "qp",
        "small",
        seed,
        [{"length": 0.1}],
        [[0.0]],
        curve=curve,
        spent=SPENT,
    )


def test_regret_area_and_steps_follow_from_the_curves(monkeypatch):
    monkeypatch.setattr(regret, "bounds_share", lambda *_: 0.0)
    first = [make_run("a", seed, [[600, 1.0, -4.0], [6000, 2.0, -2.0]]) for seed in (0, 1)]
    second = [make_run("b", seed, [[600, 1.0, -4.0], [1200, 2.0, -3.0]]) for seed in (0, 1)]
    a, b = regret.method_rows([(each, None) for each in (*first, *second)])
    assert (a.regret.value, b.regret.value) == (0.0, 0.5)
    assert (a.steps, a.seconds) == (6000, 2.0) and np.isinf(b.steps)
    limit = SPENT["environment_steps"]
    assert a.area == pytest.approx(np.log(10) / np.log(limit / 600))
    assert b.area == pytest.approx((np.log(2) + 0.5 * np.log(limit / 1200)) / np.log(limit / 600))


def test_runs_resume_and_become_a_table(tiny, tmp_path):
    found = runs.run(tmp_path, "tiny-v1", "random", None, "small", 0)
    path = next(tmp_path.glob("runs/tiny-v1/*.json"))
    stamp = path.stat().st_mtime_ns
    assert runs.run(tmp_path, "tiny-v1", "random", None, "small", 0) == found
    assert path.stat().st_mtime_ns == stamp
    runs.collect(tmp_path, tmp_path)
    assert runs.stored_runs(tmp_path) == [(found, None)]
    runs.collect(tmp_path / "absent", tmp_path)  # adds nothing, and keeps what is stored
    assert runs.stored_runs(tmp_path) == [(found, None)]
    text = board.method_table(runs.stored_runs(tmp_path), tmp_path)
    assert "| `tiny-v1` | shared | random | 1 |" in text and "not tested" in text


def test_a_table_is_extended(tiny, tmp_path):
    output = tmp_path / "tiny.parquet"
    tabulate("tiny-v1", {"rest": 3, "qp": 1}, tmp_path / "first", output, longest=0.5)
    first = Table.read("tiny-v1", output)
    again = tmp_path / "again"
    tabulate("tiny-v1", {"rest": 2, "qp": 2}, again, output, longest=0.5)
    assert [path.name for path in again.glob("tables/**/*.npz")] == ["qp-0000000-2.npz"]
    table = Table.read("tiny-v1", output)
    assert np.array_equal(table.values["rest"], first.values["rest"]) and np.array_equal(table.points, first.points)
    assert np.isfinite(table.values["qp"][:, 0]).tolist() == [True, True, False]
    tabulate("tiny-v1", {"rest": 1}, again, output, longest=0.25)  # other steps may end elsewhere: begins anew
    assert len(Table.read("tiny-v1", output)) == 1


def test_the_best_bodies_of_the_learned_models_are_scored_besides(tiny, tmp_path):
    output = tmp_path / "tiny.parquet"
    tabulate("tiny-v1", {"rest": 6, "rest_accurate": 5}, tmp_path, output, longest=0.5, best={"qp": 1})
    table = Table.read("tiny-v1", output)
    best = {int(np.nanargmin(table.values[judge][:, 0])) for judge in ("rest", "rest_accurate")}
    assert set(np.flatnonzero(np.isfinite(table.values["qp"][:, 0]))) == best
    assert table.first == {"rest": 6, "rest_accurate": 5}
    # Another mesh is another body.
    assert not np.allclose(table.values["rest"][:5, 0], table.values["rest_accurate"][:5, 0], rtol=0.02)
    tabulate("tiny-v1", {"qp": 2}, tmp_path, output, longest=0.5)  # the first ones, whatever was chosen before
    assert np.isfinite(Table.read("tiny-v1", output).values["qp"][:, 0]).nonzero()[0].tolist() == sorted({0, 1} | best)


def test_a_slow_judge_scores_a_sample_over_the_ranks(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(table_module, "FEW", 1)
    output = tmp_path / "tiny.parquet"
    tabulate("tiny-v1", {"rest": 40}, tmp_path, output, longest=0.5, ranked={"rest_few": 2})
    short = Table.read("tiny-v1", output)
    tabulate("tiny-v1", {"rest": 40}, tmp_path, output, longest=0.5, ranked={"rest_few": 4})
    table = Table.read("tiny-v1", output)
    every, best = (table.samples["rest_few"][share] for share in ("1", "0.1"))
    assert every[:2] == short.samples["rest_few"]["1"] and best[:2] == short.samples["rest_few"]["0.1"]
    ranks = np.argsort(np.argsort(table.values["rest"][:, 0]))
    assert sorted(ranks[every] // 10) == [0, 1, 2, 3] and sorted(ranks[best]) == [0, 1, 2, 3]  # one from each part
    assert set(np.flatnonzero(np.isfinite(table.values["rest_few"][:, 0]))) == {*every, *best}
    first_goal = replace(tiny.evaluator("search"), goals=tiny.goals["search"][:1])
    exact = first_goal(tiny.design(table.points[best[0]]), "qp").values["mean_distance"]
    assert table.values["rest_few"][best[0], 0] == pytest.approx(exact, rel=1e-4)
    solved = table_module.Tabulation(tiny, 0.5).few.fem(None, table.points[best[:2]])
    assert np.allclose(solved[:, 0], table.values["rest_few"][best[:2], 0], atol=1e-4)
    assert table.agreement("rest", "rest_few").bodies == table.agreement("rest", "rest_few", 0.1).bodies == 4
    with pytest.raises(ValueError, match="a sample of 5 of the best bodies needs 50 bodies of 'rest'"):
        tabulate("tiny-v1", {"rest": 40}, tmp_path, output, longest=0.5, ranked={"rest_few": 5})


def test_kendalls_tau_of_a_sample_has_an_interval(tiny):
    rng = np.random.default_rng(0)
    first = rng.random((60, 3))
    table = Table(tiny, rng.random((60, 3)), {"rest": first, "qp": first + 0.3 * rng.random((60, 3))})
    found = table.agreement("rest", "qp")
    assert found.bodies == 60 and 0.4 < found.interval[0] < found.tau < found.interval[1] < 0.9
    assert found.interval[1] - found.interval[0] < 0.3
    same = Table(tiny, table.points, {"rest": first, "qp": first}).agreement("rest", "qp")
    assert [same.tau, *same.interval] == pytest.approx([1.0, 1.0, 1.0])


def test_tables(tiny, tmp_path):
    output = tmp_path / "tiny.parquet"
    counts = {"shared": 70, "qp": 2, "rest": 3, "trained": 1, "fem": 2}
    tabulate("tiny-v1", counts, tmp_path, output, longest=0.5)
    parts = {path: path.stat().st_mtime_ns for path in tmp_path.glob("tables/**/*.npz")}
    assert len(parts) == 6  # two of the shared policy, one of each other judge
    tabulate("tiny-v1", counts, tmp_path, output, longest=0.5)
    assert {path: path.stat().st_mtime_ns for path in parts} == parts
    table = Table.read("tiny-v1", output)
    assert len(table) == 70 and np.isfinite(table.values["qp"][:, 0]).sum() == 2
    for listed, judge, index in (
        ("shared", "shared", 69),
        ("qp", "qp", 1),
        ("rest", "qp", 2),
        ("trained", "trained", 0),
    ):
        design = tiny.design(table.points[index])
        exact = tiny.evaluate(design, judge=judge).values["mean_distance"]
        assert table.lookup(table.points[index : index + 1], listed)[0, 0] == pytest.approx(exact, rel=1e-4)
    exact = tiny.evaluator("search", "fem")(tiny.design(table.points[1]), "qp").values["mean_distance"]
    assert table.lookup(table.points[1:2], "fem")[0, 0] == pytest.approx(exact, abs=1e-7)
    with pytest.raises(ValueError, match=r"unknown judge of tables 'rst'; did you mean 'rest'"):
        tabulate("tiny-v1", {"rst": 1}, tmp_path, output)
    found = table.agreement("rest", "fem")
    assert found.bodies == 2 and np.isnan(found.tau) and abs(found.bias) < 1e-4
    distances = {"rest": np.array([[1.0], [2.0], [3.0], [np.nan]]), "qp": np.array([[2.0], [4.0], [3.0], [1.0]])}
    found, best = (Table(tiny, table.points[:4], distances).agreement("rest", "qp", share) for share in (1.0, 0.5))
    assert (found.bodies, found.tau, found.bias) == (3, pytest.approx(1 / 3), 1.0) and np.isnan(found.interval).all()
    assert (best.bodies, best.bias) == (2, 1.5)
    search = TableSearch.on(table, "small", "shared")
    solve(search, make_optimiser("tpe", tiny, 0))
    assert len(search.ledger) == 7 and search.best is not None
    listed = {tuple(np.round(list(tiny.design(point).values()), 9)) for point in table.points}
    assert all(tuple(np.round(list(row.design.values()), 9)) in listed for row in search.ledger)
    found = runs.run(tmp_path, "tiny-v1", "random", "shared", "small", 1, table)
    assert found.optimum == pytest.approx(-table.values["shared"][:, 0].min())
    assert found.curve[-1][2] == max(score[0] for score in found.search_scores) <= found.optimum
    (row,) = regret.method_rows([(found, None)])
    assert row.table and 0.0 <= row.regret.value <= 1.0
    with pytest.raises(DataError, match="cannot be read"):
        Table.read("tiny-v1", tmp_path / "absent.parquet")


def make_front(method, seed, scores):
    designs = [{"length": 0.1}] * len(scores)
    return runs.Run(
        "finger-front-v1", "0", method, "qp", "small", seed, designs, scores, spent=SPENT, baseline=[-1.0, -2.0]
    )


def test_regret_of_fronts_is_that_of_their_hypervolume():
    first, second = make_front("a", 0, [[-1.0, -2.0]]), make_front("b", 0, [[-0.5, -2.0], [-1.0, -1.0]])
    third = make_front("c", 0, [[-0.5, -2.0]])
    (contest,) = regret.contests([(first, None), (second, None), (third, None)])
    # In units of the baseline, up to twice its values: 1 for the baseline, 1.5 for one body, 2 for both.
    assert [float(contest.regrets(m)[0]) for m in "abc"] == [1.0, 0.0, pytest.approx(0.5)]
    assert "| 50.0 |" in board.regret_table([(each, None) for each in (first, second, third)])


def test_tracks_compare_with_random_search():
    def rows(method, ends):
        return [(make_run(method, seed, [[600, 1.0, -4.0], [6000, 2.0, end]]), None) for seed, end in enumerate(ends)]

    stored = [*rows("random", [-3.0, -3.0, -3.0]), *rows("tpe", [-2.0, -2.5, -2.5]), *rows("cmaes", [-3.0] * 3)]
    found = {row.method: row for row in regret.track_rows(stored)}
    assert found["tpe"].regret.value == pytest.approx(0.5 / 3 + 1e-9, abs=0.1)
    assert (found["tpe"].improvement.value, found["cmaes"].improvement.value) == (1.0, 0.5)
    assert (found["tpe"].wins, found["random"].wins, found["cmaes"].wins) == (1, 0, 0)
    assert found["tpe"].track == "A" and found["tpe"].seeds == 3
    assert found["tpe"].factor == pytest.approx(found["random"].regret.value / found["tpe"].regret.value)
    assert "| A | qp | 1 x 3 | tpe |" in board.track_table(stored)
    assert regret.track_rows(rows("tpe", [-2.0])) == []


def test_unseen_goals_tell_winners_that_fit_the_search_goals_only():
    stored = []
    for seed, (method, unseen) in enumerate((("a", [-4.0, -2.0]), ("b", [-4.0, -5.0]))):
        run = make_run(method, seed, [[600, 1.0, -4.0], [6000, 2.0, -1.0]])
        run.unseen = unseen
        stored.append((run, None))
    (contest,) = regret.contests(stored)
    assert [float(contest.regrets(m)[0]) for m in "ab"] == [0.0, 0.0]
    assert [float(contest.unseen(m)[0]) for m in "ab"] == [0.5, 1.25]
    assert "| 50.0 | 125.0 |" in board.regret_table(stored, unseen=True)


def test_stored_runs_are_of_the_problems_as_they_are_frozen():
    hashes = {run.problem: run.hash for run, _ in runs.stored_runs()}
    assert {name: load_problem(name).hash for name in hashes} == hashes
