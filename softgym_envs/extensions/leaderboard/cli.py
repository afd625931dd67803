"""Verbs of the benchmark of co-design: list, show, run, winners, reference, verify, table, board, judges, freeze."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import click

from softgym_envs.cli import options
from softgym_envs.errors import ConfigError
from softgym_envs.extras import require
from softgym_envs.wording import counted

FOLDER = Path("results/benchmark")

results = click.option(
    "--folder", type=options.PATH, default=FOLDER, show_default=True, help="Folder for runs and scores."
)


@click.group(cls=options.Verbs)
def benchmark() -> None:
    """Compare optimisers of bodies and controllers on frozen problems.

    Submissions are scored on finite elements.
    """


@benchmark.command(name="list")
def list_() -> None:
    """List the problems."""
    from softgym_envs.extensions.leaderboard.frozen import load_definition, problem_names

    click.echo(f"{'problem':28s} {'track':5s} {'variables':>9s} {'judge':8s} title")
    for name in problem_names():
        problem = load_definition(name)
        click.echo(f"{name:28s} {problem.track:5s} {len(problem.variables):9d} {problem.judge:8s} {problem.title}")


@benchmark.command()
@click.argument("name")
def show(name: str) -> None:
    """Show a problem: its box, budgets, hashes and what is known about it."""
    from softgym_envs.extensions.leaderboard.frozen import load_problem
    from softgym_envs.extensions.leaderboard.problem import TRACKS
    from softgym_envs.extensions.leaderboard.scoring import reference

    problem = load_problem(name)
    definition = problem.definition
    click.echo(f"{name}: {definition.title}\ntrack {definition.track}: {TRACKS[definition.track]}")
    goals = (f"{name} ({direction})" for name, direction in zip(definition.titles, definition.directions, strict=True))
    click.echo(f"objectives: {', '.join(goals)}; the score of what is minimised has the opposite sign")
    click.echo(f"judges: {', '.join(definition.judges)}; default {definition.judge}\nvariables:")
    for variable in definition.optimised.values():
        unit = "" if variable.unit == "1" else f" {variable.unit}"
        click.echo(
            f"  {variable.name}: {variable.low:g} to {variable.high:g}{unit}, baseline {variable.baseline:g}{unit}"
        )
    for level, budget in definition.budgets.items():
        limits = ", ".join(f"{key.replace('_', ' ')} {value:g}" for key, value in budget.model_dump().items())
        click.echo(f"budget {level}: {limits}")
    click.echo("hashes: " + ", ".join(f"{key} {value[:12]}" for key, value in problem.parts.items()))
    known = reference(problem)
    if known is not None:
        baseline, best = _scores([known.baseline]), _scores(known.best)
        click.echo(f"on finite elements, test goals, SI: baseline {baseline}, best known {best}")


@benchmark.command()
@click.argument("names", nargs=-1, required=True)
@click.option(
    "--method",
    "methods",
    multiple=True,
    required=True,
    help="Optimiser, such as gp or random; several with several options. An unknown one lists all.",
)
@click.option("--judge", help="Who controls the bodies in the search: qp, shared or trained (default: the problem's).")
@click.option("--level", default="small", show_default=True, help="Budget: small, medium or large.")
@click.option("--seeds", type=click.IntRange(min=1), default=3, show_default=True, help="Number of seeds.")
@click.option("--bodies", type=click.IntRange(min=1), help="Largest number of bodies, besides the budget.")
@click.option(
    "--table", type=options.PATH, help="Choose among the bodies of this Parquet file (softgym benchmark tabulate)."
)
@click.option("--fem/--no-fem", default=False, help="Test the winners on finite elements too (minutes each).")
@results
def run(
    names: tuple[str, ...],
    methods: tuple[str, ...],
    judge: str | None,
    level: str,
    seeds: int,
    bodies: int | None,
    table: Path | None,
    fem: bool,
    folder: Path,
) -> None:
    """Run baselines on problems NAMES.

    An interrupted call continues where it stopped.
    """
    from softgym_envs.extensions.leaderboard import references, runs
    from softgym_envs.extensions.leaderboard.frozen import load_definition
    from softgym_envs.extensions.leaderboard.table import Table

    require("codesign")
    listed = None if table is None else Table.read(names[0], table)
    if listed is not None and len(names) > 1:
        raise ValueError("--table is of one problem; give one name")
    with options.resumable():
        for seed in range(seeds):
            for name in names:
                for method in methods:
                    found = runs.run(folder, name, method, judge, level, seed, listed, bodies)  # type: ignore[arg-type]
                    definition = load_definition(name)
                    click.echo(
                        f"{name} {method} {found.judge} seed {seed}: {counted(found.bodies, 'body')}, "
                        f"{found.spent['cpu_seconds']:.1f} CPU s, best {', '.join(definition.titles)}: "
                        f"{_scores([definition.signed(scores) for scores in found.search_scores[:1]])}"
                    )
                    if fem:
                        references.check_winners(folder, [found])


@benchmark.command()
@click.argument("name")
@click.option("--bodies", type=click.IntRange(min=3), default=16, show_default=True, help="Number of bodies.")
@results
def judges(name: str, bodies: int, folder: Path) -> None:
    """Compare the judges of a problem with trained policies on finite elements.

    These policies are trained for each body.
    """
    from softgym_envs.extensions.leaderboard import runs

    with options.resumable():
        found = runs.judges(folder, name, bodies)
    for judge, row in found["judges"].items():
        click.echo(f"{judge}: Kendall's tau {row['kendall_tau']:.2f}, mean exploitation {row['exploitation']:.3g} (SI)")


@benchmark.command()
@click.argument("names", nargs=-1, required=True)
@click.option("--every", multiple=True, help="Check the winners of all seeds of this method; repeat for several.")
@click.option("--rest", is_flag=True, help="Compare states at rest in place of whole episodes (a tenth of the time).")
@click.option("--store", is_flag=True, help="Add the winners to the stored ones (source checkout).")
@results
def winners(names: tuple[str, ...], every: tuple[str, ...], rest: bool, store: bool, folder: Path) -> None:
    """Check the winners of the stored searches of problems NAMES on finite elements.

    By default: the winner of each method's median seed, under the inverse QP, on the search goals, with the budget
    `small`. Exploitation is the score on the learned model minus that on finite elements. An interrupted call continues
    where it stopped.
    """
    from softgym_envs.extensions.leaderboard import winners as module

    for name in names:
        with options.resumable():
            rows = module.check(folder, name, every, rest=rest)
        for row in rows:
            exact = "no equilibrium" if row.fem is None else f"{row.fem:.4g}"
            click.echo(
                f"{name} {row.method} seed {row.seed}: learned model {row.surrogate:.4g}, finite elements {exact}, "
                f"exploitation {row.exploitation:.2g} (SI)"
            )
        click.echo(f"{name}: Kendall's tau {module.rank_correlation(rows):.2f} over {counted(len(rows), 'winner')}")
        if store:
            click.echo(f"wrote {module.store(rows)}")


@benchmark.command(name="reference")
@click.argument("names", nargs=-1, required=True)
@click.option("--accurate", is_flag=True, help="Score the baseline and the best body on the accurate mesh too.")
@results
def reference_(names: tuple[str, ...], accurate: bool, folder: Path) -> None:
    """Find which bodies score 0 and 1 on problems NAMES (source checkout, seconds to minutes each).

    0 is the baseline body. 1 is the winner of the stored searches that is best on the validation goals, unless a better
    body is already known. Both are tested on finite elements, on the test goals.
    """
    from softgym_envs.extensions.leaderboard import references
    from softgym_envs.extensions.leaderboard.frozen import load_problem
    from softgym_envs.extensions.leaderboard.scoring import make_reference

    for name in names:
        with options.resumable():
            references.check_winners(folder, [references.promising(name)])
            known = references.check_accurate(name) if accurate else make_reference(load_problem(name))
        line = f"{name}: baseline {_scores([known.baseline])}, best known {_scores(known.best)}"
        click.echo(line + (f"; accurate mesh {_scores([known.accurate])}" if accurate else ""))


@benchmark.command()
@click.argument("path", type=options.PATH)
@click.option("--record", is_flag=True, help="Store the bodies as the best known if they are (source checkout).")
@click.option("--json", "as_json", is_flag=True, help="Print the verdict as JSON.")
def verify(path: Path, record: bool, as_json: bool) -> None:
    """Check a submission: run its bodies again on finite elements."""
    from dataclasses import asdict

    from softgym_envs.extensions.leaderboard import verify as check

    verdict = check(path, record=record)
    if as_json:
        click.echo(json.dumps(asdict(verdict)))
        return
    shown = "unknown" if verdict.normalised is None else f"{verdict.normalised:.4f}"
    click.echo(f"accepted: normalised score {shown}; scores on finite elements {_scores(verdict.scores)}")
    if verdict.record:
        click.echo("this is the best known")


@benchmark.command(name="table")
@click.option("--store", is_flag=True, help="Add the runs of the folder to the stored ones (source checkout).")
@results
def table_(folder: Path, store: bool) -> None:
    """Show the runs of a folder, one row per problem, judge and method.

    Where the default folder has no runs, those that ship with the package.
    """
    from softgym_envs.extensions.leaderboard import board, runs

    own = (folder / "runs").is_dir()
    if not own and folder != FOLDER:
        raise ConfigError(f"folder '{folder}' has no runs; 'softgym benchmark run ... --folder {folder}' makes them")
    if store:
        click.echo(f"wrote {runs.collect(folder)}")
    if own:
        runs.collect(folder, folder)
    click.echo(f"runs of {folder}:" if own else "runs that ship with the package:", err=True)
    click.echo(board.method_table(runs.stored_runs(folder) if own else runs.stored_runs()))


@benchmark.command(name="board")
@click.argument("paths", nargs=-1, type=options.PATH)
def board_(paths: tuple[Path, ...]) -> None:
    """Show the leaderboard, and where the submissions in the files PATHS would stand."""
    from softgym_envs.extensions.leaderboard import board

    click.echo(board.leaderboard(more=paths))


@benchmark.command()
@click.argument("names", nargs=-1, required=True)
@click.option("--keep", is_flag=True, help="Keep stored results, if stored winners still have the same scores.")
def freeze(names: tuple[str, ...], keep: bool) -> None:
    """Freeze problems NAMES: draw their goals, and store them with the hashes (source checkout).

    Some changes alter the hash but no score, such as another spelling of an option. With --keep, some stored winners
    are scored again; if no score differs, the stored results get the new hash.
    """
    from softgym_envs.extensions.leaderboard import frozen
    from softgym_envs.extensions.leaderboard.refreeze import refreeze

    for name in names:
        for path in refreeze(name) if keep else [frozen.freeze(name)]:
            click.echo(f"wrote {path}")


@benchmark.command()
@click.argument("name")
@click.option(
    "--judge",
    "judges",
    multiple=True,
    metavar="JUDGE=N",
    default=("rest=100000", "qp=1000"),
    show_default=True,
    help="Judge and how many bodies it scores: rest, rest_accurate, qp, shared, trained, fem or fem_accurate, "
    "or one of these with _few, on few goals; repeat for several.",
)
@click.option(
    "--best",
    multiple=True,
    metavar="JUDGE=N",
    help="Judge that also scores the N best bodies of each judge at rest on a learned model; repeat for several.",
)
@click.option(
    "--ranked",
    multiple=True,
    metavar="JUDGE=N",
    help="Judge that also scores N bodies over all ranks of rest, and N over its best tenth; repeat for several.",
)
@click.option(
    "--longest",
    type=click.FloatRange(min=0.0, max=1.0, min_open=True),
    default=0.1,
    show_default=True,
    help="Largest step towards rest, as a part of the range of a command.",
)
@click.option("--output", type=options.PATH, help="Parquet file (default: the shipped table of the problem).")
@results
def tabulate(
    name: str,
    judges: tuple[str, ...],
    best: tuple[str, ...],
    ranked: tuple[str, ...],
    longest: float,
    output: Path | None,
    folder: Path,
) -> None:
    """Score many bodies of a problem by several judges and write them as a table.

    Each judge scores the first bodies of one Sobol sequence. An interrupted call continues where it stopped, and a call
    with more bodies adds to what is there.
    """
    from softgym_envs.extensions.leaderboard.table import tabulate as run

    chosen = _counts("--best", best), _counts("--ranked", ranked)
    with options.resumable():
        click.echo(f"wrote {run(name, _counts('--judge', judges), folder, output, longest, *chosen)}")


def _counts(option: str, values: Sequence[str]) -> dict[str, int]:
    """Return the number of bodies by judge.

    Raises:
        ValueError: for a text that is not a judge and a positive number.
    """
    counts = {}
    for each in values:
        judge, _, count = each.partition("=")
        if not count.isdigit() or int(count) < 1:
            raise ValueError(f"{option} {each}: give a judge and a number of bodies, such as rest=100000")
        counts[judge] = int(count)
    return counts


def _scores(bodies: Sequence[Sequence[float]]) -> str:
    """Return the scores of bodies for display."""
    return "; ".join(", ".join(f"{score:.4g}" for score in scores) for scores in bodies) or "none"
