"""Which design variables matter: one at a time (eq. 3.1), Morris' elementary effects, Sobol's variances (SALib).

Samples lie evenly in the unit coordinates of the design space: logarithmic variables on their logarithm.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codesign.tools.bodies import Box, Evaluator
from codesign.tools.config import SensitivityConfig
from codesign.tools.evaluation import Evaluation, evaluate_each
from codesign.tools.folder import run_folder
from softgym_envs.config import provenance
from softgym_envs.errors import ConfigError, ConvergenceError, DataError
from softgym_envs.storage import JsonLines, write_json

Table = dict[str, dict[str, float]]
"""Indices of each variable."""

GROUPS: dict[str, Callable[[int], int]] = {"oat": lambda d: 1, "morris": lambda d: d + 1, "sobol": lambda d: d + 2}
"""How many samples belong together with d variables: each stands alone, a trajectory, a block of Saltelli's."""


def one_at_a_time(points: np.ndarray, values: np.ndarray, box: Box) -> Table:
    """Indices of eq. 3.1: the range of a metric along one variable over its range along all, in percent.

    Args:
        points: unit coordinates (n, d): the reference first, then ``levels`` points along each variable.
        values: the metric there, shape (n,); NaN where a design is infeasible.
        box: the designs.

    Returns:
        ``share`` [%], ``low`` and ``high`` (the metric's extremes along the variable, the reference included) and
        ``infeasible`` designs, for each variable.
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
    """Morris' elementary effects: changes of the metric per change of a variable by its whole range.

    Args:
        points: unit coordinates (n, d): trajectories of d + 1 points. Those with an infeasible design are left out.
        values: the metric there, shape (n,); NaN where a design is infeasible.
        box: the designs.
        levels: of the grid.
        confidence: level of the intervals.
        seed: of their bootstrap.

    Returns:
        ``mu`` (mean), ``mu_star`` (mean of the absolute values), ``sigma`` (standard deviation: how much a variable
        acts through others or not in proportion) and ``mu_star_interval`` (half width), for each variable.
    """
    from SALib.analyze import morris as salib

    kept = _whole_blocks(values, GROUPS["morris"](len(box)))
    found = salib.analyze(
        _problem(box), 0.5 * (points[kept] + 1.0), values[kept], conf_level=confidence, num_levels=levels, seed=seed
    )
    columns = {"mu": "mu", "mu_star": "mu_star", "sigma": "sigma", "mu_star_interval": "mu_star_conf"}
    return {name: {key: float(found[v][k]) for key, v in columns.items()} for k, name in enumerate(box.names)}


def sobol(values: np.ndarray, box: Box, confidence: float, seed: int) -> Table:
    """Sobol's indices: shares of the variance of the metric over the box.

    Args:
        values: the metric at Saltelli's samples, shape (n (d + 2),); NaN where a design is infeasible. Blocks with one
            are left out: the others are no longer independent samples of the variables, so that the shares are biased,
            by more the fewer blocks are left.
        box: the designs.
        confidence: level of the intervals.
        seed: of their bootstrap.

    Returns:
        ``first`` (of the variable alone) and ``total`` (with all its interactions), and the half widths of their
        intervals, for each variable.
    """
    from SALib.analyze import sobol as salib

    kept = _whole_blocks(values, GROUPS["sobol"](len(box)))
    found = salib.analyze(
        _problem(box), values[kept], calc_second_order=False, conf_level=confidence, seed=seed, print_to_console=False
    )
    columns = {"first": "S1", "first_interval": "S1_conf", "total": "ST", "total_interval": "ST_conf"}
    return {name: {key: float(found[v][k]) for key, v in columns.items()} for k, name in enumerate(box.names)}


def _problem(box: Box) -> dict[str, Any]:
    return {"num_vars": len(box), "names": list(box.names), "bounds": [[0.0, 1.0]] * len(box)}


def _whole(values: np.ndarray, size: int) -> np.ndarray:
    """Which blocks of ``size`` samples (n,) are feasible throughout, shape (n / size,)."""
    return ~np.isnan(values.reshape(-1, size)).any(axis=1)


def _whole_blocks(values: np.ndarray, size: int) -> np.ndarray:
    """Which samples (n,) belong to blocks of ``size`` samples that are all feasible."""
    whole = _whole(values, size)
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
) -> list[Evaluation]:
    """Return the evaluations of designs; those that a file holds already are not computed again.

    Args:
        evaluator: evaluates one design.
        designs: complete designs [SI].
        path: file with one evaluation per line.
        workers: number of processes.
        progress: show a progress bar.

    Raises:
        DataError: if a line of the file is damaged.
    """
    import click

    lines = JsonLines(path)
    found: dict[int, Evaluation] = {}
    for record in lines.read():
        try:
            number = record.pop("number")
            found[number] = Evaluation(**record)
        except (KeyError, TypeError) as error:
            raise DataError(f"'{path}' holds a line that is not an evaluation: {error}") from None
    missing = [(k, design) for k, design in enumerate(designs) if k not in found]
    results = evaluate_each(evaluator, missing, workers)
    with click.progressbar(results, length=len(missing), label="designs", hidden=not progress) as bar:
        for number, evaluation in bar:
            found[number] = evaluation
            lines.append({"number": number, **evaluation.to_json()})
    return [found[k] for k in range(len(designs))]


def analyse(config: SensitivityConfig, folder: str | Path, *, progress: bool = True) -> dict[str, Any]:
    """Evaluate the samples of a study and compute its indices; goes on where it was stopped.

    Args:
        config: the study.
        folder: where ``evaluations.jsonl``, ``result.json``, the resolved configuration and a picture go.
        progress: show a bar.

    Returns:
        ``indices`` (``{metric: {variable: {index: value}}}``, see `one_at_a_time`, `morris` and `sobol`), ``designs``,
        ``infeasible``, ``groups_kept`` (share of the trajectories or blocks without an infeasible design, of which the
        indices are) and ``seconds`` of evaluation over all processes.

    Raises:
        ConfigError: if SALib is not installed (``morris``, ``sobol``), or the folder holds something else or another
            process is at it, see `codesign.tools.folder.run_folder`.
        DataError: if a line of ``evaluations.jsonl`` is damaged.
        ConvergenceError: if too few designs are feasible.
    """
    folder = Path(folder)
    with run_folder(folder, config, "a sensitivity study", may_change=("name", "workers")):
        return _analyse(config, folder, progress)


def _analyse(config: SensitivityConfig, folder: Path, progress: bool) -> dict[str, Any]:
    from codesign.tools.plots import draw_sensitivity

    box = config.bodies.box()
    try:
        points = sample(config, box)
    except ImportError as error:
        raise ConfigError(
            f"method '{config.method}' needs SALib ({error}): pip install 'softgym-envs[design]'"
        ) from None
    records = evaluate_all(
        config.bodies.evaluator(config.metrics),
        [box.design(point) for point in points],
        folder / "evaluations.jsonl",
        workers=config.workers,
        progress=progress,
    )
    if config.method == "oat" and not records[0].feasible:
        raise ConvergenceError(f"the reference design is not feasible: {records[0].infeasible}")
    lost = np.array([0.0 if record.feasible else np.nan for record in records])
    tables: dict[str, Table] = {}
    for metric in config.metrics:
        values = np.array([record.metrics.get(metric, np.nan) for record in records])
        if config.method == "oat":
            tables[metric] = one_at_a_time(points, values, box)
        elif config.method == "morris":
            tables[metric] = morris(points, values, box, config.levels, config.confidence, config.seed)
        else:
            tables[metric] = sobol(values, box, config.confidence, config.seed)
    result: dict[str, Any] = {
        "method": config.method,
        "indices": tables,
        "designs": len(records),
        "infeasible": sum(not record.feasible for record in records),
        "groups_kept": float(_whole(lost, GROUPS[config.method](len(box))).mean()),
        "seconds": sum(record.seconds for record in records),
    }
    write_json(folder / "result.json", {**provenance(), **result})
    draw_sensitivity(folder / "sensitivity.png", config.method, tables)
    return result
