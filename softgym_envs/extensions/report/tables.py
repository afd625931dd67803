"""Tables of a report: rows of text cells for its template."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.metrics.metric import Metric
from softgym_envs.codesign.records import REFINED, TrialResult
from softgym_envs.codesign.results import Comparison, Cost, StudyResults, Transfer, VariableResult
from softgym_envs.codesign.snapshot import StudySnapshot
from softgym_envs.codesign.statistics import MeshPart
from softgym_envs.units import display, present
from softgym_envs.wording import decimal, time_text

AGENTS = {"policy": "Policy", "qp": "Inverse QP"}
BACKENDS = {"fem": "FEM", REFINED: "FEM, finer mesh", "surrogate": "Surrogate"}
SHOWN_ALWAYS = ("mean_distance", "success_rate")
"""Objectives that every comparison shows, whatever the objective of the study."""


@dataclass(frozen=True)
class DesignRow:
    """A variable of baseline and winner; places are in percent of the range."""

    name: str
    optimised: bool
    description: str
    baseline: str
    winner: str
    at_limit: str
    change: str
    low: str
    high: str
    baseline_place: float
    winner_place: float | None


@dataclass(frozen=True)
class Cell:
    """A value with its interval, that with the error of the mesh, and whether it is a certain improvement."""

    value: str
    interval: str = ""
    mesh: str = ""
    good: bool = False


@dataclass(frozen=True)
class ComparisonRow:
    """Baseline and winner with one controller on one backend."""

    backend: str
    agent: str
    goals: int
    cells: list[Cell]
    closer: int
    farther: int


@dataclass(frozen=True)
class EffortRow:
    """What baseline and winner cost with one controller on one backend: efforts, strain of drives, self-contact."""

    backend: str
    agent: str
    mean: list[str]
    largest: list[str]
    strain: list[str]
    pressing: list[str]


@dataclass(frozen=True)
class TransferRow:
    """The difference of an objective between surrogate and FEM."""

    agent: str
    measure: str
    bodies: int
    mean: str
    worst: str
    spearman: str


@dataclass(frozen=True)
class FinalistRow:
    """A finalist; each cell has a value and a smaller text below it."""

    trial: int
    role: str
    cells: list[tuple[str, str]]


@dataclass(frozen=True)
class TrialRow:
    """A trial of the search."""

    number: int
    state: str
    reason: str
    origin: str
    cells: list[str]


@dataclass(frozen=True)
class CostRow:
    """Environment steps and times of a part of the study."""

    part: str
    steps: str
    cpu: str
    wall: str


def percent(value: float) -> str:
    """Return a share in percent."""
    return f"{100 * value:.1f} %"


def design_row(variable: VariableResult) -> DesignRow:
    """Return a variable of baseline and winner."""
    unit, baseline, winner = variable.unit, variable.baseline, variable.winner
    name, factor, decimals = display(unit)
    change = "-"
    if winner is not None and winner != baseline:
        change = f"{decimal((winner - baseline) * factor, decimals, '+')}{' ' + name if name else ''}"
    return DesignRow(
        name=variable.name.replace("_", " "),
        optimised=variable.optimised,
        description=variable.description,
        baseline=present(baseline, unit),
        winner="-" if winner is None else present(winner, unit),
        at_limit=f"at its {variable.at_limit} limit" if variable.at_limit else "",
        change=change,
        low=present(variable.low, unit),
        high=present(variable.high, unit),
        baseline_place=round(100 * variable.place(baseline), 1),
        winner_place=None if winner is None else round(100 * variable.place(winner), 1),
    )


def _cell(
    value: str,
    interval: Sequence[float] | None,
    show: Callable[[float], str],
    better: int = 0,
    mesh: MeshPart | None = None,
) -> Cell:
    """Return a cell; ``better`` is the sign of an improvement, 0 for a value that is not a change."""
    if interval is None:
        return Cell(value)
    whole = mesh.interval if mesh is not None and mesh.interval is not None else None
    low, high = (show(end) for end in interval)
    return Cell(
        value=value,
        interval=f"{low} to {high}",
        mesh="" if whole is None else f"with the mesh {show(whole[0])} to {show(whole[1])}",
        good=min(better * end for end in whole or interval) > 0.0,
    )


def comparison_columns(config: StudyConfig) -> list[str]:
    """Return the columns of the comparison of baseline and winner."""
    measures = [] if config.objective in SHOWN_ALWAYS else [config.primary.label]
    return [
        f"{measure}, {what}"
        for measure in (*measures, "Success", config.distance_scale.name.capitalize())
        for what in ("baseline", "winner", "change")
    ]


def comparison_row(row: Comparison, config: StudyConfig) -> ComparisonRow:
    """Return the comparison for one controller and backend."""
    measures = config.shown_objectives
    cells: list[Cell] = []
    # Measure, its mean, and the prefix of its other fields in the comparison.
    shown = [(config.primary, "objective", "objective")] if config.objective not in SHOWN_ALWAYS else []
    shown += [(measures["success_rate"], "success_rate", "success")]
    shown += [(measures["mean_distance"], "mean_distance", "distance")]
    for measure, mean, prefix in shown:
        for body in (row.baseline, row.winner):
            text, interval = measure.text(getattr(body, mean)), getattr(body, f"{prefix}_interval")
            cells.append(_cell(text, interval, measure.number))
        change, interval = getattr(row, f"{prefix}_change"), getattr(row, f"{prefix}_change_interval")
        mesh = getattr(row, f"{prefix}_mesh", None)
        show = partial(measure.number, sign="+")
        cells.append(_cell(measure.text(change, "+"), interval, show, measure.sign, mesh))
    return ComparisonRow(
        backend=BACKENDS[row.backend],
        agent=AGENTS[row.agent],
        goals=row.goals,
        cells=cells,
        closer=row.goals_closer,
        farther=row.goals_farther,
    )


def effort_rows(comparison: Sequence[Comparison], effort: Metric) -> list[EffortRow]:
    """Return the efforts of baseline and winner for each controller and backend."""
    return [
        EffortRow(
            backend=BACKENDS[row.backend],
            agent=AGENTS[row.agent],
            mean=[effort.text(body.mean_effort) for body in (row.baseline, row.winner)],
            largest=[effort.text(body.largest_effort) for body in (row.baseline, row.winner)],
            strain=["-" if s is None else percent(s) for s in (row.baseline.largest_strain, row.winner.largest_strain)],
            pressing=["-" if f is None else present(f, "N") for f in (row.baseline.self_force, row.winner.self_force)],
        )
        for row in comparison
    ]


def transfer_row(row: Transfer, objective: Metric) -> TransferRow:
    """Return how an objective differs between surrogate and FEM."""
    return TransferRow(
        agent=AGENTS[row.agent],
        measure=objective.label,
        bodies=len(row.trials),
        mean=objective.text(row.mean_gap, "+"),
        worst=objective.text(row.worst_gap, "-"),
        spearman="-" if row.spearman is None else f"{row.spearman:.2f}",
    )


def finalist_table(snapshot: StudySnapshot, results: StudyResults) -> tuple[list[str], list[FinalistRow]]:
    """Return columns and rows of the table of all finalists."""
    objective, config = snapshot.objective, snapshot.config
    optimised = [variable for variable in results.variables if variable.optimised]
    tests = {group.key: group for group in results.tests if group.goals == "unseen"}
    kinds = [(a, b) for a in AGENTS for b in BACKENDS if any(key[1:] == (a, b) for key in tests)]
    trials = {trial.number: trial for trial in snapshot.trials}
    limits = config.controller_constraints
    rows = []
    for body in results.finalists:
        values = {**body.design, **body.options}
        cells = [(present(values[variable.name], variable.unit), "") for variable in optimised]
        cells.append((objective.text(objective.sign * body.score), ""))
        if config.constraints:
            cells.append(
                ("satisfied" if trials[body.trial].feasible else "violated", _broken(snapshot, trials[body.trial]))
            )
        for kind in kinds:
            group = tests.get((body.trial, *kind))
            if group is None or group.error is not None:
                cells.append(("-" if group is None else "failed", ""))
                continue
            below = config.distance.text(group.mean.mean_distance)
            if objective.name not in SHOWN_ALWAYS:
                below = f"{objective.text(group.value(objective.name))}; {below}"
            broken = config.violations_text({name: group.value(name) for name in limits}, limits)
            cells.append((percent(group.mean.success_rate), f"{below}; {broken}" if broken else below))
        rows.append(FinalistRow(body.trial, results.roles.get(body.trial, ""), cells))
    columns = [variable.name.replace("_", " ") for variable in optimised] + [f"{objective.label} in search"]
    columns += ["constraints in search"] if config.constraints else []
    columns += [f"{AGENTS[agent]}, {BACKENDS[backend]}" for agent, backend in kinds]
    return columns, rows


def _broken(snapshot: StudySnapshot, trial: TrialResult) -> str:
    return snapshot.config.violations_text(trial.values, snapshot.config.constraints)


def trial_table(snapshot: StudySnapshot, results: StudyResults) -> tuple[list[str], list[TrialRow]]:
    """Return columns and rows of the table of all trials."""
    optimised = [variable for variable in results.variables if variable.optimised]
    config, objective = snapshot.config, snapshot.objective
    others = [name for name in config.objectives if name != objective.name]

    def cells(trial: TrialResult) -> list[str]:
        values = {**trial.design, **trial.options}
        found = [present(values[variable.name], variable.unit) for variable in optimised]
        found.append("-" if trial.score is None else objective.text(trial.values[objective.name]))
        found += [config.objectives[name].text(trial.values.get(name)) for name in others]
        if config.constraints:
            found.append("-" if trial.score is None else "satisfied" if trial.feasible else "violated")
        return [*found, objective.text(trial.qp_value), f"{trial.training_steps:,}", f"{trial.seconds:.1f} s"]

    rows = [
        TrialRow(trial.number, trial.state, trial.reason or _broken(snapshot, trial), trial.origin, cells(trial))
        for trial in snapshot.trials
    ]
    columns = [variable.name.replace("_", " ") for variable in optimised]
    columns += [objective.label, *(config.objectives[name].label for name in others)]
    columns += ["constraints"] if config.constraints else []
    return [*columns, "by inverse QP", "training steps", "time"], rows


def cost_rows(cost: Cost) -> list[CostRow]:
    """Return environment steps and time of each phase."""
    retraining = (
        f"{cost.retraining_steps:,} of training, {cost.retraining_report_steps:,} of its reports, "
        if cost.retraining_steps
        else ""
    )
    parts = {
        "screen": ("Screen by the inverse QP", f"{cost.screen_steps:,}"),
        "trials": (
            "Trials",
            f"{cost.training_steps:,} of training, {cost.report_steps:,} of its reports, {cost.selection_steps:,} of "
            "scores",
        ),
        "finalists": (
            "Final test",
            f"{retraining}{cost.test_steps_fem:,} on FEM, {cost.test_steps_surrogate:,} on the surrogate",
        ),
    }

    wall = {part: time_text(seconds) for part, seconds in cost.wall_seconds.items()}
    rows = [
        CostRow(title, steps, time_text(cost.cpu_seconds[part]), wall.get(part, "-"))
        for part, (title, steps) in parts.items()
        if part != "screen" or cost.cpu_seconds[part]
    ]
    total = CostRow("Total", "", *(time_text(sum(each.values())) for each in (cost.cpu_seconds, cost.wall_seconds)))
    return [*rows, total]
