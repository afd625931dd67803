"""Verbs for surrogates: dataset, fit, fit-inertia, calibrate-trust."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click

from softgym_envs.cli import options


@click.command()
@options.run_options("surrogate")
@options.folder
def dataset(config: Path, folder: Path, quiet: bool, overrides: tuple[str, ...]) -> None:
    """Generate the datasets of a surrogate: train, validation and test.

    An interrupted run continues where it stopped.
    """
    from softgym_envs.config import load_config
    from softgym_envs.extensions.fitting.kinds import kind_of

    kind = kind_of(config)
    wanted = load_config(config, kind.config, overrides)
    with options.resumable():
        lines = kind.data(wanted, folder, progress=not quiet)
    for line in lines:
        click.echo(line)


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
    from softgym_envs.extensions.fitting.kinds import kind_of

    kind = kind_of(config)
    wanted = load_config(config, kind.config, overrides)
    with options.resumable():
        errors = kind.fit(wanted, folder, data or folder / "data", progress=not quiet)
    click.echo(json.dumps(errors, indent=2))
    for line in kind.account(wanted, folder):
        click.echo(line, err=True)


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
    from softgym_envs.extensions.motion.inertia import write_inertia

    body = options.robot_of(robot, options_)
    found = run(body, bodies=bodies, states=states, degree=degree, workers=workers, progress=True)
    write_inertia(found, weights)
    names = ("bodies", "states", "tested_bodies", "mean_frequency_error", "largest_frequency_error")
    click.echo(json.dumps({name: found.card[name] for name in names}, indent=2))
