"""Tests of finalists where episodes end, and on a finer mesh; all meshes are quick ones."""

from __future__ import annotations

import json

import numpy as np
import pytest

from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.evaluation import Evaluation, evaluate
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.codesign.collect import collect
from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.folder import StudyFolder
from softgym_envs.codesign.goals import Stratum, missed_first
from softgym_envs.codesign.phases import ends
from softgym_envs.codesign.phases.finalists import finalist_environment
from softgym_envs.codesign.records import FinalistTest, TrialResult
from softgym_envs.codesign.snapshot import load_study
from softgym_envs.codesign.statistics import mesh_part
from softgym_envs.codesign.study import run_study
from softgym_envs.control.settling import nearest_next
from softgym_envs.errors import ConfigError, ConvergenceError
from softgym_envs.extensions.report.episodes import MOMENTS, moments
from softgym_envs.extensions.report.findings import findings
from softgym_envs.extensions.report.page import write_report
from softgym_envs.mechanics.solvers.statics import Statics
from tests.helpers import wait_until

POLICY = "diamond_reach_designs"
FINER = {"robot_options": {"mesh_size": 0.0065}, "goals": 2}
HALF_MISSED = {**FINER, "goals": 4, "choose": "missed"}


@pytest.fixture(scope="module")
def diamond():
    shown = ["leg_width", "top_height", "elbow_height", "elbow_radius"]
    return EnvironmentConfig(id="SoftGym/DiamondReach-v0", design_in_observation=shown)


@pytest.fixture(scope="module")
def body(diamond):
    """Body and goals (k, 1, 3)."""
    goals = np.array([[0.01, 0.005, 0.130], [-0.006, 0.012, 0.134]])[:, None]
    return dict(diamond.make_robot().design_space.baseline), goals


@pytest.fixture(scope="module")
def run(diamond, body):
    """Function ``run(agent) -> FinalStates``: on finite elements."""
    design, goals = body
    return lambda agent: ends.run_ends(agent, diamond.on("fem"), goals, design, start=diamond, last_steps=4)


@pytest.fixture(scope="module")
def followed(run):
    return run(POLICY)


def test_commands_are_those_of_an_episode_on_the_surrogate(diamond, body):
    design, goals = body
    paths = ends.episode_commands(POLICY, diamond, goals[:, 0], design)
    assert all(path.shape == (diamond.row.max_episode_steps + 1, 4) and not path[0].any() for path in paths)
    found = evaluate(POLICY, diamond, goals, design=design)
    backend = diamond.make(sample_design=False).unwrapped.backend
    backend.reset(design)
    reached = np.array([backend.probe(path[-1]).effector[0] for path in paths])
    np.testing.assert_allclose(reached, found.ends, atol=2e-6)


def test_a_policy_ends_where_its_whole_episode_on_finite_elements_does(diamond, body, followed):
    design, goals = body
    whole = evaluate(POLICY, diamond.on("fem"), goals, design=design)
    found = followed.evaluation
    assert found.distances == pytest.approx(whole.distances, abs=2e-5)
    assert found.ends == pytest.approx(whole.ends, abs=5e-5)
    assert (found.successes == whole.successes).all()
    assert 0.0 < followed.last_motion < 5e-5
    assert found.steps == len(goals) * 5
    assert np.isnan(found.returns).all() and np.isnan(found.tracking_distances).all()
    assert followed.unknowns == diamond.make_robot().build(design).equations


def test_the_inverse_qp_settles_at_least_as_near(run, followed):
    settled = run("qp")
    assert (settled.evaluation.distances <= followed.evaluation.distances + 2e-5).all()
    assert settled.evaluation.efforts == pytest.approx(followed.evaluation.efforts, rel=0.05)
    assert settled.last_motion is None and settled.unknowns == followed.unknowns


