"""Your own robot, from `examples/05_own_robot.py`: trained and co-designed without touching the package."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from softgym_envs import make_robot
from softgym_envs.agents.config import TrainConfig
from softgym_envs.agents.evaluation import evaluate, sample_goals
from softgym_envs.agents.training import train

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "05_own_robot.py"
ENVIRONMENT = {"robot": "own_robot:Arm", "task": "reach", "robot_options": {"layers": 4}, "max_episode_steps": 10}
STUDY = {
    "name": "own",
    "environment": ENVIRONMENT,
    "variables": ["length", "width"],
    "strategy": "qp",
    "trials": 3,
    "goals": {"source": "task", "count": 3, "unseen_count": 2},
    "finalists": {"count": 1},
}
# Ends with the traceback of a plain bug.
BUG = "nodes = (self.nodes - [0.5, 0.5, 0.0])"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the module ``own_robot``, where Python finds it."""
    (tmp_path / "own_robot.py").write_text(EXAMPLE.read_text())
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("own_robot", None)


def codesign(folder):
    """Run the study by the command line in ``folder``, as a user does."""
    (folder / "study.yaml").write_text(yaml.safe_dump(STUDY))
    command = [
        sys.executable,
        "-m",
        "softgym_envs.cli",
        "codesign",
        "--config",
        "study.yaml",
        "--folder",
        "study",
        "--allow-code",
    ]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_the_robot_has_at_most_forty_lines():
    tree = ast.parse(EXAMPLE.read_text())
    arm = next(node for node in tree.body if isinstance(node, ast.ClassDef))
    assert arm.end_lineno - arm.lineno + 1 <= 40


def test_it_is_trained(folder):
    config = TrainConfig.model_validate(
        {
            "environment": ENVIRONMENT,
            "sac": {"net_arch": [8], "batch_size": 8, "learning_starts": 4, "gradient_steps": 1},
            "steps": 20,
            "num_envs": 1,
            "evaluation_episodes": 1,
            "report_every": 10,
        }
    )
    policy = train(config, folder / "run", progress=False)
    outcome = evaluate(policy, config.environment, sample_goals(config.environment, 1, seed=0))
    assert np.isfinite(outcome.distances).all()


def test_it_is_co_designed(folder):
    done = codesign(folder)
    assert done.returncode == 0, done.stderr
    assert (folder / "study" / "results.json").exists()


def test_a_bug_in_its_file_ends_the_study_with_a_traceback(folder):
    path = folder / "own_robot.py"
    source = path.read_text()
    assert BUG in source
    path.write_text(source.replace(BUG, "nodes = (self.nodes - [0.5, 0.5])"))
    with pytest.raises(ValueError, match="could not be broadcast"):
        make_robot("own_robot:Arm").build()
    done = codesign(folder)
    assert done.returncode not in (0, 2)
    assert "could not be broadcast" in done.stderr + done.stdout
    assert "Traceback" in done.stderr + done.stdout
    assert "infeasible" not in done.stdout
