"""The verb codesign."""

from __future__ import annotations

from pathlib import Path

import click

from softgym_envs.cli import options
from softgym_envs.extras import require


@click.command()
@options.run_options("codesign")
@options.results_folder
@click.option("--workers", type=int, help="Number of worker processes (default: the config's).")
@click.option("--storage", help="PostgreSQL database shared by several machines (default: the config's).")
def codesign(
    config: Path,
    folder: Path | None,
    workers: int | None,
    storage: str | None,
    quiet: bool,
    overrides: tuple[str, ...],
) -> dict[str, str]:
    """Optimise body and controller together and write a report.

    The report is FOLDER/report.html. An interrupted study continues where it stopped.
    """
    require("codesign")
    from softgym_envs.codesign.config import StudyConfig
    from softgym_envs.codesign.result_files import REPORTS
    from softgym_envs.codesign.study import run_study
    from softgym_envs.config import load_config

    study = load_config(config, StudyConfig, (*overrides, *([f"storage={storage}"] if storage else [])))
    folder = Path("results") / study.name if folder is None else folder
    with options.resumable():
        run_study(study, folder, workers=workers, progress=not quiet)
        if not quiet:
            click.echo("drawing the report: finite elements compute what baseline and winner do at one goal")
        reports = {name: str(write(folder)) for name, write in REPORTS.items()}
    for name, path in reports.items():
        click.echo(f"{name}: {path}")
    return {"folder": str(folder), **reports}