def test_a_step_that_fails_from_the_last_goal_starts_again_from_rest(run, followed, monkeypatch):
    step, starts = FEMBackend.step, []

    def once(self, command, *args, **options):
        starts.append(float(np.abs(self.state.displacement).max()))
        if len(starts) == 6:  # the first goal takes five
            raise ConvergenceError("no equilibrium")
        return step(self, command, *args, **options)

    monkeypatch.setattr(FEMBackend, "step", once)
    assert run(POLICY).evaluation.distances == pytest.approx(followed.evaluation.distances, abs=1e-6)
    assert len(starts) == 11 and starts[5] > 1e-3 > 1e-9 > starts[6]


def test_commands_are_taken_by_short_ways(diamond):
    robot = diamond.make_robot()
    commands = np.outer([0.9, 0.1, 0.5, 0.2], robot.upper)
    assert nearest_next(commands / (robot.upper - robot.lower)) == [1, 3, 2, 0]


def test_unknown_means_survive_a_file(followed):
    found = followed.evaluation
    text = json.dumps(found.to_json(), allow_nan=False)
    again = Evaluation.from_json(json.loads(text))
    assert again.to_json() == found.to_json() and np.isnan(again.returns).all()


@pytest.mark.parametrize("agent", ["qp", POLICY])
def test_a_command_without_equilibrium_names_the_goal(agent, run, monkeypatch):
    solve = Statics.solve

    def lost(self, command, *args, **options):
        if np.any(command):
            raise ConvergenceError("no equilibrium")
        return solve(self, command, *args, **options)

    monkeypatch.setattr(Statics, "solve", lost)
    with pytest.raises(ConvergenceError, match=r"goal 1 of 2: no equilibrium"):
        run(agent)


def test_a_policy_with_memory_is_refused():
    with pytest.raises(ConfigError, match=r"sensorized_finger_reach_recurrent.*memory; allowed: episodes"):
        ends.check_policy("sensorized_finger_reach_recurrent")


# -- the part of the mesh ---------------------------------------------------------------------------------------------


def test_a_change_that_is_linear_in_the_size_of_elements_is_extrapolated_exactly():
    true, error = -1.4e-3, -0.6e-3  # at elements of size zero, and per size
    part = mesh_part(np.full(3, true + error), np.full(3, true + 0.75 * error), 0.75, (-2.5e-3, -1.5e-3))
    assert true + error + part.left == pytest.approx(true)
    assert part.left_interval == pytest.approx((part.left, part.left))
    assert part.interval == pytest.approx((-2.5e-3, -1.5e-3 - error))


def test_intervals_against_values_by_hand():
    # 1 mm and 3 mm are left; of the resamples of two goals a quarter each have means of 1 and 3 mm, the rest of 2 mm.
    part = mesh_part(np.array([-2e-3, -2e-3]), np.array([-1.5e-3, -0.5e-3]), 0.5, (-4e-3, -1e-3))
    assert part.left == pytest.approx(2e-3)
    assert part.left_interval == pytest.approx((1e-3, 3e-3))
    assert part.interval == pytest.approx((-4e-3, 2e-3))  # nothing is left below the lower end
    assert part.goals == 2 and part.ratio == 0.5
    # Errors of both signs widen both ends.
    part = mesh_part(np.zeros(2), np.array([-1e-3, 1e-3]), 0.5, (-4e-3, -1e-3))
    assert part.interval == pytest.approx((-6e-3, 1e-3))
    assert mesh_part(np.zeros(2), np.zeros(2), 0.5, None).interval is None


def test_missed_goals_are_half_of_those_on_the_finer_mesh():
    missed = np.zeros(20, dtype=bool)
    missed[[3, 8, 9, 15, 19]] = True
    assert missed_first(missed, 6) == [Stratum(0.25, (3, 8, 9)), Stratum(0.75, (0, 1, 2))]
    assert missed_first(missed, 14) == [
        Stratum(0.25, (3, 8, 9, 15, 19)),
        Stratum(0.75, (*range(3), *range(4, 8), 10, 11)),
    ]
    assert missed_first(missed[:4], 8) == [Stratum(0.25, (3,)), Stratum(0.75, (0, 1, 2))]
    assert missed_first(~missed[:3], 2) == [Stratum(1.0, (0, 1))] == missed_first(missed[:3], 2)


