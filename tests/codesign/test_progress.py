"""What a running study prints: its phases, what is finished of them, the time left and the winner's dimensions."""

import json
import re

import pytest

from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.progress import Countdown, duration
from softgym_envs.codesign.snapshot import load_study
from softgym_envs.codesign.study import run_study
from softgym_envs.extensions.report.findings import findings
from softgym_envs.storage import write_signed
from softgym_envs.version import __version__


def test_the_time_left_follows_from_the_mean_time_of_this_run():
    now = [100.0]
    countdown = Countdown(24, 4, clock=lambda: now[0])
    assert countdown.text(4) == "[ 4/24]"  # nothing is known yet
    now[0] += 60.0
    assert countdown.text(6) == "[ 6/24, 9 min left]"  # 30 s each, 18 to go
    assert countdown.text(24) == "[24/24]"


@pytest.mark.parametrize(("seconds", "text"), [(4.4, "4 s"), (89.0, "89 s"), (90.0, "2 min"), (5400.0, "1.5 h")])
def test_durations(seconds, text):
    assert duration(seconds) == text


def test_phases_counters_and_the_dimensions_of_the_winner(tmp_path, capsys):
    config = StudyConfig.model_validate(
        {
            "name": "tiny",
            "environment": {"id": "SoftGym/FingerReach-v0"},
            "variables": ["length"],
            "strategy": "qp",
            "trials": 2,
            "sampler": {"name": "random"},
            "goals": {"count": 2, "unseen_count": 2, "training_count": 2},
            "finalists": {"count": 1, "seeds": 0},
        }
    )
    run_study(config, tmp_path / "study")
    out = capsys.readouterr().out
    assert re.findall(r"^phase (\d) of 2, (\w+): ", out, re.M) == [("1", "trials"), ("2", "test")]
    assert re.findall(r"^\[(\d)/2.*?\] trial ", out, re.M) == ["1", "2"]
    tests = re.findall(r"^\[(\d)/(\d).*?\] test of trial \d, qp on \w+, unseen goals: ", out, re.M)
    assert [done for done, _ in tests] == [str(k + 1) for k in range(len(tests))] and tests[-1][0] == tests[-1][1]
    assert re.search(r"^winner: trial \d", out, re.M)
    assert re.search(r"^  length .* mm \(baseline .* mm\)", out, re.M)


def test_other_code_than_began_a_study_is_said_once_and_reported(tmp_path, capsys, tiny):
    folder, path = tmp_path / "study", tmp_path / "study" / "provenance.json"
    run_study(StudyConfig.model_validate(tiny(trials=1, sampler={"name": "random"})), folder, progress=False)
    begun = json.loads(path.read_text())
    begun["versions"]["softgym-envs"] = "0.0.1"
    write_signed(path, begun)
    change = f"begun with softgym-envs 0.0.1; continued with softgym-envs {__version__}"
    wider = {"trials": 2, "sampler": {"name": "random"}, "finalists": {"count": 1, "seeds": 0}}
    results = run_study(StudyConfig.model_validate(tiny(**wider)), folder)
    assert capsys.readouterr().out.count(f"was {change}; what they compute may differ") == 1  # trials and tests run
    assert results.provenance["code_changes"] == [change]
    first = findings(load_study(folder), results)[0]
    assert first.warns and first.title == "The code changed during the study" and change in first.text
    run_study(StudyConfig.model_validate(tiny(**wider)), folder)
    assert "warning" not in capsys.readouterr().out  # nothing was left to do
