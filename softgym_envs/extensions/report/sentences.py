"""What a report says in words: headline, key figures, question, and notes on the tests and the search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softgym_envs.codesign.collect import FEW_GOALS
from softgym_envs.codesign.metrics.metric import Metric
from softgym_envs.codesign.results import Comparison, StudyResults
from softgym_envs.codesign.snapshot import StudySnapshot
from softgym_envs.codesign.statistics import MIN_GOALS, MeshPart, kendall_tau, rank_correlation
from softgym_envs.extensions.report.episodes import Episode
from softgym_envs.extensions.report.tables import BACKENDS, SHOWN_ALWAYS, percent
from softgym_envs.units import present
from softgym_envs.wording import counted, decimal, time_text

CONTROLLERS = {
    "warm_start": "a policy fine-tuned in each trial from a shared policy",
    "scratch": "a policy trained from scratch in each trial",
    "policy": "a shared policy: one for all bodies, which also reads the design",
    "qp": "inverse QP on the condensed model, no training",
}
"""What a strategy trains, in words."""


@dataclass(frozen=True)
class KeyFigure:
    """A number of the report, and what it is."""

    value: str
    label: str


def headline(snapshot: StudySnapshot, results: StudyResults) -> str:
    """Return the finding in a few sentences."""
    baseline, winner = results.baseline, results.winner
    if winner is None:
        return f"The study has no winner: {results.no_winner}."
    if baseline is None:
        return "The baseline body is infeasible, so there is nothing to compare the winner with."
    if winner.trial == baseline.trial:
        failed = snapshot.failures
        wins = "No body scores better than the baseline" if not failed else "No better body can be simulated on FEM"
        return f"{wins}, so the baseline itself wins."
    if not results.comparison:
        return f"Trial {winner.trial} scored best. There is no comparison: {why_untested(snapshot, results)}."
    row, measure = results.comparison[0], snapshot.config.distance
    scale, rate = snapshot.config.distance_scale, snapshot.config.shown_objectives["success_rate"]
    sentences = [
        _finding(snapshot, row),
        f"On {BACKENDS[row.backend]}, with {'its own policy' if row.agent == 'policy' else 'the inverse QP'}, its "
        f"{measure.label.lower()} over {counted(row.goals, 'test goal')} is "
        f"{measure.text(row.winner.mean_distance)} instead of {measure.text(row.baseline.mean_distance)} "
        f"(difference {measure.text(row.distance_change, '+')}"
        f"{_interval(row.distance_change_interval, measure, row.distance_mesh)}). It reaches "
        f"{percent(row.winner.success_rate)} of the goals with a final {scale.name} of at most "
        f"{scale.limit_text(results.success_distance)}, the baseline {percent(row.baseline.success_rate)} "
        f"(difference {rate.text(row.success_change, '+')}{_interval(row.success_change_interval, rate)}).",
        results.few_goals,
    ]
    return " ".join(sentence for sentence in sentences if sentence)


def why_untested(snapshot: StudySnapshot, results: StudyResults) -> str:
    """Return why baseline and winner are not compared."""
    baseline, failed = results.baseline, snapshot.failures
    if baseline is not None and baseline.trial in failed:
        return f"the baseline cannot be simulated on FEM ({failed[baseline.trial]})"
    return "the tests of winner and baseline are not finished"


def _interval(interval: tuple[float, float] | None, measure: Metric, mesh: MeshPart | None = None) -> str:
    if interval is None:
        return ""
    low, high = (measure.number(end, "+") for end in sorted(interval))
    text = f", 95 % interval {low} to {high}"
    if mesh is None or mesh.interval is None:
        return text
    low, high = (measure.number(end, "+") for end in sorted(mesh.interval))
    return f"{text}, with the error of the mesh {low} to {high}"


def _finding(snapshot: StudySnapshot, row: Comparison) -> str:
    """Return whether the winner is better, and by how much in an objective other than distance and success."""
    objective, interval, mesh = snapshot.objective, row.objective_change_interval, row.objective_mesh
    whole = interval if mesh is None or mesh.interval is None else mesh.interval
    low, high = sorted(objective.sign * value for value in whole or (0.0, 0.0))
    if row.goals < FEW_GOALS:
        finding = "The optimised body scored better than the baseline in the search"
    elif low > 0.0:
        finding = "The optimised body is better than the baseline"
    elif high < 0.0:
        finding = "The optimised body is worse than the baseline"
    else:
        finding = "The test shows no certain difference between the optimised body and the baseline"
    if objective.name == "mean_distance":
        return f"{finding}."
    before, after = objective.text(row.baseline.objective), objective.text(row.winner.objective)
    change = f"change {objective.text(row.objective_change, '+')}{_interval(interval, objective, mesh)}"
    return f"{finding}. Its {objective.label.lower()} in the test is {after} instead of {before} ({change})."


def key_figures(snapshot: StudySnapshot, results: StudyResults) -> list[KeyFigure]:
    """Return the key figures: the objective first."""
    objective = snapshot.objective
    figures: list[KeyFigure] = []

    def add(value: str, label: str) -> None:
        figures.append(KeyFigure(value, label))

    if results.comparison:
        row = results.comparison[0]
        where = f"on {BACKENDS[row.backend]}, baseline to winner"
        before, after = row.baseline, row.winner
        if objective.name not in SHOWN_ALWAYS:
            add(
                f"{objective.number(before.objective)} → {objective.text(after.objective)}",
                f"{objective.label.lower()} {where}",
            )
        measure = snapshot.config.distance
        values = f"{measure.number(before.mean_distance)} → {measure.text(after.mean_distance)}"
        add(values, f"{measure.label.lower()} {where}")
        add(f"{100 * before.success_rate:.0f} → {100 * after.success_rate:.0f} %", f"test goals reached {where}")
    if results.constraints:
        label = f"complete trials that satisfy all constraints, of {results.trials['complete']}"
        add(f"{results.trials['feasible']}", label)
    transfer = [row for row in results.transfer if row.objective == objective.name]
    if transfer and transfer[0].spearman is not None:
        label = f"rank correlation of surrogate and FEM, {counted(len(transfer[0].trials), 'body')}"
        add(f"{transfer[0].spearman:.2f}", label)
    tested = " and the final test" if results.cost.cpu_seconds.get("finalists") else ""
    spent = time_text(sum(results.cost.cpu_seconds.values()))
    add(spent, f"CPU time for {counted(results.bodies, 'body')}{tested}")
    return figures


def question(snapshot: StudySnapshot, results: StudyResults) -> list[tuple[str, str]]:
    """Return what the study asks and how it answers, as pairs of a heading and a text."""
    return [*_problem(snapshot, results), *_method(snapshot, results)]


def _problem(snapshot: StudySnapshot, results: StudyResults) -> list[tuple[str, str]]:
    """Return task, body, objectives and constraints."""
    config, objective, scale = snapshot.config, snapshot.objective, snapshot.config.distance_scale
    optimised = [variable for variable in results.variables if variable.optimised]
    ranges = "; ".join(
        f"{v.name.replace('_', ' ')} from {present(v.low, v.unit)} to {present(v.high, v.unit)}" for v in optimised
    )
    direction = "as large as possible" if objective.maximize else "as small as possible"
    reached = f"a final {scale.name} of at most {scale.limit_text(results.success_distance)}"
    count = len(snapshot.folder.goals["selection"])
    rows = [
        ("Task", f"{results.environment}; success is {reached}"),
        ("Body", f"{counted(len(optimised), 'variable')}: {ranges}"),
        ("Objective", f"{objective.axis_inside} on {counted(count, 'goal')}, {direction}"),
    ]
    if config.constraints:
        texts = (config.objectives[name].constraint_text(limit) for name, limit in config.constraints.items())
        complete = counted(results.trials["complete"], "complete trial")
        satisfied = f"{results.trials['feasible']} of {complete} satisfy them"
        rows.append(("Constraints", f"{'; '.join(texts)}; {satisfied}"))
    if config.secondary_objectives:
        labels = ", ".join(config.objectives[name].axis_inside for name in config.secondary_objectives)
        rows.append(("Secondary objectives", f"{labels}; {counted(len(results.pareto), 'body')} on the Pareto front"))
    return rows


def _method(snapshot: StudySnapshot, results: StudyResults) -> list[tuple[str, str]]:
    """Return physics, controller, goals and budget of search and test."""
    config = snapshot.config
    if _uses_goals_of_search(snapshot):
        others = "the task has only one path, so the final test uses the same"
    else:
        others = f"{counted(len(snapshot.folder.goals['unseen']), 'other')} for the final test"
    done = ", ".join(f"{results.trials[s]} {s}" for s in ("complete", "pruned", "infeasible"))
    backend = BACKENDS.get(config.environment.backend, config.environment.backend)
    rows = [
        ("Physics", f"{backend} in the search; {_tested(snapshot)}"),
        ("Controller", CONTROLLERS[config.strategy]),
        ("Goals", f"{_origin_of_goals(snapshot)}; {others}"),
        ("Budget", f"{counted(max(config.trials, results.bodies), 'body')} ({done})"),
    ]
    if config.plan.trains:
        rows.append(("Training", f"{config.training.steps:,} environment steps in each trial"))
    rows.append(("Search", f"sampler {config.sampler.name}, pruner {config.pruner.name}"))
    if (screen := config.screen).enabled:
        scored = f"{counted(screen.candidates, 'body')} on {counted(screen.goals, 'goal')}"
        kept = "one of them became a trial" if screen.kept == 1 else f"{screen.kept} of them became trials"
        rows.append(("Screen", f"before the search, the inverse QP scored {scored}; {kept}"))
    if config.finalists.seeds:
        steps = config.finalists.steps or config.training.steps
        policies = counted(config.finalists.seeds, "policy")
        rows.append(("Final test", f"{policies} trained anew for each body, {steps:,} steps"))
    return rows


def _uses_goals_of_search(snapshot: StudySnapshot) -> bool:
    """Return whether the final test uses the goals of the search, because the task has one path."""
    return np.array_equal(snapshot.folder.goals["unseen"], snapshot.folder.goals["selection"])


def goals_note(snapshot: StudySnapshot) -> str:
    """Return whether the test goals are new to controllers and winner."""
    if _uses_goals_of_search(snapshot):
        return "The goals are those of the search, because the task has no others."
    return "These goals were used neither to train the controllers nor to choose the winner."


def _tested(snapshot: StudySnapshot) -> str:
    """Return on which physics the finalists are tested."""
    finalists = snapshot.config.finalists
    text = "FEM in the test"
    if finalists.test == "ends":
        text += (
            ", where episodes end: from the last command of an episode on the surrogate, the inverse QP goes on until "
            f"it settles, a policy for {counted(finalists.last_steps, 'step')}"
        )
    if (finer := finalists.refinement) is not None:
        options = ", ".join(f"{name} = {value}" for name, value in finer.robot_options.items())
        if any(isinstance(value, float) for value in finer.robot_options.values()):
            options += " in SI units"
        text += f"; baseline and winner also on a finer mesh ({options})"
    return text


def _origin_of_goals(snapshot: StudySnapshot) -> str:
    """Return where the goals come from."""
    config, goals = snapshot.config, snapshot.config.goals
    if goals.source == "family":
        vary = ", ".join(config.variables if goals.vary is None else goals.vary).replace("_", " ")
        low = f" above {100 * goals.command_low:.0f} % of their range" if goals.command_low else ""
        return f"effector positions of random bodies (varied: {vary}) under random commands{low}, equal for all bodies"
    if goals.zone is not None:
        center = ", ".join(f"{1e3 * v:g}" for v in goals.zone.center)
        half = ", ".join(f"{1e3 * v:g}" for v in goals.zone.half_size)
        return f"spread over a work zone around ({center}) mm, half size ({half}) mm, the same for every body"
    return "drawn by the task for the baseline body, the same for every body"


def effort_note(snapshot: StudySnapshot) -> str:
    """Return over what the efforts of the test are means, and of what they are the largest."""
    note = (
        "Means are over actuators, steps and goals; the largest is that of any actuator in any step. The strain of a "
        "drive is its displacement over the length of its cable or the volume of its chamber at rest; self-contact is "
        "the force with which surfaces of the body press on each other."
    )
    if len({actuator.unit for actuator in snapshot.config.robot.actuators}) > 1:
        note += " Actuators of several units are compared by their typical efforts (effort_scale)."
    if snapshot.config.finalists.test == "ends":
        note += " On FEM, they are those at the ends of the episodes."
    return note


def mesh_note(snapshot: StudySnapshot, results: StudyResults) -> str:
    """Return how the intervals contain the error of the mesh; empty without a finer mesh."""
    row = next((row for row in results.comparison if row.distance_mesh is not None), None)
    if row is None or row.distance_mesh is None:
        return ""
    mesh, measure = row.distance_mesh, snapshot.config.distance
    low, high = (measure.number(end, "+") for end in mesh.left_interval)
    finer = snapshot.config.finalists.refinement
    kinds = (
        ", about half of them missed by the baseline, weighted by their share of all,"
        if (finer is not None and finer.choose == "missed")
        else ""
    )
    note = (
        f"“With the mesh” adds what is left of the mesh's error: the change on {counted(mesh.goals, 'goal')}{kinds} on "
        "both meshes, extrapolated linearly to elements of size zero (those of the finer mesh are "
        f"{mesh.ratio:.2f} times as large), would be {measure.text(mesh.left, '+')} more ({low} to {high})."
    )
    motions = [test.last_motion for test in results.tests if test.last_motion is not None]
    if motions:
        note += f" The last step of a policy moved the effector by at most {decimal(1e3 * max(motions), 2)} mm."
    return note


def interval_note(snapshot: StudySnapshot, results: StudyResults) -> str:
    """Return what the intervals of the comparison include, or why there are none."""
    if results.comparison and results.comparison[0].goals < MIN_GOALS:
        return f"{results.few_goals} There are no intervals with fewer than {MIN_GOALS} goals."
    seeds = snapshot.config.finalists.seeds
    note = "Intervals of 95 % are Student's for means and differences, and Wilson's for rates"
    if seeds > 1:
        note += (
            f". For policies they are over goals and over {seeds} trainings of each body, each with its own seed; "
            "for the inverse QP over goals."
        )
    else:
        note += ", over goals, for the controllers as trained: they do not include the effect of another training seed."
    return f"{note} If a few goals dominate the mean, they cover less than 95 %: 75 % with a dozen goals."


def episode_text(episodes: Sequence[Episode]) -> str:
    """Return what the animation shows."""
    if not episodes:
        return ""
    ends = " and ".join(f"{episode.distance_text(-1)} for the {episode.role}" for episode in episodes)
    text = (
        f"Computed with finite elements at a typical goal: {episodes[-1].goal_text}. There the winner gains the median "
        f"of the goals that the baseline misses, or of all goals if it misses none. "
        f"The {episodes[-1].task.distance_scale.name} at the end is {ends}."
    )
    if all(reward is None for reward in episodes[-1].rewards):
        text += f" The {len(episodes[-1].states)} moments have the commands of an episode on the surrogate."
    return text


def search_notes(snapshot: StudySnapshot, results: StudyResults) -> list[str]:
    """Return how well cheaper judges predict the trials, and what the importance of variables means."""
    notes = []
    own = [t for t in snapshot.trials if t.state == "complete" and t.controller != "qp"]
    name, joint = snapshot.objective.name, "the policy that all trainings start from"
    for judge, field in (("the inverse QP", "qp_value"), (joint, "judge_value")):
        both = [t for t in own if getattr(t, field) is not None]
        scores = [getattr(t, field) for t in both], [t.values[name] for t in both]
        spearman, kendall = rank_correlation(*scores), kendall_tau(*scores)
        if spearman is not None and kendall is not None:
            notes.append(
                f"Rank correlation between {judge} and the controllers of the trials over "
                f"{counted(len(both), 'body')}: {spearman:.2f} (Spearman), {kendall:.2f} (Kendall's tau)."
            )
    if results.importance:
        notes.append(
            "Importance by PED-ANOVA: how differently the best quarter of the bodies and all bodies are distributed "
            "along a variable. With few trials this is only a hint."
        )
    return notes


def rerun(snapshot: StudySnapshot, results: StudyResults) -> list[tuple[str, str]]:
    """Return what decides the outcome of another run, as pairs of a heading and a text."""
    config, made = snapshot.config, results.provenance
    rows = [("Seeds", f"sampler {config.sampler.seed}, goals {config.goals.seed}, training {config.training.seed}")]
    if config.policy:
        rows.append(("Policy", config.policy))
    return [
        *rows,
        ("Workers", f"{config.workers}; with several, the bodies that the sampler proposes depend on their timing"),
        ("Commit", made["commit"] or "not in a git repository"),
        ("Versions", ", ".join(f"{name} {version}" for name, version in made["versions"].items())),
        ("Machine", made["platform"]),
    ]
