"""Generated parts of the pages of the benchmark: problems, leaderboard and tables of the baselines."""

from __future__ import annotations

import re

from softgym_envs.extensions.leaderboard import board

PARTS = {
    "tracks": board.tracks,
    "problems": board.problem_table,
    "references": board.reference_table,
    "board": board.leaderboard,
    "tracks_of_methods": board.track_table,
    "regrets": board.regret_table,
    "unseen": board.unseen_table,
    "methods": board.method_table,
    "winners": board.winners_table,
    "bodies": board.bodies_table,
}
"""Name of a part, in ``<!-- benchmark: NAME -->`` -> the function that writes it."""


def benchmark_page(markdown: str) -> str:
    """Return a page with its generated parts."""
    return re.sub(r"<!-- benchmark: (\w+) -->", lambda match: PARTS[match[1]](), markdown)
