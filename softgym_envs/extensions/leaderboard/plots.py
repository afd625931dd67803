"""Pictures of the benchmark's page, made from stored results: regret over compute, and best bodies over baselines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.extensions.design.plots import STYLE
from softgym_envs.extensions.leaderboard.frozen import load_problem, problem_names
from softgym_envs.extensions.leaderboard.problem import BenchmarkProblem
from softgym_envs.extensions.leaderboard.regret import EQUAL, Contest, Stored, contests
from softgym_envs.extensions.leaderboard.runs import stored_runs
from softgym_envs.extensions.leaderboard.scoring import DATA, reference
from softgym_envs.extensions.sweeps.statistics import interquartile_mean
from softgym_envs.units import present

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

BASELINE, BEST = "#ea580c", "#0f766e"
"""Colours of the outlines of bodies."""

SILHOUETTE_HEIGHT = 350  # pixels
SLENDER = 3.0
"""Length over width from which a body is drawn lying."""


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


def draw_winners(data: Path = DATA, columns: int = 3) -> np.ndarray:
    """Draw the best known body of each problem with one objective over its baseline: outlines at rest, to scale.

    Problems with the same two bodies share a panel, whose title says which variables differ.

    Returns:
        The picture, shape (height, width, 3), uint8.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    panels = [_Panel.of(*known) for known in _best_known(data)]
    panels.sort(key=lambda panel: panel.height > 1.0 / SLENDER)  # flat ones first, so that they share rows
    rows = [panels[i : i + columns] for i in range(0, len(panels), columns)]
    with matplotlib.rc_context(STYLE):
        heights = [1.2 + 2.2 * max(panel.height for panel in row) for row in rows]
        figure = Figure(figsize=(3.6 * columns, sum(heights) + 0.4), layout="constrained", dpi=110)
        canvas = FigureCanvasAgg(figure)
        grid = figure.add_gridspec(len(rows), columns, height_ratios=heights)
        for place, panel in enumerate(panels):
            axes = figure.add_subplot(grid[divmod(place, columns)])
            for (points, triangles), colour, share in zip(panel.bodies, (BEST, BASELINE), (0.45, 0.12), strict=True):
                draw_silhouette(axes, points[:, panel.plane], triangles, panel.extent, colour, share)
            across, up = ("xyz"[axis] for axis in panel.plane)
            axes.set(xlabel=f"{across} [mm]", ylabel=f"{up} [mm]", aspect="equal")
            axes.set_title("\n".join(panel.title), fontsize=8.5, loc="left")
        handles = [Patch(color=colour) for colour in (BASELINE, BEST)]
        figure.legend(handles, ["baseline", "best known body"], loc="outside upper center", ncols=2)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


@dataclass(frozen=True)
class _Panel:
    """What one panel of `draw_winners` shows: two outlines, best known body first, in the axes of a view."""

    title: list[str]
    bodies: list[tuple[np.ndarray, np.ndarray]]
    plane: list[int]

    @classmethod
    def of(cls, names: list[str], definition: BenchmarkProblem, best: dict[str, float]) -> _Panel:
        bodies = [_outline(definition, body) for body in (best, definition.baseline_values)]
        return cls([*names, *_changes(definition, best)], bodies, _plane(bodies))

    @property
    def extent(self) -> np.ndarray:
        return _extent(self.bodies, self.plane)

    @property
    def height(self) -> float:
        """Height over width, at most 1."""
        across, up = np.ptp(self.extent, axis=0)
        return min(float(up / across), 1.0)


def _best_known(data: Path) -> list[tuple[list[str], BenchmarkProblem, dict[str, float]]]:
    """Return problems with the same baseline and best known body, the definition of the first, and the body."""
    found: dict[str, tuple[list[str], BenchmarkProblem, dict[str, float]]] = {}
    for name in problem_names():
        problem = load_problem(name, check=False)
        definition, known = problem.definition, reference(problem, data)
        if known is None or len(known.designs) != 1 or definition.score_count > 1:
            continue
        key = repr((definition.robot.name, definition.baseline_values, known.designs[0]))
        found.setdefault(key, ([], definition, known.designs[0]))[0].append(name)
    return sorted(found.values(), key=lambda each: (each[1].robot.name, each[0]))


