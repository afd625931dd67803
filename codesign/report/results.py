"""What a study found: ``results.json``, ``trials.csv``, ``finalists.csv``."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation import Evaluation
from codesign.config import StudyConfig
from codesign.objectives import OBJECTIVES, Objective
from codesign.records import Finalist, FinalistTraining, TestGroup, TrialResult
from codesign.report.statistics import Interval, mean_interval, rank_correlation, rate_interval
from codesign.snapshot import StudySnapshot
from softgym_envs.config import provenance
from softgym_envs.designs import DesignVariable
from softgym_envs.storage import atomic_write, write_json

FEW_GOALS = 10
"""With fewer test goals a difference may well be chance."""
LIMIT_MARGIN = 0.02
"""A variable this close to an end of its range, as a fraction of the range, is at its limit."""


@dataclass(frozen=True)
class VariableResult:
    """A variable of the body, with its values in baseline and winner.

    Attributes:
        name: name of the variable.
        unit: SI unit.
        low: smallest value [unit].
        high: largest value [unit].
        log: whether the range is logarithmic.
        description: meaning of the variable.
        optimised: whether the study optimised it.
        baseline: value of the baseline [unit].
        winner: value of the winner [unit], or None.
        at_limit: ``"lower"`` or ``"upper"`` if the winner is at an end of the range, else empty.
    """

    name: str
    unit: str
    low: float
    high: float
    log: bool
    description: str
    optimised: bool
    baseline: float
    winner: float | None
    at_limit: str

    def place(self, value: float) -> float:
        """Return the place of a value in the range, in [0, 1], on the scale of the variable."""
        return _place(value, self.low, self.high, self.log)


@dataclass(frozen=True)
class BodyResult:
    """A body in the final test; values in SI units."""

    trial: int
    role: str
    design: dict[str, float]
    options: dict[str, float]
    score: float
    policy: str | None


@dataclass(frozen=True)
class BodyStatistics:
    """Test of one body with one controller on one backend [SI]; intervals of 95 %."""

    success_rate: float
    success_interval: Interval
    mean_distance: float
    distance_interval: Interval
    worst_distance: float
    mean_return: float
    mean_effort: float
    objective: float
    objective_interval: Interval


@dataclass(frozen=True)
class Comparison:
    """Winner against baseline on the same test goals, with one controller on one backend [SI]; intervals of 95 %."""

    backend: str
    agent: str
    goals: int
    baseline: BodyStatistics
    winner: BodyStatistics
    success_change: float
    success_change_interval: Interval
    distance_change: float
    distance_change_interval: Interval
    objective_change: float
    objective_change_interval: Interval
    goals_closer: int
    goals_farther: int


@dataclass(frozen=True)
class Transfer:
    """An objective of all finalists on the surrogate and on FEM [SI]."""

    agent: str
    objective: str
    trials: list[int]
    surrogate: list[float]
    fem: list[float]
    mean_gap: float
    worst_gap: float
    spearman: float | None


@dataclass(frozen=True)
class Cost:
    """Environment steps of each part of a study, and its time by phase [s]."""

    joint_steps: int
    joint_report_steps: int
    retraining_steps: int
    retraining_report_steps: int
    training_steps: int
    report_steps: int
    selection_steps: int
    screen_steps: int
    test_steps_surrogate: int
    test_steps_fem: int
    cpu_seconds: dict[str, float]
    wall_seconds: dict[str, float]


@dataclass(frozen=True)
class StudyResults:
    """Results of a study; quantities are in SI units.

    Attributes:
        name: name of the study.
        title: title of the report.
        environment: ID of the environment.
        objective: name of the objective.
        objectives: names of the objective and the secondary objectives.
        constraints: limit of each constraint.
        strategy: how bodies were scored.
        command: command that ran the study.
        trials: numbers of trials: ``requested``, ``complete``, ``pruned``, ``infeasible``, and ``feasible``: those that
            satisfy the constraints.
        variables: all variables of the body.
        baseline: the baseline, if it could be simulated and tested.
        winner: the body that wins, or None.
        no_winner: why there is no winner, with the nearest miss; else empty.
        few_goals: warning if there are few test goals, else empty.
        comparison: winner against baseline, for each controller and backend.
        pareto: trials on the Pareto front, with several objectives.
        transfer: surrogate against FEM over the finalists.
        finalists: all bodies in the final test.
        trainings: policies trained anew for them.
        tests: their tests.
        importance: how much each variable decides between good and bad bodies.
        cost: environment steps and time.
        success_distance: distance within which a goal counts as reached.
        provenance: versions, commit, time and machine.
    """

    name: str
    title: str
    environment: str
    objective: str
    objectives: list[str]
    constraints: dict[str, float]
    strategy: str
    command: str
    trials: dict[str, int]
    variables: list[VariableResult]
    baseline: BodyResult | None
    winner: BodyResult | None
    no_winner: str
    few_goals: str
    comparison: list[Comparison]
    pareto: list[int]
    transfer: list[Transfer]
    finalists: list[BodyResult]
    trainings: list[FinalistTraining]
    tests: list[TestGroup]
    importance: dict[str, float]
    cost: Cost
    success_distance: float
    provenance: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain data."""
        plain = {name: value for name, value in vars(self).items() if name not in ("tests", "trainings")}
        data = {name: _plain(value) for name, value in plain.items()}
        data["tests"] = [group.to_json() for group in self.tests]
        data["trainings"] = [training.to_json() for training in self.trainings]
        return data

    @property
    def roles(self) -> dict[int, str]:
        """Trial numbers of baseline and winner."""
        bodies = {"baseline": self.baseline, "winner": self.winner}
        return {body.trial: role for role, body in bodies.items() if body is not None}


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return asdict(value) if hasattr(value, "__dataclass_fields__") else value


