"""What a report concludes from results, and what it draws; the studies are written by hand."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from softgym_envs.agents.evaluation import Evaluation
from softgym_envs.codesign.collect import collect
from softgym_envs.codesign.records import FinalistTest, TrialResult
from softgym_envs.codesign.snapshot import load_study
from softgym_envs.extensions.report.episodes import Episode, typical_goal
from softgym_envs.extensions.report.figures import search_figures
from softgym_envs.extensions.report.findings import findings
from softgym_envs.extensions.report.motion import goal_outcomes, goal_views, motion
from softgym_envs.extensions.report.sentences import headline
from softgym_envs.extensions.report.tables import effort_rows
from softgym_envs.mechanics import Plane
from softgym_envs.wording import time_text

BOX = {"height": (0.020, 0.022), "joint_height": (0.005, 0.008)}


def evaluation(distances):
    distances = np.asarray(distances, dtype=float)
    ones = np.ones(len(distances))
    ends = distances[:, None] * [0.0, 0.6, -0.8]  # any point
    largest = 3.0 + ones.cumsum()
    return Evaluation(distances, distances, ones, distances < 2e-3, ones, ends, steps=1, largest_efforts=largest)


def write_trial(folder, number, score, place, controller="qp"):
    """Write the result of a trial whose variables lie at a place in [0, 1]^2 of their ranges."""
    design = {name: low + p * (high - low) for (name, (low, high)), p in zip(BOX.items(), place, strict=True)}
    TrialResult(
        number=number,
        origin="baseline" if number == 0 else f"sampler {number}",
        process="",
        design={**folder.config.baseline, **design},
        values={"mean_distance": score, "mean_effort": score},
        scores=[-score],
        controller=controller,
        evaluation=evaluation([score]),
    ).write(folder.trial(number) / "result.json")


def write_test(folder, number, agent, distances):
    values = dict.fromkeys(("mean_distance", "mean_effort"), float(np.mean(distances)))
    test = FinalistTest(number, agent, "fem", "unseen", 0, evaluation(distances), values, list(distances))
    test.write(folder.path / "finalists" / f"trial{number:04d}-{agent}-fem-unseen.json")


@pytest.fixture
def tested(study):
    """Function ``tested(policy, qp, place) -> snapshot``: baseline and winner on six goals, distances in metres."""

    def make(policy, qp, place=(0.5, 0.5), **changes):
        goals = {"count": 3, "unseen_count": 6, "training_count": 1}
        folder = study(finalists={"count": 1}, goals=goals, **changes)
        (folder.path / "trials").mkdir(exist_ok=True)
        write_trial(folder, 0, 5e-3, (0.0, 0.3), controller="a policy")
        write_trial(folder, 1, 1e-3, place, controller="a policy")
        for agent in ("policy", "qp"):
            write_test(folder, 0, agent, [5e-3, 1e-3, 5e-3, 5e-3, 5e-3, 5e-3])
        write_test(folder, 1, "policy", policy)
        write_test(folder, 1, "qp", qp)
        return load_study(folder)

    return make


def titles(snapshot):
    return [finding.title for finding in findings(snapshot, collect(snapshot))]


FAR, NEAR = np.full(6, 4e-3), np.full(6, 1e-3)
WIGGLE = 1e-5 * np.arange(6)


def test_the_body_limits_if_the_inverse_qp_does_no_better(tested):
    found = titles(tested(FAR, FAR - 1e-4 + WIGGLE))
    assert "6 of 6 test goals are not reached" in found
    assert "The body limits, not the policy" in found


def test_the_policy_limits_if_the_inverse_qp_does_better(tested):
    assert "The policy limits, not the body" in titles(tested(FAR, NEAR + WIGGLE))


def test_nothing_limits_if_every_goal_is_reached(tested):
    found = titles(tested(NEAR, NEAR))
    assert "Every test goal is reached" in found
    assert not any("limits" in title for title in found)


@pytest.mark.parametrize("second, lost", [(1e-3, False), (4e-3, True)])
def test_goals_that_only_the_baseline_reaches_are_counted(tested, second, lost):
    snapshot = tested([1e-3, second, 4e-3, 4e-3, 4e-3, 1e-3], FAR)  # the baseline reaches the second goal only
    assert ("The baseline reaches 1 of them." in findings(snapshot, collect(snapshot))[0].text) == lost


@pytest.mark.parametrize("place, count", [((0.5, 0.5), 0), ((0.0, 0.5), 1), ((1.0, 0.0), 2)])
def test_variables_at_a_limit_are_named(tested, place, count):
    snapshot = tested(FAR, FAR, place)
    found = [finding for finding in findings(snapshot, collect(snapshot)) if "at a limit" in finding.title]
    assert [finding.title for finding in found] == ([f"{count} of 2 variables at a limit"] if count else [])
    assert not count or ("lower limit of 20.00 mm" in found[0].text) == (place[0] == 0.0)


def test_a_typical_goal_has_the_median_gain(tested):
    # The gains are -3, 0, 1, 2, 3 and 4 mm: the upper median belongs to the goal with 2 mm.
    snapshot = tested([8e-3, 1e-3, 4e-3, 3e-3, 2e-3, 1e-3], FAR)
    assert typical_goal(snapshot, collect(snapshot)) == 3


def test_a_typical_goal_is_one_that_the_baseline_misses(tested):
    # The gains are -3, 0, -2, -1, 1 and 2 mm. The baseline reaches only the goal with 0 mm, the upper median of all.
    snapshot = tested([8e-3, 1e-3, 7e-3, 6e-3, 4e-3, 3e-3], FAR)
    assert typical_goal(snapshot, collect(snapshot)) == 3


@pytest.mark.parametrize("secondary", [[], ["material_volume"]])
def test_the_history_follows_the_direction_of_the_first_objective(study, secondary):
    folder = study(objective="success_rate", secondary_objectives=secondary, finalists={"count": 0})
    (folder.path / "trials").mkdir(exist_ok=True)
    for number, rate in enumerate([0.5, 0.25, 0.75, 0.5]):
        write_trial(folder, number, 1e-3, (0.1 * number, 0.5))
        path = folder.trial(number) / "result.json"
        values = {"success_rate": rate, "mean_distance": 1e-3, "material_volume": 2e-5 - 1e-6 * number}
        replace(TrialResult.read(path), values=values, scores=[rate, -2e-5][: 1 + len(secondary)]).write(path)
    snapshot = load_study(folder)
    figures = dict(search_figures(snapshot, collect(snapshot)))
    history = {trace.name: list(trace.y) for trace in figures["Every trial, and the best so far"].data}
    assert history["best so far"] == [50.0, 50.0, 75.0, 75.0]
    assert ("Several objectives" in figures) == bool(secondary)


def test_outcomes_of_goals(tested):
    snapshot = tested([1e-3, 1e-3, 4e-3, 4e-3, 4e-3, 1e-3], FAR)  # the baseline reaches the second goal only
    outcomes = goal_outcomes(snapshot, collect(snapshot))
    assert outcomes.kinds.tolist() == [1, 0, 3, 3, 3, 1]
    assert [(text, count) for _, _, text, count in outcomes.legend] == [
        ("reached by both", 1),
        ("reached by the winner only", 2),
        ("reached by neither", 3),
    ]
    views = goal_views(outcomes)
    assert 1 <= len(views) <= 3
    for plane, figure in views:
        traces = {trace.name: trace for trace in figure.data}
        ends = {name: traces.pop(f"end of the {name}") for name in ("baseline", "winner")}
        assert sum(len(trace.x) for trace in traces.values()) == 6
        goals = 1e3 * snapshot.folder.goals["unseen"][:, -1, "xyz".index(plane[0])]
        for name, distances in (("baseline", [5, 1, 5, 5, 5, 5]), ("winner", [1, 1, 4, 4, 4, 1])):
            assert list(ends[name].x[0::3]) == pytest.approx(goals) and set(ends[name].x[2::3]) == {None}
            if plane == "yz":
                assert list(ends[name].x[1::3]) == pytest.approx(0.6 * np.array(distances))
                assert list(ends[name].y[1::3]) == pytest.approx(-0.8 * np.array(distances))
    assert "yz" in dict(views)


def test_bodies_move_beside_what_stands_in_their_way():
    wall = Plane((0.0, 0.0, -0.2), (0.0, 0.0, 1.0))
    env = gymnasium.make("SoftGym/Reach-v0", robot="finger", backend="fem", robot_options={"obstacles": [wall]})
    _, info = env.reset(seed=0)
    inner = env.unwrapped
    shown = {"robot": inner.robot, "design": dict(inner.design), "model": inner.backend.model, "task": inner.task}
    states = {"states": [inner.state] * 2, "goals": [inner.goal] * 2, "distances": [info["distance"]] * 2}
    figure = motion([Episode("winner", **shown, path=inner.path, **states, rewards=[None] * 2)], None)
    names = [trace.name for trace in figure.data]
    assert names == ["winner", "path of the winner's effector", "obstacle", "goal of this episode"]
    assert all(frame.traces == (0, 1) for frame in figure.frames)  # the obstacle stands still
    np.testing.assert_allclose(figure.data[2].z, -200.0)


def test_contact_forces_are_lines_that_end_where_the_body_touches():
    wall = Plane((0.0, 0.035, 0.0), (0.0, -1.0, 0.0))
    env = gymnasium.make("SoftGym/Reach-v0", robot="finger", backend="fem", robot_options={"obstacles": [wall]})
    env.reset(seed=0)
    inner = env.unwrapped
    states = [inner.state, inner.backend.step(np.array([0.008, 0.0]))]
    shown = {"robot": inner.robot, "design": dict(inner.design), "model": inner.backend.model, "task": inner.task}
    goals = {"goals": [inner.goal] * 2, "distances": [0.0] * 2, "rewards": [None] * 2, "path": inner.path}
    figure = motion([Episode("winner", **shown, states=states, **goals)], None)
    (forces,) = [trace for trace in figure.data if trace.name.startswith("contact forces on the winner, 1 N is ")]
    starts, ends = (np.array([forces[axis][k::3] for axis in "xyz"], dtype=float).T for k in range(2))
    contacts = states[1].contacts
    np.testing.assert_allclose(ends, 1e3 * contacts.point)
    drawn = 1e-3 * (ends - starts)
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1).max(), 0.2 * inner.robot.size)
    np.testing.assert_allclose(drawn / drawn[0, 1], contacts.force / contacts.force[0, 1], atol=1e-9)
    first, last = figure.frames[0].data[2], figure.frames[-1].data[2]
    assert first.x == (None,) and len(last.x) == 3 * contacts.count


def test_plots_show_every_complete_trial(tested):
    snapshot = tested(FAR, FAR)
    results = collect(snapshot)
    drawn = dict(search_figures(snapshot, results))
    history = drawn["Every trial, and the best so far"]
    shown = {trace.name: list(trace.y) for trace in history.data if trace.mode == "markers"}
    assert shown.pop("baseline") == [5.0] and shown.pop("winner") == [1.0]
    assert [values for values in shown.values() if values] == [[5.0, 1.0]]  # Optuna's own trace of all trials
    slices = drawn["The objective along each variable"]
    marks = [trace for trace in slices.data if trace.name == "winner"]
    design = results.winner.design
    for trace in marks:
        name = slices.layout["xaxis" + trace.xaxis[1:]].title.text.removesuffix(" [mm]").replace(" ", "_")
        assert trace.x[0] == pytest.approx(1e3 * design[name])
    assert len(marks) == 2
    assert "Bodies and their objective" in drawn


def test_the_headline_says_how_certain_the_change_in_success_is(tested):
    snapshot = tested(FAR, NEAR)
    text = headline(snapshot, collect(snapshot))
    assert "It reaches 0.0 % of the goals" in text
    assert "the baseline 16.7 % (difference -16.7 pp, 95 % interval -" in text


def test_efforts_stand_in_the_report(tested):
    snapshot = tested(FAR, NEAR)
    results = collect(snapshot)
    (row, _) = effort_rows(results.comparison, snapshot.config.effort)
    assert (row.backend, row.agent, row.mean, row.largest) == ("FEM", "Policy", ["1.00 N"] * 2, ["9.00 N"] * 2)
    body = replace(results.comparison[0].winner, largest_effort=None)  # of an earlier version
    (row,) = effort_rows([replace(results.comparison[0], winner=body)], snapshot.config.effort)
    assert row.largest == ["9.00 N", "-"] and row.strain == row.pressing == ["-", "-"]


def test_finalists_differ(study):
    folder = study(finalists={"count": 2}, trials=9)
    # The best three bodies are nearly the same; the fifth is far away and among the best six, the seventh is not.
    places = [(0.5, 0.5), (0.51, 0.5), (0.5, 0.51), (0.52, 0.5), (0.9, 0.9), (0.6, 0.6), (0.0, 0.0)]
    write_trial(folder, 0, 9e-3, (0.3, 0.3))
    for number, place in enumerate(places, start=1):
        write_trial(folder, number, 1e-3 * number, place)
    assert [body.trial for body in load_study(folder).finalists] == [0, 1, 5]


@pytest.mark.parametrize(("seconds", "text"), [(2.41, "2.4 s"), (59.0, "59.0 s"), (606.0, "10.1 min")])
def test_times_are_in_seconds_or_minutes(seconds, text):
    assert time_text(seconds) == text


def on_surrogate(found, tests, name="distances"):
    """Write tests on the surrogate: trial -> distances (or untrusted shares, with distances of FEM)."""
    for number, values in tests.items():
        distances = np.full(6, 4e-3) if name == "untrusted" else values
        made = replace(evaluation(distances), untrusted=np.asarray(values if name == "untrusted" else np.zeros(6)))
        test = FinalistTest(number, "policy", "surrogate", "unseen", 0, made, {"mean_distance": 1.0}, list(distances))
        test.write(found.path / "finalists" / f"trial{number:04d}-policy-surrogate-unseen.json")
    return load_study(found)


def test_a_surrogate_that_is_not_trusted_is_named(tested):
    folder = tested(FAR, FAR).folder
    assert "The surrogate is little trusted" not in titles(on_surrogate(folder, {0: np.zeros(6)}, "untrusted"))
    found = findings(*_with_results(on_surrogate(folder, {1: np.full(6, 0.88)}, "untrusted")))
    (text,) = [finding.text for finding in found if finding.title == "The surrogate is little trusted"]
    assert "100% of the states of the baseline and 12% of the states of the winner" in text


def _with_results(snapshot):
    return snapshot, collect(snapshot)


def test_surrogate_and_fem_that_disagree_are_named(tested):
    folder = tested(4.7e-2 + WIGGLE, FAR).folder
    snapshot = on_surrogate(folder, {0: [5e-3, 1e-3, 5e-3, 5e-3, 5e-3, 5e-3], 1: np.full(6, 7e-3)})
    (text,) = [f.text for f in findings(*_with_results(snapshot)) if f.title == "Surrogate and FEM disagree"]
    assert "of the winner is 7.00 mm on the surrogate" in text and "47.0" in text


@pytest.mark.parametrize(("qp", "named"), [(9e-3, True), (4e-3, False)])
def test_a_baseline_that_the_inverse_qp_prefers_is_named(tested, qp, named):
    found = titles(tested(NEAR, np.full(6, qp)))
    assert ("With the inverse QP, the baseline is the better body" in found) == named


@pytest.mark.parametrize("objective", ["mean_distance", "mean_effort"])
def test_bodies_are_compared_by_distance_only_where_the_study_does(tested, objective):
    found = titles(tested(np.full(6, 4.3e-3), np.full(6, 9e-3), objective=objective))
    named = {"With the inverse QP, the baseline is the better body", "Other bodies do as well"}.intersection(found)
    assert len(named) == (2 if objective == "mean_distance" else 0)


def test_the_policy_limits_only_where_the_qp_closes_a_substantial_part(tested):
    """8.23 against 7.94 mm is no reason to train longer."""
    found = titles(tested(np.full(6, 8.23e-3), np.full(6, 7.94e-3) + 1e-3 * WIGGLE))
    assert "The body limits, not the policy" in found and "The policy limits, not the body" not in found


@pytest.mark.parametrize(
    ("baseline", "winner", "title", "words"),
    [
        ({}, {}, None, ""),
        ({"largest_strain": 0.2}, {"largest_strain": 0.21}, None, ""),
        (
            {"largest_strain": 0.2},
            {"largest_strain": 0.3},
            "strains more",
            "strain of a drive is 30.0 % instead of 20.0 %",
        ),
        ({"self_force": 0.0}, {"self_force": 0.05}, None, ""),
        ({"self_force": 0.0}, {"self_force": 32.0}, "strains more", "its self-contact is 32.00 N instead of 0.00 N"),
        (
            {"self_force": 1.0},
            {"self_force": 2.0, "largest_effort": 12.0},
            "pulls harder",
            "largest_effort and self_force",
        ),
    ],
)
def test_a_winner_that_costs_more_is_named(tested, baseline, winner, title, words):
    snapshot = tested(FAR, NEAR)
    results = collect(snapshot)
    row = results.comparison[0]
    row = replace(row, baseline=replace(row.baseline, **baseline), winner=replace(row.winner, **winner))
    found = findings(snapshot, replace(results, comparison=[row]))
    found = [finding for finding in found if finding.title.startswith(("The winner pulls", "The winner strains"))]
    assert [finding.title for finding in found] == ([f"The winner {title}"] if title else [])
    assert all(words in finding.text for finding in found)
