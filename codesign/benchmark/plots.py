"""Pictures of the benchmark's page, made from the stored runs: regret over compute, and winners beside baselines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from softgym_envs.agents.statistics import interquartile_mean
from softgym_envs.codesign.benchmark.frozen import load_problem
from softgym_envs.codesign.benchmark.regret import EQUAL, Contest, Stored, contests
from softgym_envs.codesign.benchmark.runs import stored_runs
from softgym_envs.codesign.report.plots import STYLE

COLOURS = {
    "random": "#94a3b8",
    "sobol": "#a16207",
    "tpe": "#2563eb",
    "gp": "#0f766e",
    "cmaes": "#ea580c",
    "nsgaii": "#9333ea",
    "halving": "#ca8a04",
    "hyperband": "#db2777",
    "botorch": "#14b8a6",
    "smac": "#84cc16",
    "map_elites": "#7c2d12",
    "cma_me": "#f59e0b",
    "gradient": "#111827",
    "critic": "#be123c",
    "distribution": "#6d28d9",
    "inheritance": "#0369a1",
}
"""Colour of each method in all figures."""


def regret_at(contest: Contest, method: str, steps: np.ndarray) -> np.ndarray:
    """Return the regret of each run after numbers of environment steps, shape (runs, len(steps)).

    It is NaN before the first body.
    """
    rows = []
    for run, _ in contest.runs[method]:
        curve = contest.curve(run)
        index = np.searchsorted(curve[:, 0], steps, side="right") - 1
        rows.append(np.where(index >= 0, curve[np.maximum(index, 0), 2], np.nan))
    return np.array(rows)


def draw_regret(runs: Sequence[Stored] | None = None, columns: int = 3) -> np.ndarray:
    """Draw regret over environment steps, a panel per problem with one objective; default the stored runs.

    Lines are interquartile means over the seeds. Regret below `EQUAL` is drawn there.

    Returns:
        The picture, shape (height, width, 3), uint8.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    shown = [c for c in contests(stored_runs() if runs is None else runs) if next(iter(c.runs.values()))[0][0].curve]
    with matplotlib.rc_context(STYLE):
        lines = -(-len(shown) // columns)
        figure = Figure(figsize=(3.3 * columns, 2.5 * lines + 0.4), layout="constrained", dpi=110)
        canvas = FigureCanvasAgg(figure)
        handles: dict[str, Any] = {}
        for place, contest in enumerate(shown):
            axes = figure.add_subplot(lines, columns, place + 1)
            first = min(contest.curve(run)[0, 0] for rows in contest.runs.values() for run, _ in rows)
            steps = np.geomspace(first, contest.steps, 120)
            for method in contest.runs:
                values = regret_at(contest, method, steps)
                mean = [interquartile_mean(column) for column in values.T]
                (line,) = axes.plot(steps, np.maximum(mean, EQUAL), color=COLOURS.get(method), lw=1.6)
                handles.setdefault(method, line)
            axes.set(xscale="log", yscale="log", ylim=(0.9 * EQUAL, 1.2))
            axes.xaxis.set_minor_formatter(NullFormatter())  # on short axes these labels would overlap
            judge = contest.judge + (", table" if contest.listed else "")
            axes.set_title(f"{contest.problem} ({judge})", fontsize=9)
        figure.supxlabel("environment steps", fontsize=9.5)
        figure.supylabel("regret", fontsize=9.5)
        figure.legend(list(handles.values()), list(handles), loc="outside upper center", ncols=min(len(handles), 6))
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def draw_winners(
    runs: Sequence[Stored] | None = None, columns: int = 4, size: tuple[int, int] = (300, 260)
) -> np.ndarray:
    """Draw the best body of each problem with one objective, at rest, in front of the pale baseline.

    Returns:
        The picture, shape (height, width, 3), uint8.
    """
    from softgym_envs.viewer.image import render_bodies

    best: dict[str, tuple[float, dict[str, float]]] = {}
    for run, _ in stored_runs() if runs is None else runs:
        if run.curve and run.optimum is None and run.designs:
            value = run.curve[-1][2]
            if run.problem not in best or value > best[run.problem][0]:
                best[run.problem] = value, run.designs[0]
    images = []
    for name, (_, design) in sorted(best.items()):
        definition = load_problem(name, check=False).definition
        body, options = definition.body(design)
        robot = definition.environment_of(options).make_robot()
        images.append(render_bodies(robot, [body], size=size, ghost=definition.baseline, texts=[name]))
    images += [np.full_like(images[0], 255)] * (-len(images) % columns)
    return np.concatenate([np.concatenate(images[i : i + columns], axis=1) for i in range(0, len(images), columns)])
