"""API reference: every public name, under the path from which it is imported."""

from __future__ import annotations

import ast
import inspect
import re
from importlib import import_module
from pathlib import Path

from site_writing import code, first_sentence, table

REPOSITORY = Path(__file__).resolve().parents[1]

PACKAGES = {
    "softgym_envs": "Registries and design spaces",
    "softgym_envs.errors": "Errors",
    "softgym_envs.envs": "Environments",
    "softgym_envs.robots": "Robots",
    "softgym_envs.mechanics": "Mechanics",
    "softgym_envs.surrogate": "Surrogates",
    "softgym_envs.backends": "Backends",
    "softgym_envs.control": "Control",
    "softgym_envs.viewer": "Pictures",
    "softgym_envs.agents": "Agents",
    "softgym_envs.codesign": "Co-design",
    "softgym_envs.extensions.beams": "Extension: bodies of beams",
    "softgym_envs.extensions.design": "Extension: design without a controller",
    "softgym_envs.extensions.fitting": "Extension: fitting of surrogates",
    "softgym_envs.extensions.gpu": "Extension: environments on tensors",
    "softgym_envs.extensions.grasping": "Extension: grasping",
    "softgym_envs.extensions.hardware": "Extension: physical robots",
    "softgym_envs.extensions.learners": "Extension: learners",
    "softgym_envs.extensions.modules": "Extension: compliant modules",
    "softgym_envs.extensions.report": "Extension: report of a study",
    "softgym_envs.extensions.sensing": "Extension: sensing",
    "softgym_envs.extensions.deployment": "Extension: deployment",
    "softgym_envs.extensions.leaderboard": "Extension: benchmark of co-design",
}
"""Packages that export public names and the module of the exceptions, with the titles of their pages."""


def public_names(package: str) -> list[str]:
    """Names that a package exports, dunder names left out; of the module of the exceptions, these."""
    module = import_module(package)
    if not hasattr(module, "__all__"):
        return [name for name, value in vars(module).items() if inspect.isclass(value) and value.__module__ == package]
    return [name for name in module.__all__ if not name.startswith("__")]


def defining_module(package: str, name: str) -> str:
    """Module in which a public name is defined, read from the imports of the package."""
    path = REPOSITORY / package.replace(".", "/") / "__init__.py"
    if not path.is_file():
        return package
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and name in {a.asname or a.name for a in node.names}:
            return defining_module(node.module, name)
    return package


def link(package: str, name: str) -> tuple[str, str]:
    """Page and anchor of a public name: of a public module if one defines it, else of the package that exports it."""
    home = defining_module(package, name)
    return f"{home if home in PACKAGES else package}.md", f"{home}.{name}"


def described(package: str, name: str) -> str:
    """First sentence of what documents a public name."""
    value = getattr(import_module(package), name)
    if isinstance(value, type) or inspect.isfunction(value):
        return code(first_sentence(inspect.getdoc(value) or ""))
    # A constant: the string below its assignment.
    source = Path(import_module(defining_module(package, name)).__file__ or "")
    text = re.search(rf'^{name}\b.*?^"""(.+?)"""', source.read_text(), flags=re.MULTILINE | re.DOTALL)
    return code(first_sentence(text[1])) if text else ""


def api_page(package: str) -> str:
    """Reference of a package, drawn from the docstrings."""
    parts = [f"# {PACKAGES[package]}\n\nImport these names from `{package}`."]
    for name in public_names(package):
        page, anchor = link(package, name)
        here = page == f"{package}.md"
        text = f"::: {anchor}" if here else f"## {name}\n\nSee [`{anchor}`]({page}#{anchor})."
        value = getattr(import_module(package), name)
        if not (isinstance(value, type) or inspect.isfunction(value)):  # a registry, whose source says little
            text += "\n    options:\n      show_attribute_values: false"
        parts.append(text)
    return "\n\n".join(parts) + "\n"


def api_index() -> str:
    """All public names with links."""
    parts = [
        "# API reference",
        "Public is what these packages export, and the exceptions in `softgym_envs.errors`. These names keep their "
        "meaning within a minor version; every other module and name may change without notice. Import each name from "
        "the package under which it stands. Units are SI.",
    ]
    for package, title in PACKAGES.items():
        rows = [
            [f"[`{name}`]({'#'.join(link(package, name))})", described(package, name)] for name in public_names(package)
        ]
        if rows:
            parts += [f"## {title}\n\n`from {package} import ...`", table(["name", "what it is"], rows)]
    return "\n\n".join(parts) + "\n"
