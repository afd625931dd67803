"""Recorded results: each comes from a commit that anyone can check out."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks import run
from softgym_envs.errors import ConfigError
from softgym_envs.extensions.leaderboard.scoring import DATA

COMMIT = "[0-9a-f]{7,40}"

ROOT = Path(__file__).parent.parent

REWRITTEN = {
    "studies/contact_aided_finger/results.json zigzag_robust",
    "softgym_envs/extensions/grasping/chain/weights/contact_aided_finger/model.json provenance",
    "softgym_envs/extensions/sensing/weights/sensorized_finger_2cavities_touched/model.json provenance",
}
"""What comes from a commit that was rewritten before it landed, or had uncommitted changes.

Making it again takes long or needs an idle machine. Nothing may be added here.
"""


def commits(record: Any, place: str) -> Iterator[tuple[str, str]]:
    """Yield the place and the commit of everything in a JSON value that names one."""
    if isinstance(record, dict):
        if isinstance(record.get("commit"), str):
            yield place, record["commit"]
        for name, value in record.items():
            yield from commits(value, f"{place} {name}")
    elif isinstance(record, list):
        for value in record:
            yield from commits(value, place)


def test_searches_of_the_benchmark_come_from_a_commit():
    found = {
        f"{run['problem']} {run['method']} {run['judge']} seed {run['seed']}": run["commit"]
        for run in json.loads((DATA / "runs.json").read_text())
    }
    for folder, key in (("references", "found"), ("submissions", "provenance")):
        for path in (DATA / folder).glob("*.json"):
            origin = json.loads(path.read_text())[key]
            if origin:  # no search has found a better body than the baseline
                found[f"{folder}/{path.name}"] = origin["commit"]
    assert len(found) > 900
    wrong = {name: commit for name, commit in found.items() if not re.fullmatch(COMMIT, str(commit))}
    assert not wrong, "run them again from a clean clone (softgym benchmark run, then table --store)"


def test_recorded_commits_are_in_the_history():
    def git(*arguments: str) -> list[str]:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
        return done.stdout.splitlines()

    if git("rev-parse", "--is-shallow-repository") != ["false"]:
        pytest.skip("needs a checkout with its whole history")
    history = git("rev-list", "HEAD")
    lengths = range(7, 41)
    known = {commit[:length] for commit in history for length in lengths}
    found = {
        (place, commit)
        for file in git("ls-files", "*.json")
        for place, commit in commits(json.loads((ROOT / file).read_text()), file)
    }
    assert len(found) > 300
    lost = {place: commit for place, commit in found if commit not in known and place not in REWRITTEN}
    assert not lost, "measure them again from a clean clone"


def test_results_of_uncommitted_code_are_not_recorded(monkeypatch):
    monkeypatch.setitem(run.BENCHMARKS, "beams", lambda: pytest.fail("must be refused before it runs"))
    monkeypatch.setattr(run.subprocess, "run", lambda *_, **__: type("Done", (), {"stdout": " M README.md\n"}))
    with pytest.raises(ConfigError, match=r"committed code only, but README.md is changed"):
        run.run(["beams"], run.RECORDS)


def test_interrupted_benchmarks_say_how_to_go_on(monkeypatch, tmp_path, capsys):
    def interrupt():
        """Stop."""
        raise KeyboardInterrupt

    def measured():
        """Measure."""
        return {"answer": 42.0}

    monkeypatch.setattr(run, "BENCHMARKS", {"first": measured, "second": interrupt, "third": measured})
    with pytest.raises(KeyboardInterrupt):
        run.run(("first", "second", "first", "third"), tmp_path / "all.json")
    assert f"1 of 3 benchmarks finished; to go on: softgym bench --output {tmp_path}/all.json second third\n" in (
        capsys.readouterr().err
    )
    assert list(json.loads((tmp_path / "all.json").read_text())) == ["first"]