def test_goals_chosen_by_the_baseline_do_not_favour_the_winner():
    """Goals where the coarse mesh makes the baseline miss by chance shrink on the finer one: the mean has no bias."""
    rng, true, found, naive = np.random.default_rng(1), -0.5, [], []
    for _ in range(400):
        baseline, winner = rng.normal(2.0, 1.0, 40), rng.normal(1.5, 1.0, 40)  # without errors of the mesh
        coarse = baseline + rng.normal(0.0, 1.0, 40)
        strata = missed_first(coarse > 3.0, 12)
        numbers = [number for stratum in strata for number in stratum.numbers]
        before, after = (winner - coarse)[numbers], (winner - baseline)[numbers]
        part = mesh_part(before, after, 0.5, None, strata)
        found.append((winner - coarse).mean() + 0.5 * part.left)  # the change at all goals on the finer mesh
        naive.append(after.mean())
    assert np.mean(found) == pytest.approx(true, abs=4.0 * np.std(found) / 20.0)
    assert np.mean(naive) < true - 0.1  # the mean over the chosen goals is biased


def test_kinds_of_goals_count_by_their_shares():
    strata = [Stratum(0.25, (1, 2)), Stratum(0.75, (0, 3))]
    part = mesh_part(
        np.array([-4e-3, -4e-3, 0.0, 0.0]), np.array([-3e-3, -1e-3, 0.0, 0.0]), 0.5, (-2e-3, -1e-3), strata
    )
    assert part.left == pytest.approx(1e-3) and part.before == pytest.approx(-2e-3)
    assert part.left_interval == pytest.approx((0.5e-3, 1.5e-3))  # of the kind that scatters
    assert part.interval == pytest.approx((-2e-3, 0.5e-3))


def evaluation(distances):
    distances = np.asarray(distances, dtype=float)
    ones = np.ones(len(distances))
    return Evaluation(distances, ones, ones, distances < 2e-3, ones, distances[:, None] * np.ones(3), steps=1)


@pytest.fixture
def written(tmp_path, tiny):
    """Function ``written(refined, ratio, error) -> snapshot``: tests written by hand, distances in metres."""

    def make(refined, ratio=None, error=None, **options):
        finer = {"robot_options": {"mesh_size": 0.005}, "goals": 2, "ratio": ratio, **options}
        data = tiny(
            finalists={"count": 1, "test": "ends", "refinement": finer},
            goals={"count": 3, "unseen_count": 6, "training_count": 1},
        )
        folder = StudyFolder.create(tmp_path / "study", StudyConfig.model_validate(data))
        heights = {0: 0.020, 1: 0.021}
        for number, height in heights.items():
            TrialResult(
                number=number,
                origin="baseline" if number == 0 else "sampler 1",
                process="",
                design={**folder.config.baseline, "height": height},
                values={"mean_distance": 5e-3 - number * 3e-3},
                scores=[-5e-3 + number * 3e-3],
                evaluation=evaluation([5e-3 - number * 3e-3]),
            ).write(folder.trial(number) / "result.json")
            tests = {("fem", 1000): np.full(6, 5e-3 - number * 4e-3), ("surrogate", None): np.full(6, 5e-3)}
            if error is not None and number == 1:
                tests[("fem", 1000)] = None
            if refined is not None:
                tests[("refined", 8000)] = np.array(refined[number])
            for (backend, unknowns), distances in tests.items():
                file = folder.path / "finalists" / f"trial{number:04d}-qp-{backend}-unseen.json"
                test = FinalistTest(number, "qp", backend, "unseen", unknowns=unknowns)
                if distances is None:
                    test.error = error
                else:
                    test.evaluation, test.values = evaluation(distances), {"mean_distance": float(distances.mean())}
                    test.goal_values = distances.tolist()
                test.write(file)
        return load_study(folder)

    return make


REFINED = [[4e-3, 4e-3], [1e-3, 1e-3]]  # a change of -3 mm instead of -4 mm


