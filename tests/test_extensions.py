"""Extensions: the package of `examples/package` adds one of each, and the core knows no extension by name."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from softgym_envs.registry import Table

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "package"
POINTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
CORE = [
    path
    for folder in ("softgym_envs", "agents", "codesign")
    for path in (ROOT / folder).rglob("*.py")
    if "extensions" not in path.relative_to(ROOT).parts
]
USES = """
import gymnasium
import numpy as np
from click.testing import CliRunner

import softgym_envs
from softgym_envs.agents import TrainConfig, evaluate, train
from softgym_envs.agents.evaluation import sample_goals
from softgym_envs.backends import make_backend
from softgym_envs.cli.app import cli
from softgym_envs.extensions.report.page import SECTIONS
from softgym_envs.codesign.sampling import SamplerConfig, make_sampler
from softgym_envs.extensions.design.bodies import StateEvaluator
from softgym_envs.surrogate import pretrained_model

robot = softgym_envs.make_robot("peg")
model = pretrained_model(robot)
assert model.members == 2, model
state = make_backend("rounded", robot).step(np.array([0.00123]))
assert abs(state.displacement[0] - 0.0012) < 1e-9
env = gymnasium.make("Example/PegHover-v0")
assert type(env.unwrapped.backend).__name__ == "SurrogateBackend" and env.unwrapped.task.name == "hover"
env.reset(seed=0)
assert env.step(env.action_space.sample())[1] > 0.0
config = TrainConfig.model_validate(
    {
        "environment": {"id": "Example/PegHover-v0"},
        "learner": "guessing",
        "guessing": {"spread": 0.5},
        "steps": 60,
        "num_envs": 2,
        "evaluation_episodes": 2,
        "report_every": 30,
    }
)
policy = train(config, "training", progress=False)
goals = sample_goals(config.environment, 2, seed=1)
for agent in (policy, "idle"):
    assert len(evaluate(agent, config.environment, goals).returns) == 2
found = StateEvaluator(robot, ["slenderness"], backend="fem").measure({"length": 0.06, "width": 0.012})
assert abs(found["slenderness"] - 5.0) < 1e-12
assert type(make_sampler(SamplerConfig(name="brute"), 0)).__name__ == "BruteForceSampler"
assert SECTIONS["peg"].title == "Pegs"
found = CliRunner().invoke(cli, ["peg"])
assert found.output == f"{1e3 * robot.build().mass:.1f} g\\n", found.output
assert "peg " in CliRunner().invoke(cli, []).output
"""


def install(source, folder, name):
    """Build and install a package from a copy of its sources, without network, to a folder of its own."""
    copy = folder / f"{name}_sources"
    shutil.copytree(source, copy, ignore=shutil.ignore_patterns("__pycache__", "build", "*.egg-info"))
    target = folder / name
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
        "--target",
        target,
    ]
    subprocess.run([*pip, copy], check=True, capture_output=True, text=True)
    return target


def run(code, folder, path):
    environment = {**os.environ, "PYTHONPATH": f"{path}{os.pathsep}{ROOT}"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_package_of_your_own_adds_one_of_each(tmp_path):
    target = install(EXAMPLE, tmp_path, "site")
    assert (target / "peg" / "weights" / "peg" / "model.safetensors").is_file()
    run(USES, tmp_path, target)


def test_listing_imports_no_package(tmp_path):
    target = install(EXAMPLE, tmp_path, "site")
    code = """
import sys
from softgym_envs.agents.learners import LEARNERS
from softgym_envs.backends.registry import BACKENDS
from softgym_envs.cli.app import VERBS
from softgym_envs.codesign.metrics.metric import METRICS
from softgym_envs.envs.tasks.registry import TASKS
from softgym_envs.robots.registry import ROBOTS
tables = (ROBOTS, TASKS, BACKENDS, LEARNERS, METRICS, VERBS)
assert all(len(list(table)) > 1 for table in tables) and "peg" in ROBOTS
print(*(name for name in sys.modules if name.split(".")[0] == "peg" or ".extensions." in name))
"""
    loaded = run(code, tmp_path, target).split()
    own = {"peg", "peg.task"}  # rows of environments are read when the suite registers them
    assert set(loaded) - own <= {name for name in loaded if name.endswith(".environments") or name.count(".") == 2}


@pytest.mark.parametrize(
    ("group", "table"),
    [("robots", "softgym_envs.robots.registry:ROBOTS"), ("verbs", "softgym_envs.cli.app:VERBS")],
)
def test_a_name_of_the_suite_cannot_be_taken(group, table, tmp_path):
    module, _, name = table.partition(":")
    taken = "finger" if group == "robots" else "train"
    info = tmp_path / "thief-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: thief\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[softgym_envs.{group}]\n{taken} = thief:Thing\n")
    code = f"from {module} import {name}\ntry:\n    {name}['{taken}']\nexcept ValueError as error:\n    print(error)"
    message = run(code, tmp_path, tmp_path)
    assert re.fullmatch(
        rf"\w+ '{taken}' is softgym_envs\.\S+ and also thief:Thing, an entry point of the package 'thief': .*\n",
        message,
    )


@pytest.mark.parametrize("group", POINTS)
def test_entry_points_of_the_suite_lead_somewhere(group):
    table = Table(group, {}, group=group)
    assert POINTS[group].keys() <= set(table)
    for name in POINTS[group]:
        assert table[name] is not None
    assert all(value.startswith("softgym_envs.extensions.") for value in POINTS[group].values())


def test_the_core_names_no_extension():
    """No string of the core is a name that only an extension registers, nor the module of one.

    Names that are plain words, such as the agent "force", count where the core would have to say them to ask for a
    kind: robots, tasks and learners. An import of an extension under any name fails in test_imports.py.
    """
    kinds = [f"softgym_envs.{kind}" for kind in ("robots", "tasks", "learners")]
    plain = "softgym_envs.metrics"  # physical quantities, of which the core has its own
    names = {
        name
        for group, points in POINTS.items()
        for name in points
        if group in kinds or (group != plain and "_" in name)
    }
    names |= {f"SoftGym/{kind}-v0" for kind in ("FingerGrasp", "GripperLift", "ModularReach", "SensorizedFingerReach")}
    assert len(names) > 20 and len(CORE) > 200
    found = []
    for path in CORE:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                if node.value in names or "softgym_envs.extensions." in node.value:
                    found.append(f"{path.relative_to(ROOT)}, line {node.lineno}: {node.value[:60]!r}")
    assert found == []
