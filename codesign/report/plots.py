"""Figures of a report, as SVG data for HTML. Lengths are shown in mm, pressures in kPa."""

from __future__ import annotations

import base64
import io
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from codesign.objectives import OBJECTIVES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "curves",
    "finalist_curves",
    "history",
    "importance",
    "overlay",
    "parallel",
    "pareto",
    "picture",
    "place",
    "present",
    "reached",
    "screen",
    "shown_unit",
    "transfer",
]

BASELINE, WINNER, OTHER, MUTED = "#64748b", "#0f766e", "#cbd5e1", "#94a3b8"
AGENTS = {"sac": ("SAC", "o"), "qp": ("inverse QP", "s")}
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
SHOWN = {"m": ("mm", 1e3, 2), "Pa": ("kPa", 1e-3, 0), "1": ("", 1.0, 3)}


def shown_unit(unit: str) -> tuple[str, float, int]:
    """Return the unit people read, the factor to it from SI, and the decimals to show."""
    return SHOWN.get(unit, (unit, 1.0, 3))


def present(value: float, unit: str) -> str:
    """Write a quantity [unit] the way people read it."""
    name, factor, decimals = shown_unit(unit)
    return f"{value * factor:.{decimals}f}{' ' + name if name else ''}"


def place(value: float, variable: Mapping[str, Any]) -> float:
    """Place of a value in the range of its variable, in [0, 1], on the variable's scale."""
    low, high = variable["low"], variable["high"]
    if variable["log"]:
        return float(np.log(value / low) / np.log(high / low))
    return (value - low) / (high - low)


