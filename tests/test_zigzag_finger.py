"""The comparison of grasps with recorded trials: reading, statistics, and bad rows."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import pytest
from click.testing import CliRunner

from benchmarks import zigzag_finger
from benchmarks.zigzag_finger import OBJECTIVES, SCENES, Outcome, Trial, evaluate, main, read_trials, summary
from softgym_envs.errors import DataError

NAMES = [*(f"d{k}" for k in range(12)), "e1", "e2", "e3"]
DESIGN = {name: 0.008 if name.startswith("e") else 0.021 for name in NAMES}
RECORDED = {"obj0": 0.1, "obj1": 2.0, "obj2": 1.0}


def write(path, rows, columns=None):
    columns = columns or ["trial", *NAMES, *OBJECTIVES.values()]
    with open(path, "w", newline="") as stream:
        writer = csv.DictWriter(stream, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    return str(path)


def row(number, **changes):
    return {"trial": number, **DESIGN, **RECORDED, **changes}


def outcome(number, ours, theirs, **changes):
    trial = Trial(str(number), {}, dict(zip(OBJECTIVES, theirs, strict=True)))
    good = Outcome(trial, dict(zip(OBJECTIVES, ours, strict=True)), "", "ok", 1.0, 2500, False, 4e-4)
    return replace(good, **changes)


def test_rows_are_read_in_any_order_of_columns_and_bad_ones_kept(tmp_path):
    path = write(tmp_path / "t.csv", [row(3), row(5, e1="thick"), row(7, obj1="inf"), row(9, d0="")])
    trials = read_trials(path)
    assert [trial.name for trial in trials] == ["3", "5", "7", "9"]
    assert trials[0].design == DESIGN
    assert trials[0].recorded == {"resistance": 0.1, "force": 2.0, "energy": 1.0}
    assert [bool(trial.error) for trial in trials] == [False, True, True, True]
    assert "thick" in trials[1].error and "not finite" in trials[2].error


def test_files_that_cannot_be_used(tmp_path):
    with pytest.raises(DataError, match="cannot be read"):
        read_trials(tmp_path / "none.csv")
    columns = ["trial", *NAMES[:7], "e1", "e2", "e3", "obj0", "obj2"]
    with pytest.raises(DataError, match="lack the columns: obj1"):
        read_trials(write(tmp_path / "a.csv", [row(0)], columns))
    with pytest.raises(DataError, match="7 or 12"):
        read_trials(write(tmp_path / "b.csv", [row(0)], ["trial", *NAMES[:9], *NAMES[12:], *OBJECTIVES.values()]))


def test_statistics():
    outcomes = [
        outcome(0, (0.1, 2.2, 1.0), (0.1, 2.0, 1.0)),
        outcome(1, (0.2, 3.0, 2.0), (0.2, 3.0, 1.0)),
        outcome(2, (0.3, 3.6, 0.5), (0.3, 4.0, 3.0), seconds=3.0),
        Outcome(Trial("3"), {}, "crosses itself", "infeasible", 0.1, 0, False, float("inf")),
    ]
    found = summary(outcomes)
    assert (found["count"], found["failures"]) == (4, 1)
    assert found["failures_by_reason"] == {"infeasible": 1}
    assert found["spearman"] == {"resistance": 1.0, "force": 1.0, "energy": -0.866}
    assert found["median_ratio"] == {"resistance": 1.0, "force": 1.0, "energy": 1.0}
    assert found["median_error"]["force"] == pytest.approx(0.1)
    assert found["worst_error"]["energy"] == pytest.approx(1.0)
    assert found["worst_trial"]["energy"] == "1"
    assert found["cpu_seconds_worst"] == 3.0
    json.dumps(found, allow_nan=False)


def test_statistics_of_nothing():
    found = summary([])
    assert found["count"] == 0 and found["spearman"] == {"resistance": None, "force": None, "energy": None}


def test_designs_out_of_bounds_are_failures():
    found = evaluate(Trial("0", DESIGN | {"e1": 0.5}, {}), SCENES["plane"], "published", 4)
    assert not found.objectives and found.status == "bad row" and "'e1' = 0.5 m is out of bounds" in found.failure


def test_command_prints_one_json_object(tmp_path, monkeypatch):
    """Rows that fail are counted and explained on stderr; all of stdout is one JSON object."""

    def fake(trial, scene, mesh, angles):
        if trial.error:
            return Outcome(trial, {}, trial.error, "bad row", 0.0, 0, False, float("inf"))
        ours = {name: 1.1 * value for name, value in trial.recorded.items()}
        return Outcome(trial, ours, "", "ok", 1.0, 2500, False, 4e-4)

    monkeypatch.setattr(zigzag_finger, "evaluate", fake)
    rows = [row(0), row(1, e2="?"), row(2, obj1=3.0), row(3)]
    path = write(tmp_path / "t.csv", rows)
    done = CliRunner().invoke(main, [path, "--limit", "3", "--object", "sphere", "--mesh", "accurate"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert (found["count"], found["failures"]) == (3, 1)
    assert found["median_ratio"] == pytest.approx({"resistance": 1.1, "force": 1.1, "energy": 1.1})
    assert set(found["spearman"]) == {"resistance", "force", "energy"}
    assert "trial 1: bad row" in done.stderr


def test_a_missing_file_is_one_line():
    done = CliRunner().invoke(main, ["/nowhere.csv"])
    assert done.exit_code == 1 and done.stderr.startswith("Error: trials '/nowhere.csv' cannot be read")


def test_one_real_trial(tmp_path):
    """A light finger on the published mesh, in few steps."""
    path = write(tmp_path / "t.csv", [row(0)])
    done = CliRunner().invoke(main, [path, "--angles", "5"])
    found = json.loads(done.stdout)
    assert (found["count"], found["failures"]) == (1, 0), done.stderr
    assert found["median_ratio"]["force"] > 0.0 and found["smallest_gap_mm"] > 0.0
