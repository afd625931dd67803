"""Freezing a problem again after a change that should not change scores, such as another spelling of an option."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np

from softgym_envs.errors import DataError
from softgym_envs.extensions.leaderboard.frozen import freeze, frozen_parts, load_definition, load_problem
from softgym_envs.extensions.leaderboard.problem import Judge
from softgym_envs.extensions.leaderboard.runs import stored_runs
from softgym_envs.extensions.leaderboard.scoring import DATA
from softgym_envs.storage import atomic_write

SAME = 1e-5
"""Largest difference between a stored score and its repetition, relative to the larger of it and the baseline's score.

Leaderboards show scores as parts of the way from the baseline to the best known body, with fewer digits. Relative to
the score alone, a difference says little: some winners end within a micrometre of their goals, and another version of a
solver moves them by a nanometre.
"""

FILES = ("runs.json", "winners.json", "references/*.json", "submissions/*.json")
"""Files of stored results that name the hash of their problem."""


def refreeze(name: str, bodies: int = 5, data: Path = DATA) -> list[Path]:
    """Freeze a problem again and keep its stored results, if scoring some stored winners again gives the same scores.

    Args:
        name: ID of the problem.
        bodies: number of stored winners to score again, by the judge of their search; trainings are left out.
        data: folder of the stored results.

    Returns:
        The files in which the hash was renamed.

    Raises:
        DataError: if no winner is stored, a score differs, or the shared policy is another one; then nothing is
            changed.
    """
    definition = load_definition(name)  # an unknown name is an error of its own
    problem = load_problem(name, check=False)
    if frozen_parts(definition, problem.goals).get("policy") != problem.parts.get("policy"):
        # It decides what the judges shared and trained say of every body, whichever judge the stored searches had.
        raise DataError(f"problem '{name}': the shared policy is another one; this needs a new version")
    winners = [
        (run, design, np.array(scores))
        for run, _ in stored_runs(data)
        if (run.problem, run.hash) == (name, problem.hash) and run.judge in ("qp", "shared") and run.optimum is None
        for design, scores in zip(run.designs, run.search_scores, strict=True)
    ]
    if not winners:
        raise DataError(f"problem '{name}': no winner is stored that could be scored again; freeze it without --keep")
    places = np.unique(np.linspace(0, len(winners) - 1, min(bodies, len(winners))).astype(int))
    for run, design, scores in (winners[place] for place in places):
        found = problem.evaluate(design, judge=cast("Judge", run.judge), seed=run.seed)
        allowed = SAME * np.maximum(np.abs(scores), np.abs(run.baseline))
        if not found.feasible or not (np.abs(np.subtract(found.scores, scores)) <= allowed).all():
            raise DataError(
                f"problem '{name}': a winner of {run.method}, seed {run.seed}, had the scores {scores.tolist()} and "
                f"now has {found.scores}; this is another problem and needs a new version"
            )
    old = problem.hash
    freeze(name)
    new = load_problem(name).hash
    return _rename(old, new, data)


def _rename(old: str, new: str, data: Path) -> list[Path]:
    """Replace a hash in all stored results; return the files that had it."""
    changed = []
    for path in sorted(path for pattern in FILES for path in data.glob(pattern)):
        text = path.read_text()
        if old in text:
            with atomic_write(path, "w") as stream:
                stream.write(text.replace(old, new))
            changed.append(path)
    for path in sorted((data / "tables").glob("*.parquet")):
        from pyarrow import parquet

        table = parquet.read_table(path)
        meta = dict(table.schema.metadata or {})
        if meta.get(b"hash") == old.encode():
            meta[b"hash"] = new.encode()
            with atomic_write(path) as stream:
                parquet.write_table(table.replace_schema_metadata(meta), stream, compression="zstd")
            changed.append(path)
    return changed
