"""The verbs of the benchmark on the command line."""

import json

import pytest

from softgym_envs.extensions.leaderboard import Search, submit
from softgym_envs.extensions.leaderboard.problem import TRACKS


def test_list_and_show(softgym, tiny):
    status, out, _ = softgym("benchmark", "list")
    assert status == 0 and "tiny-v1" in out
    status, out, _ = softgym("benchmark", "show", "tiny-v1")
    assert status == 0 and TRACKS["A"] in out and "budget small: environment steps 700" in out
    status, _, err = softgym("benchmark", "show", "tyny-v1")
    assert status == 2 and "unknown problem 'tyny-v1'; did you mean 'tiny-v1'" in err


def test_run_and_table(softgym, tiny, tmp_path):
    verb = ["benchmark", "run", "tiny-v1", "--method", "random", "--folder", tmp_path]
    status, out, _ = softgym(*verb, "--seeds", "2")
    assert status == 0 and "tiny-v1 random shared seed 1: 7 bodies" in out and "best mean_distance [m]: 0.00" in out
    status, out, err = softgym("benchmark", "table", "--folder", tmp_path)
    assert status == 0 and "| `tiny-v1` | shared | random | 2 |" in out and err == f"runs of {tmp_path}:\n"
    status, _, err = softgym("benchmark", "table", "--folder", tmp_path / "other")
    assert status == 2 and "other' has no runs; 'softgym benchmark run" in err
    status, _, err = softgym(*verb, "--method", "rndom")
    assert status == 2 and "unknown method 'rndom'; did you mean 'random'" in err
    status, _, err = softgym(*verb, "--level", "tiny")
    assert status == 2 and "unknown level 'tiny'" in err


def test_verify(softgym, tiny, tmp_path, data, monkeypatch):
    search = Search(tiny)
    search.evaluate(tiny.definition.baseline_values)
    path = tmp_path / "submission.json"
    submission = submit(search, "by hand")
    submission.write(path)
    monkeypatch.setattr("softgym_envs.extensions.leaderboard.submission.DATA", data)
    status, out, _ = softgym("benchmark", "verify", path, "--json")
    assert status == 0 and len(json.loads(out)["scores"]) == 1
    submission.hash = "0" * 32
    submission.write(path)
    status, _, err = softgym("benchmark", "verify", path)
    assert status == 2 and len(err.strip().splitlines()) == 1 and "another version of 'tiny-v1'" in err


@pytest.mark.parametrize("verb", ["board", "table"])
def test_shipped_data_can_be_shown(softgym, verb, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where there are no runs of one's own
    status, out, _ = softgym("benchmark", verb)
    assert status == 0 and out.strip()
