"""Verb for configurations: configs."""

from __future__ import annotations

from pathlib import Path

import click

from softgym_envs.cli import options
from softgym_envs.config import CONFIGS, config_text, shipped_configs
from softgym_envs.errors import ConfigError
from softgym_envs.storage import atomic_write


@click.command()
@click.option("--copy", type=options.PATH, metavar="FOLDER", help="Copy them all to this new folder, to edit them.")
def configs(copy: Path | None) -> dict[str, list[str]] | None:
    """List the shipped configurations, or copy them.

    Every verb with --config accepts their names.
    """
    if copy is None:
        for folder, verbs in options.VERBS.items():
            click.echo(f"{verbs}:")
            for name in shipped_configs(folder):
                click.echo(f"  {name}")
        return {folder: list(shipped_configs(folder)) for folder in options.VERBS}
    if copy.exists():
        raise ConfigError(f"'{copy}' exists; choose a new folder for the configurations")
    for folder in options.VERBS:
        for name, path in shipped_configs(folder).items():
            with atomic_write(copy / folder / f"{name}.yaml") as stream:
                stream.write(config_text(path).encode())
    for path in sorted(path for path in CONFIGS.glob("*/*") if path.suffix != ".yaml"):  # data beside configurations
        with atomic_write(copy / path.relative_to(CONFIGS)) as stream:
            stream.write(path.read_bytes())
    click.echo(f"wrote {copy}")
    return None
