"""Submissions: a true one is accepted, and each way to cheat is refused with one line."""

import shutil

import numpy as np
import pytest
import yaml

from softgym_envs.agents.policy import policy_path
from softgym_envs.errors import DataError, WeightsError
from softgym_envs.extensions.leaderboard import Search, board, frozen, problem, submit, verify
from softgym_envs.extensions.leaderboard import submission as submission_module
from softgym_envs.extensions.leaderboard.frozen import file_hash
from softgym_envs.extensions.leaderboard.problem import goal_key
from softgym_envs.extensions.leaderboard.scoring import reference
from softgym_envs.extensions.leaderboard.submission import SubmissionRefused
from softgym_envs.storage import read_json, write_json
from tests.extensions.leaderboard.conftest import tiny_definition


@pytest.fixture
def submission(tiny):
    search = Search(tiny)
    for point in ([0, 0, 0], [0.5, -0.9, 0.8]):
        search.evaluate(tiny.design(np.array(point, dtype=float)))
    return submit(search, "by hand", author="a test")


def refused(submission, folder, message, data):
    path = folder / "submission.json"
    submission.write(path)
    with pytest.raises((SubmissionRefused, DataError), match=message) as error:
        verify(path, data=data)
    assert "\n" not in str(error.value)


def test_a_true_submission_is_accepted_and_recorded(submission, tiny, tmp_path, data):
    path = tmp_path / "submission.json"
    submission.write(path)
    verdict = verify(path, data=data, record=True)
    known = reference(tiny, data)
    assert known is not None and known.baseline[0] < 0.0
    better = verdict.scores[0][0] > known.baseline[0]
    assert verdict.record == better and verdict.normalised == (1.0 if better else None)
    assert abs(verdict.exploitation) < 2e-3
    with pytest.raises(DataError, match=r"claims no scores; write it with submit\(..., test=True\)"):
        board.leaderboard(tmp_path / "none", data, [path])
    submission.claimed = verdict.scores
    submission.write(path)
    assert "| by hand | a test | small |" in board.leaderboard(tmp_path / "none", data, [path])
    again = verify(path, data=data)
    assert again.scores == verdict.scores and not again.record
    submission.claimed = [[verdict.scores[0][0] * 0.9]]
    refused(submission, tmp_path, r"the score on the test goals is .*, but running the body again gives", data)
    for forged in (float("inf"), float("nan")):
        submission.claimed = [[forged]]
        refused(submission, tmp_path, r"claimed holds numbers that are not finite", data)


def test_differences_below_the_tolerance_of_the_inverse_qp_are_rounding():
    baseline = [-1.8e-3]
    assert submission_module._agree([-5.511e-7], [-5.523e-7], 1e-3, baseline)  # two processors, measured
    assert not submission_module._agree([-5.5e-7], [-6.0e-7], 1e-3, baseline)


def test_steps_behind_the_shared_policy_are_counted(submission, tiny):
    assert submission.pretraining_steps == 80_000 + 10 * 200 * 50  # training and learning curve, in its card
    search = Search(tiny, judge="qp")
    search.evaluate(tiny.definition.baseline_values)
    assert submit(search, "by hand").pretraining_steps == 0


def test_a_forged_ledger(submission, tmp_path, data):
    for row in submission.ledger:
        row["scores"] = [0.9 * row["scores"][0]]
    refused(submission, tmp_path, r"the score in the ledger is .*, but running the body again gives", data)


def test_a_body_that_the_search_has_not_scored(submission, tmp_path, data):
    name = next(iter(submission.designs[0]))
    submission.designs[0][name] *= 0.999
    refused(submission, tmp_path, rf"the submitted body \({name} = .* is not in the ledger, which has 2 rows", data)


def test_a_body_out_of_the_box(submission, tmp_path, data):
    submission.designs[0]["length"] = 1.0
    refused(submission, tmp_path, r"the body is not in the box of 'tiny-v1': .*'length' = 1 m is out of bounds", data)


def test_a_wrong_version(submission, tmp_path, data):
    submission.hash = "0" * 32
    refused(submission, tmp_path, r"the submission is for another version of 'tiny-v1'", data)