@pytest.mark.parametrize(
    "ratio, left", [(None, 2e-3), (0.75, 4e-3)]
)  # half as large elements have 8 times the unknowns
def test_a_report_has_the_part_of_the_mesh(written, ratio, left):
    snapshot = written(REFINED, ratio)
    results = collect(snapshot)
    fem, refined, surrogate = results.comparison
    assert [row.backend for row in (fem, refined, surrogate)] == ["fem", "refined", "surrogate"]
    assert (fem.goals, refined.goals) == (6, 2)
    assert refined.distance_change == pytest.approx(-3e-3) and refined.distance_mesh is None
    assert fem.distance_mesh.left == fem.objective_mesh.left == pytest.approx(left)
    assert fem.distance_mesh.interval == pytest.approx((-4e-3, -4e-3 + left))
    assert results.winner.trial == 1
    texts = {finding.title: finding.text for finding in findings(snapshot, results)}
    titles = list(texts)
    assert any("2 goals the change is -3.00 mm on the finer mesh and -4.00 mm on" in text for text in texts.values())
    assert ("A finer mesh agrees" in titles) == (left < 4e-3)
    assert ("With the mesh's error, the gain is not certain" in titles) == (left >= 4e-3)


def test_elements_of_beams_are_lines(written, monkeypatch):
    snapshot = written(REFINED)
    monkeypatch.setattr(type(snapshot.config.robot), "made_of_beams", True)
    assert collect(snapshot).comparison[0].distance_mesh.ratio == pytest.approx(1000 / 8000)


def test_the_baseline_alone_chooses_goals_of_the_finer_mesh(written):
    folder = written(None, goals=4, choose="missed").folder
    file = folder.path / "finalists" / "trial0000-qp-fem-unseen.json"
    test = FinalistTest.read(file)
    test.evaluation = evaluation([1e-3, 5e-3, 1e-3, 1e-3, 5e-3, 1e-3])
    test.write(file)
    snapshot = load_study(folder)
    assert snapshot.refined_goals == [Stratum(1 / 3, (1, 4)), Stratum(2 / 3, (0, 2))]
    assert [plan.numbers for plan in snapshot.refinements] == 2 * [(1, 4, 0, 2)]
    for plan, distances in zip(snapshot.refinements, ([4e-3, 2e-3, 1e-3, 1e-3], 4 * [1e-3]), strict=True):
        found = evaluation(distances)
        FinalistTest(
            plan.finalist.trial,
            "qp",
            "refined",
            "unseen",
            0,
            found,
            {"mean_distance": 0.0},
            distances,
            unknowns=8000,
            numbers=list(plan.numbers),
        ).write(folder.path / plan.file)
    snapshot = load_study(folder)
    part = collect(snapshot).comparison[0].objective_mesh
    # Written by hand: changes of -4 mm at all goals of the coarse mesh, and -3, -1, 0, 0 mm on the fine one.
    assert part.before == pytest.approx(-4e-3) and part.goals == 4 and part.ratio == pytest.approx(0.5)
    assert part.left == pytest.approx(2.0 * (2e-3 / 3 + 4e-3 * 2 / 3))
    found = findings(snapshot, collect(snapshot))
    assert any("half of them missed by the baseline" in finding.text for finding in found)


def test_refinements_wait_for_the_winner(written):
    snapshot = written(None)
    assert [(plan.finalist.trial, plan.backend) for plan in snapshot.refinements] == [(0, "refined"), (1, "refined")]
    (snapshot.folder.path / "finalists" / "trial0001-qp-fem-unseen.json").unlink()
    assert load_study(snapshot.folder).refinements == []


def test_a_body_that_fails_never_wins(written):
    snapshot = written(None, error="goal 2 of 6: no equilibrium")
    assert snapshot.winner.role == "baseline" and snapshot.refinements == []
    results = collect(snapshot)
    titles = {finding.title: finding.text for finding in findings(snapshot, results)}
    assert "It cannot win. Trial 1: goal 2 of 6: no equilibrium." in titles["1 of 2 bodies fails on FEM"]
    test = snapshot.folder.path / "finalists" / "trial0000-qp-fem-unseen.json"
    FinalistTest(0, "qp", "fem", "unseen", error="goal 1 of 6: lost").write(test)
    assert (
        "no finalist can be simulated on FEM; trial 0: goal 1 of 6: lost" == load_study(snapshot.folder).verdict.reason
    )


