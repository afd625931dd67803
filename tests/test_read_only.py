"""An installation that nobody can write to, without a home, as in a container, makes, resets and steps every ID."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from softgym_envs import ENVIRONMENTS

ROOT = Path(__file__).parents[1]
MOUNT = 'mount --bind "$0" "$0" && mount -o remount,ro,bind "$0" && cd / && exec "$@"'
"""Makes a folder read-only for one process, also for root."""
STEP = """
import gymnasium, softgym_envs
env = gymnasium.make({id!r})
env.reset(seed=0)
env.step(env.action_space.sample())
"""


def read_only(tmp_path, *command):
    """Run a command for which the checkout is read-only and home cannot be made."""
    environment = {"PATH": "/usr/bin:/bin", "HOME": "/proc/none", "TMPDIR": str(tmp_path), "OMP_NUM_THREADS": "1"}
    started = ["unshare", "--mount", "sh", "-c", MOUNT, str(ROOT), *command]
    return subprocess.run(started, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def caches(tmp_path_factory):
    """The temporary folder of all cases, which keeps their compiled kernels."""
    folder = tmp_path_factory.mktemp("read_only")
    if shutil.which("unshare") is None or read_only(folder, "true").returncode:
        pytest.skip("this machine does not let a test make a folder read-only")
    return folder


@pytest.mark.parametrize("id", ENVIRONMENTS)
def test_every_environment_steps(id, caches):
    done = read_only(caches, sys.executable, "-W", "ignore", "-c", STEP.format(id=id))
    assert done.returncode == 0, done.stderr
    assert "caches are kept in" in done.stderr and "Traceback" not in done.stderr
