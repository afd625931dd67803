"""The verb hardware, on an emulation in simulated time: nothing here depends on how late it runs."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

BENCH = """
robot: finger
device: dynamixel
dynamixel:
  port: /dev/null
  servos:
    cable_1: {id: 1, radius: 0.01}
    cable_2: {id: 2, radius: 0.01, reverse: true}
tracker: {port: /dev/null}
"""


def softgym(folder, *arguments):
    command = [sys.executable, "-m", "softgym_envs.cli", "hardware", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


@pytest.fixture
def bench(tmp_path):
    (tmp_path / "bench.yaml").write_text(BENCH)
    return tmp_path


def test_check_says_what_is_measured(bench):
    done = softgym(bench, "check", "bench.yaml", "--emulate", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["actuators"]["cable_2"] == {"displacement": 0.0, "effort": None}
    assert abs(found["effectors"][0][2] + 0.12) < 1e-3


def test_run_reaches_a_goal_and_counts(bench):
    done = softgym(bench, "run", "bench.yaml", "SoftGym/FingerReach-v0", "--agent", "qp", "--emulate", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["episodes"][0]["success"]
    assert found["steps"] > 50 and found["missed"] == found["lost"] == found["unseen"] == 0


def test_ports_that_do_not_exist_are_named(bench):
    done = softgym(bench, "check", "bench.yaml", "dynamixel.port=/dev/missing")
    assert done.returncode == 2 and done.stderr.startswith("softgym: error: port '/dev/missing' cannot be opened: ")
