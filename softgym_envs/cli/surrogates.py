"""Verbs for surrogates: dataset, fit, deploy."""

from __future__ import annotations

import json
from pathlib import Path

import click

from softgym_envs.cli import options
from softgym_envs.errors import ConfigError


@click.command()
@options.run_options("surrogate")
@options.folder
def dataset(config: Path, folder: Path, quiet: bool, overrides: tuple[str, ...]) -> None:
    """Generate the datasets of a surrogate.

    The datasets are train, validation and test. An interrupted run continues where it stopped.
    """
    from softgym_envs.config import load_config
    from softgym_envs.surrogate.training import FitConfig, generate_datasets

    with options.resumable():
        data = generate_datasets(load_config(config, FitConfig, overrides), folder, progress=not quiet)
    for split, columns in data.items():
        click.echo(f"{split}: {len(columns['rest'])} states of {int(columns['rest'].sum())} designs")


@click.command()
@options.run_options("surrogate")
@options.folder
@click.option("--data", type=options.PATH, help="Folder of the datasets (default: FOLDER/data).")
def fit(config: Path, folder: Path, data: Path | None, quiet: bool, overrides: tuple[str, ...]) -> None:
    """Generate data, train a surrogate and test it.

    An interrupted run continues where it stopped.
    """
    from softgym_envs.config import load_config
    from softgym_envs.surrogate.training import FitConfig
    from softgym_envs.surrogate.training import fit as run

    with options.resumable():
        errors = run(load_config(config, FitConfig, overrides), folder, data or folder / "data", progress=not quiet)
    click.echo(json.dumps(errors, indent=2))


@click.command()
@click.argument("robot", shell_complete=options.complete_robot)
@click.argument("files", nargs=-1, required=True, type=options.PATH)
@options.robot_option
@options.design
@click.option("--weights", type=options.PATH, help="Folder of the weights (default: the shipped weights).")
@click.option("--members", type=int, help="Number of ensemble members to average (default: all).")
@click.option("--name", default="softgym", show_default=True, help="Prefix of the names that a header defines.")
def deploy(
    robot: str,
    files: tuple[Path, ...],
    options_: tuple[str, ...],
    design: tuple[str, ...],
    weights: Path | None,
    members: int | None,
    name: str,
) -> None:
    """Write a surrogate as a C header or an ONNX graph.

    FILES end with .h (a C header of one body) or .onnx (a graph that takes the design as an input).
    """
    from softgym_envs.surrogate.export.c import export_c
    from softgym_envs.surrogate.export.common import FORMATS
    from softgym_envs.surrogate.export.onnx import export_onnx
    from softgym_envs.surrogate.pretrained import pretrained_model

    for file in files:
        if file.suffix not in FORMATS:
            raise ConfigError(f"'{file}' must end with {' or '.join(FORMATS)}")
    if design and all(file.suffix == ".onnx" for file in files):
        raise ConfigError("--design applies to C headers (.h) only: an .onnx graph takes the design as an input")
    model = pretrained_model(options.robot_of(robot, options_), weights)
    chosen = options.design_of(design)
    for file in files:
        if file.suffix == ".h":
            export_c(model, chosen, file, members=members, name=name)
        else:
            export_onnx(model, file, members=members)
        click.echo(f"wrote {file}")
