"""Figures of a report: plotly, whose code the page contains, so that they work offline.

Those of the search are Optuna's own, of a study whose parameters and values have the units that people read.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.codesign.records import TrialResult
from softgym_envs.codesign.results import StudyResults
from softgym_envs.codesign.snapshot import StudySnapshot
from softgym_envs.units import display

if TYPE_CHECKING:
    import optuna
    from plotly.graph_objects import Figure

    from softgym_envs.designs import DesignVariable

BASELINE, WINNER, OTHER, VIOLATES = "#64748b", "#0f766e", "#94a3b8", "#dc2626"
COLOURS = {"baseline": BASELINE, "winner": WINNER}
AGENTS = {"policy": ("policy", "circle"), "qp": ("inverse QP", "square")}
MARKERS = {"baseline": ("cross", 13), "winner": ("star", 16)}

FONT = {"family": "system-ui, -apple-system, Segoe UI, Roboto, Helvetica Neue, Arial, sans-serif", "size": 12.5}
GRID = {"gridcolor": "#e2e8f0", "zeroline": False, "linecolor": "#94a3b8"}
WIDE = 3  # variables beside each other

Titled = tuple[str, "Figure"]


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


def styled(figure: Figure, height: int, **layout: Any) -> Figure:
    """Give a figure the look of the page."""
    figure.update_layout(
        height=height,
        width=None,
        title=None,
        font=FONT,
        template="none",
        paper_bgcolor="#ffffff",
        plot_bgcolor="#ffffff",
        margin={"l": 62, "r": 16, "t": 16, "b": 52},
        legend={"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0},
        hoverlabel={"align": "left"},
        **layout,
    )
    figure.update_xaxes(**GRID)
    figure.update_yaxes(**GRID)
    return figure


def blank(height: int, **layout: Any) -> Figure:
    """Return a figure without traces."""
    from plotly.graph_objects import Figure

    return styled(Figure(), height, **layout)


def _side_by_side(titles: Sequence[str], height: int) -> Figure:
    """Return a figure of several plots in a row."""
    from plotly.subplots import make_subplots

    return styled(make_subplots(1, len(titles), subplot_titles=titles, horizontal_spacing=0.09), height).update_layout(
        margin_t=56, legend_y=1.12
    )


# -- search ---------------------------------------------------------------------------------------------------------


class _Shown:
    """The trials of a study as Optuna's figures show them, in the units that people read."""

    def __init__(self, snapshot: StudySnapshot, results: StudyResults) -> None:
        self.objectives = [snapshot.config.objectives[name] for name in results.objectives]
        self.variables = [snapshot.config.optimised[name] for name in snapshot.config.variables]
        self.names = [self._name(variable) for variable in self.variables]
        self.roles = results.roles
        self.trials = {trial.number: trial for trial in snapshot.trials}

    @staticmethod
    def _name(variable: DesignVariable) -> str:
        unit = display(variable.unit).unit
        return variable.name.replace("_", " ") + (f" [{unit}]" if unit else "")

    def params(self, trial: TrialResult) -> dict[str, Any]:
        """Return the values of the variables of a trial."""
        values = {**trial.design, **trial.options}
        return {
            name: str(variable.choices[int(values[variable.name])])
            if variable.choices
            else values[variable.name] * display(variable.unit).factor
            for name, variable in zip(self.names, self.variables, strict=True)
        }

    def values(self, trial: TrialResult) -> list[float]:
        """Return the objectives of a trial."""
        return [trial.values[objective.name] * objective.scale for objective in self.objectives]

    def study(self, count: int) -> optuna.Study:
        """Return an Optuna study of the first objectives; of one, Optuna knows which trials are the best so far."""
        import optuna
        from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
        from optuna.trial import TrialState

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        study = optuna.create_study(directions=[objective.direction for objective in self.objectives[:count]])
        space: dict[str, BaseDistribution] = {}
        for name, variable in zip(self.names, self.variables, strict=True):
            factor = display(variable.unit).factor
            space[name] = (
                CategoricalDistribution([str(choice) for choice in variable.choices])
                if variable.choices
                else FloatDistribution(variable.low * factor, variable.high * factor, log=variable.log)
            )
        for number in range(max(self.trials, default=-1) + 1):  # a number that is missing failed
            trial = self.trials.get(number)
            if trial is None or trial.state != "complete":
                study.add_trial(optuna.create_trial(state=TrialState.PRUNED if trial else TrialState.FAIL))
                continue
            limits = {} if trial.feasible else trial.violations
            shown = optuna.create_trial(
                params=self.params(trial), distributions=space, values=self.values(trial)[:count], constraints=limits
            )
            study.add_trial(shown)
        return study

    def mark(self, figure: Figure, x: Any, y: Any, **place: Any) -> None:
        """Mark baseline and winner; ``x`` and ``y`` map a trial to what the axes show."""
        for number, role in self.roles.items():
            trial, (symbol, size) = self.trials[number], MARKERS[role]
            look = {"color": COLOURS[role], "symbol": symbol, "size": size, "line": {"color": "#ffffff", "width": 1}}
            figure.add_scatter(
                x=[x(trial)], y=[y(trial)], mode="markers", name=role, marker=look, legendgroup=role, **place
            )