# -- whole studies ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def killed_and_continued(tmp_path_factory, tiny, start_study):
    """Folder of a study that was killed in its final test and continued, and what the test had found before."""
    folder = tmp_path_factory.mktemp("ends") / "study"
    data = tiny(
        trials=3,
        goals={"count": 4, "unseen_count": 9, "training_count": 1},  # more than one job has
        finalists={"count": 1, "test": "ends", "choose": "fem", "refinement": HALF_MISSED},
    )
    process = start_study(folder, data)

    def tests():
        return {path.name: path.read_bytes() for path in folder.glob("finalists/trial*.json")}

    wait_until(tests, interval=0.02, failed=lambda: None if process.poll() is None else process.stdout.read())
    process.kill()
    process.communicate()
    before = tests()
    run_study(StudyConfig.model_validate(data), folder, progress=False)
    return StudyFolder(folder), data, before, tests()


def test_a_killed_test_continues(killed_and_continued):
    _, _, before, after = killed_and_continued
    assert before and before.items() <= after.items()
    kinds = sorted(name.split("-", 1)[1] for name in after)
    each = ["qp-fem-selection.json", "qp-fem-unseen.json", "qp-refined-unseen.json", "qp-surrogate-unseen.json"]
    winner = load_study(killed_and_continued[0]).winner
    assert kinds == sorted(2 * each if winner.role != "baseline" else 2 * [k for k in each if "refined" not in k])


def test_goals_of_one_test_are_shared_by_the_workers(killed_and_continued):
    """A test is what its parts found, goal by goal, and what one call finds for all goals."""
    folder, *_ = killed_and_continued
    parts = [FinalistTest.read(path) for path in sorted(folder.path.glob("finalists/parts/trial0000-*.json"))]
    assert [part.numbers for part in parts] == [[0, 1, 2, 3, 4], [5, 6, 7, 8]]
    joined = FinalistTest.read(folder.path / "finalists" / "trial0000-qp-fem-unseen.json")
    distances = np.concatenate([part.evaluation.distances for part in parts])
    assert joined.numbers is None and joined.evaluation.distances.tolist() == distances.tolist()
    environment, start = (finalist_environment(folder.config, kind, {}) for kind in ("fem", "surrogate"))
    design = folder.config.baseline
    whole = ends.run_ends("qp", environment, folder.goals["unseen"], design, start=start, last_steps=1)
    assert np.allclose(whole.evaluation.distances, distances, atol=1e-6)


def test_its_report_shows_every_mesh(killed_and_continued):
    folder, *_ = killed_and_continued
    text = write_report(folder.path).read_text()
    snapshot = load_study(folder)
    assert "FEM in the test, where episodes end" in text and "a finer mesh (mesh_size = 0.0065 in SI units)" in text
    assert snapshot.winner.role == "finalist"
    assert "FEM, finer mesh" in text and "With the mesh” adds what is left" in text
    coarse, fine = (
        t
        for t in sorted(snapshot.tests, key=lambda t: t.unknowns or 0)
        if t.trial == 0 and t.goals == "unseen" and t.backend != "surrogate"
    )
    assert coarse.unknowns < fine.unknowns and len(fine.mean) == 4 and len(coarse.mean) == 9
    missed = [number for number in range(9) if not coarse.mean.successes[number]]
    half = missed[: max(2, 4 - (9 - len(missed)))]
    assert fine.numbers[: len(half)] == half and len(set(fine.numbers)) == 4
    # The meshes differ by more than a millimetre, but the same goal is the worst.
    assert fine.mean.distances.argmax() == coarse.mean.distances[fine.numbers].argmax() == 0
    assert "4 goals, about half of them missed by the baseline" in text
    json.loads((folder.path / "results.json").read_text(), parse_constant=pytest.fail)


