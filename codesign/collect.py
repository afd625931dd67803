"""Gathering the results of a study from its snapshot."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from softgym_envs.agents.evaluation import none_for_nan
from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.goals import Stratum
from softgym_envs.codesign.metrics.metric import Metric
from softgym_envs.codesign.records import REFINED, Finalist, TestGroup
from softgym_envs.codesign.results import (
    BodyStatistics,
    Comparison,
    Cost,
    StudyResults,
    Transfer,
    VariableResult,
)
from softgym_envs.codesign.snapshot import StudySnapshot
from softgym_envs.codesign.statistics import (
    Interval,
    MeshPart,
    mean_interval,
    mesh_part,
    rank_correlation,
    rate_interval,
)
from softgym_envs.wording import counted

FEW_GOALS = 10
"""With fewer test goals a difference may well be chance."""


def collect(snapshot: StudySnapshot) -> StudyResults:
    """Gather the results of a study, finished or not."""
    config, winner, baseline = snapshot.config, snapshot.winner, snapshot.baseline
    states = [trial.state for trial in snapshot.trials]
    counts = {state: states.count(state) for state in ("complete", "pruned", "infeasible")}
    comparison = _comparisons(snapshot)
    few = comparison[0].goals if comparison else FEW_GOALS
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
        baseline=baseline,
        winner=winner,
        no_winner=snapshot.verdict.reason,
        few_goals=f"Only {counted(few, 'test goal')}: the difference may be chance." if few < FEW_GOALS else "",
        comparison=comparison,
        pareto=snapshot.pareto if config.secondary_objectives else [],
        transfer=[
            row
            for objective in snapshot.config.shown_objectives.values()
            for row in _transfer(snapshot.unseen_tests, objective)
        ],
        finalists=snapshot.finalists,
        trainings=snapshot.trainings,
        tests=snapshot.tests,
        importance=_importance(snapshot),
        cost=_cost(snapshot),
        success_distance=config.success_distance,
        provenance=snapshot.folder.stamp(),
    )


def _variables(config: StudyConfig, winner: Finalist | None) -> list[VariableResult]:
    variables = {**config.space.variables, **config.optimised}
    values = {**config.baseline, **config.baseline_values}
    best = {} if winner is None else {**winner.design, **winner.options}

    return [
        VariableResult(
            name=name,
            unit=variable.unit,
            low=variable.low,
            high=variable.high,
            log=variable.log,
            description=variable.description,
            optimised=name in config.variables,
            baseline=values[name],
            winner=best.get(name),
        )
        for name, variable in variables.items()
    ]


def _comparisons(snapshot: StudySnapshot) -> list[Comparison]:
    winner, baseline = snapshot.winner, snapshot.baseline
    if winner is None or baseline is None:
        return []
    found = {group.key: group for group in snapshot.unseen_tests}
    finer = snapshot.config.finalists.refinement
    rows = []
    for backend in snapshot.config.test_backends:
        for physics in (backend, REFINED) if backend == "fem" and finer is not None else (backend,):
            for agent in winner.agents:
                before, after = (found.get((body.trial, agent, physics)) for body in (baseline, winner))
                if before is not None and after is not None:
                    rows.append(_compare(before, after, snapshot.objective))
    if finer is not None:
        dimension = 1 if snapshot.config.robot.made_of_beams else 3
        trials, strata = (baseline.trial, winner.trial), snapshot.refined_goals or []
        rows = [_with_mesh(row, found, trials, strata, finer.ratio, dimension) for row in rows]
    return rows


def _with_mesh(
    row: Comparison,
    found: Mapping[tuple[int, str, str], TestGroup],
    trials: tuple[int, int],
    strata: Sequence[Stratum],
    ratio: float | None,
    dimension: int,
) -> Comparison:
    """Return the comparison on FEM with what is left of the mesh's error, if the finer mesh was tested; else as it is.

    Args:
        row: the comparison.
        found: tests on unseen goals.
        trials: of baseline and winner.
        strata: the goals of the finer mesh.
        ratio: of the sizes of elements, or None for what follows from the unknowns.
        dimension: of the elements: with half their size there are about 2 ** dimension times as many.
    """
    tests = [[found.get((trial, row.agent, physics)) for trial in trials] for physics in ("fem", REFINED)]
    coarse, fine = ([group for group in pair if group is not None] for pair in tests)
    if row.backend != "fem" or len(coarse) < 2 or len(fine) < 2:
        return row
    if ratio is None:
        few, many = coarse[0].unknowns, fine[0].unknowns
        if few is None or many is None or few >= many:
            return row
        ratio = (few / many) ** (1.0 / dimension)

    def part(column: Callable[[TestGroup], np.ndarray | None], interval: Interval) -> MeshPart | None:
        changes = []
        for pair in (coarse, fine):
            before, after = (column(group) for group in pair)
            if before is None or after is None:
                return None
            changes.append(after.mean(axis=0) - before.mean(axis=0))
        return mesh_part(changes[0][fine[0].numbers], changes[1], ratio, interval, strata)

    return replace(
        row,
        distance_mesh=part(lambda group: group.table("distances"), row.distance_change_interval),
        objective_mesh=part(lambda group: group.objective_table, row.objective_change_interval),
    )


def _statistics(group: TestGroup, objective: Metric) -> BodyStatistics:
    mean, own = group.mean, group.objective_table
    return BodyStatistics(
        success_rate=mean.success_rate,
        success_interval=rate_interval(group.table("successes")),
        mean_distance=mean.mean_distance,
        distance_interval=mean_interval(group.table("distances")),
        worst_distance=group.worst_distance,
        mean_return=none_for_nan(mean.mean_return),
        mean_effort=mean.mean_effort,
        objective=group.value(objective.name),
        objective_interval=None if own is None else mean_interval(own),
        largest_effort=none_for_nan(group.largest_effort),
        largest_strain=none_for_nan(group.largest_strain),
        self_force=none_for_nan(group.self_force),
    )


def _compare(baseline: TestGroup, winner: TestGroup, objective: Metric) -> Comparison:
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


def _transfer(groups: list[TestGroup], objective: Metric) -> list[Transfer]:
    """Return an objective on surrogate and FEM over the finalists, for each controller."""

    def value(group: TestGroup) -> float:
        name = objective.name
        return group.value(name) if name in group.tests[0].values else float(getattr(group.mean, name))

    rows = []
    for agent in ("policy", "qp"):
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
    sign = snapshot.objective.sign
    first = (lambda trial: -sign * trial.values[0]) if snapshot.config.secondary_objectives else None
    try:
        with warnings.catch_warnings():  # it warns that it takes small values for good ones, which is what we want
            warnings.filterwarnings("ignore", "PedAnovaImportanceEvaluator computes", UserWarning)
            study = snapshot.optuna_study
            found = optuna.importance.get_param_importances(study, evaluator=evaluator, target=first)
    except (ValueError, RuntimeError):  # the trials have no quantile
        return {}
    return {name: float(value) for name, value in found.items()}


def _cost(snapshot: StudySnapshot) -> Cost:
    config, trials = snapshot.config, snapshot.trials
    screened = [result.evaluation for result in snapshot.screen if result.evaluation is not None]
    # Of all bodies that ever were finalists, not only of the present ones.
    tests, retrained = snapshot.all_tests, snapshot.all_trainings
    points = sum(len(trial.curve) for trial in trials)

    def test_steps(*backends: str) -> int:
        return sum(test.evaluation.steps for test in tests if test.backend in backends and test.evaluation is not None)

    return Cost(
        retraining_steps=sum(training.steps for training in retrained),
        retraining_report_steps=sum(training.report_steps for training in retrained),
        training_steps=sum(trial.training_steps for trial in trials),
        report_steps=points * config.training.evaluation_episodes * config.episode_steps,
        selection_steps=sum(trial.steps_of_scores for trial in trials),
        screen_steps=sum(evaluation.steps for evaluation in screened),
        test_steps_surrogate=test_steps("surrogate"),
        test_steps_fem=test_steps("fem", REFINED),
        cpu_seconds={
            "screen": sum(evaluation.cpu_seconds for evaluation in screened),
            "trials": sum(trial.cpu_seconds for trial in trials),
            "finalists": sum(test.evaluation.cpu_seconds for test in tests if test.evaluation is not None)
            + sum(training.cpu_seconds for training in retrained),
        },
        wall_seconds=snapshot.account.wall_seconds,
    )
