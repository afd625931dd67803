"""Winners on finite elements."""

import dataclasses
import math

import pytest

from softgym_envs.errors import DataError
from softgym_envs.extensions.leaderboard import board, frozen, references, refreeze, runs, scoring, winners


def test_winners_are_scored_on_both_models_and_stored(tiny, tmp_path):
    for seed in (0, 1, 2):
        runs.run(tmp_path, "tiny-v1", "random", "qp", "small", seed)
    runs.collect(tmp_path, tmp_path)
    (median,) = winners.check(tmp_path, "tiny-v1", data=tmp_path)
    every = winners.check(tmp_path, "tiny-v1", ["random"], data=tmp_path)
    assert [row.seed for row in every] == [0, 1, 2] and [row for row in every if row.median] == [median]
    assert sorted(row.surrogate for row in every)[1] == median.surrogate
    assert abs(median.exploitation) < 0.1 * abs(median.fem)
    (settled,) = winners.check(tmp_path, "tiny-v1", data=tmp_path, rest=True)
    assert settled.rest and settled.fem == pytest.approx(median.fem, abs=2e-6)
    assert settled.surrogate == pytest.approx(median.surrogate, abs=1e-6)
    winners.store([median], tmp_path)
    winners.store(every, tmp_path)
    assert winners.stored_winners(tmp_path) == every
    text = board.winners_table(tmp_path)
    assert "| `tiny-v1` | random |" in text and "3 winners" in text
    assert -1.0 <= winners.rank_correlation(every) <= 1.0 and math.isnan(winners.rank_correlation(every[:2]))


def test_a_problem_frozen_again_keeps_results_that_are_still_true(tiny, problems, tmp_path):
    with pytest.raises(DataError, match="no winner is stored that could be scored again"):
        refreeze.refreeze("tiny-v1", data=tmp_path)
    run = runs.run(tmp_path, "tiny-v1", "random", "shared", "small", 0)
    runs.collect(tmp_path, tmp_path)
    path = problems / "tiny-v1.json"
    path.write_text(path.read_text().replace(tiny.parts["weights"], "0" * 32))  # as after another calibration
    stale = frozen.load_problem("tiny-v1", check=False).hash
    stored = tmp_path / "runs.json"
    stored.write_text(stored.read_text().replace(tiny.hash, stale))
    assert refreeze.refreeze("tiny-v1", data=tmp_path) == [stored]
    assert frozen.load_problem("tiny-v1").hash == tiny.hash
    ((kept, _),) = runs.stored_runs(tmp_path)
    assert kept == run and kept.hash == tiny.hash
    text = stored.read_text()
    stored.write_text(text.replace(repr(run.search_scores[0][0]), repr(1.01 * run.search_scores[0][0])))
    with pytest.raises(DataError, match="this is another problem and needs a new version"):
        refreeze.refreeze("tiny-v1", data=tmp_path)


def test_another_policy_for_all_bodies_needs_a_new_version(tiny, problems, tmp_path):
    runs.run(tmp_path, "tiny-v1", "random", "qp", "small", 0)  # the inverse QP does not notice the policy
    stored = runs.collect(tmp_path, tmp_path)
    path = problems / "tiny-v1.json"
    path.write_text(path.read_text().replace(tiny.parts["policy"], "0" * 32))
    stale = frozen.load_problem("tiny-v1", check=False).hash
    stored.write_text(stored.read_text().replace(tiny.hash, stale))
    with pytest.raises(DataError, match="the shared policy is another one"):
        refreeze.refreeze("tiny-v1", data=tmp_path)
    assert stale in stored.read_text()


def test_runs_of_a_version_that_is_no_longer_offered_are_dropped(tiny, problems, tmp_path):
    runs.run(tmp_path, "tiny-v1", "random", "shared", "small", 0)
    stored = runs.collect(tmp_path, tmp_path)
    assert len(runs.stored_runs(tmp_path)) == 1
    (problems / "tiny-v1.yaml").rename(problems / "tiny-v2.yaml")
    assert runs.collect(tmp_path, tmp_path) == stored and runs.stored_runs(tmp_path) == []


def test_problems_without_stored_searches_are_refused(tiny, tmp_path):
    with pytest.raises(ValueError, match="no searches"):
        winners.check(tmp_path, "tiny-v1", data=tmp_path)


def test_the_most_promising_winner_becomes_the_best_known(tiny, tmp_path):
    with pytest.raises(ValueError, match="no searches are stored"):
        references.promising("tiny-v1", tmp_path)
    good, poor = {"length": 0.038, "height": 0.022, "joint_height": 0.005}, tiny.definition.baseline_values
    for seed, (design, score, unseen) in enumerate([(poor, -1.0, -4.0), (good, -2.0, -3.0)]):  # unseen goals decide
        curve = [[100, 1.0, -5.0], [200, 2.0, score]]
        made = runs.Run("tiny-v1", tiny.hash, "random", "qp", "small", seed, [design], [[score]], curve, [-4.0, unseen])
        made.write(tmp_path / "runs" / "tiny-v1" / f"{seed}.json")
    runs.collect(tmp_path, tmp_path)
    best = references.promising("tiny-v1", tmp_path)
    assert best.designs == [good]
    references.check_winners(tmp_path, [best], tmp_path)
    known = scoring.reference(tiny, tmp_path)
    assert known.designs == [good] and known.best[0] > known.baseline
    worse = dataclasses.replace(best, designs=[poor])
    references.check_winners(tmp_path, [worse], tmp_path)
    assert scoring.reference(tiny, tmp_path) == known  # the better body stays
    assert "| random, judge qp | - |" in board.reference_table(tmp_path)
