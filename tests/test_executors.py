"""Parallel calls on processes: results, errors, and no process left behind."""

import math
import operator
import os
import signal
import subprocess
import sys

import pytest

from softgym_envs.executors import parallel_map
from tests.helpers import live_processes, wait_until

# Functions of the standard library: workers cannot import test files.
SQUARES = [(k, k) for k in range(20)]


@pytest.mark.parametrize("workers", [1, 2])
def test_every_call_is_made_once(workers):
    assert sorted(parallel_map(operator.mul, SQUARES, workers)) == [k * k for k in range(20)]
    assert list(parallel_map(operator.mul, [], workers)) == []


def test_one_worker_is_this_process():
    here = os.getpid()
    assert set(parallel_map(os.getpid, [()] * 3, 1)) == {here}
    assert set(parallel_map(os.getpid, [()], 2)) == {here}
    assert here not in set(parallel_map(os.getpid, [()] * 3, 2))


@pytest.mark.parametrize("workers", [1, 2])
def test_errors_reach_the_caller(workers):
    with pytest.raises(ValueError, match="math domain error"):
        list(parallel_map(math.sqrt, [(4.0,), (-1.0,), (9.0,)], workers))


def test_workers_end_with_their_owner():
    """Busy and idle workers end after their owner was killed."""
    code = (
        "import time; from softgym_envs.executors import parallel_map\n"
        "arguments = [(0,), (0,), (600,)]\n"
        "for _ in parallel_map(time.sleep, arguments, 3): print('done', flush=True)"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
    ) as process:
        try:
            assert process.stdout is not None
            assert [process.stdout.readline() for _ in range(2)] == [b"done\n"] * 2
            assert len(live_processes(process.pid)) >= 4  # the owner, three workers and the tracker of shared memory
            # The owner remains a zombie while the workers notice its end.
            os.kill(process.pid, signal.SIGKILL)
            wait_until(lambda: not live_processes(process.pid))
        finally:
            for left in live_processes(process.pid):
                os.kill(left, signal.SIGKILL)


def test_ctrl_c_of_workers_with_progress_bars_is_quiet():
    bar = "import time, tqdm\nwith tqdm.tqdm(total=2) as bar:\n    bar.update()\n    bar.refresh()\n    time.sleep(600)"
    code = f"from softgym_envs.executors import parallel_map\nlist(parallel_map(exec, [({bar!r},)] * 2, 2))"
    with subprocess.Popen(
        [sys.executable, "-c", f"import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n{code}"],
        stderr=subprocess.PIPE,
        start_new_session=True,
    ) as process:
        try:
            assert process.stderr is not None
            seen = b""
            while seen.count(b"1/2") < 2:
                seen += os.read(process.stderr.fileno(), 4096)
            os.killpg(process.pid, signal.SIGINT)
            assert b"leaked" not in process.stderr.read() and process.wait() != 0
            wait_until(lambda: not live_processes(process.pid))
        finally:
            for left in live_processes(process.pid):
                os.kill(left, signal.SIGKILL)
