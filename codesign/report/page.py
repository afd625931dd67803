"""The report of a study: one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from markupsafe import Markup

from softgym_envs.codesign.objectives import Objective
from softgym_envs.codesign.report import interactive, plots, tables
from softgym_envs.codesign.report.collect import FEW_GOALS
from softgym_envs.codesign.report.episodes import Episode, run_episodes
from softgym_envs.codesign.report.exports import Download, write_exports
from softgym_envs.codesign.report.files import write_results
from softgym_envs.codesign.report.findings import findings
from softgym_envs.codesign.report.results import Comparison, StudyResults
from softgym_envs.codesign.report.statistics import MIN_GOALS, MeshPart, kendall_tau, rank_correlation
from softgym_envs.codesign.report.tables import BACKENDS, SHOWN_ALWAYS, percent
from softgym_envs.codesign.report.units import present
from softgym_envs.codesign.snapshot import StudySnapshot, load_study
from softgym_envs.errors import SoftGymError
from softgym_envs.robots.base import Robot
from softgym_envs.storage import atomic_write

CONTROLLERS = {
    "warm_start": "a policy fine-tuned in each trial from a shared policy",
    "scratch": "a policy trained from scratch in each trial",
    "policy": "a shared policy: one for all bodies, which also reads the design",
    "critic": "a shared policy, trained together with bodies that its critic proposes",
    "distribution": "a shared policy, trained together with a distribution of bodies",
    "qp": "inverse QP on the condensed model, no training",
}
IMAGE_SIZE = (420, 420)


def write_report(folder: str | Path) -> Path:
    """Write ``report.html`` and the tables of results of a study, finished or not, and return the path of the report.

    Raises:
        DataError: if the folder holds no study.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    snapshot = load_study(folder)
    results = write_results(snapshot)
    episodes, failed = [], ""
    try:
        episodes = run_episodes(snapshot, results)
    except SoftGymError as error:  # the report is useful without them
        failed = f"The episodes of baseline and winner cannot be shown: {error}"
    downloads, missing = write_exports(snapshot, results, episodes)
    film = next((file for file in downloads if file.name.endswith(".gif")), None)
    templates = FileSystemLoader(Path(__file__).parent / "templates")
    environment = Environment(
        loader=templates, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    text = environment.get_template("report.html.j2").render(
        **_context(snapshot, results, episodes),
        downloads=downloads,
        not_written=[*missing, failed] if failed else missing,
        film=_source(film),
    )
    path = snapshot.folder.path / "report.html"
    with atomic_write(path, "w") as stream:
        stream.write(text)
    return path


def _context(snapshot: StudySnapshot, results: StudyResults, episodes: Sequence[Episode]) -> dict[str, Any]:
    config = snapshot.config
    outcomes = interactive.goal_outcomes(snapshot, results)
    complete = any(trial.state == "complete" for trial in snapshot.trials)
    return {
        "r": results,
        "headline": _headline(snapshot, results),
        "findings": findings(snapshot, results),
        "plotly": Markup(interactive.plotly_code()),
        "comparison_goals": results.comparison[0].goals if results.comparison else 0,
        "radius": config.distance_scale.limit_text(results.success_distance),
        "measure": config.distance.label.lower(),
        "goal_legend": outcomes.legend if outcomes else [],
        "end_legend": plots.COLOURS,
        "goal_views": []
        if outcomes is None
        else [Markup(interactive.html(figure, f"goals-{plane}")) for plane, figure in interactive.goal_views(outcomes)],
        "motion": Markup(interactive.html(interactive.motion(episodes, outcomes), "motion")) if episodes else "",
        "episode": _episode_text(episodes),
        "tiles": _tiles(snapshot, results),
        "question": _question(snapshot, results),
        **_pictures(snapshot, results),
        "design": [tables.design_row(variable) for variable in results.variables],
        "comparison_columns": tables.comparison_columns(config),
        "comparison": [tables.comparison_row(row, config) for row in results.comparison],
        "goals_note": "The goals are those of the search, because the task has no others."
        if _same_goals(snapshot)
        else "These goals were used neither to train the controllers nor to choose the winner.",
        "no_comparison": results.no_winner or _untested(snapshot, results),
        "mesh_note": _mesh_note(snapshot, results),
        "interval_note": _interval_note(snapshot, results),
        "figures": {
            "reached": plots.reached(snapshot, results),
            "transfer": plots.transfer(snapshot, results),
        },
        "interactive": _interactive(snapshot, results) if complete else [],
        "search": _search(snapshot, results) if complete else [],
        "search_notes": _search_notes(snapshot, results),
        "transfer": [tables.transfer_row(row, config.shown_objectives[row.objective]) for row in results.transfer],
        **tables.finalist_table(snapshot, results),
        **tables.trial_table(snapshot, results),
        "cost": tables.cost_rows(results.cost),
        "rerun": _rerun(snapshot, results),
        "config": yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False),
    }