def _outline(definition: BenchmarkProblem, values: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the points [m] (n, 3) of a body at rest and the triangles (t, 3) of its surface, without rigid objects."""
    from softgym_envs.viewer.surface import BodySurface, ShapeFinder

    design, options = definition.body(values)
    shapes = ShapeFinder(definition.environment_of(options).make_robot())
    surface = BodySurface(shapes.load(design))
    return surface.points(shapes.at(design)), surface.triangles[~surface.rigid]


def _plane(bodies: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[int]:
    """Return the axes of the view, to the right and up, in which the outlines of two bodies differ most.

    The view shows the longest side in full. A slender body lies, any other stands.
    """
    spans = np.ptp(np.concatenate([points[np.unique(triangles)] for points, triangles in bodies]), axis=0)
    longest = int(spans.argmax())
    found = {}
    for other in set(range(3)) - {longest}:
        plane = [longest, other] if spans[longest] > SLENDER * spans[other] else sorted((longest, other))
        extent = _extent(bodies, plane)
        first, second = (silhouette(points[:, plane], triangles, extent) for points, triangles in bodies)
        found[float(np.mean(first != second) * np.prod(np.ptp(extent, axis=0)))] = plane
    return found[max(found)]


def _extent(bodies: Sequence[tuple[np.ndarray, np.ndarray]], plane: list[int]) -> np.ndarray:
    """Return the lower and the upper corner [m] of a rectangle around bodies in a plane, shape (2, 2)."""
    points = np.concatenate([points[np.unique(triangles)][:, plane] for points, triangles in bodies])
    margin = 0.04 * np.ptp(points, axis=0).max()
    return np.array([points.min(axis=0) - margin, points.max(axis=0) + margin])


def _changes(definition: BenchmarkProblem, best: Mapping[str, float]) -> list[str]:
    """Return lines such as ``"length 41.50 mm -> 38.00 mm"``, one for each variable."""
    lines = []
    for name, variable in definition.optimised.items():
        before, after = (present(value, variable.unit) for value in (definition.baseline_values[name], best[name]))
        lines.append(f"{name.replace('_', ' ')} {before.split()[0]} \N{RIGHTWARDS ARROW} {after}")
    return lines


def silhouette(points: np.ndarray, triangles: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """Return the shadow of a body on a plane, as an image (h, w) of 0 and 1.

    The body has points in the plane [m] (n, 2) and triangles (t, 3). ``extent`` holds two corners of the image [m],
    shape (2, 2).
    """
    from PIL import Image, ImageDraw

    scale = SILHOUETTE_HEIGHT / (extent[1, 1] - extent[0, 1])
    image = Image.new("L", (round(scale * (extent[1, 0] - extent[0, 0])), SILHOUETTE_HEIGHT))
    draw = ImageDraw.Draw(image)
    for corners in (points[triangles] - extent[0]) * scale:
        draw.polygon([(float(a), float(b)) for a, b in corners], fill=1)
    return np.asarray(image)


def draw_silhouette(
    ax: Any, points: np.ndarray, triangles: np.ndarray, extent: np.ndarray, colour: str, opacity: float = 0.16
) -> None:
    """Draw the shadow of a body [mm] with its outline; points, triangles and extent are those of `silhouette`."""
    image = silhouette(points, triangles, extent)
    grid = [1e3 * np.linspace(extent[0, k], extent[1, k], n) for k, n in enumerate(reversed(image.shape))]
    ax.contourf(*grid, image, levels=[0.5, 1.5], colors=[colour], alpha=opacity)
    ax.contour(*grid, image, levels=[0.5], colors=[colour], linewidths=1.3)