def test_an_unknown_problem(submission, tmp_path, data):
    submission.problem = "tiny-v2"
    refused(submission, tmp_path, r"unknown problem 'tiny-v2'; did you mean 'tiny-v1'", data)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"judge": "magic"}, r"problem 'tiny-v1' has no judge 'magic'; allowed: qp, shared, trained"),
        ({"level": "huge"}, r"level 'huge' does not exist; allowed: small, medium, large"),
        ({"designs": []}, r"0 bodies are submitted; allowed: 1 to 1"),
        ({"claimed": [[-0.01], [-1e-9]]}, r"scores of 2 bodies are claimed; allowed: those of the 1 submitted ones"),
        ({"controller": "policy"}, r"controller 'policy' does not exist; allowed: .*, or policy with a file"),
        ({"controller": "policy", "policy": {"file": "x"}}, r"policy lacks sha256, goals; needed: file, sha256 and"),
        (
            {"controller": "policy", "policy": {"file": "x", "sha256": "0", "goals": "all"}},
            r"policy.goals = 'all' must be a list of hashes",
        ),
    ],
)
def test_values_that_no_search_writes(submission, tmp_path, data, change, message):
    for name, value in change.items():
        setattr(submission, name, value)
    refused(submission, tmp_path, message, data)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"hash": 3}, r"the submission: hash: must be a valid string, got 3"),
        ({"claimd": []}, r"the submission: unknown field 'claimd'; did you mean 'claimed'"),
        ({"designs": [{"length": "long"}]}, r"designs.0.length: must be a valid number.*got 'long'"),
        ({"ledger": [3]}, r"ledger.0: must be a mapping of keys to values, got 3"),
        ({"ledger": [{"design": {}, "judge": "qp", "fem_solves": "many"}]}, r"ledger.0: fem_solves: .*got 'many'"),
    ],
)
def test_fields_of_another_type(submission, tmp_path, data, change, message):
    path = tmp_path / "submission.json"
    write_json(path, {**submission.to_json(), **change})
    with pytest.raises(DataError, match=message):
        verify(path, data=data)
    write_json(path, {"problem": "tiny-v1"})
    with pytest.raises(DataError, match=r"missing required keys hash, method, author, level"):
        verify(path, data=data)
    write_json(path, [submission.to_json()])
    with pytest.raises(DataError, match=r"the submission must be an object with fields, got a list"):
        verify(path, data=data)


def test_costs_that_are_not_what_a_score_takes(submission, tmp_path, data):
    for row in submission.ledger:
        row["environment_steps"] = 0
    refused(submission, tmp_path, r"counts 0 environment steps for the submitted body, but scoring it takes 100", data)
    submission.ledger[1]["environment_steps"] = -100
    refused(submission, tmp_path, r"ledger.1.environment_steps = -100; allowed: finite numbers from 0", data)
    submission.ledger[1]["environment_steps"] = 100
    submission.ledger[0]["cpu_seconds"] = float("nan")
    refused(submission, tmp_path, r"ledger.0.cpu_seconds = nan; allowed: finite numbers from 0", data)


def test_more_than_the_budget(submission, tmp_path, data):
    submission.ledger *= 8
    refused(submission, tmp_path, r"exceeds the budget 'small': environment_steps = 1500 before the last body", data)


def test_an_unknown_controller(submission, tmp_path, data):
    submission.controller = "magic"
    refused(submission, tmp_path, r"controller 'magic' does not exist; allowed: qp, shared, trained, or policy", data)


