"""Steps of a release: check that a tag and the version agree, and print the section of a version in the changelog.

Run ``release.py check v0.1.0`` or ``release.py notes v0.1.0``.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def version() -> str:
    """Return the version that the package declares."""
    text = (ROOT / "softgym_envs" / "version.py").read_text(encoding="utf-8")
    match = re.search(r'^__version__ = "([^"]+)"$', text, re.MULTILINE)
    if match is None:
        raise SystemExit("release: softgym_envs/version.py states no __version__")
    return match[1]


def section(number: str) -> str:
    """Return the changelog's section of one version, without its heading."""
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    match = re.search(rf"^## {re.escape(number)}\b([^\n]*)\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    if match is None:
        raise SystemExit(f"release: CHANGELOG.md has no section '## {number}'")
    if "unreleased" in match[1]:
        raise SystemExit(f"release: CHANGELOG.md calls {number} unreleased; put the date of the release there")
    return match[2].strip()


def main() -> None:
    """Run one step."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=("check", "notes"))
    parser.add_argument("tag", help="tag of the release, such as v0.1.0")
    arguments = parser.parse_args()
    number = arguments.tag.removeprefix("v")
    if number != version():
        raise SystemExit(f"release: the tag is {arguments.tag}, but softgym_envs/version.py says {version()}")
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    if f"version: {number}\n" not in citation:
        raise SystemExit(f"release: CITATION.cff does not say 'version: {number}'")
    text = section(number)
    if arguments.step == "notes":
        sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
