"""Verbs for surrogates: dataset, fit, fit-inertia, calibrate-trust."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click

from softgym_envs.cli import options
from softgym_envs.wording import counted


@click.command()
@options.run_options("surrogate")
@options.folder
def dataset(config: Path, folder: Path, quiet: bool, overrides: tuple[str, ...]) -> None:
    """Generate the datasets of a surrogate: train, validation and test.

    An interrupted run continues where it stopped.
    """
    from softgym_envs.config import load_config
    from softgym_envs.extensions.fitting.parts.training import PartConfig, generate_part_data
    from softgym_envs.extensions.fitting.training import FitConfig, generate_datasets

    if _is_part(config):
        held = generate_part_data(load_config(config, PartConfig, overrides), folder)
        click.echo(counted(len(held.body), "state"))
        return
    with options.resumable():
        data = generate_datasets(load_config(config, FitConfig, overrides), folder, progress=not quiet)
    for split, columns in data.items():
        states, bodies = len(columns["rest"]), int(columns["rest"].sum())
        click.echo(f"{split}: {counted(states, 'state')} of {counted(bodies, 'design')}")


@click.command()
@options.run_options("surrogate")
@options.folder
@click.option("--data", type=options.PATH, help="Folder of the datasets (default: FOLDER/data).")
def fit(config: Path, folder: Path, data: Path | None, quiet: bool, overrides: tuple[str, ...]) -> None:
    """Generate data, train a surrogate and test it.

    The weights are written to FOLDER; their errors on the test set are printed. An interrupted run continues where it
    stopped.
    """
    from softgym_envs.config import load_config
    from softgym_envs.extensions.fitting.parts.training import PartConfig, fit_part
    from softgym_envs.extensions.fitting.training import FitConfig, account
    from softgym_envs.extensions.fitting.training import fit as run
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.storage import read_json

    if _is_part(config):
        part = load_config(config, PartConfig, overrides)
        click.echo(json.dumps(fit_part(part, folder, data or folder / "data", progress=not quiet), indent=2))
        return
    wanted = load_config(config, FitConfig, overrides)
    with options.resumable():
        errors = run(wanted, folder, data or folder / "data", progress=not quiet)
    click.echo(json.dumps(errors, indent=2))
    click.echo("errors of the effector are in metres, all others are shares (1 is 100%)", err=True)
    robot = make_robot(wanted.robot, **wanted.robot_options)
    for line in account(robot, read_json(folder / "model.json")):
        click.echo(line, err=True)


def _is_part(config: Path) -> bool:
    """Whether a configuration is that of a learned part, not of a whole robot."""
    from softgym_envs.config import config_text, read_value

    return "part" in (read_value(config_text(config)) or {})


@click.command("calibrate-trust")
@click.argument("robot", shell_complete=options.complete_robot)
@options.robot_option
@click.option("--weights", type=options.PATH, help="Folder of the weights, whose card is written.")
@click.option("--test", is_flag=True, help="Only judge the weights, by default the shipped ones, on a seed of its own.")
@click.option("--folder", type=options.PATH, help="Keep the FEM states in this folder; an interrupted run continues.")
@click.option(
    "--bodies", type=click.IntRange(1), default=64, show_default=True, help="Number of bodies in each stratum."
)
@click.option("--states", type=click.IntRange(1), default=5, show_default=True, help="Number of commands per body.")
@click.option(
    "--adversarial-states",
    type=click.IntRange(0),
    default=500,
    show_default=True,
    help="Number of states of each search for the worst trusted ones.",
)
@click.option("--seed", type=click.IntRange(0), default=11, show_default=True, help="Seed of all states.")
@click.option(
    "--tolerance",
    type=click.FloatRange(0.0, min_open=True),
    help="With --test of a robot of equal parts: trust uncertainties up to this [m] (default: the goal tolerance).",
)
@click.option("--kept-only", is_flag=True, help="Calibrate on what FOLDER holds of an interrupted run.")
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="Number of processes.")
def calibrate_trust(
    robot: str,
    options_: tuple[str, ...],
    weights: Path | None,
    test: bool,
    folder: Path | None,
    bodies: int,
    states: int,
    adversarial_states: int,
    seed: int,
    tolerance: float | None,
    kept_only: bool,
    workers: int,
) -> None:
    """Calibrate the uncertainty of a surrogate on FEM.

    Bodies are drawn in strata, such as inside the design box and at its corners. The uncertainty is scaled until it
    covers 95 % of the errors under commands in each stratum. Then the limit of trust is lowered until a search finds
    no trusted state that is off by more than the goal tolerance. The result is written to the card of the weights.
    Bodies of learned parts have no search, and those of the Tetrapod one command each.

    With --test nothing is written: calibrated weights are judged as they are, on states of another --seed. Robots of
    equal parts are judged by their choices as well, such as the number of fingers.
    """
    from dataclasses import asdict

    from softgym_envs.extensions.fitting.calibration import calibrate, tested
    from softgym_envs.extensions.fitting.data.sampling import HasParts
    from softgym_envs.extensions.fitting.within import calibrate_within, tested_within
    from softgym_envs.surrogate.pretrained import pretrained_folder

    body = options.robot_of(robot, options_)
    if test and body.learning.parts:
        raise click.UsageError(f"--test judges weights of whole robots; those of '{robot}' are of learned parts")
    if weights is None and not test:
        raise click.UsageError("--weights FOLDER is missing: a calibration writes to the card of the weights there")
    if tolerance is not None and not (test and isinstance(body, HasParts)):
        raise click.UsageError("--tolerance is for --test of robots of equal parts, such as 'composed_gripper'")
    weights = weights or pretrained_folder(body.one_part() if isinstance(body, HasParts) else body)
    if body.learning.parts:
        from softgym_envs.extensions.fitting.parts.calibration import calibrate_parts

        found_of_parts = calibrate_parts(weights, body.learned_mesh(), bodies=bodies, seed=seed)
        click.echo(json.dumps(found_of_parts, indent=2))
        return
    if isinstance(body, HasParts):
        sizes: dict[str, Any] = {
            "bodies": bodies,
            "states": states,
            "seed": seed,
            "state_folder": folder,
            "workers": workers,
        }
        with nullcontext() if folder is None else options.resumable():
            if test:
                found = tested_within(weights, body, tolerance=tolerance, **sizes)
            else:
                found = calibrate_within(weights, body, **sizes)
        click.echo(json.dumps({name: asdict(row) for name, row in found.items()}, indent=2))
        return
    with nullcontext() if folder is None else options.resumable():
        found = (tested if test else calibrate)(
            weights, body, bodies=bodies, states=states,
            adversarial_states=adversarial_states, seed=seed, state_folder=folder, kept_only=kept_only, workers=workers,
        )  # fmt: skip
    click.echo(json.dumps({name: asdict(row) for name, row in found.items()}, indent=2))


@click.command("fit-inertia")
@click.argument("robot", shell_complete=options.complete_robot)
@options.robot_option
@click.option("--weights", type=options.PATH, required=True, help="Folder of the weights; the inertia goes there too.")
@click.option("--bodies", type=click.IntRange(8), default=128, show_default=True, help="Number of bodies.")
@click.option("--states", type=click.IntRange(1), default=4, show_default=True, help="Number of commands per body.")
@click.option("--degree", type=click.IntRange(1), default=3, show_default=True, help="Degree of the polynomials.")
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="Number of processes.")
def fit_inertia(
    robot: str, options_: tuple[str, ...], weights: Path, bodies: int, states: int, degree: int, workers: int
) -> None:
    """Learn the inertia of a robot, for motion on its surrogate.

    Draws bodies, solves equilibria on FEM and reduces the mass of each body about them. The result is written beside
    the weights.
    """
    from softgym_envs.extensions.fitting.inertia_training import fit_inertia as run
    from softgym_envs.surrogate.inertia import write_inertia

    body = options.robot_of(robot, options_)
    found = run(body, bodies=bodies, states=states, degree=degree, workers=workers, progress=True)
    write_inertia(found, weights)
    names = ("bodies", "states", "tested_bodies", "mean_frequency_error", "largest_frequency_error")
    click.echo(json.dumps({name: found.card[name] for name in names}, indent=2))
