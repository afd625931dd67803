"""Verbs of sweeps: sweep, results."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import click

from softgym_envs.cli import options
from softgym_envs.errors import SoftGymError
from softgym_envs.wording import counted


@click.command()
@click.argument("configs", nargs=-1)
@click.option("--seed", "seeds", type=int, multiple=True, default=(0, 1, 2), show_default=True, help="Repeat it.")
@click.option("--workers", type=int, default=1, show_default=True, help="Number of worker processes.")
@click.option("--folder", type=options.PATH, required=True, help="Folder of all results.")
@click.option("--goals", type=int, default=100, show_default=True, help="Number of unseen goals on the surrogate.")
@click.option(
    "--fem-goals",
    type=int,
    default=10,
    show_default=True,
    help="Number of unseen goals on FEM; 0 leaves FEM out for environments on the surrogate.",
)
def sweep(
    configs: tuple[str, ...], seeds: tuple[int, ...], workers: int, folder: Path, goals: int, fem_goals: int
) -> None:
    """Train and evaluate configurations with several seeds, one process each.

    CONFIGS are names of shipped configurations, or files; default all shipped ones. An interrupted sweep continues
    where it stopped.
    """
    from softgym_envs.config import shipped_configs
    from softgym_envs.extensions.sweeps.sweep import run_sweep

    shipped = shipped_configs("agents")
    files = [shipped.get(name, Path(name)) for name in configs or shipped]
    with options.resumable():
        failed = run_sweep(files, seeds, workers, folder, goals=goals, fem_goals=fem_goals)
    if failed:
        raise SoftGymError(f"{counted(failed, 'job')} failed; run the same command again to repeat them")


@click.command()
@click.option("--folder", type=options.PATH, help="Folder of stored runs (default: the shipped runs).")
@click.option("--output", type=options.PATH, help="Write the table to this file instead of printing it.")
@click.option("--curves", type=options.PATH, help="Draw the learning curves to this file (.png, .svg or .pdf).")
@options.as_json
def results(folder: Path | None, output: Path | None, curves: Path | None, as_json: bool) -> None:
    """Print a table of training runs and draw their learning curves."""
    from softgym_envs.extensions.sweeps.results import RESULTS, draw_curves, load_runs, summary, table
    from softgym_envs.storage import atomic_write

    runs = load_runs(folder or RESULTS)
    text = json.dumps([asdict(row) for row in summary(runs)]) if as_json else table(runs)
    if output is None:
        click.echo(text)
    else:
        with atomic_write(output, "w") as stream:
            stream.write(text)
        click.echo(f"wrote {output}")
    if curves is not None:
        click.echo(f"wrote {draw_curves(runs, curves)}")