def test_what_was_tested_stays(killed_and_continued):
    folder, data, *_ = killed_and_continued
    for change in ({"test": "episodes"}, {"last_steps": 9}, {"refinement": {**FINER, "goals": 1}}):
        config = StudyConfig.model_validate({**data, "finalists": {**data["finalists"], **change}})
        with pytest.raises(ConfigError, match=f"holds a study with finalists.{next(iter(change))}"):
            StudyFolder.create(folder.path, config)


def test_whole_episodes_on_a_finer_mesh(tmp_path, tiny):
    data = tiny(
        trials=2,
        goals={"count": 2, "unseen_count": 2, "training_count": 1},
        finalists={"count": 1, "refinement": {**FINER, "goals": 1}},
    )
    results = run_study(StudyConfig.model_validate(data), tmp_path / "study", progress=False)
    tests = {(test.trial, test.backend): test for test in results.tests}
    assert {backend for _, backend in tests} == {"fem", "surrogate", "refined"}
    assert tests[0, "fem"].unknowns < tests[0, "refined"].unknowns
    assert np.isfinite(tests[0, "refined"].mean.returns).all() and tests[0, "refined"].last_motion is None
    assert tests[0, "refined"].mean.distances == pytest.approx(tests[0, "fem"].mean.distances[:1], rel=0.5)


def test_a_finer_mesh_can_be_added_to_a_finished_study(tmp_path, tiny):
    def config(**finalists):
        data = tiny(
            trials=2,
            goals={"count": 2, "unseen_count": 2, "training_count": 1},
            finalists={"count": 1, "choose": "fem", **finalists},
        )
        return StudyConfig.model_validate(data)

    before = run_study(config(), tmp_path / "study", progress=False)
    assert before.winner.role == "finalist" and before.comparison[0].objective_mesh is None
    kept = {file: file.read_bytes() for file in (tmp_path / "study" / "finalists").glob("*.json")}
    finer = {"refinement": {**FINER, "goals": 1}}
    after = run_study(config(**finer), tmp_path / "study", progress=False)
    assert {file: file.read_bytes() for file in kept} == kept  # nothing was tested again
    fem, refined = after.comparison[:2]
    assert (fem.backend, refined.backend) == ("fem", "refined") and 0.0 < fem.objective_mesh.ratio < 1.0
    assert fem.objective_change == before.comparison[0].objective_change
    with pytest.raises(ConfigError, match=r"holds a study with finalists\.refinement"):
        run_study(config(), tmp_path / "study", progress=False)


def test_a_wrong_option_of_the_finer_mesh_is_found_first(tmp_path, tiny):
    finer = {"robot_options": {"mesh_sise": 0.005}, "goals": 2}
    config = StudyConfig.model_validate(tiny(finalists={"count": 1, "refinement": finer}))
    with pytest.raises(ConfigError, match=r"finalists\.refinement\.robot_options = .*mesh_sise"):
        run_study(config, tmp_path / "study", progress=False)
    assert not (tmp_path / "study").exists()


@pytest.mark.parametrize("ends_of_pulls", [(1.0,), (0.6, 1.0), (0.01, 1.0)])
def test_moments_are_even_along_the_way(ends_of_pulls):
    pulls = np.concatenate([np.linspace(0.0, ends_of_pulls[0], 30), *([[end] * 20 for end in ends_of_pulls])])
    commands = np.outer(pulls, [3.0, 4.0])
    picked = moments(commands)
    assert picked[-1] == len(commands) - 1 and len(picked) <= MOMENTS and picked == sorted(set(picked))
    steps = np.abs(np.diff(pulls[picked], prepend=0.0))
    largest = np.abs(np.diff(pulls)).max()
    assert (steps <= 1.0 / MOMENTS + largest + 1e-12).all()


def test_an_episode_that_stands_still_has_one_moment():
    assert moments(np.zeros((5, 2))) == [4]
