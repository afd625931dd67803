"""Verb for developers: bench."""

from __future__ import annotations

from pathlib import Path

import click

from softgym_envs.cli import options
from softgym_envs.errors import ConfigError


@click.command()
@click.option(
    "--output", type=options.PATH, default=Path("results/bench.json"), show_default=True, help="File for the results."
)
@click.argument("names", nargs=-1)
def bench(output: Path, names: tuple[str, ...]) -> None:
    """Measure speed.

    Runs the benchmarks NAMES, or all of them if no name is given. Needs a source checkout.
    """
    try:
        from benchmarks.run import run
    except ImportError:
        raise ConfigError("benchmarks ship with the source only: run 'softgym bench' in a source checkout") from None
    run(names, output)