def collect(snapshot: StudySnapshot) -> StudyResults:
    """Gather the results of a study, finished or not."""
    config, winner, baseline = snapshot.config, snapshot.winner, snapshot.baseline
    states = [trial.state for trial in snapshot.trials]
    counts = {state: states.count(state) for state in ("complete", "pruned", "infeasible")}
    comparison = _comparisons(snapshot)
    few = comparison[0].goals if comparison else FEW_GOALS
    unseen = snapshot.unseen_tests
    bodies = {body.number: _body(body) for body in snapshot.finalists}
    return StudyResults(
        name=config.name,
        title=config.title or config.name,
        environment=config.environment.title,
        objective=config.objective,
        objectives=[config.objective, *config.secondary_objectives],
        constraints=config.constraints,
        strategy=config.strategy,
        command=snapshot.account.command,
        trials={"requested": config.trials, **counts, "feasible": sum(trial.feasible for trial in snapshot.trials)},
        variables=_variables(config, winner),
        baseline=None if baseline is None else bodies[baseline.number],
        winner=None if winner is None else bodies[winner.number],
        no_winner=snapshot.verdict.reason,
        few_goals=f"Only {few} test goals: the difference may be chance." if few < FEW_GOALS else "",
        comparison=comparison,
        pareto=snapshot.pareto if config.secondary_objectives else [],
        transfer=[row for objective in _measured(snapshot) for row in _transfer(unseen, objective)],
        finalists=list(bodies.values()),
        trainings=snapshot.trainings,
        tests=snapshot.tests,
        importance=_importance(snapshot),
        cost=_cost(snapshot),
        success_distance=config.success_distance,
        provenance=provenance(),
    )


def _body(finalist: Finalist) -> BodyResult:
    return BodyResult(
        finalist.number, finalist.role, finalist.design, finalist.options, finalist.score, finalist.policy
    )


def _variables(config: StudyConfig, winner: Finalist | None) -> list[VariableResult]:
    variables = {**config.space.variables, **config.optimised}
    values = {**config.baseline, **config.baseline_values}
    best = {} if winner is None else {**winner.design, **winner.options}

    def row(name: str, variable: DesignVariable) -> VariableResult:
        limit = ""
        if name in best and name in config.variables:
            place = _place(best[name], variable.low, variable.high, variable.log)
            limit = "lower" if place <= LIMIT_MARGIN else "upper" if place >= 1.0 - LIMIT_MARGIN else ""
        return VariableResult(
            name=name,
            unit=variable.unit,
            low=variable.low,
            high=variable.high,
            log=variable.log,
            description=variable.description,
            optimised=name in config.variables,
            baseline=values[name],
            winner=best.get(name),
            at_limit=limit,
        )

    return [row(name, variable) for name, variable in variables.items()]


def _place(value: float, low: float, high: float, log: bool) -> float:
    if log:
        return float(np.log(value / low) / np.log(high / low))
    return (value - low) / (high - low)


