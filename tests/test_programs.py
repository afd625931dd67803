"""Benchmarks that are programs explain themselves, and name an argument that is missing."""

import ast
import runpy
import sys

import pytest

from tests.test_readme import ROOT

NEEDED = {
    "carry": "payload, generations",
    "grown_shapes": "folder",
    "structure_policy": "folder",
    "structures": "folder",
    "zigzag_robust": "folder",
}
"""What each of them cannot do without."""


@pytest.mark.parametrize("name", [*NEEDED, "design_networks", "learned_sensors", "learners", "networks", "strategies"])
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
