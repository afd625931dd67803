"""Benchmarks that are programs explain themselves, and name an argument that is missing."""

import ast
import re
import runpy
import sys

import pytest

from tests.test_readme import ROOT

NEEDED = {
    "carry": "payload, generations",
    "grown_shapes": "folder",
    "structure_policy": "folder",
    "structures": "folder",
    "studies": "FOLDER",
    "zigzag_robust": "folder",
}
"""What each of them cannot do without."""


BARE = ("contact", "hybrid", "motion", "page", "printed")
"""Programs without arguments."""
OTHERS = ("design_networks", "learned_sensors", "learners", "networks", "strategies")


@pytest.mark.parametrize("name", [*NEEDED, *BARE, *OTHERS])
def test_help_of_a_program_is_its_docstring(name, monkeypatch, capsys):
    path = ROOT / "benchmarks" / f"{name}.py"
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as left:
        runpy.run_path(str(path), run_name="__main__")
    assert left.value.code == 0 and ast.get_docstring(ast.parse(path.read_text())) in capsys.readouterr().out


@pytest.mark.parametrize("name", NEEDED)
def test_a_missing_argument_is_named(name, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [name])
    with pytest.raises(SystemExit) as left:
        runpy.run_path(str(ROOT / "benchmarks" / f"{name}.py"), run_name="__main__")
    assert left.value.code == 2 and f"required: {NEEDED[name]}" in capsys.readouterr().err


PROGRAMS = [path for folder in ("benchmarks", "docs") for path in sorted((ROOT / folder).glob("*.py"))]
PROGRAMS = [path for path in PROGRAMS if 'if __name__ == "__main__":' in path.read_text()]


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.stem)
def test_every_program_reads_its_arguments_by_a_parser(path):
    """Else it would take ``--help`` for an argument, or begin its work."""
    assert re.search(r"ArgumentParser\(|@click\.command", path.read_text())


@pytest.mark.parametrize("name", ["make_images", "run_page"])
def test_programs_of_the_documentation_have_help(name, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as left:
        runpy.run_path(str(ROOT / "docs" / f"{name}.py"), run_name="__main__")
    assert left.value.code == 0 and capsys.readouterr().out.startswith(f"usage: {name}")


def test_an_unknown_picture_is_named(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    monkeypatch.setattr(sys, "argv", ["make_images", "fingers"])
    with pytest.raises(SystemExit, match="unknown pictures fingers; allowed: arm,"):
        runpy.run_path(str(ROOT / "docs" / "make_images.py"), run_name="__main__")
