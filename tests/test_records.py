"""Recorded results of benchmarks: each comes from a commit that anyone can run again."""

from __future__ import annotations

import json
import re

import pytest

from benchmarks import run
from benchmarks.recorded import SOURCES
from softgym_envs.errors import ConfigError

ENTRIES = [(path.name, name, entry) for path in SOURCES for name, entry in json.loads(path.read_text()).items()]


@pytest.mark.parametrize(("file", "name", "entry"), ENTRIES, ids=["-".join(entry[:2]) for entry in ENTRIES])
def test_recorded_results_come_from_a_commit(file, name, entry):
    commit = str(entry.get("commit"))
    assert re.fullmatch("[0-9a-f]{7,40}", commit), f"'{name}' in {file} comes from {commit}: measure it again"


def test_results_of_uncommitted_code_are_not_recorded(monkeypatch):
    monkeypatch.setitem(run.BENCHMARKS, "networks", lambda: pytest.fail("must be refused before it runs"))
    monkeypatch.setattr(run.subprocess, "run", lambda *_, **__: type("Done", (), {"stdout": " M README.md\n"}))
    with pytest.raises(ConfigError, match=r"committed code only, but README.md is changed"):
        run.run(["networks"], run.RECORDS)
