"""Jobs on processes and on Ray: results, errors, and no process left behind."""

import math
import operator
import os
import signal
import subprocess
import sys

import pytest

from softgym_envs.executors import EXECUTORS, run_jobs
from softgym_envs.testing import live_processes, wait_until

# Jobs are of the standard library: workers cannot import test files.
SQUARES = [(operator.mul, (k, k)) for k in range(20)]


def test_unknown_executor():
    with pytest.raises(ValueError, match=r"'threads' is unknown; allowed: 'loky', 'ray'"):
        list(run_jobs(SQUARES, 2, "threads"))


@pytest.mark.parametrize("workers", [1, 2])
def test_every_job_is_done_once(workers):
    assert sorted(run_jobs(SQUARES, workers)) == [k * k for k in range(20)]
    assert list(run_jobs([], workers)) == []


def test_one_worker_is_this_process():
    here = os.getpid()
    assert set(run_jobs([(os.getpid, ())] * 3, 1)) == {here}
    assert set(run_jobs([(os.getpid, ())], 2)) == {here}
    assert here not in set(run_jobs([(os.getpid, ())] * 3, 2))


@pytest.mark.parametrize("workers", [1, 2])
def test_errors_arrive(workers):
    with pytest.raises(ValueError, match="math domain error"):
        list(run_jobs([(math.sqrt, (4.0,)), (math.sqrt, (-1.0,)), (math.sqrt, (9.0,))], workers))


def test_workers_end_with_their_owner():
    """Busy and idle ones, when nobody was left to tell them."""
    code = (
        "import time; from softgym_envs.executors import run_jobs\n"
        "jobs = [(time.sleep, (0,)), (time.sleep, (0,)), (time.sleep, (600,))]\n"
        "for _ in run_jobs(jobs, 3): print('done', flush=True)"
    )
    # What a worker says of its owner's death is of no interest.
    command = [sys.executable, "-c", code]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
    ) as process:
        try:
            assert process.stdout is not None
            assert [process.stdout.readline() for _ in range(2)] == [b"done\n"] * 2
            assert (
                len(live_processes(process.pid)) >= 4
            )  # the owner, three workers; and what watches over shared memory
            # Nobody has taken note of the death yet when the workers have to see it.
            os.kill(process.pid, signal.SIGKILL)
            wait_until(lambda: not live_processes(process.pid))
        finally:
            for left in live_processes(process.pid):
                os.kill(left, signal.SIGKILL)


def test_ray_that_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r"executor = 'ray' needs Ray \(.*\): pip install 'softgym-envs\[ray\]'"):
        list(run_jobs(SQUARES, 2, "ray"))


# Ray leaves files and sockets of its cluster to the garbage collector.
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_ray():
    ray = pytest.importorskip("ray")
    assert "ray" in EXECUTORS
    assert list(run_jobs([], 2, "ray")) == []
    assert sorted(run_jobs(SQUARES, 2, "ray")) == [k * k for k in range(20)]
    assert not ray.is_initialized()  # the cluster that was started for the jobs is gone
    with pytest.raises(ValueError, match="math domain error"):
        list(run_jobs([(math.sqrt, (4.0,)), (math.sqrt, (-1.0,))], 2, "ray"))
    assert not ray.is_initialized()
