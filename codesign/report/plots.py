"""Figures of a report, as SVG data for HTML, with the units of `softgym_envs.units`."""

from __future__ import annotations

import base64
import io
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.codesign.report.results import StudyResults
from softgym_envs.codesign.snapshot import StudySnapshot
from softgym_envs.units import present

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BASELINE, WINNER, OTHER, MUTED, VIOLATES = "#64748b", "#0f766e", "#cbd5e1", "#94a3b8", "#dc2626"
COLOURS = {"baseline": BASELINE, "winner": WINNER}
AGENTS = {"policy": ("policy", "o"), "qp": ("inverse QP", "s")}
SILHOUETTE_HEIGHT = 350  # pixels
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
def _figure(width: float, height: float, columns: int = 1) -> Iterator[tuple[Figure, list[Any], list[str]]]:
    """Yield a figure, its axes, and a list; when the block ends the figure's data URI is appended to the list."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasSVG(figure)
        axes = list(np.atleast_1d(figure.subplots(1, columns)))
        out: list[str] = []
        yield figure, axes, out
        stream = io.BytesIO()
        figure.savefig(stream, format="svg", metadata={"Date": None})
        out.append(_uri(stream.getvalue(), "svg+xml"))


def _uri(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def picture(image: np.ndarray) -> str:
    """Return an image (h, w, 3) uint8 as WebP data for HTML."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image).save(stream, format="webp", quality=85)
    return _uri(stream.getvalue(), "webp")


def curves(snapshot: StudySnapshot, results: StudyResults) -> str | None:
    """Learning curve of each trial; None without training."""
    trials = [trial for trial in snapshot.trials if trial.curve]
    return _curves(snapshot, results, [(t.number, t.curve, "--" if t.state == "pruned" else "-") for t in trials])


def finalist_curves(snapshot: StudySnapshot, results: StudyResults) -> str | None:
    """Learning curves of the policies that were trained anew for the finalists; None without them."""
    return _curves(snapshot, results, [(t.trial, t.curve, "-") for t in results.trainings if t.curve])


def _curves(
    snapshot: StudySnapshot, results: StudyResults, drawn: Sequence[tuple[int, list[list[float]], str]]
) -> str | None:
    """Learning curves: trial, environment steps with scores, and line style of each."""
    if not drawn:
        return None
    objective, roles = snapshot.objective, results.roles
    labelled: set[str] = set()
    with _figure(6.2, 3.2) as (_, (ax,), out):
        for number, curve, line in sorted(drawn, key=lambda row: row[0] in roles):
            steps, scores = np.array(curve, dtype=float).T
            role = roles.get(number, "")
            label = role or "other bodies"
            ax.plot(
                steps,
                objective.value_of(scores),
                line,
                color=COLOURS.get(role, OTHER),
                label=None if label in labelled else label,
                linewidth=2.2 if role else 1.1,
                marker=".",
                markersize=4,
            )
            labelled.add(label)
        ax.set(xlabel="environment steps of training", ylabel=f"{objective.axis} in training")
        ax.legend(fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)  # above the curves, not over them
    return out[0]


