"""A small study that is fast because it trains nothing: the inverse QP scores bodies."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.folder import StudyFolder

ROOT = Path(__file__).resolve().parents[2]
RUN = """
import signal
import sys
from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.study import run_study
from softgym_envs.config import load_config
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored if the parent runs in the background
run_study(load_config(sys.argv[1], StudyConfig), sys.argv[2])
"""


def _tiny(**changes):
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


@pytest.fixture(scope="session")
def tiny():
    """Function ``tiny(**changes)``: plain data of a tiny study."""
    return _tiny


@pytest.fixture
def study(tmp_path):
    """Function ``study(**changes) -> StudyFolder``: the folder of a tiny study that has not run yet."""
    return lambda **changes: StudyFolder.create(tmp_path / "study", StudyConfig.model_validate(_tiny(**changes)))


@pytest.fixture(scope="session")
def start_study():
    """Function ``start_study(folder, data)``: run a study in another process."""

    def start(folder, data):
        path = folder.with_suffix(".yaml")
        path.write_text(yaml.safe_dump(data))
        command = [sys.executable, "-c", RUN, str(path), str(folder)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    return start
