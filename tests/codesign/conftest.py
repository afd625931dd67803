"""A small study that is fast because it needs no training: bodies are scored by the inverse QP."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from codesign.config import StudyConfig

ROOT = Path(__file__).resolve().parents[2]
RUN = """
import sys
from codesign.config import StudyConfig
from codesign.study import run_study
from softgym_envs.config import load_config
run_study(load_config(sys.argv[1], StudyConfig), sys.argv[2])
"""


def tiny(**changes: Any) -> dict[str, Any]:
    """Plain data of a tiny study."""
    return {
        "name": "tiny",
        "environment": {"id": "SoftGym/FingerReach-v0"},
        "variables": ["height", "joint_height"],
        "strategy": "qp",
        "trials": 6,
        "goals": {"count": 6, "unseen_count": 3, "training_count": 4},
        "sampler": {"name": "tpe", "options": {"n_startup_trials": 3}},
        "finalists": {"count": 0},
        **changes,
    }


@pytest.fixture
def config() -> Callable[..., StudyConfig]:
    return lambda **changes: StudyConfig.model_validate(tiny(**changes))


def start_study(path: Path, folder: Path, data: dict[str, Any]) -> subprocess.Popen[str]:
    """Run a study in a process of its own."""
    path.write_text(yaml.safe_dump(data))
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", RUN, str(path), str(folder)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