def _same_goals(snapshot: StudySnapshot) -> bool:
    """Return whether the task has one path, so that the final test uses the goals of the search."""
    return np.array_equal(snapshot.folder.goals["unseen"], snapshot.folder.goals["selection"])


def _headline(snapshot: StudySnapshot, results: StudyResults) -> str:
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
        return f"Trial {winner.trial} scored best. There is no comparison: {_untested(snapshot, results)}."
    row, measure = results.comparison[0], snapshot.config.distance
    scale = snapshot.config.distance_scale
    sentences = [
        _finding(snapshot, row),
        f"On {BACKENDS[row.backend]}, with {'its own policy' if row.agent == 'policy' else 'the inverse QP'}, its "
        f"{measure.label.lower()} over {row.goals} test goals is {measure.text(row.winner.mean_distance)} instead of "
        f"{measure.text(row.baseline.mean_distance)} (difference {measure.text(row.distance_change, '+')}"
        f"{_interval(row.distance_change_interval, measure, row.distance_mesh)}). It reaches "
        f"{percent(row.winner.success_rate)} of the goals with a final {scale.name} of at most "
        f"{scale.limit_text(results.success_distance)}, the baseline {percent(row.baseline.success_rate)}.",
        results.few_goals,
    ]
    return " ".join(sentence for sentence in sentences if sentence)


def _untested(snapshot: StudySnapshot, results: StudyResults) -> str:
    """Return why baseline and winner are not compared."""
    baseline, failed = results.baseline, snapshot.failures
    if baseline is not None and baseline.trial in failed:
        return f"the baseline cannot be simulated on FEM ({failed[baseline.trial]})"
    return "the tests of winner and baseline are not finished"


def _interval(interval: tuple[float, float] | None, measure: Objective, mesh: MeshPart | None = None) -> str:
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


def _tiles(snapshot: StudySnapshot, results: StudyResults) -> list[dict[str, str]]:
    """Return the key figures: the objective first."""
    objective, tiles = snapshot.objective, []

    def add(value: str, label: str) -> None:
        tiles.append({"value": value, "label": label})

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
        label = f"rank correlation of surrogate and FEM, {len(transfer[0].trials)} bodies"
        add(f"{transfer[0].spearman:.2f}", label)
    cpu = sum(results.cost.cpu_seconds.values())
    add(f"{cpu / 60:.1f} min", f"CPU time for {results.trials['requested']} bodies")
    return tiles


def _question(snapshot: StudySnapshot, results: StudyResults) -> list[tuple[str, str]]:
    config, objective = snapshot.config, snapshot.objective
    optimised = [variable for variable in results.variables if variable.optimised]
    ranges = "; ".join(
        f"{v.name.replace('_', ' ')} from {present(v.low, v.unit)} to {present(v.high, v.unit)}" for v in optimised
    )
    direction = "as large as possible" if objective.maximize else "as small as possible"
    count, unseen = len(snapshot.folder.goals["selection"]), len(snapshot.folder.goals["unseen"])
    others = f"{unseen} others for the final test"
    if _same_goals(snapshot):
        others = "the task has only one path, so the final test uses the same"
    done = ", ".join(f"{results.trials[s]} {s}" for s in ("complete", "pruned", "infeasible"))
    backend = BACKENDS.get(config.environment.backend, config.environment.backend)
    scale = config.distance_scale
    reached = f"a final {scale.name} of at most {scale.limit_text(results.success_distance)}"
    rows = [
        ("Task", f"{results.environment}; success is {reached}"),
        ("Body", f"{len(optimised)} variables: {ranges}"),
        ("Objective", f"{objective.axis_inside} on {count} goals, {direction}"),
    ]
    if config.constraints:
        texts = (config.objectives[name].constraint_text(limit) for name, limit in config.constraints.items())
        satisfied = f"{results.trials['feasible']} of {results.trials['complete']} complete trials satisfy them"
        rows.append(("Constraints", f"{'; '.join(texts)}; {satisfied}"))
    if config.secondary_objectives:
        labels = ", ".join(config.objectives[name].axis_inside for name in config.secondary_objectives)
        rows.append(("Secondary objectives", f"{labels}; {len(results.pareto)} bodies on the Pareto front"))
    rows += [
        ("Physics", f"{backend} in the search; {_tested(snapshot)}"),
        ("Controller", CONTROLLERS[config.strategy]),
        ("Goals", f"{_origin_of_goals(snapshot)}; {others}"),
        ("Budget", f"{config.trials} bodies ({done})"),
    ]
    if config.plan.trains:
        rows.append(("Training", f"{config.training.steps:,} environment steps in each trial"))
    if config.plan.proposer:
        rows.append(("Training", f"{config.joint.steps:,} environment steps on many bodies, none in the trials"))
    rows.append(("Search", f"sampler {config.sampler.name}, pruner {config.pruner.name}"))
    if (screen := config.screen).enabled:
        scored = f"{screen.candidates} bodies on {screen.goals} goals"
        rows.append(("Screen", f"before the search, the inverse QP scored {scored}; {screen.kept} became trials"))
    if config.finalists.seeds:
        steps = config.finalists.steps or config.training.steps
        rows.append(("Final test", f"{config.finalists.seeds} policies trained anew for each body, {steps:,} steps"))
    return rows