@contextmanager
def _figure(width: float, height: float, columns: int = 1) -> Iterator[tuple[Figure, list[Any], list[str]]]:
    """Yield a figure, its axes, and a list that receives its data URI when the block ends."""
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
    """Return an image (h, w, 3) uint8 as PNG data for HTML."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image).save(stream, format="png", optimize=True)
    return _uri(stream.getvalue(), "png")


def _roles(results: Mapping[str, Any]) -> dict[int, str]:
    """Trial numbers of baseline and winner."""
    return {results[role]["trial"]: role for role in ("baseline", "winner") if results[role] is not None}


def history(trials: Sequence[Mapping[str, Any]], results: Mapping[str, Any]) -> str:
    """Objective of each trial, and the best so far."""
    objective = OBJECTIVES[results["objective"]]
    done = [t for t in trials if t["state"] == "complete"]
    roles = _roles(results)
    with _figure(6.2, 3.2) as (_, (ax,), out):
        kinds = (("sampler", MUTED, "o"), ("screen", "#d97706", "D"), ("joint", "#7c3aed", "^"))
        for kind, colour, marker in kinds:
            part = [t for t in done if t["origin"].startswith(kind) and roles.get(t["number"]) != "winner"]
            if part:
                values = [objective.shown(t["score"]) for t in part]
                ax.scatter(
                    [t["number"] for t in part],
                    values,
                    26,
                    colour,
                    marker=marker,
                    label=f"from the {kind}{' training' if kind == 'joint' else ''}",
                    zorder=3,
                )
        for trial in done:
            if (role := roles.get(trial["number"])) is not None:
                colour = WINNER if role == "winner" else BASELINE
                value = objective.shown(trial["score"])
                ax.scatter(
                    trial["number"], value, 95, colour, marker="*" if role == "winner" else "P", label=role, zorder=5
                )
        best = np.maximum.accumulate([t["score"] for t in done])
        ax.step(
            [t["number"] for t in done],
            [objective.shown(b) for b in best],
            where="post",
            color=WINNER,
            label="best so far",
        )
        for state, marker in (("pruned", "|"), ("infeasible", "x")):
            part = [t["number"] for t in trials if t["state"] == state]
            if part:
                ax.plot(part, [0.02] * len(part), marker, color=MUTED, transform=ax.get_xaxis_transform(), label=state)
        ax.set(xlabel="trial", ylabel=_axis(objective))
        ax.legend(fontsize=8, ncols=2)
    return out[0]


def pareto(trials: Sequence[Mapping[str, Any]], results: Mapping[str, Any]) -> str | None:
    """All complete trials in the first two objectives, with the Pareto front of all of them."""
    if len(results["objectives"]) < 2:
        return None
    first, second = (OBJECTIVES[name] for name in results["objectives"][:2])
    complete = [trial for trial in trials if trial["state"] == "complete"]
    points = {t["number"]: (first.shown(t["scores"][0]), second.shown(t["scores"][1])) for t in complete}
    roles = _roles(results)
    with _figure(6.4, 3.6) as (figure, (ax,), image):
        ax.plot(*zip(*points.values(), strict=True), "o", color=OTHER, ms=5, label="bodies")
        front = sorted(points[number] for number in results["pareto"])
        if front:  # else no body keeps the limits
            ax.plot(*zip(*front, strict=True), "o-", color=WINNER, ms=5, lw=1, label="Pareto front")
        for number, name in roles.items():
            if number in points:
                ax.annotate(name, points[number], textcoords="offset points", xytext=(6, 6), color=MUTED)
        ax.set(xlabel=_axis(first), ylabel=_axis(second))
        ax.legend()
    return image[0]


def _axis(objective: Any) -> str:
    return f"{objective.label}{f' [{objective.unit}]' if objective.unit else ''}"


def curves(trials: Sequence[Mapping[str, Any]], results: Mapping[str, Any]) -> str | None:
    """Reports of each trial during its training, or None without training."""
    trained = [t for t in trials if t["curve"]]
    if not trained:
        return None
    objective = OBJECTIVES[results["objective"]]
    roles = _roles(results)
    with _figure(6.2, 3.2) as (_, (ax,), out):
        for trial in sorted(trained, key=lambda t: t["number"] in roles):
            steps, scores = np.array(trial["curve"], dtype=float).T
            role = roles.get(trial["number"])
            colour = {"winner": WINNER, "baseline": BASELINE}.get(role or "", OTHER)
            style = {"marker": ".", "markersize": 4, "linestyle": "--" if trial["state"] == "pruned" else "-"}
            ax.plot(steps, objective.shown(scores), color=colour, label=role, linewidth=2.2 if role else 1.1, **style)
        ax.set(xlabel="environment steps of training", ylabel=f"{_axis(objective)} in training")
        if roles:
            ax.legend(fontsize=8)
    return out[0]


def finalist_curves(results: Mapping[str, Any]) -> str | None:
    """Progress of the policies that were trained anew for the finalists, one line each, or None without them."""
    trained = [row for row in results["trainings"] if row["curve"]]
    if not trained:
        return None
    objective, roles = OBJECTIVES[results["objective"]], _roles(results)
    colours = {"winner": WINNER, "baseline": BASELINE}
    told: set[str] = set()
    with _figure(6.2, 3.2) as (_, (ax,), out):
        for row in sorted(trained, key=lambda row: row["trial"] in roles):
            steps, scores = np.array(row["curve"], dtype=float).T
            role = roles.get(row["trial"], "")
            label = role or "other finalists"
            ax.plot(
                steps,
                objective.shown(scores),
                color=colours.get(role, OTHER),
                label=None if label in told else label,
                linewidth=1.8 if role else 1.1,
                marker=".",
                markersize=4,
            )
            told.add(label)
        ax.set(xlabel="environment steps of training", ylabel=f"{_axis(objective)} in training")
        ax.legend(fontsize=8)
    return out[0]


def parallel(trials: Sequence[Mapping[str, Any]], results: Mapping[str, Any]) -> str:
    """Bodies as lines across their variables, coloured by the objective."""
    import matplotlib
    from matplotlib.colors import Normalize

    objective = OBJECTIVES[results["objective"]]
    done = sorted((t for t in trials if t["state"] == "complete"), key=lambda t: t["score"])
    variables = [v for v in results["variables"] if v["optimised"]]
    roles = _roles(results)
    scores = np.array([t["score"] for t in done])
    shown = np.array([objective.shown(score) for score in scores])
    worst, best = scores.min(), scores.max() if np.ptp(scores) else scores.min() + 1.0
    colours = matplotlib.colormaps["viridis_r" if objective.sign < 0 else "viridis"]
    ends = (objective.shown(worst), objective.shown(best))
    norm = Normalize(min(ends), max(ends))
    with _figure(6.2, 3.2) as (figure, (ax,), out):
        ax.grid(False)
        for trial, score, value in zip(done, scores, shown, strict=True):
            heights = [place(trial["design"][v["name"]], v) for v in variables]
            heights.append((score - worst) / (best - worst))
            role = roles.get(trial["number"])
            ax.plot(
                heights,
                color={"winner": WINNER, "baseline": BASELINE}.get(role or "", colours(norm(value))),
                linewidth=2.8 if role else 1.1,
                alpha=1.0 if role else 0.75,
                label=role,
                zorder=4 if role else 2,
            )
        for i, variable in enumerate(variables):
            ax.axvline(i, color="#94a3b8", linewidth=1.0, zorder=1)
            for height, end in ((-0.05, variable["low"]), (1.05, variable["high"])):
                ax.text(
                    i, height, present(end, variable["unit"]), ha="center", va="center", fontsize=8, color="#475569"
                )
        ax.axvline(len(variables), color="#94a3b8", linewidth=1.0, zorder=1)
        for height, end in zip((-0.05, 1.05), ends, strict=True):
            ax.text(len(variables), height, f"{end:.2f}", ha="center", va="center", fontsize=8, color="#475569")
        names = [v["name"].replace("_", " ") for v in variables] + [_axis(objective)]
        ax.set_xticks(range(len(names)), [textwrap.fill(name, 13) for name in names])
        ax.set(yticks=[], ylim=(-0.12, 1.12))
        for side in ("left", "bottom"):
            ax.spines[side].set_visible(False)
        ax.tick_params(length=0)
        figure.colorbar(matplotlib.cm.ScalarMappable(norm, colours), ax=ax, label=_axis(objective), pad=0.02)
        if roles:
            ax.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2)
    return out[0]


def silhouette(nodes: np.ndarray, triangles: np.ndarray, extent: np.ndarray, pixels: int = 700) -> np.ndarray:
    """Return where a body is in the plane of its two last coordinates, as an image (h, w) of 0 and 1.

    Args:
        nodes: [m], shape (n, 3).
        triangles: its boundary, shape (t, 3).
        extent: lower and upper corner of the image [m], shape (2, 2).
        pixels: height of the image.
    """
    from PIL import Image, ImageDraw

    scale = pixels / (extent[1, 1] - extent[0, 1])
    image = Image.new("L", (round(scale * (extent[1, 0] - extent[0, 0])), pixels))
    draw = ImageDraw.Draw(image)
    for corners in (nodes[:, 1:][triangles] - extent[0]) * scale:
        draw.polygon([(float(y), float(z)) for y, z in corners], fill=1)
    return np.asarray(image)


def overlay(shapes: Sequence[tuple[str, Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]]]]) -> str:
    """Side views of baseline and winner over each other, to scale.

    Args:
        shapes: for each pose its caption and, by role, nodes [m] (n, 3), boundary triangles (t, 3) and effectors [m]
            (k, 3).
    """
    with _figure(9.4, 4.4, len(shapes)) as (_, axes, out):
        for ax, (caption, bodies) in zip(axes, shapes, strict=True):
            points = np.concatenate([nodes[:, 1:] for nodes, _, _ in bodies.values()])
            margin = 0.05 * np.ptp(points[:, 1])
            extent = np.array([points.min(axis=0) - margin, points.max(axis=0) + margin])
            for role, (nodes, triangles, effectors) in bodies.items():
                colour = WINNER if role == "winner" else BASELINE
                image = silhouette(nodes, triangles, extent)
                grid = [1e3 * np.linspace(extent[0, k], extent[1, k], n) for k, n in enumerate(reversed(image.shape))]
                ax.contourf(*grid, image, levels=[0.5, 1.5], colors=[colour], alpha=0.16)
                ax.contour(*grid, image, levels=[0.5], colors=[colour], linewidths=1.3)
                ax.scatter(*(1e3 * effectors[:, 1:].T), 30, colour, zorder=4, label=f"{role}, effector")
            ax.set(xlabel="y [mm]", ylabel="z [mm]", aspect="equal")
            ax.set_title(caption, fontsize=10, color="#334155")
        axes[-1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1.02, 0.5))
    return out[0]


def importance(results: Mapping[str, Any]) -> str | None:
    """Importance of each variable, or None where it is not known."""
    found = results["importance"]
    if not found:
        return None
    with _figure(6.2, 3.2) as (_, (ax,), out):
        names = list(reversed(found))
        bars = ax.barh([n.replace("_", " ") for n in names], [100 * found[n] for n in names], color=WINNER, height=0.55)
        ax.bar_label(bars, fmt="%.0f %%", padding=4, fontsize=9, color="#334155")
        ax.set(xlabel="importance [%]", xlim=(0, 115))
        ax.grid(axis="y", visible=False)
    return out[0]


def screen(trials: Sequence[Mapping[str, Any]], results: Mapping[str, Any]) -> str | None:
    """Score of each body by the inverse QP against that by its trained controller, or None without one."""
    objective = OBJECTIVES[results["objective"]]
    done = [t for t in trials if t["state"] == "complete" and t["agent"] != "qp"]
    if len(done) < 2:
        return None
    roles = _roles(results)
    with _figure(6.2, 3.2) as (_, (ax,), out):
        for trial in sorted(done, key=lambda t: t["number"] in roles):
            role = roles.get(trial["number"])
            colour = {"winner": WINNER, "baseline": BASELINE}.get(role or "", MUTED)
            x, y = (objective.shown(objective.score(trial[key])) for key in ("qp", "evaluation"))
            ax.scatter(
                x, y, 80 if role else 26, colour, marker="*" if role else "o", label=role, zorder=4 if role else 3
            )
        ax.set(xlabel=f"inverse QP: {_axis(objective).lower()}", ylabel=f"SAC: {_axis(objective).lower()}")
        if roles:
            ax.legend(fontsize=8)
    return out[0]


def transfer(results: Mapping[str, Any]) -> str | None:
    """Finalists on the surrogate against FEM, on test goals; None without FEM."""
    keys = [k for k in ("success_rate", "mean_distance") if any(r["objective"] == k for r in results["transfer"])]
    if not keys:
        return None
    roles = _roles(results)
    with _figure(9.4, 3.5, len(keys)) as (_, axes, out):
        for ax, key in zip(axes, keys, strict=True):
            objective = OBJECTIVES[key]
            rows = [r for r in results["transfer"] if r["objective"] == key]
            everything = np.concatenate([[*row["surrogate"], *row["fem"]] for row in rows]) * objective.scale
            margin = 0.08 * (np.ptp(everything) or 1.0)
            ends = np.array([everything.min() - margin, everything.max() + margin])
            ax.plot(ends, ends, color="#94a3b8", linewidth=1.0, linestyle=":", label="equal")
            for row in rows:
                label, marker = AGENTS[row["agent"]]
                colours = [{"winner": WINNER, "baseline": BASELINE}.get(roles.get(t, ""), OTHER) for t in row["trials"]]
                points = (np.array(row[name]) * objective.scale for name in ("surrogate", "fem"))
                ax.scatter(*points, s=48, c=colours, marker=marker, edgecolors="#334155", linewidths=0.6, zorder=3)
                ax.scatter([], [], s=40, c="white", marker=marker, edgecolors="#334155", label=label)
            for colour, label in ((WINNER, "winner"), (BASELINE, "baseline"), (OTHER, "other finalist")):
                ax.scatter([], [], s=40, c=colour, marker="o", label=label)
            ax.set(xlabel=f"surrogate: {_axis(objective).lower()}", ylabel=f"FEM: {_axis(objective).lower()}")
            ax.set(xlim=ends, ylim=ends, aspect="equal")
        axes[-1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1.02, 0.5))
    return out[0]


def reached(results: Mapping[str, Any]) -> str | None:
    """Share of the test goals reached within a distance on FEM, baseline against winner; None without FEM."""
    agents = [row["agent"] for row in results["comparison"] if row["backend"] == "fem"]
    if not agents:
        return None
    with _figure(9.4, 3.3, len(agents)) as (_, axes, out):
        for ax, agent in zip(axes, agents, strict=True):
            for role, colour in (("baseline", BASELINE), ("winner", WINNER)):
                wanted = (results[role]["trial"], agent, "fem", "unseen")
                record = next(
                    r for r in results["evaluations"] if (r["trial"], r["agent"], r["backend"], r["goals"]) == wanted
                )
                distances = 1e3 * np.sort(record["distances"])
                share = 100 * np.arange(len(distances) + 1) / len(distances)
                ax.step([0, *distances], share, where="post", color=colour, linewidth=2.0, label=role)
            radius = 1e3 * results["success_distance"]
            ax.axvline(radius, color="#d97706", linewidth=1.0, linestyle="--", label=f"success: {radius:g} mm")
            ax.set(xlabel="final distance to the goal on FEM [mm]", ylabel="test goals reached [%]", ylim=(0, 102))
            ax.set_title(AGENTS[agent][0], fontsize=10, color="#334155")
            ax.set_xlim(left=0)
            ax.legend(fontsize=8, loc="lower right")
    return out[0]
