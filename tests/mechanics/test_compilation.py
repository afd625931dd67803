"""The cache of compiled kernels."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys

import pytest

from softgym_envs.mechanics import compilation

PACKAGE = compilation.ROOT
KERNEL = """
from tiny.mechanics.compilation import njit

LENGTH = {length}

@njit(cache=True)
def length():
    return LENGTH
"""
CALLER = """
from tiny.mechanics.compilation import njit
from tiny.kernel import length

@njit(cache=True)
def twice():
    return 2 * length()

print(twice(), *(sum(counts.values()) for counts in twice.stats[1:]))
"""

PLACE = """
from typing import NamedTuple

class Place(NamedTuple):
    x: float
"""
USER = """
from tiny.mechanics.compilation import njit
from tiny.{module} import Place

@njit(cache=True)
def twice(place):
    return 2.0 * place.x

print(twice(Place(1.0)), *(sum(counts.values()) for counts in twice.stats[1:]))
"""


@pytest.fixture
def edited(monkeypatch):
    """A function that pretends that a file has another content."""

    def edit(file):
        compilation.source_hash.cache_clear()
        text = compilation._text
        monkeypatch.setattr(compilation, "_text", lambda path: text(path) + ("# edited" if path == file else ""))

    yield edit
    monkeypatch.undo()
    compilation.source_hash.cache_clear()


def tiny_package(folder):
    """Make a small package with a copy of the module."""
    package = folder / "tiny"
    (package / "mechanics").mkdir(parents=True)
    shutil.copy(compilation.__file__, package / "mechanics" / "compilation.py")
    return package


def printed(module, folder):
    """Return the words that a module of the small package prints."""
    command = [sys.executable, "-c", f"import tiny.{module}"]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout.split()


@pytest.mark.parametrize(
    ("file", "depends"),
    [
        ("extensions/beams/solver/batch.py", True),
        ("extensions/beams/solver/motion.py", True),
        ("extensions/beams/beam_kernels.py", True),  # over equations
        ("mechanics/solvers/equilibrium.py", True),  # constants
        ("mechanics/contact/obstacles.py", True),  # its classes are named beside the kernels of contact
        ("mechanics/solvers/statics.py", False),
    ],
)
def test_kernels_depend_on_the_files_that_their_code_comes_from(edited, file, depends):
    path = PACKAGE / "extensions/beams/solver/batch.py"
    before = compilation.source_hash(path)
    edited(PACKAGE / file)
    assert (compilation.source_hash(path) != before) == depends


def test_an_edit_of_a_kernel_recompiles_kernels_of_other_files_that_call_it(tmp_path):
    """Numba alone would go on with the old code."""
    package = tiny_package(tmp_path)
    (package / "caller.py").write_text(CALLER)

    def run(length):
        (package / "kernel.py").write_text(KERNEL.format(length=length))
        return printed("caller", tmp_path)

    assert run(1) == ["2", "0", "1"]  # result, loaded from the cache, compiled
    assert run(1) == ["2", "1", "0"]
    assert run(3) == ["6", "0", "1"]


def test_kernels_whose_types_have_moved_are_compiled_again(tmp_path):
    """As after an upgrade. Numba alone would not find the old module."""
    package = tiny_package(tmp_path)

    def run(module):
        (package / f"{module}.py").write_text(PLACE)
        (package / "user.py").write_text(USER.format(module=module))
        return printed("user", tmp_path)

    assert run("old") == ["2.0", "0", "1"]
    (package / "old.py").unlink()
    assert run("new") == ["2.0", "0", "1"]
    assert run("new") == ["2.0", "1", "0"]


def test_all_kernels_use_this_cache():
    sources = {path: path.read_text() for path in compilation.ROOT.rglob("*.py") if path.name != "compilation.py"}
    own = re.compile(r"^from numba import .*jit|^import numba", re.MULTILINE)
    assert [path for path, text in sources.items() if own.search(text)] == []