def _tested(snapshot: StudySnapshot) -> str:
    """Return on which physics the finalists are tested."""
    finalists = snapshot.config.finalists
    text = "FEM in the test"
    if finalists.test == "ends":
        text += (
            ", where episodes end: from the command at which an episode on the surrogate ends the inverse QP settles, "
            f"and a policy takes {finalists.last_steps} more steps"
        )
    if (finer := finalists.refinement) is not None:
        options = ", ".join(f"{name} = {value}" for name, value in finer.robot_options.items())
        text += f"; baseline and winner also on a finer mesh ({options})"
    return text


def _mesh_note(snapshot: StudySnapshot, results: StudyResults) -> str:
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
        f"“With the mesh” adds what is left of the mesh's error: the change on {mesh.goals} goals{kinds} on both "
        "meshes, extrapolated linearly to elements of size zero (those of the finer mesh are "
        f"{mesh.ratio:.2f} times as large), would be {measure.text(mesh.left, '+')} more ({low} to {high})."
    )
    motions = [test.last_motion for test in results.tests if test.last_motion is not None]
    if motions:
        note += f" The last step of a policy moved the effector by at most {1e3 * max(motions):.2f} mm."
    return note


def _origin_of_goals(snapshot: StudySnapshot) -> str:
    config, goals = snapshot.config, snapshot.config.goals
    if goals.source == "family":
        vary = ", ".join(config.variables if goals.vary is None else goals.vary).replace("_", " ")
        low = f" above {100 * goals.command_low:.0f} % of their range" if goals.command_low else ""
        return f"effector positions of random bodies ({vary} vary) under random commands{low}, the same for every body"
    if goals.zone is not None:
        center = ", ".join(f"{1e3 * v:g}" for v in goals.zone.center)
        half = ", ".join(f"{1e3 * v:g}" for v in goals.zone.half_size)
        return f"spread over a work zone around ({center}) mm, half size ({half}) mm, the same for every body"
    return "drawn by the task for the baseline body, the same for every body"


def _poses(snapshot: StudySnapshot) -> list[tuple[str, np.ndarray | None]]:
    """Return captions and commands (n_a,) of the pictures."""
    robot = snapshot.config.robot
    half = 0.5 * robot.upper
    poses: list[tuple[str, np.ndarray | None]] = [("at rest", None), ("all actuators at 50 %", half)]
    if len(half) > 1:
        first = np.zeros_like(half)
        first[0] = half[0]
        poses.append(("first actuator at 50 %", first))
    return poses


def _pictures(snapshot: StudySnapshot, results: StudyResults) -> dict[str, Any]:
    """Return pictures of baseline and winner in each pose and both over each other, or why there are none."""
    bodies = {"baseline": snapshot.config.baseline}
    if results.winner is not None:
        bodies["winner"] = results.winner.design
    poses = _poses(snapshot)
    context: dict[str, Any] = {"poses": [name for name, _ in poses], "pictures": [], "overlay": None, "no_pictures": ""}
    try:
        context["pictures"], shapes = _photographs(snapshot.config.robot, bodies, poses)
        context["overlay"] = plots.overlay(shapes)
    except Exception as error:  # pictures need a working OpenGL, a report does not
        context["no_pictures"] = f"No pictures: {type(error).__name__}: {error}"
    return context


