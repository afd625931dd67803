"""Run the Python blocks of a page as one script: ``python docs/run_page.py PAGE FOLDER``.

The blocks share a namespace and run in the folder. A block with a title is written there as a file, to be imported.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from pathlib import Path


def code_blocks(page: Path, language: str = "python") -> list[tuple[str, str, int]]:
    """Return the title (or ``""``), text and first line number of each fenced block of a language."""
    text = page.read_text()
    pattern = rf'^```{language}(?: title="([^"]+)")?\n(.*?)^```$'
    return [
        (match[1] or "", match[2], text[: match.start(2)].count("\n"))
        for match in re.finditer(pattern, text, flags=re.MULTILINE | re.DOTALL)
    ]


def run_page(page: Path, folder: Path) -> None:
    """Run the blocks of a page in a folder. Use a separate process, because a page may register things."""
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    namespace: dict[str, object] = {"__name__": "__page__"}
    for title, text, line in code_blocks(page):
        if title:
            (folder / title).write_text(text)
        else:
            # Blank lines before the block give errors the line numbers of the page.
            exec(compile("\n" * line + text, str(page), "exec"), namespace)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("folder", type=Path)
    given = parser.parse_args()
    run_page(given.page.resolve(), given.folder.resolve())
