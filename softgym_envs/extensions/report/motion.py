"""Figures of the goals that baseline and winner reach, and of both bodies in motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.codesign.results import StudyResults
from softgym_envs.codesign.snapshot import StudySnapshot
from softgym_envs.extensions.report.episodes import Episode
from softgym_envs.extensions.report.figures import BASELINE, COLOURS, VIOLATES, WINNER, blank
from softgym_envs.wording import decimal

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

MAX_FRAMES = 24
MAX_POINTS = 60_000
"""Largest number of surface points in all frames of a body, which bounds the size of the page."""

OBSTACLE, FORCE = "#9db4d4", "#111827"

LONGEST_FORCE = 0.2
"""Length of the largest contact force that is drawn, relative to the size of the robot."""

GOAL_KINDS: tuple[tuple[str, str, str, str], ...] = (
    ("reached by both", "circle", "#1d4ed8", "●"),
    ("reached by the winner only", "diamond", WINNER, "◆"),
    ("reached by the baseline only", "square", "#b45309", "■"),
    ("reached by neither", "x", VIOLATES, "✕"),
)
"""Outcome of a goal, with the plotly symbol, the colour and the character of its marker."""


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
    if snapshot.config.environment.task_class.distance_scale.goal_unit != "m":
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
        axes = [{"title": f"{'xyz'[axis]} [mm]"} for axis in (a, b)]
        figure = blank(330, showlegend=False, xaxis=axes[0], yaxis={**axes[1], "scaleanchor": "x"})
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
    """Baseline and winner over each other at one goal, step by step, with all goals and what stands in the way.

    It can be rotated and played.
    """
    from plotly.graph_objects import Frame

    from softgym_envs.viewer.scene import obstacle_skins
    from softgym_envs.viewer.surface import BodySurface

    surfaces = [BodySurface(episode.model) for episode in episodes]
    points = max(len(surface.nodes) for surface in surfaces)
    count = max(2, min(MAX_FRAMES, max(len(e.states) for e in episodes), MAX_POINTS // points))
    picks = [episode.pick(count) for episode in episodes]
    figure = blank(560, scene=_scene(), uirevision="constant")
    stretch = _force_stretch(episodes, picks)

    def traces(frame: int, whole: bool) -> list[dict[str, Any]]:
        drawn: list[dict[str, Any]] = []
        for episode, surface, pick in zip(episodes, surfaces, picks, strict=True):
            index = pick[min(frame, len(pick) - 1)]
            nodes = episode.states[index].nodes
            assert nodes is not None, "finite elements compute nodes"
            drawn.append(_body_trace(episode.role, surface.points(nodes), surface.triangles if whole else None))
            drawn.append(_tip_trace(episode, index, whole))
            if stretch is not None:
                drawn.append(_force_trace(episode, index, stretch, whole))
        return drawn

    length = max(map(len, picks))
    for trace in traces(length - 1, whole=True):  # at first at the goal
        figure.add_trace(trace)
    moving = list(range(len(figure.data)))
    for vertices, triangles in obstacle_skins(episodes[0].model, episodes[0].robot):
        figure.add_trace(_surface_trace(vertices, triangles, "obstacle", OBSTACLE, 0.5))
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
    winner = role == "winner"
    return _surface_trace(points, faces, role, WINNER if winner else BASELINE, 1.0 if winner else 0.3)


def _surface_trace(
    points: np.ndarray, faces: np.ndarray | None, name: str, colour: str, opacity: float
) -> dict[str, Any]:
    x, y, z = (1e3 * points).T.astype(np.float32)
    trace: dict[str, Any] = {"type": "mesh3d", "x": x, "y": y, "z": z}
    if faces is not None:
        i, j, k = faces.T.astype(np.int32)
        trace |= {
            "i": i,
            "j": j,
            "k": k,
            "name": name,
            "showlegend": True,
            "hoverinfo": "name",
            "color": colour,
            "opacity": opacity,
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


def _force_stretch(episodes: Sequence[Episode], picks: Sequence[list[int]]) -> float | None:
    """Return the length in which a contact force of 1 N is drawn [m]; None if no body touches anything."""
    largest = 0.0
    for episode, pick in zip(episodes, picks, strict=True):
        for index in pick:
            contacts = episode.states[index].contacts
            if contacts is not None and contacts.count:
                largest = max(largest, float(np.linalg.norm(contacts.force, axis=1).max()))
    return LONGEST_FORCE * episodes[0].robot.size / largest if largest > 0.0 else None


def _force_trace(episode: Episode, index: int, stretch: float, whole: bool) -> dict[str, Any]:
    """Return the forces of obstacles on a body as lines that end where it touches, ``stretch`` metres per newton."""
    contacts = episode.states[index].contacts
    if contacts is None:
        lines = np.zeros((0, 2, 3))
    else:
        lines = 1e3 * np.stack([contacts.point - stretch * contacts.force, contacts.point], axis=1)
    # A trace without points would leave the legend for good.
    x, y, z = (_broken(lines[:, :, axis]) or [None] for axis in range(3))
    trace: dict[str, Any] = {"type": "scatter3d", "x": x, "y": y, "z": z}
    if whole:
        name = f"contact forces on the {episode.role}, 1 N is {1e3 * stretch:.2g} mm long"
        trace |= {"mode": "lines", "line": {"color": FORCE, "width": 5}, "name": name, "hoverinfo": "name"}
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
