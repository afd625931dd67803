"""Pictures of the design tools. Lengths, volumes and angles are shown in mm, mm3 and degrees."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from codesign.report.plots import BASELINE, MUTED, OTHER, STYLE, WINNER, shown_unit
from codesign.tools.metrics import METRICS, SHOWN
from softgym_envs.storage import atomic_write

if TYPE_CHECKING:
    from codesign.tools.bodies import Box
    from codesign.tools.calibration import Fit
    from codesign.tools.gradient import Descent, WeightedCost

__all__ = ["draw_calibration", "draw_descents", "draw_front", "draw_sensitivity", "label"]


def label(name: str) -> str:
    """Return the name of a metric with the unit it is shown in."""
    _, unit = METRICS[name].shown(0.0)
    words = name.replace("_", " ")
    return words if unit == "1" else f"{words} [{unit}]"


def shown(name: str, values: Any) -> np.ndarray:
    """Values of a metric [SI] as they are shown."""
    return np.asarray(values, dtype=float) * SHOWN.get(METRICS[name].unit, (1.0, ""))[0]


@contextmanager
def figure(path: str | Path, columns: int = 1, width: float = 5.2, height: float = 4.0) -> Iterator[Any]:
    """Axes side by side, written as a PNG at the end; yields them as a list."""
    import matplotlib

    with matplotlib.rc_context(STYLE):
        from matplotlib.figure import Figure

        drawn = Figure(figsize=(columns * width, height), dpi=150, layout="constrained")
        yield list(np.atleast_1d(drawn.subplots(1, columns)))
        with atomic_write(path) as stream:
            drawn.savefig(stream, format="png")


def draw_calibration(
    path: str | Path,
    box: Box,
    fits: Sequence[Fit],
    interval: Mapping[str, Sequence[float]] | None,
    refined: Fit | None = None,
) -> None:
    """Draw the cost and each fitted variable against the evaluations, a line a start, with interval and refined fit."""
    with figure(path, 1 + len(box)) as axes:
        for number, fit in enumerate(fits, start=1):
            steps = np.arange(1, len(fit.history) + 1)
            axes[0].semilogy(steps, [row["cost"] for row in fit.history], marker=".", label=f"start {number}")
            for axis, name in zip(axes[1:], box.names, strict=True):
                _, scale, _ = shown_unit(box.space[name].unit)
                axis.plot(steps, [scale * row[name] for row in fit.history], marker=".")
        axes[0].set_ylabel("sum of squared relative residuals")
        axes[0].legend()
        for axis, name in zip(axes[1:], box.names, strict=True):
            unit, scale, _ = shown_unit(box.space[name].unit)
            axis.set_ylabel(name.replace("_", " ") + (f" [{unit}]" if unit else ""))
            if refined is not None:
                axis.axhline(scale * refined.found[name], color=BASELINE, ls="--", label="refined on FEM")
                axis.legend()
            if interval is not None:
                axis.axhspan(*(scale * end for end in interval[name]), color=OTHER, alpha=0.6, lw=0, zorder=0)
        for axis in axes:
            axis.set_xlabel("evaluation (best so far)")


def draw_descents(path: str | Path, cost: WeightedCost, descents: Sequence[Descent]) -> None:
    """Draw the cost of every descent, and, of two or more metrics, the first two on the grid with all ends."""
    import torch

    names = [objective.metric for objective in cost.objectives]
    with figure(path, 1 + (len(names) > 1)) as axes:
        for descent in descents:
            axes[0].plot(descent.history, marker=".")
        axes[0].set_xlabel("iteration")
        axes[0].set_ylabel("normalised cost")
        if len(names) > 1:
            with torch.no_grad():
                ends = cost.metrics(cost.box.values(torch.tensor([d.end for d in descents], dtype=torch.float64)))
            axes[1].scatter(
                shown(names[0], cost.values[:, 0]), shown(names[1], cost.values[:, 1]), s=6, color=MUTED, label="grid"
            )
            axes[1].scatter(
                shown(names[0], ends[:, 0]), shown(names[1], ends[:, 1]), s=36, color=WINNER, label="descents"
            )
            axes[1].set_xlabel(label(names[0]))
            axes[1].set_ylabel(label(names[1]))
            axes[1].legend()


def draw_front(
    path: str | Path,
    names: Sequence[str],
    values: np.ndarray,
    front: np.ndarray,
    references: Mapping[str, Sequence[float]] | None = None,
) -> None:
    """Draw all evaluated designs with the Pareto front, of the first two metrics; of one metric, its course.

    Args:
        path: PNG to write.
        names: of the metrics.
        values: of all designs [SI], shape (n, m), in the order of evaluation.
        front: indices of the non-dominated designs.
        references: metrics [SI] of designs to compare with, by name.
    """
    with figure(path, width=6.0, height=4.4) as (axis,):
        if len(names) == 1:
            axis.scatter(np.arange(len(values)), shown(names[0], values[:, 0]), s=7, color=MUTED)
            axis.scatter(front, shown(names[0], values[front, 0]), s=36, color=WINNER, label="best")
            axis.set_xlabel("evaluation")
            axis.set_ylabel(label(names[0]))
        else:
            columns = [shown(name, values[:, k]) for k, name in enumerate(names[:2])]
            axis.scatter(columns[0], columns[1], s=7, color=MUTED, label=f"{len(values)} designs")
            axis.scatter(columns[0][front], columns[1][front], s=16, color=WINNER, label=f"front, {len(front)} designs")
            for name, point in (references or {}).items():
                x, y = (float(shown(metric, point[k])) for k, metric in enumerate(names[:2]))
                axis.scatter(x, y, s=50, marker="D", color=BASELINE, zorder=3)
                axis.annotate(name, (x, y), xytext=(6, 5), textcoords="offset points")
            axis.set_xlabel(label(names[0]))
            axis.set_ylabel(label(names[1]))
        axis.legend()


def draw_sensitivity(path: str | Path, method: str, tables: Mapping[str, Mapping[str, Any]]) -> None:
    """Draw a bar for each variable, a panel for each metric.

    Args:
        path: PNG to write.
        method: ``"oat"``, ``"morris"`` or ``"sobol"``.
        tables: what `codesign.tools.sensitivity.analyse` found, by metric.
    """
    with figure(path, len(tables), width=4.6, height=3.4) as axes:
        for axis, (metric, table) in zip(axes, tables.items(), strict=True):
            variables = list(table)
            place = np.arange(len(variables))[::-1]
            if method == "oat":
                axis.barh(place, [table[v]["share"] for v in variables], color=WINNER)
                axis.set_xlabel("share of the global range [%]")
            elif method == "morris":
                scale = float(shown(metric, 1.0))
                size = [scale * table[v]["mu_star"] for v in variables]
                error = [scale * table[v]["mu_star_interval"] for v in variables]
                axis.barh(place, size, xerr=error, color=WINNER, ecolor=BASELINE)
                axis.set_xlabel(f"mean elementary effect, {METRICS[metric].shown(0.0)[1]} over the range")
            else:
                for offset, key, color, words in (
                    (0.2, "first", WINNER, "first order"),
                    (-0.2, "total", MUTED, "total"),
                ):
                    size = [table[v][key] for v in variables]
                    error = [table[v][f"{key}_interval"] for v in variables]
                    axis.barh(place + offset, size, 0.4, xerr=error, color=color, ecolor=BASELINE, label=words)
                axis.set_xlabel("share of the variance")
                axis.legend()
            axis.set_yticks(place, [v.replace("_", " ") for v in variables])
            axis.set_title(metric.replace("_", " "), fontsize=10)