def _comparisons(snapshot: StudySnapshot) -> list[Comparison]:
    winner, baseline = snapshot.winner, snapshot.baseline
    if winner is None or baseline is None:
        return []
    found = {group.key: group for group in snapshot.unseen_tests}
    rows = []
    for backend in snapshot.config.test_backends:
        for agent in winner.agents:
            before, after = (found.get((body.number, agent, backend)) for body in (baseline, winner))
            if before is not None and after is not None:
                rows.append(_compare(before, after, snapshot.objective))
    return rows


def _statistics(group: TestGroup, objective: Objective) -> BodyStatistics:
    mean, own = group.mean, group.objective_table
    return BodyStatistics(
        success_rate=mean.success_rate,
        success_interval=rate_interval(group.table("successes")),
        mean_distance=mean.mean_distance,
        distance_interval=mean_interval(group.table("distances")),
        worst_distance=group.worst_distance,
        mean_return=mean.mean_return,
        mean_effort=mean.mean_effort,
        objective=group.value(objective.name),
        objective_interval=None if own is None else mean_interval(own),
    )


def _compare(baseline: TestGroup, winner: TestGroup, objective: Objective) -> Comparison:
    """Return winner minus baseline, goal by goal."""
    change = winner.mean.distances - baseline.mean.distances
    before, after = _statistics(baseline, objective), _statistics(winner, objective)

    def interval(name: str) -> Interval:
        return mean_interval(winner.table(name), baseline.table(name))

    own = winner.objective_table, baseline.objective_table
    return Comparison(
        backend=winner.backend,
        agent=winner.agent,
        goals=len(change),
        baseline=before,
        winner=after,
        success_change=after.success_rate - before.success_rate,
        success_change_interval=interval("successes"),
        distance_change=float(change.mean()),
        distance_change_interval=interval("distances"),
        objective_change=after.objective - before.objective,
        objective_change_interval=None if own[0] is None or own[1] is None else mean_interval(own[0], own[1]),
        goals_closer=int((change < 0.0).sum()),
        goals_farther=int((change > 0.0).sum()),
    )


def _measured(snapshot: StudySnapshot) -> list[Objective]:
    """Return the objective of a study, success rate and mean distance."""
    return list(
        {o.name: o for o in (snapshot.objective, *map(OBJECTIVES.get, ("success_rate", "mean_distance"))) if o}.values()
    )


def _transfer(groups: list[TestGroup], objective: Objective) -> list[Transfer]:
    """Return an objective on surrogate and FEM over the finalists, for each controller."""

    def value(group: TestGroup) -> float:
        name = objective.name
        return group.value(name) if name in group.tests[0].values else float(getattr(group.mean, name))

    rows = []
    for agent in ("sac", "qp"):
        values = {
            backend: {group.trial: value(group) for group in groups if (group.agent, group.backend) == (agent, backend)}
            for backend in ("surrogate", "fem")
        }
        trials = sorted(set(values["surrogate"]) & set(values["fem"]))
        if trials:
            surrogate, fem = ([values[backend][trial] for trial in trials] for backend in ("surrogate", "fem"))
            gaps = np.subtract(fem, surrogate)
            rows.append(
                Transfer(
                    agent=agent,
                    objective=objective.name,
                    trials=trials,
                    surrogate=surrogate,
                    fem=fem,
                    mean_gap=float(gaps.mean()),
                    worst_gap=float(np.abs(gaps).max()),
                    spearman=rank_correlation(surrogate, fem),
                )
            )
    return rows


def _importance(snapshot: StudySnapshot) -> dict[str, float]:
    """Return how much each variable decides between good and bad bodies (PED-ANOVA); nothing with too few trials."""
    import optuna

    scores = [trial.score for trial in snapshot.trials if trial.state == "complete"]
    if len(scores) < 8 or len(snapshot.config.variables) < 2 or len(set(scores)) < 3:
        return {}
    evaluator = optuna.importance.PedAnovaImportanceEvaluator(target_quantile=0.25)
    first = (lambda trial: -trial.values[0]) if snapshot.config.secondary_objectives else None
    try:
        with warnings.catch_warnings():  # it warns that it takes small values for good ones, which is what we want
            warnings.filterwarnings("ignore", "PedAnovaImportanceEvaluator computes", UserWarning)
            study = snapshot.optuna_study
            found = optuna.importance.get_param_importances(study, evaluator=evaluator, target=first)
    except (ValueError, RuntimeError):  # the trials have no quantile
        return {}
    return {name: float(value) for name, value in found.items()}


