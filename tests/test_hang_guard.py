"""A test that hangs ends its process with a traceback; a test on a slow machine is not stopped."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def run(code):
    start = "import sys, threading, time\nfrom tests import hang_guard\n"
    return subprocess.run([sys.executable, "-c", start + code], cwd=ROOT, capture_output=True, text=True, check=False)


def test_a_block_that_hangs_ends_with_its_stack():
    code = """
def forever():
    threading.Event().wait()

with hang_guard.end_if_hung(sys.stderr, limit=0.2, interval=0.05):
    forever()
"""
    done = run(code)
    assert done.returncode == 1
    assert "Timeout" in done.stderr and "in forever" in done.stderr


def test_a_busy_machine_is_given_more_time():
    code = """
hang_guard.slowdown = lambda: 1e6
with hang_guard.end_if_hung(sys.stderr, limit=0.1, interval=0.05):
    time.sleep(0.5)
time.sleep(0.3)
print("done")
"""
    done = run(code)
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\n", "")


def test_load_is_per_core(monkeypatch):
    from tests import hang_guard

    monkeypatch.setattr("os.sched_getaffinity", lambda process: {0, 1})
    for load, expected in ((0.5, 1.0), (2.0, 1.0), (8.0, 4.0)):
        monkeypatch.setattr("os.getloadavg", lambda load=load: (load, 0.0, 0.0))
        assert hang_guard.slowdown() == expected
