"""Which design variables matter: one at a time (thesis, eq. 3.1), Morris' elementary effects, Sobol's indices (SALib).

Samples are uniform in the unit coordinates of the box: logarithmic variables are uniform in their logarithm.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.codesign.metrics.metric import find_metric
from softgym_envs.codesign.records import Score
from softgym_envs.codesign.scoring import Evaluator
from softgym_envs.errors import ConfigError, ConvergenceError, DataError
from softgym_envs.extensions.design.bodies import evaluate_each
from softgym_envs.extensions.design.box import Box
from softgym_envs.extensions.design.config import SensitivityConfig
from softgym_envs.extensions.design.plots import draw_sensitivity
from softgym_envs.extensions.design.records import SensitivityResult
from softgym_envs.runs import RunFolder
from softgym_envs.storage import JsonLines, write_signed

Table = dict[str, dict[str, float]]
"""Indices by variable."""

GROUP_SIZES: dict[str, Callable[[int], int]] = {
    "oat": lambda d: 1,  # every sample alone
    "morris": lambda d: d + 1,  # a trajectory
    "sobol": lambda d: d + 2,  # a block of Saltelli's scheme
}
"""Number of samples that belong together, for d variables."""


def one_at_a_time(points: np.ndarray, values: np.ndarray, box: Box) -> Table:
    """Return the range of a metric along each variable, in percent of its range over all samples (thesis, eq. 3.1).

    Points (n, d) in unit coordinates are the reference, then equally many along each variable. Values (n,) are NaN
    where a design is infeasible.

    Returns:
        For each variable, ``share`` [%], ``low`` and ``high`` (extremes of the metric along the variable, the reference
        included), and the number of ``infeasible`` designs.
    """
    levels = (len(points) - 1) // len(box)
    spread = float(np.nanmax(values) - np.nanmin(values))
    table = {}
    for k, name in enumerate(box.names):
        along = values[1 + k * levels : 1 + (k + 1) * levels]
        local = np.append(along, values[0])
        low, high = float(np.nanmin(local)), float(np.nanmax(local))
        table[name] = {
            "share": 100.0 * (high - low) / spread if spread else 0.0,
            "low": low,
            "high": high,
            "infeasible": int(np.isnan(along).sum()),
        }
    return table


def morris(points: np.ndarray, values: np.ndarray, box: Box, levels: int, confidence: float, seed: int) -> Table:
    """Return Morris' elementary effects: changes of a metric when a variable changes by its whole range.

    Points (n, d) in unit coordinates form trajectories of d + 1 points; those with an infeasible design, whose value is
    NaN, are left out. The seed is that of the bootstrap of the intervals.

    Returns:
        For each variable, ``mu`` (mean), ``mu_star`` (mean of the absolute values), ``sigma`` (standard deviation,
        large for interactions and nonlinear effects) and ``mu_star_interval`` (half width).
    """
    from SALib.analyze import morris as salib

    kept = _in_whole_groups(values, GROUP_SIZES["morris"](len(box)))
    found = salib.analyze(
        _problem(box), 0.5 * (points[kept] + 1.0), values[kept], conf_level=confidence, num_levels=levels, seed=seed
    )
    columns = {"mu": "mu", "mu_star": "mu_star", "sigma": "sigma", "mu_star_interval": "mu_star_conf"}
    return {name: {key: float(found[v][k]) for key, v in columns.items()} for k, name in enumerate(box.names)}


def sobol(values: np.ndarray, box: Box, confidence: float, seed: int) -> Table:
    """Return Sobol's indices: shares of the variance of a metric over the box.

    Values are those at Saltelli's samples, shape (n (d + 2),). Blocks with an infeasible design (NaN) are left
    out. The variables of the other blocks are no longer independent, which biases the shares, more so the fewer
    blocks are left. The seed is that of the bootstrap of the intervals.

    Returns:
        For each variable, ``first`` (effect of the variable alone), ``total`` (with all its interactions), and the half
        widths of their intervals.
    """
    from SALib.analyze import sobol as salib

    kept = _in_whole_groups(values, GROUP_SIZES["sobol"](len(box)))
    found = salib.analyze(
        _problem(box), values[kept], calc_second_order=False, conf_level=confidence, seed=seed, print_to_console=False
    )
    columns = {"first": "S1", "first_interval": "S1_conf", "total": "ST", "total_interval": "ST_conf"}
    return {name: {key: float(found[v][k]) for key, v in columns.items()} for k, name in enumerate(box.names)}


def _problem(box: Box) -> dict[str, Any]:
    return {"num_vars": len(box), "names": list(box.names), "bounds": [[0.0, 1.0]] * len(box)}


def _in_whole_groups(values: np.ndarray, size: int) -> np.ndarray:
    """Return which samples (n,) belong to groups of ``size`` samples that are all feasible."""
    whole = ~np.isnan(values.reshape(-1, size)).any(axis=1)
    if whole.sum() < 2:
        raise ConvergenceError(f"only {whole.sum()} of {len(whole)} groups of samples are feasible; narrow the bounds")
    return np.repeat(whole, size)


def sample(config: SensitivityConfig, box: Box) -> np.ndarray:
    """Return the samples of a study in unit coordinates, shape (n, d)."""
    if config.method == "oat":
        reference = box.unit(box.reference)
        points = np.tile(reference, (1 + config.levels * len(box), 1))
        for k in range(len(box)):
            points[1 + k * config.levels : 1 + (k + 1) * config.levels, k] = np.linspace(-1.0, 1.0, config.levels)
        return points
    if config.method == "morris":
        from SALib.sample import morris as design

        samples = design.sample(_problem(box), config.samples, num_levels=config.levels, seed=config.seed)
    else:
        from SALib.sample import sobol as design

        samples = design.sample(_problem(box), config.samples, calc_second_order=False, seed=config.seed)
    return 2.0 * samples - 1.0


def evaluate_all(
    evaluator: Evaluator,
    designs: Sequence[Mapping[str, float]],
    path: Path,
    *,
    workers: int = 1,
    progress: bool = True,
) -> list[Score]:
    """Return the evaluations of complete designs [SI]; those that a file of JSON lines holds are not computed again.

    Raises:
        DataError: if a line of the file is damaged.
    """
    import click

    lines = JsonLines(path)
    found: dict[int, Score] = {}
    for record in lines.read():
        try:
            number = record.pop("number")
            found[number] = Score.from_json(record)
        except (KeyError, DataError) as error:
            raise DataError(f"'{path}' holds a line that is not an evaluation: {error}") from None
    missing = [(k, design) for k, design in enumerate(designs) if k not in found]
    results = evaluate_each(evaluator, missing, workers)
    with click.progressbar(results, length=len(missing), label="designs", hidden=not progress) as bar:
        for number, evaluation in bar:
            found[number] = evaluation
            lines.append({"number": number, **evaluation.to_json()})
    return [found[k] for k in range(len(designs))]


def analyse_sensitivity(config: SensitivityConfig, folder: str | Path, *, progress: bool = True) -> SensitivityResult:
    """Evaluate the samples of a study and compute its indices; continues a study that was interrupted.

    Args:
        config: the study.
        folder: where ``evaluations.jsonl``, ``result.json``, the resolved configuration and a picture go.
        progress: show a progress bar.

    Raises:
        ConfigError: if SALib is not installed (``morris``, ``sobol``), the folder holds results of another
            configuration or tool, or another process uses it.
        DataError: if a line of ``evaluations.jsonl`` is damaged.
        ConvergenceError: if too few designs are feasible.
    """
    may_change = ("name", "workers")
    run = RunFolder(folder, SensitivityConfig, "a sensitivity study")
    with run.reserve(config, may_change, progress=progress) as place:
        result = _analyse(config, place, progress)
        write_signed(place / "result.json", {**run.stamp(), **result.to_json()})
        metrics = [find_metric(name) for name in config.metrics]
        draw_sensitivity(place / "sensitivity.png", config.method, metrics, result.indices)
    return result


def _analyse(config: SensitivityConfig, folder: Path, progress: bool) -> SensitivityResult:
    box = config.bodies.box()
    try:
        points = sample(config, box)
    except ImportError as error:
        raise ConfigError(
            f"method '{config.method}' needs SALib ({error}): pip install 'softgym-envs[design]'"
        ) from None
    evaluations = evaluate_all(
        config.bodies.evaluator(config.metrics),
        [box.design(point) for point in points],
        folder / "evaluations.jsonl",
        workers=config.workers,
        progress=progress,
    )
    if config.method == "oat" and not evaluations[0].feasible:
        raise ConvergenceError(f"the reference design is infeasible: {evaluations[0].reason}")
    indices: dict[str, Table] = {}
    for metric in map(find_metric, config.metrics):
        values = np.array(
            [evaluation.values[metric.name] if evaluation.feasible else np.nan for evaluation in evaluations]
        )
        if config.method == "oat":
            indices[metric.name] = one_at_a_time(points, values, box)
        elif config.method == "morris":
            indices[metric.name] = morris(points, values, box, config.levels, config.confidence, config.seed)
        else:
            indices[metric.name] = sobol(values, box, config.confidence, config.seed)
    feasible = np.array([evaluation.feasible for evaluation in evaluations])
    return SensitivityResult(
        method=config.method,
        indices=indices,
        designs=len(evaluations),
        infeasible=int((~feasible).sum()),
        groups_kept=float(feasible.reshape(-1, GROUP_SIZES[config.method](len(box))).all(axis=1).mean()),
        seconds=sum(evaluation.seconds for evaluation in evaluations),
    )
