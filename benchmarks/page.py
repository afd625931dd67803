"""``python -m benchmarks.page``: write the recorded results into the README and the documentation.

A marked place in a Markdown file is rewritten from the results, so that no number is typed twice::

    <!-- bench: headlines -->a table of `benchmarks.tables`<!-- /bench -->
    <!-- bench: shared_finger :: cube, mean [mm] :: .2f -->0.23<!-- /bench -->

The second form names a benchmark, one of its results, and how to write it:

* a result may be a pattern with ``*``; then ``min`` or ``max`` in front of the format says which match to take;
* ``[1]`` in front of the format takes an item of a list;
* an empty format writes the value as it stands.

Results come from ``benchmarks/results.json`` (written by ``softgym bench``) and, for runs that no benchmark repeats,
from ``benchmarks/data/recorded.json``. A test compares all pages with both files.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

from benchmarks.accurate_meshes import TABLES as ACCURATE_TABLES
from benchmarks.contact_sets import TABLES as SET_TABLES
from benchmarks.convergence_tables import CONVERGENCE_TABLES
from benchmarks.deployed_estimator import TABLES as ESTIMATOR_TABLES
from benchmarks.force_limits import TABLES as FORCE_TABLES
from benchmarks.grasp_codesign import TABLES as GRASP_TABLES
from benchmarks.grown_shapes import TABLES as GROWN_TABLES
from benchmarks.learned_sensors import TABLES as SENSOR_TABLES
from benchmarks.modular import TABLES as MODULAR_TABLES
from benchmarks.motion import TABLES as MOTION_TABLES
from benchmarks.printed import TABLES as PRINTED_TABLES
from benchmarks.recorded import figure
from benchmarks.robustness import TABLES as ROBUSTNESS_TABLES
from benchmarks.structure_policy import TABLES as POLICY_TABLES
from benchmarks.structures import TABLES as STRUCTURE_TABLES
from benchmarks.tables import TABLES as OTHER_TABLES
from benchmarks.trust_tables import TABLES as TRUST_TABLES
from benchmarks.zigzag_tables import ZIGZAG_TABLES
from softgym_envs.errors import DataError

TABLES = (
    OTHER_TABLES
    | ZIGZAG_TABLES
    | CONVERGENCE_TABLES
    | ACCURATE_TABLES
    | GRASP_TABLES
    | SET_TABLES
    | MODULAR_TABLES
    | MOTION_TABLES
    | SENSOR_TABLES
    | ESTIMATOR_TABLES
    | FORCE_TABLES
    | ROBUSTNESS_TABLES
    | PRINTED_TABLES
    | STRUCTURE_TABLES
    | TRUST_TABLES
    | POLICY_TABLES
    | GROWN_TABLES
)
ROOT = Path(__file__).resolve().parents[1]
MARKER = re.compile(r"(<!-- bench: (?P<key>.+?) -->)(?P<text>.*?)(<!-- /bench -->)", re.DOTALL)


def fill(text: str) -> str:
    """Return a Markdown page with every marked place rewritten from the results."""

    def replace(match: re.Match[str]) -> str:
        name, *rest = (part.strip() for part in match["key"].split("::"))
        if rest:
            content = figure(name, *rest)
        elif name in TABLES:
            content = f"\n\n{TABLES[name]()}\n\n"
        else:
            raise DataError(f"no table '{name}'; allowed: {', '.join(TABLES)}")
        return f"{match[1]}{content}{match[4]}"

    return MARKER.sub(replace, text)


def pages() -> list[Path]:
    """Return the Markdown files that may contain marked places."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def main() -> int:
    """Rewrite all pages; return how many changed."""
    changed = 0
    for path in pages():
        text = path.read_text()
        try:
            filled = fill(text)
        except DataError as error:
            raise SystemExit(f"{path.relative_to(ROOT)}: {error}") from None
        if filled != text:
            path.write_text(filled)
            print(f"wrote {path.relative_to(ROOT)}")
            changed += 1
    return changed


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    main()
    sys.exit(0)
