"""Notebooks of the tutorials: the text and the Python blocks of a page as cells."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from site_writing import DOCS

PAGES = (
    "tutorials/first_steps",
    "tutorials/own_robot",
    "tutorials/training",
    "tutorials/fitting",
    "tutorials/pressure",
    "tutorials/deploying",
    "inverse_qp",
)
"""Pages that are notebooks as well; all their code runs from top to bottom."""
INSTALL = """# Installs the suite where it is missing, such as on Colab. The build of torch for CPUs saves gigabytes.
import importlib.util
import subprocess
import sys

if importlib.util.find_spec("softgym_envs") is None:
    pip = [sys.executable, "-m", "pip", "install", "--quiet"]
    if importlib.util.find_spec("torch") is None:
        subprocess.run([*pip, "torch", "--index-url", "https://download.pytorch.org/whl/cpu"], check=True)
    subprocess.run([*pip, "softgym-envs[all]"], check=True)"""
"""First cell of each notebook."""
_BLOCK = re.compile(r'^```python(?: title="([^"]+)")?\n(.*?)^```$', flags=re.MULTILINE | re.DOTALL)


def notebook(page: Path) -> str:
    """Return a page as a notebook in format 4, as JSON."""
    text, cells, end = page.read_text(), [_cell("code", INSTALL)], 0
    for match in _BLOCK.finditer(text):
        cells.append(_cell("markdown", text[end : match.start()]))
        # A block with a title is a file that later blocks import.
        cells.append(_cell("code", (f"%%writefile {match[1]}\n" if match[1] else "") + match[2]))
        end = match.end()
    cells.append(_cell("markdown", text[end:]))
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    shown = [cell for cell in cells if cell["source"]]
    for number, cell in enumerate(shown):
        cell["id"] = f"cell-{number}"
    return json.dumps(
        {"cells": shown, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}, indent=1
    )


def notebooks() -> dict[str, str]:
    """Return the notebooks of the site, by their paths in it."""
    return {f"{name}.ipynb": notebook(DOCS / f"{name}.md") for name in PAGES}


def _cell(kind: str, source: str) -> dict[str, Any]:
    cell: dict[str, Any] = {"cell_type": kind, "metadata": {}, "source": source.strip("\n")}
    return cell | ({"execution_count": None, "outputs": []} if kind == "code" else {})
