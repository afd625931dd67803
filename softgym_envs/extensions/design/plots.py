"""Pictures of the design tools. Lengths, volumes and angles are shown in mm, mm3 and degrees."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.codesign.metrics.metric import Metric
from softgym_envs.extensions.design.records import CalibrationResult
from softgym_envs.storage import atomic_write
from softgym_envs.units import display
from softgym_envs.wording import counted

BASELINE, WINNER, OTHER, MUTED = "#64748b", "#0f766e", "#cbd5e1", "#94a3b8"
STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 9.5,
    "axes.edgecolor": "#94a3b8",
    "axes.labelcolor": "#334155",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e2e8f0",
    "grid.linewidth": 0.8,
    "xtick.color": "#475569",
    "ytick.color": "#475569",
    "legend.frameon": False,
    "svg.hashsalt": "softgym-envs",
}


@contextmanager
def figure(path: str | Path, columns: int = 1, width: float = 5.2, height: float = 4.0) -> Iterator[Any]:
    """Yield a list of axes side by side, and write them as a PNG at the end."""
    import matplotlib

    with matplotlib.rc_context(STYLE):
        from matplotlib.figure import Figure

        drawn = Figure(figsize=(columns * width, height), dpi=150, layout="constrained")
        yield list(np.atleast_1d(drawn.subplots(1, columns)))
        with atomic_write(path) as stream:
            drawn.savefig(stream, format="png")


def draw_calibration(path: str | Path, units: Mapping[str, str], result: CalibrationResult) -> None:
    """Draw the cost and each parameter against the evaluations, one line per start, with intervals and refined fit.

    ``units`` are the SI units of the fitted parameters by name.
    """
    with figure(path, 1 + len(units)) as axes:
        for number, fit in enumerate(result.fits, start=1):
            steps = np.arange(1, len(fit.history) + 1)
            axes[0].semilogy(steps, [row["cost"] for row in fit.history], marker=".", label=f"start {number}")
            for axis, (name, unit) in zip(axes[1:], units.items(), strict=True):
                axis.plot(steps, [display(unit).factor * row[name] for row in fit.history], marker=".")
        axes[0].set_ylabel("sum of squared relative residuals")
        axes[0].legend()
        for axis, (name, si_unit) in zip(axes[1:], units.items(), strict=True):
            unit, scale, _ = display(si_unit)
            axis.set_ylabel(name.replace("_", " ") + (f" [{unit}]" if unit else ""))
            if result.refined is not None:
                axis.axhline(scale * result.refined.found[name], color=BASELINE, ls="--", label="refined on FEM")
                axis.legend()
            if result.intervals is not None and name in result.intervals:
                axis.axhspan(*(scale * end for end in result.intervals[name]), color=OTHER, alpha=0.6, lw=0, zorder=0)
        for axis in axes:
            axis.set_xlabel("evaluation (best so far)")


def draw_descents(
    path: str | Path,
    metrics: Sequence[Metric],
    histories: Sequence[Sequence[float]],
    grid: np.ndarray,
    ends: np.ndarray,
) -> None:
    """Draw the cost of every descent and, for two or more metrics, the first two on the grid and at all ends.

    The metrics [SI] have the shape (n, m) on the grid and (k, m) at the ends.
    """
    with figure(path, 1 + (len(metrics) > 1)) as axes:
        for history in histories:
            axes[0].plot(history, marker=".")
        axes[0].set_xlabel("iteration")
        axes[0].set_ylabel("normalised cost")
        if len(metrics) > 1:
            x, y = metrics[:2]
            for values, size, color, name in ((grid, 6, MUTED, "grid"), (ends, 36, WINNER, "descents")):
                axes[1].scatter(x.scale * values[:, 0], y.scale * values[:, 1], s=size, color=color, label=name)
            axes[1].set_xlabel(x.axis)
            axes[1].set_ylabel(y.axis)
            axes[1].legend()


def draw_front(
    path: str | Path,
    metrics: Sequence[Metric],
    values: np.ndarray,
    front: np.ndarray,
    references: Mapping[str, Sequence[float]] | None = None,
) -> None:
    """Draw all evaluated designs and the front: the first metric against each other one, or all values of a single one.

    The values [SI] have the shape (n, m), in the order of evaluation, ``front`` has indices into them, and
    ``references`` has metrics [SI] of designs to compare with, by name.
    """
    scale = np.array([metric.scale for metric in metrics])
    shown = scale * values
    with figure(path, max(1, len(metrics) - 1), width=6.0, height=4.4) as axes:
        if len(metrics) == 1:
            axes[0].scatter(np.arange(len(shown)), shown[:, 0], s=7, color=MUTED)
            axes[0].scatter(front, shown[front, 0], s=36, color=WINNER, label="best")
            axes[0].set_xlabel("evaluation")
            axes[0].set_ylabel(metrics[0].axis)
        else:
            for k, axis in enumerate(axes, start=1):
                x, y = shown[:, 0], shown[:, k]
                axis.scatter(x, y, s=7, color=MUTED, label=counted(len(shown), "design"))
                axis.scatter(x[front], y[front], s=16, color=WINNER, label=f"front, {counted(len(front), 'design')}")
                for name, point in (references or {}).items():
                    place = (scale[0] * point[0], scale[k] * point[k])
                    axis.scatter(*place, s=50, marker="D", color=BASELINE, zorder=3)
                    axis.annotate(name, place, xytext=(6, 5), textcoords="offset points")
                axis.set_xlabel(metrics[0].axis)
                axis.set_ylabel(metrics[k].axis)
        axes[0].legend()


def draw_sensitivity(
    path: str | Path, method: str, metrics: Sequence[Metric], indices: Mapping[str, Mapping[str, Any]]
) -> None:
    """Draw one panel per metric, with one bar per variable; ``indices`` is that of `SensitivityResult`."""
    with figure(path, len(metrics), width=4.6, height=3.4) as axes:
        for axis, metric in zip(axes, metrics, strict=True):
            table = indices[metric.name]
            variables = list(table)
            place = np.arange(len(variables))[::-1]
            if method == "oat":
                axis.barh(place, [table[v]["share"] for v in variables], color=WINNER)
                axis.set_xlabel("share of the global range [%]")
            elif method == "morris":
                scale = metric.scale
                size = [scale * table[v]["mu_star"] for v in variables]
                error = [scale * table[v]["mu_star_interval"] for v in variables]
                axis.barh(place, size, xerr=error, color=WINNER, ecolor=BASELINE)
                axis.set_xlabel(f"mean elementary effect, {metric.display.unit} over the range")
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
            axis.set_title(metric.name.replace("_", " "), fontsize=10)
