"""Frozen problems: nothing that decides a score may change unnoticed, and searches keep to their budget."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import yaml

from softgym_envs.errors import ConfigError, DataError, DesignError
from softgym_envs.extensions.leaderboard import Search, load_problem, problem_names
from softgym_envs.extensions.leaderboard.frozen import freeze, load_definition
from softgym_envs.extensions.leaderboard.problem import GOAL_SETS, TRACKS, JudgedScore, goal_key
from softgym_envs.extensions.leaderboard.search import METHODS, BudgetSpent, make_optimiser, solve
from softgym_envs.extensions.leaderboard.together import MOTIONS
from tests.extensions.leaderboard.conftest import tiny_definition

NAMES = problem_names()


def test_there_are_at_least_twelve_problems_in_all_tracks():
    definitions = [load_definition(name) for name in NAMES]
    assert len(NAMES) >= 12
    assert {definition.track for definition in definitions} == set(TRACKS)
    assert len({definition.robot.name for definition in definitions}) >= 7


@pytest.mark.parametrize("name", NAMES)
def test_what_decides_a_score_is_what_was_frozen(name):
    """After a deliberate change: softgym benchmark freeze NAME, and a new version once the suite is released."""
    problem = load_problem(name)
    for key in GOAL_SETS:
        assert len(problem.goals[key]) == problem.definition.goals[key].count
    if not problem.single_path:
        keys = [goal_key(goal) for key in GOAL_SETS for goal in problem.goals[key]]
        assert len(keys) == len(set(keys))
    assert set(problem.definition.baseline_values) == set(problem.variables)


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"variables": ["length", "height"]}, "definition"),
        ({"environment": {"id": "SoftGym/FingerReach-v0", "robot_options": {"unilateral": False}}}, "definition"),
        ({"policy": "finger_reach"}, "policy"),
    ],
)
def test_a_change_is_found(tiny, problems, change, part):
    (problems / "tiny-v1.yaml").write_text(yaml.safe_dump(tiny_definition(**change)))
    with pytest.raises(DataError, match=rf"problem 'tiny-v1' differs from what was frozen in: .*{part}"):
        load_problem("tiny-v1")


def test_a_changed_goal_is_found(tiny, problems):
    path = problems / "tiny-v1.json"
    x = repr(float(tiny.goals["test"][0, 0, 0]))
    text = path.read_text()
    assert x in text
    path.write_text(text.replace(x, repr(float(x) + 1e-5)))
    with pytest.raises(DataError, match=r"differs from what was frozen in: goals"):
        load_problem("tiny-v1")


def test_freezing_again_gives_the_same_problem(tiny):
    freeze("tiny-v1")
    assert load_problem("tiny-v1").hash == tiny.hash


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "tiny"}, "name"),
        ({"judge": "qp", "track": "C"}, "secondary_objectives"),
        ({"policy": None}, "judge 'shared' needs a 'policy'"),
        ({"goals": {"test": {"source": "family", "count": 1, "seed": 1}}}, "goals must have the sets"),
    ],
)
def test_definitions_are_checked(problems, change, message):
    (problems / "tiny-v1.yaml").write_text(yaml.safe_dump(tiny_definition(**change)))
    with pytest.raises(ConfigError, match=message):
        load_definition("tiny-v1")


def test_unknown_problems_and_problems_that_are_not_frozen(problems):
    with pytest.raises(ConfigError, match=r"unknown problem 'tyny-v1'; did you mean 'tiny-v1'"):
        load_problem("tyny-v1")
    with pytest.raises(DataError, match=r"'tiny-v1' is not frozen; run: softgym benchmark freeze tiny-v1"):
        load_problem("tiny-v1")


def test_an_evaluation_counts_what_it_costs(tiny):
    baseline = tiny.definition.baseline_values
    whole, half = tiny.evaluate(baseline), tiny.evaluate(baseline, 0.5)
    assert (whole.environment_steps, half.environment_steps) == (100, 50)
    assert whole.fem_solves == 0 and whole.score == -whole.values["mean_distance"] < 0.0
    assert tiny.evaluate(baseline).score == whole.score
    with pytest.raises(DesignError, match=r"'length' = 1 m is out of bounds"):
        tiny.evaluate({**baseline, "length": 1.0})
    with pytest.raises(DesignError, match=r"the design lacks height"):
        tiny.evaluate({name: value for name, value in baseline.items() if name != "height"})
    with pytest.raises(ValueError, match=r"budget = 0 must be a share in \(0, 1\]"):
        tiny.evaluate(baseline, 0)
    with pytest.raises(ValueError, match=r"unknown judge 'pq'; allowed: qp, shared, trained"):
        tiny.evaluate(baseline, judge="pq")


JOINT = ("critic", "distribution")
TOGETHER = ("together", "evolution")
PACKAGES = {"botorch": "botorch", "smac": "smac", "map_elites": "ribs", "cma_me": "ribs"}


@pytest.mark.parametrize("method", [method for method in METHODS if method not in JOINT + TOGETHER])
def test_each_baseline_solves_and_repeats_itself(tiny, method):
    if method in PACKAGES:
        pytest.importorskip(PACKAGES[method])
    found = []
    for _ in range(2):
        search = Search(tiny)
        solve(search, make_optimiser(method, tiny, 3))
        found.append(search)
    assert [row.design for row in found[0].ledger] == [row.design for row in found[1].ledger]
    assert found[0].ledger[0].design == tiny.definition.baseline_values
    whole = [row for row in found[0].ledger if row.share == 1.0]
    spent, scores = found[0].spent["environment_steps"], sum(max(50, 100 * row.share) for row in found[0].ledger)
    assert 700 <= spent and (spent > scores if method == "gradient" else spent == scores < 800)
    assert found[0].best.score == max(row.score for row in whole)
    with pytest.raises(BudgetSpent, match=r"the budget 'small' is spent \(environment_steps = 7"):
        found[0].evaluate(tiny.definition.baseline_values)


@pytest.mark.parametrize("method", TOGETHER)
def test_body_and_gait_are_searched_together_and_the_judge_gives_another_gait(method, monkeypatch):
    monkeypatch.setitem(MOTIONS, "ascend", 2)
    monkeypatch.setitem(MOTIONS, "evolve", 15)  # one generation of 14
    problem, found = load_problem("swimmer-swim-v1"), []
    for _ in range(2):
        optimiser = make_optimiser(method, problem, 0)
        found.append(optimiser.ask())
        steps, seconds = optimiser.take_charge()
        assert steps == 60 * {"together": 2, "evolution": 14}[method] and seconds > 0.0
        assert optimiser.take_charge() == (0, 0.0)
    assert found[0] == found[1] and set(found[0]) == set(problem.variables)
    search = Search(problem, limit=2)
    solve(search, optimiser)  # one more search, of the motions that are left for it
    first, second = search.ledger
    assert first.environment_steps == first.fem_solves == second.fem_solves == 1_200 + 100 + 100
    assert second.environment_steps == 1_400 + {"together": 60, "evolution": 0}[method]
    assert problem.evaluate(second.design).scores == second.scores  # its own gait is forgotten
    with pytest.raises(ValueError, match=r"learner 'analytic' has no gait .*; allowed: gait"):
        make_optimiser(method, load_problem("finger-control-v1"), 0)


def test_bodies_that_move_are_judged_by_the_plain_gait_or_by_their_own():
    definition = load_definition("swimmer-swim-v1")
    assert definition.judges == ("qp", "trained")
    problem = load_problem("swimmer-swim-v1")
    plain, own = (problem.evaluate(definition.baseline_values, judge=judge).score for judge in definition.judges)
    assert own > 2.0 * plain > 0.0


def test_points_of_the_unit_box(tiny):
    low, high = (tiny.design(np.full(3, sign)) for sign in (-1.0, 1.0))
    for name, variable in tiny.definition.optimised.items():
        assert (low[name], high[name]) == (pytest.approx(variable.low), pytest.approx(variable.high))


def test_a_limit_of_bodies_counts_shares():
    search = Search(load_problem("finger-zone-v1"), limit=2)
    search.ledger = [JudgedScore("qp"), *(JudgedScore("qp", share=0.25) for _ in range(3))]
    assert search.open
    search.ledger.append(JudgedScore("qp", share=0.25))
    assert not search.open


@pytest.mark.parametrize("method", ["halving", "hyperband"])
def test_halving_scores_only_promising_bodies_on_all_goals(method):
    problem = load_problem("finger-zone-v1")
    optimiser, told = make_optimiser(method, problem, 0), []
    for _ in range(300):  # one of the brackets of Hyperband stops no body after the first score
        share, design = optimiser.share, dict(optimiser.ask())
        told.append(JudgedScore("qp", share, design=design, scores=[-design["length"]]))
        optimiser.tell(told[-1])
    shares = [row.share for row in told]
    assert shares.count(0.25) > shares.count(0.5) > shares.count(1.0) >= 1
    for first, second in itertools.pairwise(told):
        assert second.share == 0.25 or (second.share == 2.0 * first.share and second.design == first.design)
    kept, all_ = ([row.design["length"] for row in told if row.share == share] for share in (0.5, 0.25))
    assert np.mean(kept) < np.mean(all_)  # short bodies score better here


@pytest.mark.parametrize("method", PACKAGES)
def test_methods_of_other_packages_find_a_better_body_than_the_baseline(method):
    """A smooth score without a simulator; 40 bodies are enough for every seed that was tried."""
    pytest.importorskip(PACKAGES[method])
    problem = load_problem("finger-zone-v1")
    optimiser, scores = make_optimiser(method, problem, 0), []
    optimised = problem.definition.optimised
    for _ in range(40):
        design = dict(optimiser.ask())
        point = np.array([float(optimised[name].to_unit(value)) for name, value in design.items()])
        assert np.abs(point).max() <= 1.0 + 1e-9
        infeasible = "none" if point[0] > 0.9 else None
        scores.append(-float(np.sum((point - 0.5) ** 2)))
        optimiser.tell(JudgedScore("qp", design=design, scores=[] if infeasible else scores[-1:], reason=infeasible))
    assert max(scores) > -0.75  # that of the middle of the box


@pytest.mark.parametrize("method", JOINT)
def test_joint_methods_train_first_and_count_the_steps(tiny, problems, method):
    from softgym_envs.extensions.leaderboard.joint import EPISODES, REPORTS, JointOptimiser

    optimiser = JointOptimiser(tiny, 0, method, steps=300)
    optimiser.steps_left = 100.0
    with pytest.raises(ValueError, match="100 environment steps are left, too few for a joint training"):
        optimiser.ask()
    optimiser.steps_left = 10_000.0
    bodies = [dict(optimiser.ask()) for _ in range(2)]
    assert all(tiny.definition.checked(body) == pytest.approx(body) for body in bodies) and bodies[0] != bodies[1]
    steps, seconds = optimiser.take_charge()
    assert steps == 300 + REPORTS * EPISODES * tiny.definition.episode_steps and seconds > 0.0
    assert optimiser.take_charge() == (0, 0.0)


def test_children_inherit_the_policies_of_their_parents(tiny, monkeypatch):
    from softgym_envs.extensions.leaderboard import problem as module

    started, real = [], module.train
    monkeypatch.setattr(
        module, "train", lambda *args, **keys: started.append(str(keys["initial"])) or real(*args, **keys)
    )
    definition = tiny.definition.model_copy(
        update={
            "training": tiny.definition.training.model_copy(update={"steps": 256, "report_every": 256}),
            "budgets": {
                **tiny.definition.budgets,
                "small": tiny.definition.budgets["small"].model_copy(update={"environment_steps": 100_000}),
            },
        }
    )
    problem = replace(tiny, definition=definition)
    search = Search(problem, judge="trained", limit=8)
    solve(search, make_optimiser("inheritance", problem, 0))
    assert started[:7] == [definition.policy] * 7  # the baseline and the first six bodies
    assert started[7].endswith("policy.safetensors") and started[7] != definition.policy
