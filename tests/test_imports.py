"""Structure of the code: layers of packages, light imports, no import circles, no private imports, short files."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("softgym_envs", "agents", "codesign")
"""Folders of the package; the last two are linked into the first."""

# From the bottom to the top. A package imports from packages in lower layers and from itself.
LAYERS = [
    {"softgym_envs.version", "softgym_envs.errors", "softgym_envs.wording"},
    {"softgym_envs.arguments", "softgym_envs.extras", "softgym_envs.storage", "softgym_envs.units"}
    | {"softgym_envs.quantities"},
    {"softgym_envs._lazy"},
    {"softgym_envs.designs", "softgym_envs.registry", "softgym_envs.executors"},
    {"softgym_envs.config"},
    {"softgym_envs.runs"},
    {"softgym_envs.mechanics"},
    {"softgym_envs.robots"},
    {"softgym_envs.surrogate"},
    {"softgym_envs.backends"},
    {"softgym_envs.control"},
    {"softgym_envs.envs"},
    {"softgym_envs.agents"},
    {"softgym_envs.codesign"},
    {"softgym_envs.viewer"},
    {"softgym_envs.cli"},
    # Extensions: no core package imports one. Those of one layer do not know each other.
    {"softgym_envs.extensions.paths"},
    {"softgym_envs.extensions", "softgym_envs.extensions.beams"}
    | {"softgym_envs.extensions.learners", "softgym_envs.extensions.motion"}
    | {"softgym_envs.extensions.postgres", "softgym_envs.extensions.recordings"}
    | {"softgym_envs.extensions.sweeps"},
    {"softgym_envs.extensions.fitting", "softgym_envs.extensions.report"},
    {"softgym_envs.extensions.design"},
    {
        "softgym_envs.extensions.gpu",
        "softgym_envs.extensions.grasping",
        "softgym_envs.extensions.hardware",
        "softgym_envs.extensions.hybrid",
        "softgym_envs.extensions.measured",
        "softgym_envs.extensions.networks",
        "softgym_envs.extensions.sensing",
        "softgym_envs.extensions.walkers",
    },
    {"softgym_envs.extensions.deployment", "softgym_envs.extensions.leaderboard"},
    {"softgym_envs.extensions.checks", "softgym_envs.extensions.modules"},
]
LEVEL = {package: level for level, layer in enumerate(LAYERS) for package in layer}
# The viewer is imported only inside the functions that draw.
LAZY = {("softgym_envs.envs", "softgym_envs.viewer"), ("softgym_envs.codesign", "softgym_envs.viewer")}
HEAVY = ("torch", "gmsh", "stable_baselines3", "optuna", "rerun", "pyvista", "vtk", "numba", "scipy", "matplotlib")

FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    if parts[0] in ("agents", "codesign"):
        parts = ("softgym_envs", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def package_of(module):
    """The package in `LAYERS` of a dotted module name; softgym_envs itself has none."""
    parts = module.split(".")
    if parts[0] != "softgym_envs":
        return parts[0]
    return ".".join(parts[: 3 if parts[1:2] == ["extensions"] else 2]) if len(parts) > 1 else None


def statements(body, lazy=False):
    """All statements in a list of them, each with whether it is inside a function."""
    for node in body:
        yield node, lazy
        inside = lazy or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for part in ("body", "orelse", "finalbody"):
            yield from statements(getattr(node, part, []), inside)
        for clause in (*getattr(node, "handlers", []), *getattr(node, "cases", [])):
            yield from statements(clause.body, inside)


@cache
def imports_of(path):
    """Modules of this project that a file imports, each with its line and whether it happens inside a function only."""
    found = []
    for node, lazy in statements(ast.parse(path.read_text()).body):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            # ``from softgym_envs import errors`` imports a module, ``from softgym_envs.errors import X`` a name.
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            if name.split(".")[0] in ("softgym_envs", "benchmarks", "studies"):
                found.append((name, lazy, node.lineno))
    return found


def test_every_package_has_a_layer():
    names = {package_of(module_name(path)) for path in FILES} - {None}
    assert names <= set(LEVEL), names - set(LEVEL)
    assert len(FILES) > 30


def test_imports_go_downwards():
    upwards = []
    for path in FILES:
        module = module_name(path)
        here = package_of(module)
        if here is None:
            continue  # ``softgym_envs/__init__.py`` exports from several packages; a test below keeps it light
        for name, lazy, line in imports_of(path):
            there = package_of(name)
            if there not in LEVEL or there == here or (lazy and (here, there) in LAZY):
                continue
            if LEVEL[there] >= LEVEL[here]:
                upwards.append(f"{module}, line {line}: {here} must not import {name}")
    assert upwards == []


def test_the_checker_detects_a_forbidden_import(tmp_path):
    path = tmp_path / "bad.py"
    path.write_text(
        "from softgym_envs import viewer\n\ndef f():\n    import softgym_envs.agents.training\n"
        "    from softgym_envs.envs import x\n"
    )
    found = [(name, lazy) for name, lazy, _ in imports_of(path)]
    assert found == [
        ("softgym_envs.viewer", False),
        ("softgym_envs.agents.training", True),
        ("softgym_envs.envs.x", True),
    ]
    assert [package_of(name) for name, _ in found] == [
        "softgym_envs.viewer",
        "softgym_envs.agents",
        "softgym_envs.envs",
    ]


def loaded_by(statement):
    """Heavy packages in ``sys.modules`` after a statement in a fresh process."""
    code = f"import sys; {statement}; print(*(m for m in {HEAVY} if m in sys.modules))"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    return done.stdout.split()


@pytest.mark.parametrize("module", ["softgym_envs", "softgym_envs.cli"])
def test_importing_the_suite_is_light(module):
    assert loaded_by(f"import {module}") == []


def test_the_light_import_registers_the_environments():
    statement = "import gymnasium, softgym_envs; assert any(i.startswith('SoftGym/') for i in gymnasium.registry)"
    assert loaded_by(statement) == []


STEP = """
import sys, gymnasium, softgym_envs
env = gymnasium.make("SoftGym/{identifier}")
env.reset(seed=0), env.step(env.action_space.sample())
print(*(name for name in sys.modules if name.startswith("softgym_envs.mechanics.")))
"""
SURROGATE_NEEDS = "condensation compilation materials solvers solvers.complementarity".split()
"""Modules of mechanics that a step on a surrogate may load: 1,000 of 16,000 lines, neither elements nor equilibria."""


@pytest.mark.parametrize("identifier", ["FingerReach-v0", "DiamondTrack-v0"])
def test_a_step_on_a_surrogate_loads_no_finite_elements(identifier):
    done = subprocess.run(
        [sys.executable, "-c", STEP.format(identifier=identifier)], capture_output=True, text=True, cwd=ROOT, check=True
    )
    loaded = {name.removeprefix("softgym_envs.mechanics.") for name in done.stdout.split()}
    assert loaded - set(SURROGATE_NEEDS) == set()


FEM_LEAVES_OUT = "contact.contact skins io solvers.dynamics solvers.compiled solvers.contact_rows".split()
"""Modules of mechanics that a step of a solid with cables must not load: 7,000 lines with what they import."""


def test_a_step_on_finite_elements_loads_what_it_uses():
    step = STEP.replace('{identifier}")', 'FingerReach-v0", backend="fem")')
    done = subprocess.run([sys.executable, "-c", step], capture_output=True, text=True, cwd=ROOT, check=True)
    loaded = {name.removeprefix("softgym_envs.mechanics.") for name in done.stdout.split()}
    assert "solvers.statics" in loaded
    assert loaded & set(FEM_LEAVES_OUT) == set()


# -- structure ----------------------------------------------------------------------------------------------------

STRUCTURED = (*FOLDERS, "benchmarks")
MODULES = {module_name(path): path for package in STRUCTURED for path in (ROOT / package).rglob("*.py")}
MAX_LINES = 600


def module_of(name, modules):
    """The module that an imported dotted name belongs to: itself, or the module that defines it."""
    while name and name not in modules:
        name = name.rpartition(".")[0]
    return name


def import_graph(modules):
    """Module -> modules that it imports anywhere, also inside functions and for type checkers."""
    return {
        module: {module_of(name, modules) for name, _, _ in imports_of(path)} - {module, ""}
        for module, path in modules.items()
    }


def circles(graph):
    """Groups of modules that import each other, directly or through others (Tarjan's algorithm)."""
    index, low, stack, found = {}, {}, [], []

    def visit(module):
        index[module] = low[module] = len(index)
        stack.append(module)
        for other in sorted(graph[module]):
            if other not in index:
                visit(other)
                low[module] = min(low[module], low[other])
            elif other in stack:
                low[module] = min(low[module], index[other])
        if low[module] == index[module]:
            group = stack[stack.index(module) :]
            del stack[stack.index(module) :]
            if len(group) > 1:
                found.append(sorted(group))

    for module in sorted(graph):
        if module not in index:
            visit(module)
    return found


def private_imports(path):
    """Underscore names that a file imports from other modules of this project, with their lines."""
    for name, _, line in imports_of(path):
        parts = name.split(".")
        if any(part.startswith("_") and not part.startswith("__") for part in parts) and "_lazy" not in parts:
            yield f"line {line}: {name}"


def test_no_circles():
    """Neither at import time nor by imports inside functions or for type checkers."""
    assert circles(import_graph(MODULES)) == []


def test_names_with_an_underscore_stay_in_their_module():
    found = {module: list(private_imports(path)) for module, path in MODULES.items()}
    assert {module: lines for module, lines in found.items() if lines} == {}


def test_files_are_short():
    lines = {module: len(path.read_text().splitlines()) for module, path in MODULES.items()}
    assert {module: count for module, count in lines.items() if count > MAX_LINES} == {}


def test_the_checkers_detect_circles_and_private_names(tmp_path):
    sources = {
        "softgym_envs.agents.one": "def f():\n    from softgym_envs.agents import two\n",
        "softgym_envs.agents.two": "from softgym_envs.agents.three import _hidden, shown\n",
        "softgym_envs.agents.three": "import softgym_envs.agents.one\n",
        "softgym_envs.agents.four": "from softgym_envs.agents.one import f\n",
    }
    modules = {}
    for name, text in sources.items():
        modules[name] = tmp_path / f"{name}.py"
        modules[name].write_text(text)
    assert circles(import_graph(modules)) == [
        ["softgym_envs.agents.one", "softgym_envs.agents.three", "softgym_envs.agents.two"]
    ]
    found = {name: list(private_imports(path)) for name, path in modules.items()}
    assert found == {
        **dict.fromkeys(sources, []),
        "softgym_envs.agents.two": ["line 1: softgym_envs.agents.three._hidden"],
    }


@pytest.mark.parametrize("name", ["agents", "codesign"])
def test_the_folders_are_imported_under_one_name_only(name):
    assert (ROOT / "softgym_envs" / name).resolve() == ROOT / name
    code = f"import softgym_envs.{name}; import {name}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert f"ImportError: the package is softgym_envs.{name}: import that in place of {name}" in done.stderr
