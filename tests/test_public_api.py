"""The public API: few names, each exported by one package; README, docs and examples use nothing else."""

from __future__ import annotations

import ast
import re
from collections import Counter
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = [
    "softgym_envs",
    "softgym_envs.agents",
    "softgym_envs.backends",
    "softgym_envs.codesign",
    "softgym_envs.control",
    "softgym_envs.envs",
    "softgym_envs.extensions.beams",
    "softgym_envs.extensions.deployment",
    "softgym_envs.extensions.design",
    "softgym_envs.extensions.fitting",
    "softgym_envs.extensions.gpu",
    "softgym_envs.extensions.grasping",
    "softgym_envs.extensions.hardware",
    "softgym_envs.extensions.leaderboard",
    "softgym_envs.extensions.learners",
    "softgym_envs.extensions.modules",
    "softgym_envs.extensions.report",
    "softgym_envs.extensions.sensing",
    "softgym_envs.mechanics",
    "softgym_envs.robots",
    "softgym_envs.surrogate",
    "softgym_envs.viewer",
]
ERRORS = "softgym_envs.errors"
"""The one public module that is not a package: its exceptions."""
MAX_NAMES = 118
ROOMS = ("benchmarks", "softgym_envs")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def exported(package):
    """Names that a package exports, dunder names left out."""
    return [name for name in import_module(package).__all__ if not name.startswith("__")]


# -- exports --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_import(package):
    module = import_module(package)
    for name in module.__all__:
        assert getattr(module, name) is not None
        assert name in dir(module)
    with pytest.raises(AttributeError, match=r"no attribute 'Absent'; public names: .*"):
        module.Absent  # noqa: B018


@pytest.mark.parametrize("package", PACKAGES)
def test_type_checkers_see_the_public_names(package):
    tree = ast.parse((ROOT / package.replace(".", "/") / "__init__.py").read_text())
    guarded = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {alias.asname: alias.name for node in guarded.body for alias in node.names}
    assert seen == {name: name for name in import_module(package).__all__}


def test_each_name_is_exported_once_and_there_are_few():
    count = Counter(name for package in PACKAGES for name in exported(package))
    assert [name for name, times in count.items() if times > 1] == []
    assert len(count) <= MAX_NAMES


def test_the_reference_documents_every_public_package(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    assert sorted(import_module("site_api").PACKAGES) == sorted([*PACKAGES, ERRORS])


def test_all_packages_with_public_names_are_listed():
    """Rooms of the product that export names are in the list above: no public name escapes the checks."""
    found = [
        ".".join(path.parent.relative_to(ROOT).parts)
        for path in [ROOT / "softgym_envs" / "__init__.py", *(ROOT / "softgym_envs").glob("*/__init__.py")]
        + [
            *(ROOT / "softgym_envs").glob("extensions/*/__init__.py"),
        ]
        if "lazy_exports(" in path.read_text() or re.search(r"^__all__ = \[", path.read_text(), flags=re.MULTILINE)
    ]
    assert sorted(found) == PACKAGES


# -- use in the README, the docs and the examples ---------------------------------------------------------------------


def is_public(path):
    """Whether a dotted path is a public package, one of its names, or an attribute of such a name."""
    if path in (*PACKAGES, ERRORS):
        return True
    parts = path.split(".")
    for length in range(len(parts) - 1, 0, -1):
        package, name = ".".join(parts[:length]), parts[length]
        if package in PACKAGES:
            return name in exported(package)
        if package == ERRORS:
            return isinstance(getattr(import_module(ERRORS), name, None), type)
    return False


def imported(code):
    """Dotted paths of this project that Python code imports."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            paths = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.module and node.level == 0, "relative import"
            paths = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        yield from (path for path in paths if path.split(".")[0] in ROOMS)


def private_paths_of_page(text):
    """Paths that are not public, in the Python blocks of a page (imports) and in its inline code (dotted names)."""
    fences = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^\1```$", flags=re.MULTILINE | re.DOTALL)
    blocks = [re.sub(f"^{m[1]}", "", m[3], flags=re.MULTILINE) for m in fences.finditer(text) if m[2] == "python"]
    names = re.findall(r"`((?:softgym_envs|agents|codesign)(?:\.\w+)+)[^`]*`", fences.sub("", text))
    return [path for path in (*(path for block in blocks for path in imported(block)), *names) if not is_public(path)]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_pages_use_public_paths(page):
    assert private_paths_of_page(page.read_text()) == []


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda p: p.stem)
def test_examples_use_public_paths(example):
    assert [path for path in imported(example.read_text()) if not is_public(path)] == []


def test_the_checker_sees_private_paths():
    page = """
        Text with `softgym_envs.robots.Robot.build`, `softgym_envs.extensions.design.Absent`
        and `softgym_envs.errors.DataError`.

    ```python title="arm.py"
    import softgym_envs.designs
    from softgym_envs import DesignSpace, errors
    from softgym_envs.robots import Robot, make_robot
    from arm import Arm
    ```

    ```python
    from softgym_envs.errors import WeightsError, unknown_name
    def f():
        import benchmarks.speed
    ```
    """
    text = re.sub("^    ", "", page, flags=re.MULTILINE)
    assert private_paths_of_page(text) == [
        "softgym_envs.designs",
        "softgym_envs.robots.make_robot",
        "softgym_envs.errors.unknown_name",
        "benchmarks.speed",
        "softgym_envs.extensions.design.Absent",
    ]
