"""The verb validate."""

from __future__ import annotations

from pathlib import Path

import click

from softgym_envs.cli import options
from softgym_envs.extras import require


@click.command()
@click.argument("robot")
@click.option("--data", type=options.PATH, help="Folder with the recordings; without it, says where they are.")
@click.option("--page", type=options.PATH, help="File of the page (default: results/validate_ROBOT.html).")
def validate(robot: str, data: Path | None, page: Path | None) -> None:
    """Compare a robot with public recordings of it.

    Robots: silicone_beam, tendon_cone, tendon_rod. Nothing is downloaded.
    """
    require("measured")
    from softgym_envs.extensions.design.fit_page import write_page
    from softgym_envs.extensions.measured.comparison import find_source

    source = find_source(robot)
    if data is None:
        click.echo(f"recordings of {robot}: {source.origin}\n  folder there: {source.folder}\n  files: {source.files}")
        click.echo(f"copy them to a folder of yours, then run: softgym validate {robot} --data FOLDER")
        return
    comparison = source.compare(data)
    for line in comparison.lines:
        click.echo(f"{line.what}: {line.ours}" + (f" ({line.others})" if line.others else ""))
    if comparison.fitted:
        click.echo("fitted:")
        for text in comparison.fitted:
            click.echo(f"  {text}")
    page = Path("results") / f"validate_{robot}.html" if page is None else page
    page.parent.mkdir(parents=True, exist_ok=True)
    write_page(page, comparison.page)
    click.echo(f"page: {page}")