def search_figures(snapshot: StudySnapshot, results: StudyResults) -> list[Titled]:
    """Return the figures of the search with their titles."""
    found = [
        *_of_trials(snapshot, results),
        ("Which variables matter", importance(results)),
        *_learning(snapshot, results),
        ("The inverse QP as a predictor of the trained controller", screen(snapshot, results)),
    ]
    return [(title, figure) for title, figure in found if figure is not None]


def _of_trials(snapshot: StudySnapshot, results: StudyResults) -> Iterator[tuple[str, Figure | None]]:
    """Yield Optuna's figures of all complete trials, with baseline and winner."""
    from optuna import visualization

    shown = _Shown(snapshot, results)
    study = shown.study(1)
    named: dict[str, Any] = {"target_name": shown.objectives[0].axis}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        history = styled(visualization.plot_optimization_history(study, **named), 360)
        history.update_traces(name="best so far", selector={"name": "Best Value"})
        shown.mark(history, lambda trial: trial.number, lambda trial: shown.values(trial)[0])
        yield "Every trial, and the best so far", history
        for start in range(0, len(shown.names), WIDE):
            part = shown.names[start : start + WIDE]
            figure = styled(visualization.plot_slice(study, part, **named), 340)
            for column, name in enumerate(sorted(part), start=1):  # as Optuna does
                place = {} if len(part) == 1 else {"row": 1, "col": column}
                shown.mark(
                    figure,
                    lambda trial, name=name: shown.params(trial)[name],
                    lambda trial: shown.values(trial)[0],
                    showlegend=column == 1,
                    **place,
                )
            yield "The objective along each variable", figure
        if len(shown.objectives) > 1:
            labels = [objective.axis for objective in shown.objectives]
            front = visualization.plot_pareto_front(
                shown.study(2), target_names=labels[:2], targets=lambda trial: trial.values[:2]
            )
            shown.mark(front, lambda trial: shown.values(trial)[0], lambda trial: shown.values(trial)[1])
            yield "Several objectives", styled(front, 400)
        if len(shown.names) > 1:
            lines = styled(visualization.plot_parallel_coordinate(study, shown.names, **named), 380)
            yield "Bodies and their objective", lines.update_layout(margin={"l": 90, "r": 70, "t": 70, "b": 30})


def importance(results: StudyResults) -> Figure | None:
    """Importance of each variable; None if it is unknown."""
    if not results.importance:
        return None
    names = [name.replace("_", " ") for name in reversed(results.importance)]
    shares = [100.0 * share for share in reversed(results.importance.values())]
    figure = blank(90 + 34 * len(names), xaxis={"title": "importance [%]"}, margin_l=150)
    figure.add_bar(x=shares, y=names, orientation="h", marker_color=WINNER, texttemplate="%{x:.0f} %")
    return figure


def _learning(snapshot: StudySnapshot, results: StudyResults) -> Iterator[Titled]:
    """Yield learning curves of the trials, and of the finalists that were trained anew."""
    objective, roles = snapshot.objective, results.roles
    trials = [(trial.number, trial.curve, trial.state == "pruned") for trial in snapshot.trials if trial.curve]
    anew = [(training.trial, training.curve, False) for training in results.trainings if training.curve]
    for title, curves in (
        ("Learning in the trials", trials),
        ("Learning of the finalists, each with several seeds", anew),
    ):
        if not curves:
            continue
        axes = {"xaxis": {"title": "environment steps"}, "yaxis": {"title": f"{objective.axis} in training"}}
        figure, labelled = blank(360, **axes), set()
        for number, curve, pruned in sorted(curves, key=lambda row: row[0] in roles):
            steps, scores = np.array(curve, dtype=float).T
            role = roles.get(number, "other bodies")
            figure.add_scatter(
                x=steps,
                y=objective.value_of(scores),
                name=role,
                legendgroup=role,
                showlegend=role not in labelled,
                text=f"trial {number}",
                line={
                    "color": COLOURS.get(role, "#cbd5e1"),
                    "width": 2.4 if role in COLOURS else 1.2,
                    "dash": "dash" if pruned else "solid",
                },
            )
            labelled.add(role)
        yield title, figure


