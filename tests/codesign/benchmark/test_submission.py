"""Submissions: a true one is accepted, and each way to cheat is refused with one line."""

import shutil

import numpy as np
import pytest

from softgym_envs.agents.policy import policy_path
from softgym_envs.codesign.benchmark import Search, board, submit, verify
from softgym_envs.codesign.benchmark.frozen import file_hash
from softgym_envs.codesign.benchmark.problem import goal_key
from softgym_envs.codesign.benchmark.scoring import reference
from softgym_envs.codesign.benchmark.submission import SubmissionRefused
from softgym_envs.errors import DataError


@pytest.fixture
def submission(tiny):
    search = Search(tiny)
    for point in ([0, 0, 0], [0.5, -0.9, 0.8]):
        search.evaluate(tiny.design(np.array(point, dtype=float)))
    return submit(search, "by hand", author="a test")


def refused(submission, folder, message, data):
    path = folder / "submission.json"
    submission.write(path)
    with pytest.raises(SubmissionRefused, match=message) as error:
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
    refused(submission, tmp_path, r"a submitted body is not in the ledger", data)


def test_a_body_out_of_the_box(submission, tmp_path, data):
    submission.designs[0]["length"] = 1.0
    refused(submission, tmp_path, r"the body is not in the box of 'tiny-v1': .*'length' = 1 m is out of bounds", data)


def test_a_wrong_version(submission, tmp_path, data):
    submission.hash = "0" * 32
    refused(submission, tmp_path, r"the submission is for another version of 'tiny-v1'", data)


def test_an_unknown_problem(submission, tmp_path, data):
    submission.problem = "tiny-v2"
    refused(submission, tmp_path, r"unknown problem 'tiny-v2'; did you mean 'tiny-v1'", data)


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
    submission.policy["goals"] = [goal_key(tiny.goals["test"][0]), "0" * 16]
    refused(submission, tmp_path, r"'mine.safetensors' was trained on 1 of the test goals of 'tiny-v1'", data)
    submission.policy = {**submission.policy, "goals": [], "sha256": "0" * 32}
    refused(submission, tmp_path, r"is not the one that was submitted: its SHA-256 differs", data)
    submission.policy["sha256"] = file_hash(source)
    submission.write(tmp_path / "submission.json")
    assert len(verify(tmp_path / "submission.json", data=data).scores) == 1