def parallel(snapshot: StudySnapshot, results: StudyResults) -> str:
    """Bodies as lines across their variables, coloured by the objective."""
    import matplotlib
    from matplotlib.colors import Normalize

    objective = snapshot.objective
    done = sorted((t for t in snapshot.trials if t.scores is not None), key=lambda t: t.score or 0.0)
    variables = [variable for variable in results.variables if variable.optimised]
    roles = results.roles
    scores = np.array([t.score for t in done])
    shown = np.array([objective.value_of(score) for score in scores])
    worst, best = scores.min(), scores.max() if np.ptp(scores) else scores.min() + 1.0
    colours = matplotlib.colormaps["viridis_r" if objective.sign < 0 else "viridis"]
    ends = (objective.value_of(worst), objective.value_of(best))
    norm = Normalize(min(ends), max(ends))
    with _figure(6.2, 3.2) as (figure, (ax,), out):
        ax.grid(False)
        for trial, score, value in zip(done, scores, shown, strict=True):
            values = {**trial.design, **trial.options}
            heights = [variable.place(values[variable.name]) for variable in variables]
            heights.append((score - worst) / (best - worst))
            role = roles.get(trial.number)
            ax.plot(
                heights,
                color=COLOURS.get(role or "", colours(norm(value))),
                linewidth=2.8 if role else 1.1,
                alpha=1.0 if role else 0.75,
                label=role,
                zorder=4 if role else 2,
            )
        for i, variable in enumerate(variables):
            ax.axvline(i, color="#94a3b8", linewidth=1.0, zorder=1)
            for height, end in ((-0.05, variable.low), (1.05, variable.high)):
                ax.text(i, height, present(end, variable.unit), ha="center", va="center", fontsize=8, color="#475569")
        ax.axvline(len(variables), color="#94a3b8", linewidth=1.0, zorder=1)
        for height, end in zip((-0.05, 1.05), ends, strict=True):
            ax.text(len(variables), height, f"{end:.2f}", ha="center", va="center", fontsize=8, color="#475569")
        names = [variable.name.replace("_", " ") for variable in variables] + [objective.axis]
        ax.set_xticks(range(len(names)), [textwrap.fill(name, 13) for name in names])
        ax.set(yticks=[], ylim=(-0.12, 1.12))
        for side in ("left", "bottom"):
            ax.spines[side].set_visible(False)
        ax.tick_params(length=0)
        figure.colorbar(matplotlib.cm.ScalarMappable(norm, colours), ax=ax, label=objective.axis, pad=0.02)
        if roles:
            ax.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2)
    return out[0]


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


def overlay(shapes: Sequence[tuple[str, Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]]]]) -> str:
    """Overlaid views of baseline and winner, to scale, along the axis along which the bodies move least.

    Each pose has its caption and, by role, points [m] (n, 3), triangles (t, 3) and effectors [m] (k, 3). The points of
    a role have the same order in all poses.
    """
    first, last = shapes[0][1], shapes[-1][1]
    moved = [np.abs(last[role][0] - first[role][0]).mean(axis=0) for role in first]
    plane = np.delete(np.arange(3), np.mean(moved, axis=0).argmin())
    labels = [f"{'xyz'[axis]} [mm]" for axis in plane]
    with _figure(9.4, 4.4, len(shapes)) as (_, axes, out):
        for ax, (caption, bodies) in zip(axes, shapes, strict=True):
            points = np.concatenate([shape[:, plane] for shape, _, _ in bodies.values()])
            margin = 0.05 * np.ptp(points[:, 1])
            extent = np.array([points.min(axis=0) - margin, points.max(axis=0) + margin])
            for role, (shape, triangles, effectors) in bodies.items():
                colour = WINNER if role == "winner" else BASELINE
                draw_silhouette(ax, shape[:, plane], triangles, extent, colour)
                ax.scatter(*(1e3 * effectors[:, plane].T), 30, colour, zorder=4, label=f"{role}, effector")
            ax.set(xlabel=labels[0], ylabel=labels[1], aspect="equal")
            ax.set_title(caption, fontsize=10, color="#334155")
        axes[-1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1.02, 0.5))
    return out[0]


def importance(results: StudyResults) -> str | None:
    """Importance of each variable; None if it is unknown."""
    found = results.importance
    if not found:
        return None
    with _figure(6.2, 3.2) as (_, (ax,), out):
        names = list(reversed(found))
        bars = ax.barh([n.replace("_", " ") for n in names], [100 * found[n] for n in names], color=WINNER, height=0.55)
        ax.bar_label(bars, fmt="%.0f %%", padding=4, fontsize=9, color="#334155")
        ax.set(xlabel="importance [%]", xlim=(0, 115))
        ax.grid(axis="y", visible=False)
    return out[0]


