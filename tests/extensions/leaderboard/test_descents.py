"""The gradient method: its derivatives, its score at rest, and what it pays."""

import numpy as np
import pytest

from softgym_envs.extensions.leaderboard.descents import SettledCost
from softgym_envs.extensions.leaderboard.frozen import load_problem
from softgym_envs.extensions.leaderboard.search import Search, make_optimiser, solve


@pytest.mark.parametrize(
    ("name", "body"), [("finger-zone-v1", 0), ("diamond-reach-v1", 0), ("cable-trunk-reach-v3", 2)]
)
def test_gradients_agree_with_differences_and_the_score_with_episodes(name, body):
    """Bodies 0, 6 and 7 of the cable trunk stop short of a goal in large steps, which episodes reach in small ones."""
    problem = load_problem(name)
    cost = SettledCost(problem)
    point = np.random.default_rng(body).uniform(-0.9, 0.9, len(problem.variables))
    value, gradient = cost.with_gradient(point)
    steps = 1e-3 * np.eye(len(point))
    differences = [(cost.with_gradient(point + s)[0] - cost.with_gradient(point - s)[0]) / 2e-3 for s in steps]
    assert gradient == pytest.approx(differences, rel=0.02, abs=0.02 * np.abs(gradient).max())
    design = {variable: cost.box.design(point)[variable] for variable in problem.variables}
    episodes, baseline = (problem.evaluate(d, judge="qp") for d in (design, problem.definition.baseline_values))
    assert value * -baseline.score == pytest.approx(-episodes.score, rel=0.01)


def test_a_search_pays_for_its_gradients_and_keeps_to_its_budget():
    problem = load_problem("finger-zone-v1")
    search = Search(problem, "small", "qp", limit=6)
    own = solve(search, make_optimiser("gradient", problem, 0))
    episode = search.ledger[0].environment_steps
    assert search.ledger[1].environment_steps > episode and len(search.ledger) < 6
    assert 5 * episode < search.spent["environment_steps"] < 7 * episode
    assert not search.open and own >= 0.0
    assert search.best.score > 1.1 * search.ledger[0].score  # scores are negative distances


def test_problems_without_a_distance_to_points_are_refused():
    for name, message in (("finger-press-v2", "distance to points"), ("finger-front-v1", "unknown method 'gradient'")):
        with pytest.raises(ValueError, match=message):
            make_optimiser("gradient", load_problem(name), 0)
