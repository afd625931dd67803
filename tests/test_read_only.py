"""An installation that nobody can write to, without a home, as in a container, keeps its caches elsewhere."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MOUNT = 'mount --bind "$0" "$0" && mount -o remount,ro,bind "$0" && cd / && exec "$@"'
"""Makes a folder read-only for one process, also for root."""
STEP = """
import gymnasium, softgym_envs
env = gymnasium.make("SoftGym/FingerReach-v0", backend={backend!r})
env.reset(seed=0)
env.step(env.action_space.sample())
"""


def read_only(tmp_path, *command):
    """Run a command for which the checkout is read-only and home cannot be made."""
    environment = {"PATH": "/usr/bin:/bin", "HOME": "/proc/none", "TMPDIR": str(tmp_path), "OMP_NUM_THREADS": "1"}
    started = ["unshare", "--mount", "sh", "-c", MOUNT, str(ROOT), *command]
    return subprocess.run(started, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("backend", ["surrogate", "fem"])
def test_an_environment_steps(backend, tmp_path):
    """Environments write compiled kernels and meshes, all of them with the same code."""
    if shutil.which("unshare") is None or read_only(tmp_path, "true").returncode:
        pytest.skip("this machine does not let a test make a folder read-only")
    done = read_only(tmp_path, sys.executable, "-W", "ignore", "-c", STEP.format(backend=backend))
    assert done.returncode == 0, done.stderr
    assert "caches are kept in" in done.stderr and "Traceback" not in done.stderr
