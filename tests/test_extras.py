"""Core without extras: one line says what to install; the first use says that it compiles."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib import import_module
from importlib.metadata import packages_distributions
from pathlib import Path

import numba
import pytest
import yaml

from softgym_envs.errors import MissingLibrary
from softgym_envs.extras import EXTRAS, SYSTEM_PACKAGES, explain, require
from softgym_envs.mechanics.compilation import ANNOUNCED
from softgym_envs.version import __version__

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture
def without(monkeypatch):
    """Function ``without(module)``: make a module look as if it were not installed."""
    import_module("scipy.stats")  # looks for torch when it is imported, and takes None for a module

    return lambda module: monkeypatch.setitem(sys.modules, module, None)


@pytest.mark.parametrize(
    ("module", "extra", "arguments"),
    [
        ("torch", "train", ["train", "--config", "finger_reach", "--folder", "x"]),
        ("pyvista", "viewer", ["show", "finger", "--picture", "x.png"]),
        ("rerun", "viewer", ["rollout", "SoftGym/FingerReach-v0", "--record", "x.rrd"]),
        ("optuna", "codesign", ["codesign", "--config", "finger_reach"]),
        ("markupsafe", "codesign", ["codesign", "--config", "finger_reach"]),
        ("optuna", "codesign", ["benchmark", "run", "finger-zone-v1", "--method", "tpe"]),
        ("gmsh", "geometry", ["show", "finger", "--option", "mesh_size=0.0061"]),
    ],
)
def test_a_missing_library_is_one_line_that_names_its_extra(
    module, extra, arguments, softgym, without, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    if module == "gmsh":  # which another process imports
        (tmp_path / "gmsh.py").write_text("raise ModuleNotFoundError(\"No module named 'gmsh'\", name='gmsh')\n")
        monkeypatch.syspath_prepend(tmp_path)
    else:
        without(module)
    status, _, err = softgym(*arguments)
    assert status == 2 and len(err.strip().splitlines()) == 1
    assert f"{module} is not installed; install it with: pip install 'softgym-envs[{extra}]'" in err


def test_the_same_line_in_python(without):
    without("torch")
    with pytest.raises(MissingLibrary, match=r"torch is not installed; .*\[train\]"):
        require("train")
    require("viewer")
    assert explain(ModuleNotFoundError("No module named 'nonsense'", name="nonsense")) is None
    assert explain(OSError("disk full")) is None


def test_a_missing_system_library_is_named_with_the_packages_to_install():
    problem = OSError("libGLU.so.1: cannot open shared object file: No such file or directory")
    assert explain(problem).startswith("libGLU.so.1, a system library, is missing; on Debian")
    assert "libglu1-mesa" in explain(problem)


def test_extras_are_those_of_the_package():
    extras = PROJECT["optional-dependencies"]
    assert set(EXTRAS) <= set(extras)
    page = (ROOT / "docs" / "install.md").read_text()
    assert [extra for extra in set(extras) - {"test", "docs", "compare"} if f"`{extra}`" not in page] == []


def test_every_imported_library_is_of_the_core_or_of_an_extra():
    """A library that comes only with another one is missing without it, and no line would say what to install."""
    core = {re.split(r"[<>=;\[]", line)[0] for line in PROJECT["dependencies"]}
    distributions = packages_distributions()
    known = {module for modules in EXTRAS.values() for module in modules}
    found = {}
    for folder in ("softgym_envs", "agents", "codesign"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                names += [node.module] if isinstance(node, ast.ImportFrom) else []
                found |= {name.partition(".")[0]: path.relative_to(ROOT) for name in names}
    ours = {"softgym_envs", "benchmarks", "__main__", "pydantic_core"}  # the last one is a part of pydantic
    others = {module: path for module, path in found.items() if module not in {*sys.stdlib_module_names, *ours}}
    assert "numpy" in others and "markupsafe" in others
    assert {
        module: str(path)
        for module, path in others.items()
        if module not in known and not {module, *(name.lower() for name in distributions.get(module, []))} & core
    } == {}


def test_system_packages_are_the_same_everywhere():
    for name in ("Makefile", "Dockerfile", "docs/install.md"):
        words = (ROOT / name).read_text().replace("\\", " ").split()
        assert set(SYSTEM_PACKAGES.split()) <= {word.strip("`,;") for word in words}, name


@pytest.mark.skipif(sys.platform != "linux" or shutil.which("make") is None, reason="needs make on Linux")
@pytest.mark.parametrize(
    ("gpu", "reached", "arguments", "tried"),
    [
        (False, True, [], True),
        (False, False, [], True),  # the index of torch cannot be reached: pip's own index is left
        (True, True, [], False),
        (False, True, ["TORCH_INDEX="], False),
    ],
)
def test_make_takes_torch_without_cuda_where_there_is_no_gpu(gpu, reached, arguments, tried, tmp_path):
    def program(path, text):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)

    for name in ("Makefile", "requirements.lock", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    program(tmp_path / "bin" / "nvidia-smi", f"exit {0 if gpu else 9}")
    refused = "" if reached else 'case "$*" in *--index-url*) exit 1;; esac'
    program(tmp_path / "venv" / "bin" / "python", f'echo "$@" >> {tmp_path}/log; {refused}')
    environment = {**os.environ, "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}"}
    environment = {name: value for name, value in environment.items() if name not in ("TORCH_INDEX", "MAKEFLAGS")}
    command = ["make", "VENV=venv", "venv/.stamp", *arguments]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    calls = (tmp_path / "log").read_text().splitlines()
    torch = next(line for line in (ROOT / "requirements.lock").read_text().splitlines() if line.startswith("torch=="))
    wanted = f"--index-url https://download.pytorch.org/whl/cpu {torch}"
    assert [call.endswith(wanted) for call in calls if "--index-url" in call] == [True] * tried
    assert calls[-2].endswith("-r requirements.lock") and calls[-1].endswith("-e .")
    assert ("setup: no torch from" in done.stderr) == (not reached)


def test_citation_and_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == __version__ and citation["license"] == PROJECT["license"]
    assert citation["title"] in (ROOT / "README.md").read_text()


@pytest.mark.parametrize(
    ("words", "completed"),
    [
        ("softgym rol", ["rollout"]),
        ("softgym rollout SoftGym/FingerT", ["SoftGym/FingerTrack-v0"]),
        ("softgym show diam", ["diamond"]),
        ("softgym codesign --config finger_reach_scr", ["finger_reach_scratch"]),
    ],
)
def test_words_are_completed_in_the_shell(words, completed):
    count = str(len(words.split()) - 1)
    variables = {"_SOFTGYM_COMPLETE": "bash_complete", "COMP_WORDS": words, "COMP_CWORD": count}
    command = [sys.executable, "-c", "from softgym_envs.cli import main; main()"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **variables}, cwd=ROOT)
    assert done.stdout.split() == [f"plain,{word}" for word in completed]


def test_the_first_compilation_is_announced_once(monkeypatch, capfd):
    monkeypatch.delenv(ANNOUNCED)

    def kernel(x):
        return x + 1

    kernel.__module__ = "softgym_envs.kernels"
    compiled = numba.njit(kernel)
    compiled(1)
    compiled(1.0)
    assert capfd.readouterr().err.count("compiling numerical kernels") == 1
