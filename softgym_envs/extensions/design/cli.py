"""Verbs for design without a controller: optimise, sensitivity, calibrate."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import click

from softgym_envs.cli import options
from softgym_envs.extras import require
from softgym_envs.wording import counted

INDICES = {
    "oat": "share: range along a variable, of that over all designs [%]; low, high: its ends (SI units)",
    "morris": "mu, mu_star, sigma: effects of a whole range of a variable (SI units); interval: {}",
    "sobol": "first, total: shares of the variance, from 0 to 1; interval: {}",
}
"""What the numbers of `sensitivity` mean, by method."""


@click.command()
@options.run_options("design")
@options.results_folder
def sensitivity(config: Path, folder: Path | None, quiet: bool, overrides: tuple[str, ...]) -> None:
    """Rank design variables by their effect.

    The configuration names the method: one variable at a time, Morris or Sobol. An interrupted run continues where it
    stopped.
    """
    require("codesign")
    from softgym_envs.config import load_config
    from softgym_envs.extensions.design.config import SensitivityConfig
    from softgym_envs.extensions.design.sensitivity import analyse_sensitivity

    study = load_config(config, SensitivityConfig, overrides)
    folder = Path("results") / study.name if folder is None else folder
    with options.resumable():
        result = analyse_sensitivity(study, folder, progress=not quiet)
    click.echo(INDICES[result.method].format(f"half widths of {100.0 * study.confidence:g} % intervals"))
    for metric, table in result.indices.items():
        keys = list(next(iter(table.values())))
        click.echo(f"\n{metric:24s} " + " ".join(f"{key:>16s}" for key in keys))
        for variable, row in table.items():
            click.echo(f"  {variable:22s} " + " ".join(f"{row[key]:16.5g}" for key in keys))
    kept = f" ({100 * result.groups_kept:.0f} % of the sample groups remain usable)" if result.infeasible else ""
    click.echo(f"\n{counted(result.designs, 'design')}, {result.infeasible} infeasible{kept}; wrote {folder}")


@click.command()
@options.run_options("design")
@options.results_folder
def optimise(config: Path, folder: Path | None, quiet: bool, overrides: tuple[str, ...]) -> None:
    """Search for the best bodies without a controller.

    The configuration names the solver: an Optuna sampler or gradient descent. An interrupted run of a sampler continues
    where it stopped.
    """
    require("codesign")
    from softgym_envs.config import load_config
    from softgym_envs.extensions.design import gradient
    from softgym_envs.extensions.design.config import OptimiseConfig
    from softgym_envs.extensions.design.gradient_free import search

    study = load_config(config, OptimiseConfig, overrides)
    folder = Path("results") / study.name if folder is None else folder
    if study.solver.method == "gradient":
        result = gradient.optimise(study, folder)
        click.echo(json.dumps(result.best.to_json(), indent=2))
        click.echo(f"{counted(len(result.descents), 'descent')}, {result.seconds:.2f} s; wrote {folder}")
        return
    with options.resumable():
        found = search(study, folder, progress=not quiet)
    ends = found.front[:1] if len(study.objectives) == 1 else [found.front[0], found.front[-1]]
    for row in ends:
        click.echo(json.dumps(row.to_json()))
    click.echo(
        f"{counted(len(found.front), 'design')} on the front of {found.feasible} feasible and "
        f"{counted(found.infeasible, 'infeasible design')}; wrote {folder}"
    )


@click.command()
@options.config("design")
@options.results_folder
@options.overrides
def calibrate(config: Path, folder: Path | None, overrides: tuple[str, ...]) -> dict[str, Any]:
    """Fit design variables to measured states in a CSV or JSON file."""
    require("codesign")
    from softgym_envs.config import load_config
    from softgym_envs.extensions.design.calibration import calibrate as run
    from softgym_envs.extensions.design.config import CalibrationConfig

    study = load_config(config, CalibrationConfig, overrides)
    folder = Path("results") / study.name if folder is None else folder
    result = run(study, folder)
    for name, value in {**{name: result.design[name] for name in study.fit}, **result.nuisances}.items():
        ends = (result.intervals or {}).get(name)
        text = f"{name} = {value:.6g}"
        if ends is not None and ends[1] > ends[0]:
            # Enough digits to distinguish both ends.
            digits = max(6, 2 - math.floor(math.log10((ends[1] - ends[0]) / (abs(value) or 1.0))))
            text += f", {100 * (result.level or 0.0):g} % interval {ends[0]:.{digits}g} to {ends[1]:.{digits}g}"
        elif ends is not None:
            text += ", no interval: the model fits the data exactly"
        if name in result.at_bound:
            text += "; at its bound: the best fit may lie outside the bounds"
        click.echo(text)
    for note in result.notes:
        click.echo(note)
    errors = ", ".join(f"{name} {value:.3g}" for name, value in result.errors.items())
    if result.held_out_errors:
        errors += "; held out: " + ", ".join(f"{name} {value:.3g}" for name, value in result.held_out_errors.items())
    click.echo(f"root mean square errors: {errors} (SI units); {result.seconds:.1f} s; wrote {folder}")
    return result.to_json()
