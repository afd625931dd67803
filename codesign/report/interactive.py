"""Interactive figures of a report: plotly, whose code the page contains, so that they work offline."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.codesign.records import TrialResult
from softgym_envs.codesign.report.episodes import Episode
from softgym_envs.codesign.report.plots import BASELINE, COLOURS, MUTED, VIOLATES, WINNER
from softgym_envs.codesign.report.results import StudyResults
from softgym_envs.codesign.snapshot import StudySnapshot
from softgym_envs.units import display, present
from softgym_envs.wording import decimal

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

MAX_FRAMES = 24
MAX_POINTS = 60_000
"""Largest number of surface points in all frames of a body, which bounds the size of the page."""

GOAL_KINDS: tuple[tuple[str, str, str, str], ...] = (
    ("reached by both", "circle", "#1d4ed8", "●"),
    ("reached by the winner only", "diamond", WINNER, "◆"),
    ("reached by the baseline only", "square", "#b45309", "■"),
    ("reached by neither", "x", VIOLATES, "✕"),
)
"""Outcome of a goal, with the plotly symbol, the colour and the character of its marker."""

_FONT = {"family": "system-ui, -apple-system, Segoe UI, Roboto, Helvetica Neue, Arial, sans-serif", "size": 12.5}
_GRID = {"gridcolor": "#e2e8f0", "zeroline": False, "linecolor": "#94a3b8"}


def plotly_code() -> str:
    """Return the code of plotly, for a script element of the page (4.8 MB)."""
    from plotly.offline import get_plotlyjs

    return get_plotlyjs()


def html(figure: Figure, name: str) -> str:
    """Return a figure as an HTML element with the ID ``name``; the page has to contain `plotly_code` before it."""
    from plotly.io import to_html

    config = {"responsive": True, "displaylogo": False, "modeBarButtonsToRemove": ["lasso2d", "select2d"]}
    return to_html(
        figure, config, include_plotlyjs=False, full_html=False, div_id=name, default_width="100%", auto_play=False
    )


def _figure(height: int, **layout: Any) -> Figure:
    from plotly.graph_objects import Figure, Layout

    return Figure(
        layout=Layout(
            height=height,
            font=_FONT,
            template="none",
            paper_bgcolor="#ffffff",
            plot_bgcolor="#ffffff",
            margin={"l": 62, "r": 16, "t": 16, "b": 52},
            legend={"orientation": "h", "y": 1.02, "yanchor": "bottom"},
            hoverlabel={"align": "left"},
            **layout,
        )
    )


# -- bodies of the search -------------------------------------------------------------------------------------------


def _role(results: StudyResults, trial: TrialResult) -> str:
    broken = "" if trial.feasible else "violates a constraint"
    return results.roles.get(trial.number) or broken or "other bodies"


_LOOKS = {
    "other bodies": (MUTED, "circle", 8),
    "violates a constraint": (VIOLATES, "x", 8),
    "baseline": (BASELINE, "cross", 13),
    "winner": (WINNER, "star", 16),
}


def _description(snapshot: StudySnapshot, results: StudyResults, trial: TrialResult) -> str:
    """Return what a plot says of a body under the pointer."""
    values = {**trial.design, **trial.options}
    lines = [f"<b>trial {trial.number}</b> ({trial.origin})"]
    for name in results.objectives:
        objective = snapshot.config.objectives[name]
        lines.append(f"{objective.label}: {objective.text(trial.values[name])}")
    for variable in results.variables:
        if variable.optimised:
            lines.append(f"{variable.name.replace('_', ' ')}: {present(values[variable.name], variable.unit)}")
    return "<br>".join(lines)


def _scatter(
    figure: Figure, snapshot: StudySnapshot, results: StudyResults, x: Any, y: Any, *, legend: bool = True, **place: int
) -> None:
    """Draw every complete trial; ``x`` and ``y`` map a trial to what the axes show."""
    done = [trial for trial in snapshot.trials if trial.state == "complete"]
    for role, (colour, symbol, size) in _LOOKS.items():
        part = [trial for trial in done if _role(results, trial) == role]
        if part:
            figure.add_scatter(
                x=[x(trial) for trial in part],
                y=[y(trial) for trial in part],
                mode="markers",
                name=role,
                legendgroup=role,
                showlegend=legend,
                text=[_description(snapshot, results, trial) for trial in part],
                hovertemplate="%{text}<extra></extra>",
                marker={"color": colour, "symbol": symbol, "size": size, "line": {"color": "#ffffff", "width": 0.8}},
                **place,
            )


def history(snapshot: StudySnapshot, results: StudyResults) -> Figure:
    """Objective of each trial, and the best so far."""
    objective = snapshot.objective
    figure = _figure(360, xaxis={"title": "trial", **_GRID}, yaxis={"title": objective.axis, **_GRID})
    feasible = [trial for trial in snapshot.trials if trial.feasible]
    if feasible:
        best = objective.value_of(np.maximum.accumulate([trial.score or 0.0 for trial in feasible]))
        numbers = [trial.number for trial in feasible]
        line = {"shape": "hv", "color": WINNER, "width": 1.6}
        figure.add_scatter(x=numbers, y=best, mode="lines", line=line, name="best so far", hoverinfo="skip")
    _scatter(figure, snapshot, results, lambda t: t.number, lambda t: objective.value_of(t.score))
    return figure


def slices(snapshot: StudySnapshot, results: StudyResults) -> Figure:
    """Objective against each variable that the study optimises."""
    from plotly.subplots import make_subplots

    objective = snapshot.objective
    variables = [variable for variable in results.variables if variable.optimised]
    columns = min(3, len(variables))
    rows = -(-len(variables) // columns)
    figure = make_subplots(rows, columns, shared_yaxes=True, vertical_spacing=0.3 / rows, horizontal_spacing=0.03)
    figure.update_layout(_figure(70 + 270 * rows).layout)
    for index, variable in enumerate(variables):
        place = {"row": index // columns + 1, "col": index % columns + 1}

        def value(trial: TrialResult, name: str = variable.name, unit: str = variable.unit) -> float:
            return {**trial.design, **trial.options}[name] * display(unit).factor

        _scatter(figure, snapshot, results, value, lambda t: objective.value_of(t.score), legend=index == 0, **place)
        unit = display(variable.unit).unit
        title = variable.name.replace("_", " ") + (f" [{unit}]" if unit else "")
        figure.update_xaxes(title=title, type="log" if variable.log else "linear", **_GRID, **place)
        figure.update_yaxes(title=objective.axis if index % columns == 0 else None, **_GRID, **place)
    return figure


def pareto(snapshot: StudySnapshot, results: StudyResults) -> Figure | None:
    """Complete trials in the first two objectives, with the Pareto front; None with one objective."""
    if len(results.objectives) < 2:
        return None
    first, second = (snapshot.config.objectives[name] for name in results.objectives[:2])
    figure = _figure(400, xaxis={"title": first.axis, **_GRID}, yaxis={"title": second.axis, **_GRID})
    points = {
        t.number: (t.values[first.name] * first.scale, t.values[second.name] * second.scale)
        for t in snapshot.trials
        if t.scores
    }
    front = sorted(points[number] for number in results.pareto)
    if front:
        x, y = zip(*front, strict=True)
        figure.add_scatter(
            x=x, y=y, mode="lines", line={"color": WINNER, "width": 1.4}, name="Pareto front", hoverinfo="skip"
        )
    _scatter(figure, snapshot, results, lambda t: points[t.number][0], lambda t: points[t.number][1])
    return figure


# -- goals ----------------------------------------------------------------------------------------------------------


class GoalOutcomes:
    """Which of the unseen goals baseline and winner reach on FEM, with the controller of the study.

    Attributes:
        points: the goals, the last ones of paths [m], shape (n, 3).
        distances: final distances of baseline and winner [m], shape (2, n).
        ends: where the effector ends, for each training of baseline and winner [m], shape (trainings, n, 3) each.
        kinds: index into `GOAL_KINDS`, shape (n,).
    """

    def __init__(
        self, points: np.ndarray, distances: np.ndarray, reached: np.ndarray, ends: dict[str, np.ndarray]
    ) -> None:
        self.points, self.distances, self.ends = points, distances, ends
        self.kinds = np.select([reached.all(axis=0), reached[1], reached[0]], [0, 1, 2], 3)

    @property
    def legend(self) -> list[tuple[str, str, str, int]]:
        """Character, colour, meaning and number of goals of each kind that occurs."""
        counts = [int((self.kinds == kind).sum()) for kind in range(len(GOAL_KINDS))]
        return [
            (character, colour, text, count)
            for (text, _, colour, character), count in zip(GOAL_KINDS, counts, strict=True)
            if count
        ]

    def texts(self, chosen: np.ndarray) -> list[str]:
        """Return what a plot says of goals under the pointer; ``chosen`` is a mask (n,)."""
        return [
            f"goal ({', '.join(f'{1e3 * v:.1f}' for v in point)}) mm"
            f"<br>baseline ends {decimal(1e3 * before, 2)} mm away<br>winner ends {decimal(1e3 * after, 2)} mm away"
            for point, (before, after) in zip(self.points[chosen], self.distances.T[chosen], strict=True)
        ]


def goal_outcomes(snapshot: StudySnapshot, results: StudyResults) -> GoalOutcomes | None:
    """Return what baseline and winner reach; None without their tests on FEM, or for goals that are not positions."""
    rows = [row for row in results.comparison if row.backend == "fem"]
    if not rows or results.baseline is None or results.winner is None:
        return None
    if snapshot.config.environment.task_class.goal_unit != "m":
        return None
    tests = {group.key: group for group in snapshot.unseen_tests}
    found = [tests[body.trial, rows[0].agent, "fem"] for body in (results.baseline, results.winner)]
    return GoalOutcomes(
        snapshot.folder.goals["unseen"][:, -1],
        np.array([group.mean.distances for group in found]),
        np.array([group.mean.successes >= 0.5 for group in found]),
        {role: group.table("ends") for role, group in zip(("baseline", "winner"), found, strict=True)},
    )


def goal_views(outcomes: GoalOutcomes) -> list[tuple[str, Figure]]:
    """Return the names and figures of the projections of the goals on the planes in which they spread."""
    spread = np.ptp(outcomes.points, axis=0)
    planes = [(1, 2), (0, 2), (0, 1)]
    shown = [plane for plane in planes if all(spread[axis] > 1e-6 for axis in plane)] or planes[:1]
    views = []
    for a, b in shown:
        axes = [{"title": f"{'xyz'[axis]} [mm]", **_GRID} for axis in (a, b)]
        figure = _figure(330, showlegend=False, xaxis=axes[0], yaxis={**axes[1], "scaleanchor": "x"})
        for role, ends in outcomes.ends.items():
            starts = np.broadcast_to(outcomes.points, ends.shape).reshape(-1, 3)
            lines = 1e3 * np.stack([starts, ends.reshape(-1, 3)], axis=1)
            figure.add_scatter(
                x=_broken(lines[:, :, a]),
                y=_broken(lines[:, :, b]),
                mode="lines+markers",
                name=f"end of the {role}",
                hoverinfo="skip",
                line={"color": COLOURS[role], "width": 1},
                marker={"color": COLOURS[role], "size": [0, 4, 0] * len(lines)},
            )
        for kind, (name, symbol, colour, _) in enumerate(GOAL_KINDS):
            chosen = outcomes.kinds == kind
            figure.add_scatter(
                x=1e3 * outcomes.points[chosen, a],
                y=1e3 * outcomes.points[chosen, b],
                mode="markers",
                name=name,
                text=outcomes.texts(chosen),
                hovertemplate="%{text}<extra></extra>",
                marker={"color": colour, "symbol": symbol, "size": 9},
            )
        views.append((f"{'xyz'[a]}{'xyz'[b]}", figure))
    return views


def _broken(lines: np.ndarray) -> list[float | None]:
    """Return lines of two points (n, 2) as one line that is broken after each of them."""
    return [value for start, end in lines.tolist() for value in (start, end, None)]


# -- bodies in motion -----------------------------------------------------------------------------------------------


def motion(episodes: Sequence[Episode], outcomes: GoalOutcomes | None) -> Figure:
    """Baseline and winner over each other at one goal, step by step, with all goals; it can be rotated and played."""
    from plotly.graph_objects import Frame

    from softgym_envs.viewer.surface import BodySurface

    surfaces = [BodySurface(episode.model) for episode in episodes]
    points = max(len(surface.nodes) for surface in surfaces)
    count = max(2, min(MAX_FRAMES, max(len(e.states) for e in episodes), MAX_POINTS // points))
    picks = [episode.pick(count) for episode in episodes]
    figure = _figure(560, scene=_scene(), uirevision="constant")

    def traces(frame: int, whole: bool) -> list[dict[str, Any]]:
        drawn: list[dict[str, Any]] = []
        for episode, surface, pick in zip(episodes, surfaces, picks, strict=True):
            index = pick[min(frame, len(pick) - 1)]
            nodes = episode.states[index].nodes
            assert nodes is not None, "finite elements compute nodes"
            drawn.append(_body_trace(episode.role, surface.points(nodes), surface.triangles if whole else None))
            drawn.append(_tip_trace(episode, index, whole))
        return drawn

    length = max(map(len, picks))
    for trace in traces(length - 1, whole=True):  # at first at the goal
        figure.add_trace(trace)
    moving = list(range(len(figure.data)))
    _add_goals(figure, episodes[0], outcomes)
    figure.frames = [Frame(name=str(k), data=traces(k, whole=False), traces=moving) for k in range(length)]
    _add_player(figure, episodes, picks, length)
    return figure


def _add_goals(figure: Figure, episode: Episode, outcomes: GoalOutcomes | None) -> None:
    """Add all goals by their outcome, and the goal or path of the episode that is shown."""
    if outcomes is not None:
        for kind, (name, symbol, colour, _) in enumerate(GOAL_KINDS):
            chosen = outcomes.kinds == kind
            if chosen.any():
                x, y, z = 1e3 * outcomes.points[chosen].T
                figure.add_scatter3d(
                    x=x,
                    y=y,
                    z=z,
                    mode="markers",
                    name=f"goals {name}",
                    text=outcomes.texts(chosen),
                    marker={"color": colour, "symbol": symbol, "size": 4},
                    hovertemplate="%{text}<extra></extra>",
                )
    if episode.has_places:
        x, y, z = 1e3 * episode.path.T
        figure.add_scatter3d(
            x=x,
            y=y,
            z=z,
            mode="markers" if len(x) == 1 else "lines",
            name="goal of this episode",
            marker={"color": "#d97706", "size": 9, "symbol": "circle-open", "line": {"width": 3}},
            line={"color": "#d97706", "width": 5},
        )


def _scene() -> dict[str, Any]:
    axis = {"backgroundcolor": "#f8fafc", "gridcolor": "#e2e8f0", "showbackground": True, "nticks": 6}
    return {
        **{f"{name}axis": {"title": f"{name} [mm]", **axis} for name in "xyz"},
        "aspectmode": "data",
        # Far enough for the labels of the axes, which hang below the box.
        "camera": {"eye": {"x": 2.5, "y": 1.2, "z": 0.55}, "center": {"x": 0.0, "y": 0.0, "z": -0.1}},
    }


def _body_trace(role: str, points: np.ndarray, faces: np.ndarray | None) -> dict[str, Any]:
    """Return a surface from points [m] (p, 3) and triangles (t, 3), which frames that only move it leave out."""
    x, y, z = (1e3 * points).T.astype(np.float32)
    trace: dict[str, Any] = {"type": "mesh3d", "x": x, "y": y, "z": z}
    if faces is not None:
        i, j, k = faces.T.astype(np.int32)
        winner = role == "winner"
        trace |= {
            "i": i,
            "j": j,
            "k": k,
            "name": role,
            "showlegend": True,
            "hoverinfo": "name",
            "color": WINNER if winner else BASELINE,
            "opacity": 1.0 if winner else 0.3,
            "flatshading": True,
            "lighting": {"ambient": 0.55, "diffuse": 0.7, "specular": 0.1},
        }
    return trace


def _tip_trace(episode: Episode, index: int, whole: bool) -> dict[str, Any]:
    x, y, z = (1e3 * np.array([state.effector[0] for state in episode.states[: index + 1]])).T.astype(np.float32)
    trace: dict[str, Any] = {"type": "scatter3d", "x": x, "y": y, "z": z}
    if whole:
        colour = WINNER if episode.role == "winner" else BASELINE
        look = {
            "mode": "lines+markers",
            "line": {"color": colour, "width": 4},
            "marker": {"color": colour, "size": 2.5},
        }
        trace |= {"name": f"path of the {episode.role}'s effector", "showlegend": False, "hoverinfo": "name", **look}
    return trace


def _add_player(figure: Figure, episodes: Sequence[Episode], picks: Sequence[list[int]], length: int) -> None:
    """Add buttons to play and stop, and a slider over the steps whose label says how far each body is."""

    def label(frame: int) -> str:
        ends = ", ".join(
            f"{e.role} {e.distance_text(pick[min(frame, len(pick) - 1)])}"
            for e, pick in zip(episodes, picks, strict=True)
        )
        longest = max(picks, key=len)
        return f"step {longest[frame]}: {ends}"

    still = {"mode": "immediate", "frame": {"duration": 0, "redraw": True}, "transition": {"duration": 0}}
    play = {**still, "frame": {"duration": 90, "redraw": True}}
    figure.update_layout(
        margin={"l": 0, "r": 0, "t": 10, "b": 0},
        modebar={"orientation": "v"},  # beside the legend, not over it
        updatemenus=[
            {
                "type": "buttons",
                "direction": "left",
                "x": 0,
                "y": 0,
                "xanchor": "left",
                "yanchor": "top",
                "pad": {"t": 28, "l": 8},
                "buttons": [
                    {"label": "Play", "method": "animate", "args": [None, play]},
                    {"label": "Stop", "method": "animate", "args": [[None], still]},
                ],
            }
        ],
        sliders=[
            {
                "x": 0.2,
                "len": 0.78,
                "y": 0,
                "yanchor": "top",
                "pad": {"t": 18},
                "active": length - 1,
                "ticklen": 0,
                "minorticklen": 0,
                "currentvalue": {
                    "prefix": f"{episodes[0].task.distance_scale.name} at ",
                    "xanchor": "left",
                    "font": {"size": 13, "color": "#334155"},
                },
                "font": {"size": 12, "color": "rgba(0, 0, 0, 0)"},  # of the labels below, which would overlap
                "steps": [{"label": label(k), "method": "animate", "args": [[str(k)], still]} for k in range(length)],
            }
        ],
    )
