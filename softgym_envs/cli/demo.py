"""Verb that shows what the package is for."""

from __future__ import annotations

from pathlib import Path

import click

from softgym_envs.cli import options
from softgym_envs.config import CONFIGS

STUDY = "finger_reach"
"""Shipped configuration of the demonstration."""


@click.command()
@click.option(
    "--folder", type=options.PATH, default=Path("results/demo"), show_default=True, help="Folder for the results."
)
@click.option("--workers", type=int, help="Number of worker processes (default: the config's).")
@options.quiet
@click.pass_context
def demo(context: click.Context, folder: Path, workers: int | None, quiet: bool) -> None:
    """Run a co-design study of the Soft Finger and write its report, in about ten minutes.

    The same as: softgym codesign --config finger_reach
    """
    from softgym_envs.cli.codesign import codesign

    config = CONFIGS / "codesign" / f"{STUDY}.yaml"
    context.invoke(codesign, config=config, folder=folder, workers=workers, storage=None, quiet=quiet, overrides=())