def screen(snapshot: StudySnapshot, results: StudyResults) -> str | None:
    """Objective of each body with the inverse QP and with its trained controller; None without one."""
    objective = snapshot.objective
    done = [t for t in snapshot.trials if t.scores is not None and t.controller != "qp"]
    if len(done) < 2:
        return None
    roles = results.roles
    with _figure(6.2, 3.2) as (_, (ax,), out):
        for trial in sorted(done, key=lambda t: t.number in roles):
            role = roles.get(trial.number)
            colour = COLOURS.get(role or "", MUTED)
            x, y = ((trial.qp_value or 0.0) * objective.scale, trial.values[objective.name] * objective.scale)
            ax.scatter(
                x, y, 80 if role else 26, colour, marker="*" if role else "o", label=role, zorder=4 if role else 3
            )
        ax.set(xlabel=f"inverse QP: {objective.axis_inside}", ylabel=f"policy: {objective.axis_inside}")
        if roles:
            ax.legend(fontsize=8)
    return out[0]


def transfer(snapshot: StudySnapshot, results: StudyResults) -> str | None:
    """Finalists on surrogate and FEM, on the test goals; None without both."""
    keys = list(dict.fromkeys(row.objective for row in results.transfer))
    if not keys:
        return None
    roles = results.roles
    with _figure(9.4, 3.5, len(keys)) as (_, axes, out):
        for ax, key in zip(axes, keys, strict=True):
            objective = snapshot.config.shown_objectives[key]
            rows = [row for row in results.transfer if row.objective == key]
            everything = np.concatenate([[*row.surrogate, *row.fem] for row in rows]) * objective.scale
            margin = 0.08 * (np.ptp(everything) or 1.0)
            ends = np.array([everything.min() - margin, everything.max() + margin])
            ax.plot(ends, ends, color="#94a3b8", linewidth=1.0, linestyle=":", label="equal")
            for row in rows:
                label, marker = AGENTS[row.agent]
                colours = [COLOURS.get(roles.get(number, ""), OTHER) for number in row.trials]
                points = (np.array(values) * objective.scale for values in (row.surrogate, row.fem))
                ax.scatter(*points, s=48, c=colours, marker=marker, edgecolors="#334155", linewidths=0.6, zorder=3)
                ax.scatter([], [], s=40, c="white", marker=marker, edgecolors="#334155", label=label)
            shown = {roles.get(number, "other finalist") for row in rows for number in row.trials}
            for colour, label in ((WINNER, "winner"), (BASELINE, "baseline"), (OTHER, "other finalist")):
                if label in shown:
                    ax.scatter([], [], s=40, c=colour, marker="o", label=label)
            ax.set(xlabel=f"surrogate: {objective.axis_inside}", ylabel=f"FEM: {objective.axis_inside}")
            ax.set(xlim=ends, ylim=ends, aspect="equal")
        axes[-1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1.02, 0.5))
    return out[0]


def reached(snapshot: StudySnapshot, results: StudyResults) -> str | None:
    """Share of the test goals reached within a distance on FEM, for baseline and winner; None without FEM."""
    scale = snapshot.config.distance_scale
    agents = [row.agent for row in results.comparison if row.backend == "fem"]
    tests = {(*group.key, group.goals): group for group in results.tests}
    if not agents:
        return None
    with _figure(9.4, 3.3, len(agents)) as (_, axes, out):
        for ax, agent in zip(axes, agents, strict=True):
            for number, role in results.roles.items():
                distances = scale.factor * np.sort(tests[number, agent, "fem", "unseen"].mean.distances)
                share = 100 * np.arange(len(distances) + 1) / len(distances)
                ax.step([0, *distances], share, where="post", color=COLOURS[role], linewidth=2.0, label=role)
            radius, limit = scale.factor * results.success_distance, scale.limit_text(results.success_distance)
            ax.axvline(radius, color="#d97706", linewidth=1.0, linestyle="--", label=f"success: {limit}")
            ax.set(xlabel=f"final {scale.name} on FEM [{scale.unit}]", ylabel="test goals reached [%]", ylim=(0, 102))
            ax.set_title(AGENTS[agent][0], fontsize=10, color="#334155")
            ax.set_xlim(left=0)
            ax.legend(fontsize=8, loc="lower right")
    return out[0]