def _cost(snapshot: StudySnapshot) -> Cost:
    config, trials, shared = snapshot.config, snapshot.trials, snapshot.shared_policy
    screened = [result.evaluation for result in snapshot.screen if result.evaluation is not None]
    # Of all bodies that ever were finalists, not only of the present ones.
    tests, retrained = snapshot.all_tests, snapshot.all_trainings
    points = sum(len(trial.curve) for trial in trials)

    def test_steps(backend: str) -> int:
        return sum(test.evaluation.steps for test in tests if test.backend == backend and test.evaluation is not None)

    return Cost(
        joint_steps=shared.training_steps if shared else 0,
        joint_report_steps=shared.report_steps if shared else 0,
        retraining_steps=sum(training.steps for training in retrained),
        retraining_report_steps=sum(training.report_steps for training in retrained),
        training_steps=sum(trial.training_steps for trial in trials),
        report_steps=points * config.training.evaluation_episodes * config.episode_steps,
        selection_steps=sum(trial.steps_of_scores for trial in trials),
        screen_steps=sum(evaluation.steps for evaluation in screened),
        test_steps_surrogate=test_steps("surrogate"),
        test_steps_fem=test_steps("fem"),
        cpu_seconds={
            "screen": sum(evaluation.cpu_seconds for evaluation in screened),
            "shared_policy": shared.cpu_seconds if shared else 0.0,
            "trials": sum(trial.cpu_seconds for trial in trials),
            "finalists": sum(test.evaluation.cpu_seconds for test in tests if test.evaluation is not None)
            + sum(training.cpu_seconds for training in retrained),
        },
        wall_seconds=snapshot.account.wall_seconds,
    )


def write_results(snapshot: StudySnapshot) -> StudyResults:
    """Write ``results.json``, ``trials.csv`` and ``finalists.csv``; return what is in the first."""
    results = collect(snapshot)
    folder = snapshot.folder.path
    write_json(folder / "results.json", results.to_json())
    units = {variable.name: variable.unit for variable in results.variables}
    _write_csv(folder / "trials.csv", (_trial_row(trial, snapshot.config, units) for trial in snapshot.trials))
    bodies = {body.trial: body for body in results.finalists}
    _write_csv(folder / "finalists.csv", (_test_row(group, bodies[group.trial], units) for group in results.tests))
    return results


def _write_csv(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    rows = list(rows)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with atomic_write(path, "w") as stream:
        writer = csv.DictWriter(stream, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _field(evaluation: Evaluation | None, name: str) -> float | None:
    return None if evaluation is None else getattr(evaluation, name)


def _trial_row(trial: TrialResult, config: StudyConfig, units: Mapping[str, str]) -> dict[str, Any]:
    evaluation, qp = trial.evaluation, trial.qp
    named = {
        name: trial.values.get(name) for name in config.objectives if name not in ("success_rate", "mean_distance")
    }
    return {
        "trial": trial.number,
        "state": trial.state,
        "feasible": trial.feasible,
        "origin": trial.origin,
        **{f"{name} [{units[name]}]": value for name, value in {**trial.design, **trial.options}.items()},
        "score": trial.score,
        "success_rate": _field(evaluation, "success_rate"),
        "mean_distance [m]": _field(evaluation, "mean_distance"),
        "mean_return": _field(evaluation, "mean_return"),
        **{f"{name} [SI]": value for name, value in named.items()},
        **{f"violation of {name} [SI]": trial.violations.get(name) for name in config.constraints},
        "qp_success_rate": _field(qp, "success_rate"),
        "qp_mean_distance [m]": _field(qp, "mean_distance"),
        "training_steps": trial.training_steps,
        "seconds": round(trial.seconds, 3),
        "cpu_seconds": round(trial.cpu_seconds, 3),
        "sampler_seed": trial.sampler_seed,
        "reason": trial.reason or config.violations_text(trial.values, config.constraints) or None,
    }


def _test_row(group: TestGroup, body: BodyResult, units: Mapping[str, str]) -> dict[str, Any]:
    mean = group.mean if group.error is None else None
    return {
        "trial": group.trial,
        "role": body.role,
        **{f"{name} [{units[name]}]": value for name, value in {**body.design, **body.options}.items()},
        "agent": group.agent,
        "backend": group.backend,
        "goals": group.goals,
        "success_rate": _field(mean, "success_rate"),
        "mean_distance [m]": _field(mean, "mean_distance"),
        "worst_distance [m]": None if mean is None else group.worst_distance,
        "mean_return": _field(mean, "mean_return"),
        "mean_effort": _field(mean, "mean_effort"),
        "steps": _field(mean, "steps"),
        "error": group.error,
    }