def test_policies(submission, tiny, tmp_path, data):
    source, path = policy_path("finger_reach_designs"), tmp_path / "mine.safetensors"
    submission.controller = "policy"
    submission.policy = {"file": "mine.safetensors", "sha256": file_hash(source), "goals": []}
    refused(submission, tmp_path, r"the policy 'mine.safetensors' does not lie beside the submission", data)
    shutil.copy(source, path)
    shutil.copy(source.with_suffix(".json"), path.with_suffix(".json"))
    key = goal_key(tiny.goals["test"][0])
    trained_on = rf"'mine.safetensors' was trained on 1 of the 1 test goals of 'tiny-v1' \({key}\); allowed: any other"
    submission.policy["goals"] = [key, "0" * 16]
    refused(submission, tmp_path, trained_on, data)
    submission.policy = {**submission.policy, "goals": [], "sha256": "0" * 32}
    refused(submission, tmp_path, r"is not the one that was submitted: its SHA-256 begins with \w{12}, that of", data)
    submission.policy["sha256"] = file_hash(source)
    card = read_json(path.with_suffix(".json"))
    goals = {"goals": tiny.goals["test"][:, 0].tolist()}  # named by the training itself
    environment = {**card["config"]["environment"], "task_options": goals}
    write_json(path.with_suffix(".json"), {**card, "config": {**card["config"], "environment": environment}})
    refused(submission, tmp_path, trained_on, data)
    path.with_suffix(".json").unlink()
    refused(submission, tmp_path, r"policy card .*mine.json' cannot be read: No such file or directory", data)
    shutil.copy(source.with_suffix(".json"), path.with_suffix(".json"))
    other = policy_path("diamond_reach_designs")
    for suffix in (".safetensors", ".json"):
        shutil.copy(other.with_suffix(suffix), tmp_path / f"other{suffix}")
    submission.policy = {"file": "other.safetensors", "sha256": file_hash(other), "goals": []}
    refused(submission, tmp_path, r"cannot be tested: environment.id = SoftGym/FingerReach-v0 .* does not fit", data)
    submission.policy = {"file": "mine.safetensors", "sha256": file_hash(source), "goals": []}
    submission.write(tmp_path / "submission.json")
    assert len(verify(tmp_path / "submission.json", data=data).scores) == 1


@pytest.fixture
def trained(problems):
    """The problem ``tiny-v1`` whose bodies act through policies that are trained for them."""
    (problems / "tiny-v1.yaml").write_text(yaml.safe_dump(tiny_definition(judge="trained")))
    frozen.freeze("tiny-v1")
    return frozen.load_problem("tiny-v1")


def test_a_policy_that_was_trained_for_the_winner_need_not_be_trained_again(trained, tmp_path, data, monkeypatch):
    search = Search(trained)
    search.evaluate(trained.definition.baseline_values)
    submission = submit(search, "by hand", test=True)
    path = tmp_path / "mine.json"
    submission.write(path)
    assert (tmp_path / "mine_policy" / "policy.json").is_file()
    assert submission.policy["file"] == "mine_policy/policy.safetensors"
    assert submission.policy["goals"] == sorted(goal_key(goal) for goal in trained.goals["training"])
    with monkeypatch.context() as patch:
        patch.setattr(problem, "train", lambda *_, **__: pytest.fail("the check trains a policy"))
        assert verify(path, data=data).scores == submission.claimed
    steps = submission.ledger[0]["environment_steps"]
    submission.ledger[0]["environment_steps"] = steps - 1
    refused(submission, tmp_path, rf"counts {steps - 1} environment steps .* but scoring it takes {steps}", data)
    submission.ledger[0].update(environment_steps=steps, scores=[0.9 * submission.ledger[0]["scores"][0]])
    refused(submission, tmp_path, r"the score in the ledger is .*, but running the body again gives", data)


def test_a_policy_of_ones_own_is_attached_with_its_card(tiny, tmp_path):
    search = Search(tiny, judge="qp")
    search.evaluate(tiny.definition.baseline_values)
    submission = submit(search, "by hand", policy="finger_reach_designs")
    submission.write(tmp_path / "mine.json")
    assert submission.controller == "policy"
    copy = tmp_path / "mine_policy" / "policy.safetensors"
    assert file_hash(copy) == submission.policy["sha256"] == file_hash(policy_path("finger_reach_designs"))
    with pytest.raises(WeightsError, match=r"policy 'none.safetensors' does not exist"):
        submit(search, "by hand", policy="none.safetensors")


def test_files_that_cannot_be_read(submission, tmp_path, data):
    path = tmp_path / "submission.json"
    with pytest.raises(DataError, match=r"submission.json' cannot be read: No such file or directory"):
        verify(path, data=data)
    submission.write(path)
    path.write_text(path.read_text()[:400])
    with pytest.raises(DataError, match=r"submission.json' cannot be read: it is truncated or not valid JSON"):
        verify(path, data=data)
