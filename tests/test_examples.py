"""The examples run without changes."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def test_there_are_examples():
    assert len(EXAMPLES) >= 4


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_example(path, tmp_path):
    arguments = [str(tmp_path / "image.png")] if "bodies" in path.stem else []
    done = subprocess.run(
        [sys.executable, "-W", "error", str(path), *arguments],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() and not done.stderr.strip()
    if arguments:
        assert (tmp_path / "image.png").read_bytes().startswith(b"\x89PNG")


def test_from_an_stl_to_the_compliance_takes_15_lines():
    lines = (ROOT / "examples" / "04_stl_to_compliance.py").read_text().splitlines()
    assert sum(bool(line.strip()) for line in lines) <= 15