def _photographs(
    robot: Robot, bodies: Mapping[str, dict[str, float]], poses: Sequence[tuple[str, np.ndarray | None]]
) -> tuple[list[tuple[str, list[str]]], list[tuple[str, dict[str, Any]]]]:
    """Return the pictures of each body, and what `plots.overlay` draws: all bodies in the first two poses."""
    from softgym_envs.viewer.image import ImageRenderer
    from softgym_envs.viewer.surface import BodySurface

    renderer = ImageRenderer(robot, IMAGE_SIZE)
    pictures: list[tuple[str, list[str]]] = []
    shapes: list[tuple[str, dict[str, Any]]] = [(caption, {}) for caption, _ in poses[:2]]
    try:
        for role, body in bodies.items():
            pictures.append((role, []))
            surface = BodySurface(renderer.shapes.load(body))
            for index, (_, command) in enumerate(poses):
                pictures[-1][1].append(plots.picture(renderer.render_body(body, command)))
                if index < len(shapes):  # the renderer has just found this shape: asking for it again costs nothing
                    points = surface.points(renderer.shapes.at(body, command))
                    shapes[index][1][role] = (points, surface.triangles, renderer.shapes.state.effector)
    finally:
        renderer.close()
    return pictures, shapes


def _interval_note(snapshot: StudySnapshot, results: StudyResults) -> str:
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


def _search(snapshot: StudySnapshot, results: StudyResults) -> list[tuple[str, str]]:
    figures = (
        ("Learning in the trials", plots.curves),
        ("Learning of the finalists, each with several seeds", plots.finalist_curves),
        ("Bodies and their objective", plots.parallel),
        ("Which variables matter", lambda _, results: plots.importance(results)),
        ("The inverse QP as a predictor of the trained controller", plots.screen),
    )
    drawn = ((title, draw(snapshot, results)) for title, draw in figures)
    return [(title, image) for title, image in drawn if image is not None]


def _interactive(snapshot: StudySnapshot, results: StudyResults) -> list[tuple[str, Markup]]:
    figures = (
        ("Every trial, and the best so far", "history", interactive.history),
        ("The objective along each variable", "slices", interactive.slices),
        ("Several objectives", "pareto", interactive.pareto),
    )
    drawn = ((title, name, draw(snapshot, results)) for title, name, draw in figures)
    return [(title, Markup(interactive.html(figure, name))) for title, name, figure in drawn if figure is not None]


def _source(film: Download | None) -> str:
    """Return the source of an image element."""
    return "" if film is None else film.href.replace("data:application/octet-stream", "data:image/gif")


def _episode_text(episodes: Sequence[Episode]) -> str:
    """Return what the animation shows."""
    if not episodes:
        return ""
    ends = " and ".join(f"{episode.distance_text(-1)} for the {episode.role}" for episode in episodes)
    text = (
        f"Computed with finite elements at a typical goal, where the winner gains the median of all goals: "
        f"{episodes[-1].goal_text}. The {episodes[-1].task.distance_scale.name} at the end is {ends}."
    )
    if all(reward is None for reward in episodes[-1].rewards):
        text += f" The {len(episodes[-1].states)} moments have the commands of an episode on the surrogate."
    return text


def _search_notes(snapshot: StudySnapshot, results: StudyResults) -> list[str]:
    notes = []
    own = [t for t in snapshot.trials if t.state == "complete" and t.controller != "qp"]
    name, joint = snapshot.objective.name, "the policy that all trainings start from"
    for judge, field in (("the inverse QP", "qp_value"), (joint, "judge_value")):
        both = [t for t in own if getattr(t, field) is not None]
        scores = [getattr(t, field) for t in both], [t.values[name] for t in both]
        spearman, kendall = rank_correlation(*scores), kendall_tau(*scores)
        if spearman is not None and kendall is not None:
            notes.append(
                f"Rank correlation between {judge} and the controllers of the trials over {len(both)} bodies: "
                f"{spearman:.2f} (Spearman), {kendall:.2f} (Kendall's tau)."
            )
    if results.importance:
        notes.append(
            "Importance by PED-ANOVA: how differently the best quarter of the bodies and all bodies are distributed "
            "along a variable. With few trials this is only a hint."
        )
    return notes


def _rerun(snapshot: StudySnapshot, results: StudyResults) -> list[tuple[str, str]]:
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