def screen(snapshot: StudySnapshot, results: StudyResults) -> Figure | None:
    """Objective of each body with the inverse QP and with its trained controller; None without one."""
    objective = snapshot.objective
    done = [t for t in snapshot.trials if t.scores and t.controller != "qp" and t.qp_value is not None]
    if len(done) < 2:
        return None
    titles = [f"{controller}: {objective.axis_inside}" for controller in ("inverse QP", "policy")]
    figure = blank(380, xaxis={"title": titles[0]}, yaxis={"title": titles[1]})
    for role in ("other bodies", *COLOURS):
        part = [trial for trial in done if results.roles.get(trial.number, "other bodies") == role]
        symbol, size = MARKERS.get(role, ("circle", 8))
        figure.add_scatter(
            x=[(trial.qp_value or 0.0) * objective.scale for trial in part],
            y=[trial.values[objective.name] * objective.scale for trial in part],
            mode="markers",
            name=role,
            text=[f"trial {trial.number}" for trial in part],
            marker={"color": COLOURS.get(role, OTHER), "symbol": symbol, "size": size},
        )
    return figure


# -- test -----------------------------------------------------------------------------------------------------------


def transfer(snapshot: StudySnapshot, results: StudyResults) -> Figure | None:
    """Finalists on surrogate and FEM, on the test goals; None without both."""
    names = list(dict.fromkeys(row.objective for row in results.transfer))
    if not names:
        return None
    objectives = [snapshot.config.shown_objectives[name] for name in names]
    figure, labelled = _side_by_side([objective.label for objective in objectives], 360), set()
    for column, objective in enumerate(objectives, start=1):
        rows = [row for row in results.transfer if row.objective == objective.name]
        everything = np.concatenate([[*row.surrogate, *row.fem] for row in rows]) * objective.scale
        margin = 0.08 * (np.ptp(everything) or 1.0)
        ends = [everything.min() - margin, everything.max() + margin]
        dotted = {"color": OTHER, "width": 1, "dash": "dot"}
        figure.add_scatter(x=ends, y=ends, mode="lines", line=dotted, showlegend=False, row=1, col=column)
        for row in rows:
            agent, symbol = AGENTS[row.agent]
            for number, surrogate, fem in zip(row.trials, row.surrogate, row.fem, strict=True):
                role = results.roles.get(number, "other finalist")
                name = f"{role}, {agent}"
                figure.add_scatter(
                    x=[surrogate * objective.scale],
                    y=[fem * objective.scale],
                    mode="markers",
                    name=name,
                    legendgroup=name,
                    showlegend=name not in labelled,
                    text=[f"trial {number}"],
                    marker={"color": COLOURS.get(role, "#cbd5e1"), "symbol": symbol, "size": 11, "line": {"width": 1}},
                    row=1,
                    col=column,
                )
                labelled.add(name)
        unit = f" [{objective.display.unit}]" if objective.display.unit else ""
        figure.update_xaxes(title=f"on the surrogate{unit}", row=1, col=column)
        figure.update_yaxes(title=f"on FEM{unit}" if column == 1 else None, row=1, col=column)
    return figure


def reached(snapshot: StudySnapshot, results: StudyResults) -> Figure | None:
    """Share of the test goals reached within a distance on FEM, for baseline and winner; None without FEM."""
    scale = snapshot.config.distance_scale
    agents = [row.agent for row in results.comparison if row.backend == "fem"]
    tests = {(*group.key, group.goals): group for group in results.tests}
    if not agents:
        return None
    figure = _side_by_side([AGENTS[agent][0] for agent in agents], 330)
    for column, agent in enumerate(agents, start=1):
        for number, role in results.roles.items():
            distances = scale.factor * np.sort(tests[number, agent, "fem", "unseen"].mean.distances)
            share = 100 * np.arange(len(distances) + 1) / len(distances)
            line = {"shape": "hv", "color": COLOURS[role], "width": 2.2}
            figure.add_scatter(
                x=[0, *distances],
                y=share,
                mode="lines",
                name=role,
                legendgroup=role,
                showlegend=column == 1,
                line=line,
                row=1,
                col=column,
            )
        limit = scale.limit_text(results.success_distance)
        figure.add_vline(
            scale.factor * results.success_distance,
            line={"color": "#d97706", "width": 1, "dash": "dash"},
            annotation_text=f"success: {limit}",
            annotation_position="bottom right",
            row=1,
            col=column,
        )
        figure.update_xaxes(title=f"final {scale.name} on FEM [{scale.unit}]", rangemode="tozero", row=1, col=column)
        figure.update_yaxes(title="goals reached [%]" if column == 1 else None, range=[0, 102], row=1, col=column)
    return figure
