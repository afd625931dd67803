"""The public API: lazily exported names exist, and type checkers see the same ones."""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# A package joins this list when its __init__ uses `lazy_exports`.
PACKAGES = [
    "agents",
    "codesign",
    "softgym_envs",
    "softgym_envs.backends",
    "softgym_envs.control",
    "softgym_envs.envs",
    "softgym_envs.mechanics",
    "softgym_envs.robots",
    "softgym_envs.surrogate",
]


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
