"""A problem with two goals, which is scored in a second on finite elements."""

import shutil
from pathlib import Path

import pytest
import yaml

from softgym_envs.extensions.leaderboard import frozen

ROOT = Path(__file__).parents[3]
SHIPPED = ROOT / "softgym_envs" / "extensions" / "leaderboard" / "problems"


def tiny_definition(**changes):
    problem = yaml.safe_load((SHIPPED / "finger-zone-v1.yaml").read_text())
    counts = {"training": 3, "search": 2, "validation": 1, "test": 1}
    for name, count in counts.items():
        problem["goals"][name]["count"] = count
    budget = {"environment_steps": 700, "cpu_seconds": 600, "fem_solves": 1000}
    levels = dict.fromkeys(("small", "medium", "large"), budget)
    return {**problem, "name": "tiny-v1", "judge": "shared", "budgets": levels, **changes}


@pytest.fixture
def problems(tmp_path, monkeypatch):
    """A folder of problems with one, ``tiny-v1``, not yet frozen."""
    folder = tmp_path / "problems"
    folder.mkdir()
    monkeypatch.setattr(frozen, "_folder", lambda: folder)
    (folder / "tiny-v1.yaml").write_text(yaml.safe_dump(tiny_definition()))
    return folder


@pytest.fixture
def tiny(problems):
    """The problem ``tiny-v1``, frozen."""
    frozen.freeze("tiny-v1")
    return frozen.load_problem("tiny-v1")


@pytest.fixture
def data(tmp_path):
    folder = tmp_path / "data"
    yield folder
    shutil.rmtree(folder, ignore_errors=True)
