"""Programs outside the package explain themselves, and read their arguments by a parser."""

import re
import runpy
import sys

import pytest

from tests.test_readme import ROOT

PROGRAMS = [path for folder in ("benchmarks", "docs") for path in sorted((ROOT / folder).glob("*.py"))]
PROGRAMS = [path for path in PROGRAMS if 'if __name__ == "__main__":' in path.read_text()]


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.stem)
def test_every_program_reads_its_arguments_by_a_parser(path):
    """Else it would take ``--help`` for an argument, or begin its work."""
    assert re.search(r"ArgumentParser\(|@click\.command", path.read_text())


@pytest.mark.parametrize("name", ["figures", "make_images", "run_page"])
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
