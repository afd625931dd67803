"""``python -m softgym_envs.extensions.grasping.chain``: generate data, train a chain, and test it once."""

from __future__ import annotations

import json
from pathlib import Path

import click

from softgym_envs.config import load_config
from softgym_envs.extensions.grasping.chain.training import ChainConfig, fit_chain


@click.command()
@click.option("--config", required=True, type=click.Path(path_type=Path), help="YAML file, see `ChainConfig`.")
@click.option("--folder", required=True, type=click.Path(path_type=Path), help="Folder of the weights.")
@click.option("--data", type=click.Path(path_type=Path), help="Folder of the datasets (default: FOLDER/data).")
@click.argument("overrides", nargs=-1)
def main(config: Path, folder: Path, data: Path | None, overrides: tuple[str, ...]) -> None:
    """Generate missing data, train the members and write the weights with their card."""
    errors = fit_chain(load_config(config, ChainConfig, overrides), folder, data or folder / "data")
    click.echo(json.dumps(errors, indent=2))


if __name__ == "__main__":
    main()
