"""The report of a study: one HTML file for people that needs nothing beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from codesign.folder import StudyFolder
from codesign.objectives import OBJECTIVES
from codesign.report import plots
from codesign.report.exports import write_exports
from codesign.report.plots import place, present, shown_unit
from codesign.report.results import rank_correlation, write_results
from softgym_envs.storage import atomic_write

__all__ = ["write_report"]

AGENTS = {"sac": "SAC policy", "qp": "Inverse QP"}
BACKENDS = {"fem": "FEM", "surrogate": "Surrogate"}
CONTROLLERS = {
    "warm_start": "SAC, fine-tuned in each trial from one design-conditioned policy",
    "scratch": "SAC, trained from scratch in each trial",
    "policy": "SAC, one design-conditioned policy that judges every body",
    "critic": "SAC, trained together with bodies that its critic proposes, then judge of every body",
    "distribution": "SAC, trained together with a distribution of bodies, then judge of every body",
    "qp": "inverse QP on the condensed model, no training",
}
IMAGE_SIZE = (420, 420)


def write_report(folder: str | Path) -> Path:
    """Write ``report.html`` of a study, and ``results.json``, ``trials.csv`` and ``finalists.csv`` anew.

    Args:
        folder: folder of a study, finished or not.

    Returns:
        The report.

    Raises:
        DataError: if the folder holds no study.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    study = StudyFolder(folder)
    results = write_results(study)
    files, no_files = [], ""
    try:
        files = write_exports(study)
    except Exception as error:  # a report is worth having without them
        no_files = f"Not written: {type(error).__name__}: {error}"
    templates = FileSystemLoader(Path(__file__).parent / "templates")
    environment = Environment(
        loader=templates, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    text = environment.get_template("report.html.j2").render(
        {**_context(study, results), "files": files, "no_files": no_files}
    )
    path = study.path / "report.html"
    with atomic_write(path, "w") as stream:
        stream.write(text)
    return path


def _context(study: StudyFolder, results: dict[str, Any]) -> dict[str, Any]:
    trials = study.results()
    complete = any(trial["state"] == "complete" for trial in trials)
    return {
        "r": results,
        "headline": _headline(results),
        "tiles": _tiles(results),
        "question": _question(study, results),
        **_pictures(study, results),
        "design": [_design_row(variable) for variable in results["variables"]],
        "comparison": [_comparison_row(row) for row in results["comparison"]],
        "goals_note": _goals_note(study),
        "interval_note": _interval_note(study),
        "figures": {"reached": plots.reached(results), "transfer": plots.transfer(results)},
        "search": _search(trials, results) if complete else [],
        "search_notes": _search_notes(trials, results),
        "transfer": [_transfer_row(row) for row in results["transfer"] if row["objective"] != "mean_return"],
        **_finalist_table(results),
        **_trial_table(trials, results),
        "cost": _cost_rows(results["cost"]),
        "rerun": _rerun(study, results),
        "config": yaml.safe_dump(study.config.model_dump(mode="json"), sort_keys=False),
    }


def _same_goals(study: StudyFolder) -> bool:
    """The task has one path, so that the final test is on the goals of the search."""
    return np.array_equal(study.goals["unseen"], study.goals["selection"])


def _goals_note(study: StudyFolder) -> str:
    if _same_goals(study):
        return "The goals are those of the search: the task has no others."
    return "Goals that were used neither to train the controllers nor to choose the winner."


def _percent(value: float) -> str:
    return f"{100 * value:.1f} %"


def _mm(value: float, sign: str = "") -> str:
    return f"{1e3 * value:{sign}.2f} mm"


#: Fewer test goals than this prove nothing.
FEW = 10


def _headline(results: Mapping[str, Any]) -> str:
    """The finding in a sentence or two."""
    baseline, winner = results["baseline"], results["winner"]
    if winner is None:
        return (
            "The study has no winner: no trial is complete, no body keeps the limits, or no finalists were asked for."
        )
    if baseline is None:
        return "The baseline body is infeasible, so there is nothing to compare the winner with."
    if winner["trial"] == baseline["trial"]:
        return "No body was found that scores better than the baseline: the winner is the baseline itself."
    if not results["comparison"]:
        return f"Trial {winner['trial']} scored best; it was not tested on FEM yet."
    row = results["comparison"][0]
    objective = OBJECTIVES[results["objective"]]
    interval = row["objective_change_interval"]
    low, high = sorted(objective.sign * value for value in interval or (0.0, 0.0))
    if row["goals"] < FEW:
        finding = f"Test goals are too few to tell chance from a better body ({row['goals']})"
    elif low > 0.0:
        finding = "The optimised body is better than the baseline"
    elif high < 0.0:
        finding = "The optimised body is worse than the baseline"
    else:
        finding = "No difference between the optimised body and the baseline is certain"
    if objective.key != "mean_distance":
        before, after = (objective.text(objective.sign * value) for value in row["objective"])
        ends = [objective.sign * objective.shown(value) for value in interval or ()]
        finding += f" in its {objective.label.lower()}, {after} instead of {before}"
        if ends:
            finding += (
                f" (95 % interval of the change {' to '.join(f'{value:+.3g}' for value in ends)} "
                f"{objective.unit}".rstrip()
                + ")"
            )
    sure = ""
    if row["distance_change_interval"] is not None:
        low, high = row["distance_change_interval"]
        sure = f", 95 % interval {1e3 * low:+.2f} to {1e3 * high:+.2f}"
    return (
        f"{finding}: on {BACKENDS[row['backend']]}, with its own {AGENTS[row['agent']]}, it ends "
        f"{_mm(row['winner']['mean_distance'])} from {row['goals']} test goals on average instead of "
        f"{_mm(row['baseline']['mean_distance'])} (difference {_mm(row['distance_change'], '+')}{sure}), and reaches "
        f"{_percent(row['winner']['success_rate'])} of them within {1e3 * results['success_distance']:g} mm instead of "
        f"{_percent(row['baseline']['success_rate'])}."
    )


def _tiles(results: Mapping[str, Any]) -> list[dict[str, str]]:
    tiles = []
    if results["comparison"]:
        row = results["comparison"][0]
        where = f"on {BACKENDS[row['backend']]}, baseline to winner"
        before, after = row["baseline"], row["winner"]
        tiles += [
            {
                "value": f"{1e3 * before['mean_distance']:.2f} → {_mm(after['mean_distance'])}",
                "label": f"mean final distance {where}",
            },
            {
                "value": f"{100 * before['success_rate']:.0f} → {100 * after['success_rate']:.0f} %",
                "label": f"test goals reached {where}",
            },
        ]
    transfer = [row for row in results["transfer"] if row["objective"] == "mean_distance"]
    if transfer and transfer[0]["spearman"] is not None:
        tiles.append(
            {
                "value": f"{transfer[0]['spearman']:.2f}",
                "label": f"rank correlation of surrogate and FEM, {len(transfer[0]['trials'])} bodies",
            }
        )
    cpu = sum(results["cost"]["cpu_seconds"].values())
    tiles.append({"value": f"{cpu / 60:.1f} min", "label": f"CPU time for {results['trials']['asked']} bodies"})
    return tiles


def _question(study: StudyFolder, results: Mapping[str, Any]) -> list[tuple[str, str]]:
    config = study.config
    goals = config.goals
    optimised = [variable for variable in results["variables"] if variable["optimised"]]
    ranges = "; ".join(
        f"{v['name'].replace('_', ' ')} from {present(v['low'], v['unit'])} to {present(v['high'], v['unit'])}"
        for v in optimised
    )
    direction = "as small as possible" if OBJECTIVES[config.objective].sign < 0 else "as large as possible"
    if goals.source == "family":
        vary = ", ".join(config.variables if goals.vary is None else goals.vary).replace("_", " ")
        origin = (
            f"effector positions of random bodies (other {vary}) under random commands"
            + (f" above {100 * goals.command_low:.0f} % of their range" if goals.command_low else "")
            + ", the same for every body"
        )
    elif goals.zone is not None:
        center = ", ".join(f"{1e3 * v:g}" for v in goals.zone.center)
        half = ", ".join(f"{1e3 * v:g}" for v in goals.zone.half_size)
        origin = f"spread over a work zone about ({center}) mm, half size ({half}) mm, the same for every body"
    else:
        origin = "drawn as the task draws them for the baseline body, the same for every body"
    count, unseen = len(study.goals["selection"]), study.goals["unseen"]
    others = f"{len(unseen)} others for the final test"
    if _same_goals(study):
        others = "it has one path and no other, so the final test is on the same"
    done = ", ".join(f"{results['trials'][s]} {s}" for s in ("complete", "pruned", "infeasible"))
    rows = [
        ("Task", f"{config.environment.title}, success within {1e3 * results['success_distance']:g} mm at the end"),
        ("Body", f"{len(optimised)} variables: {ranges}"),
        ("Objective", f"{OBJECTIVES[config.objective].label.lower()} on {count} goals, {direction}"),
        (
            "Physics",
            f"{BACKENDS.get(config.environment.backend, config.environment.backend)} in the search, FEM in the test",
        ),
        ("Controller", CONTROLLERS[config.strategy]),
        ("Goals", f"{origin}; {others}"),
        ("Budget", f"{config.trials} bodies ({done})"),
        ("Search", f"sampler {config.sampler.name}, pruner {config.pruner.name}" + _screen_text(study)),
    ]
    if config.plan.trains:
        rows.insert(7, ("Training", f"{config.training.steps:,} environment steps a trial"))
    if config.plan.proposer:
        rows.insert(7, ("Training", f"{config.joint.steps:,} environment steps on many bodies, none in a trial"))
    if config.finalists.seeds:
        steps = config.finalists.steps or config.training.steps
        rows.append(("Final test", f"{config.finalists.seeds} policies trained anew for each body, {steps:,} steps"))
    if config.also:
        others = ", ".join(OBJECTIVES[name].label.lower() for name in config.also)
        rows.insert(3, ("Beside it", f"{others}; {len(results['pareto'])} bodies on the Pareto front"))
    if config.limits:
        limits = (
            f"{OBJECTIVES[name].label.lower()} {'at most' if OBJECTIVES[name].sign < 0 else 'at least'} "
            f"{value * OBJECTIVES[name].scale:g} {OBJECTIVES[name].unit}".rstrip()
            for name, value in config.limits.items()
        )
        rows.insert(3, ("Limits", "; ".join(limits)))
    return rows


def _screen_text(study: StudyFolder) -> str:
    screen = study.config.screen
    if not screen.enabled:
        return ""
    return (
        f"; before it, the inverse QP scored {screen.candidates} bodies on {screen.goals} goals and kept {screen.kept}"
    )


def _poses(study: StudyFolder) -> list[tuple[str, np.ndarray | None]]:
    """Captions and commands (n_a,) of the pictures."""
    robot = study.config.robot
    half = 0.5 * robot.upper
    poses: list[tuple[str, np.ndarray | None]] = [("at rest", None), ("all actuators at 50 %", half)]
    if len(half) > 1:
        first = np.zeros_like(half)
        first[0] = half[0]
        poses.append(("first actuator at 50 %", first))
    return poses


def _pictures(study: StudyFolder, results: Mapping[str, Any]) -> dict[str, Any]:
    """Pictures of baseline and winner in each pose, and their side views over each other, or why there are none."""
    bodies = {"baseline": study.config.baseline}
    if results["winner"] is not None:
        bodies["winner"] = results["winner"]["design"]
    poses = _poses(study)
    context: dict[str, Any] = {"poses": [pose for pose, _ in poses], "pictures": [], "overlay": None, "no_pictures": ""}
    try:
        context["pictures"] = _photographs(study, bodies)
        context["overlay"] = plots.overlay(_shapes(study, bodies))
    except Exception as error:  # drawing needs a working OpenGL, a report does not
        context["no_pictures"] = f"No pictures: {type(error).__name__}: {error}"
    return context


def _photographs(study: StudyFolder, bodies: Mapping[str, dict[str, float]]) -> list[tuple[str, list[str]]]:
    from softgym_envs.viewer.image import ImageRenderer

    renderer = ImageRenderer(study.config.robot, IMAGE_SIZE)
    try:
        return [
            (role, [plots.picture(renderer.render_body(body, command)) for _, command in _poses(study)])
            for role, body in bodies.items()
        ]
    finally:
        renderer.close()


def _shapes(study: StudyFolder, bodies: Mapping[str, dict[str, float]]) -> list[tuple[str, dict[str, Any]]]:
    """What `plots.overlay` draws: at rest and with all actuators at 50 %."""
    from softgym_envs.viewer.surface import BodySurface, ShapeFinder

    finder = ShapeFinder(study.config.robot)
    shapes: list[tuple[str, dict[str, Any]]] = [(caption, {}) for caption, _ in _poses(study)[:2]]
    for role, body in bodies.items():
        model = finder.load(body)
        surface = BodySurface(model)
        for (_, command), (_, drawn) in zip(_poses(study), shapes, strict=False):
            drawn[role] = (surface.shape(finder.at(body, command)), surface.faces, finder.state.effector)
    return shapes


def _design_row(variable: Mapping[str, Any]) -> dict[str, Any]:
    unit = variable["unit"]
    baseline, winner = variable["baseline"], variable["winner"]
    name, factor, decimals = shown_unit(unit)

    changed = winner is not None and winner != baseline
    return {
        "name": variable["name"].replace("_", " "),
        "optimised": variable["optimised"],
        "description": variable["description"],
        "baseline": present(baseline, unit),
        "winner": "-" if winner is None else present(winner, unit),
        "change": f"{(winner - baseline) * factor:+.{decimals}f}{' ' + name if name else ''}" if changed else "-",
        "low": present(variable["low"], unit),
        "high": present(variable["high"], unit),
        "baseline_place": round(100 * place(baseline, variable), 1),
        "winner_place": None if winner is None else round(100 * place(winner, variable), 1),
    }


def _comparison_row(row: Mapping[str, Any]) -> dict[str, Any]:
    def cell(
        value: str, interval: Sequence[float] | None, show: Callable[[float], str], better: float = 0.0
    ) -> dict[str, Any]:
        """``better``: the sign of a change for the better, 0 for what is none."""
        if interval is None:
            return {"value": value, "interval": "", "good": False}
        low, high = (show(end) for end in interval)
        return {"value": value, "interval": f"{low} to {high}", "good": min(better * end for end in interval) > 0.0}

    def rate(value: float) -> str:
        return f"{100 * value:.0f}"

    def signed_rate(value: float) -> str:
        return f"{100 * value:+.0f}"

    def length(value: float) -> str:
        return f"{1e3 * value:.2f}"

    def signed_length(value: float) -> str:
        return f"{1e3 * value:+.2f}"

    cells = []
    for role in ("baseline", "winner"):
        cells.append(cell(_percent(row[role]["success_rate"]), row[role]["success_interval"], rate))
    cells.append(cell(f"{100 * row['success_change']:+.1f} pp", row["success_change_interval"], signed_rate, 1.0))
    for role in ("baseline", "winner"):
        cells.append(cell(_mm(row[role]["mean_distance"]), row[role]["distance_interval"], length))
    cells.append(cell(_mm(row["distance_change"], "+"), row["distance_change_interval"], signed_length, -1.0))
    return {
        "backend": BACKENDS[row["backend"]],
        "agent": AGENTS[row["agent"]],
        "cells": cells,
        "closer": row["goals_closer"],
        "farther": row["goals_farther"],
    }


def _interval_note(study: StudyFolder) -> str:
    seeds = study.config.finalists.seeds
    note = "Intervals of 95 % of means and differences are Student's, of rates Wilson's"
    if seeds > 1:
        note += (
            f"; those of SAC are over goals and over {seeds} trainings for each body, with other seeds, those of the "
            "inverse QP over goals."
        )
    else:
        note += " over goals, for the controllers as trained: they do not contain the chance of another training seed."
    return f"{note} Where a few goals decide the mean they cover less than 95 %, of a dozen goals 75 %."


def _search(trials: list[dict[str, Any]], results: Mapping[str, Any]) -> list[tuple[str, str]]:
    figures = (
        ("Every trial, and the best so far", plots.history(trials, results)),
        ("Several objectives", plots.pareto(trials, results)),
        ("Learning inside the trials", plots.curves(trials, results)),
        ("Learning of the finalists, each with several seeds", plots.finalist_curves(results)),
        ("Bodies and their objective", plots.parallel(trials, results)),
        ("Which variables matter", plots.importance(results)),
        ("The inverse QP as a predictor of the trained controller", plots.screen(trials, results)),
    )
    return [(title, image) for title, image in figures if image is not None]


def _search_notes(trials: list[dict[str, Any]], results: Mapping[str, Any]) -> list[str]:
    notes = []
    objective = OBJECTIVES[results["objective"]]
    both = [t for t in trials if t["state"] == "complete" and t["agent"] != "qp"]
    correlation = rank_correlation(
        [objective.score(t["qp"]) for t in both], [objective.score(t["evaluation"]) for t in both]
    )
    if correlation is not None:
        notes.append(
            f"Rank correlation (Spearman) between the inverse QP and the trained controllers over {len(both)} bodies: "
            f"{correlation:.2f}."
        )
    if results["importance"]:
        notes.append(
            "Importance is PED-ANOVA's: how differently the best quarter of the bodies and all of them are spread "
            "along a variable. With few trials it is a hint, not a measurement."
        )
    return notes


def _transfer_row(row: Mapping[str, Any]) -> dict[str, Any]:
    objective = OBJECTIVES[row["objective"]]

    def gap(value: float, sign: str) -> str:
        shown = round(value * objective.scale, 2) + 0.0  # no negative zero
        return f"{shown:{sign}.2f} {'pp' if objective.unit == '%' else objective.unit}"

    return {
        "agent": AGENTS[row["agent"]],
        "measure": objective.label,
        "bodies": len(row["trials"]),
        "mean": gap(row["mean_gap"], "+"),
        "worst": gap(row["worst_gap"], ""),
        "spearman": "-" if row["spearman"] is None else f"{row['spearman']:.2f}",
    }


def _finalist_table(results: Mapping[str, Any]) -> dict[str, Any]:
    """Columns and rows of the table of all finalists."""
    optimised = [variable for variable in results["variables"] if variable["optimised"]]
    tests = {(r["trial"], r["agent"], r["backend"]): r for r in results["evaluations"] if r["goals"] == "unseen"}
    kinds = [(a, b) for a in AGENTS for b in BACKENDS if any(key[1:] == (a, b) for key in tests)]
    objective = OBJECTIVES[results["objective"]]
    winner = None if results["winner"] is None else results["winner"]["trial"]
    rows = []
    for body in results["finalists"]:
        cells = [(present(body["design"][v["name"]], v["unit"]), "") for v in optimised]
        cells.append((objective.text(body["score"]), ""))
        for kind in kinds:
            record = tests.get((body["trial"], *kind))
            if record is None or "error" in record:
                cells.append(("-" if record is None else "failed", ""))
            else:
                cells.append((_percent(record["success_rate"]), _mm(record["mean_distance"])))
        is_winner = body["trial"] == winner
        role = "winner" if is_winner else "baseline" if body["role"] == "baseline" else ""
        rows.append({"trial": body["trial"], "role": role, "winner": is_winner, "cells": cells})
    columns = [v["name"].replace("_", " ") for v in optimised] + [f"{objective.label} in search"]
    columns += [f"{AGENTS[agent]}, {BACKENDS[backend]}" for agent, backend in kinds]
    return {"finalist_columns": columns, "finalists": rows}


def _trial_table(trials: list[dict[str, Any]], results: Mapping[str, Any]) -> dict[str, Any]:
    optimised = [variable for variable in results["variables"] if variable["optimised"]]
    objective = OBJECTIVES[results["objective"]]
    rows = [
        {
            "number": trial["number"],
            "state": trial["state"],
            "reason": trial["reason"],
            "origin": trial["origin"],
            "cells": [
                *(present(trial["design"][v["name"]], v["unit"]) for v in optimised),
                objective.text(trial["score"]),
                "-" if "error" in trial["qp"] else objective.text(objective.score(trial["qp"])),
                f"{trial['training_steps']:,}",
                f"{trial['seconds']:.1f} s",
            ],
        }
        for trial in trials
    ]
    columns = [v["name"].replace("_", " ") for v in optimised]
    return {"trial_columns": [*columns, objective.label, "by inverse QP", "training steps", "time"], "trials": rows}


def _cost_rows(cost: Mapping[str, Any]) -> list[dict[str, str]]:
    steps = {
        "screen": f"{cost['screen_steps']:,}",
        "judge": f"{cost['joint_steps']:,} of training, {cost['joint_report_steps']:,} of its reports",
        "trials": f"{cost['training_steps']:,} of training, {cost['report_steps']:,} of its reports, "
        f"{cost['selection_steps']:,} of scores",
        "finalists": (
            f"{cost['retraining_steps']:,} of training, {cost['retraining_report_steps']:,} of its reports, "
            if cost["retraining_steps"]
            else ""
        )
        + f"{cost['test_steps_fem']:,} on FEM, {cost['test_steps_surrogate']:,} on the surrogate",
    }
    titles = {
        "screen": "Screen by the inverse QP",
        "judge": "Bodies and policy together",
        "trials": "Trials",
        "finalists": "Final test",
    }

    def minutes(seconds: float | None) -> str:
        return "-" if seconds is None else f"{seconds / 60:.1f} min"

    rows = [
        {
            "part": title,
            "steps": steps[part],
            "cpu": minutes(cost["cpu_seconds"][part]),
            "wall": minutes(cost["wall_seconds"].get(part)),
        }
        for part, title in titles.items()
        if part not in ("screen", "judge") or cost["cpu_seconds"][part]
    ]
    total = {
        "part": "Together",
        "steps": "",
        "cpu": minutes(sum(cost["cpu_seconds"].values())),
        "wall": minutes(sum(cost["wall_seconds"].values())),
    }
    return [*rows, total]


def _rerun(study: StudyFolder, results: Mapping[str, Any]) -> list[tuple[str, str]]:
    config, made = study.config, results["provenance"]
    rows = [
        ("Seeds", f"sampler {config.sampler.seed}, goals {config.goals.seed}, training {config.training.seed}"),
        ("Workers", f"{config.workers}; with several, which bodies the sampler proposes depends on their timing"),
        ("Commit", made["commit"] or "not in a git repository"),
        ("Versions", ", ".join(f"{name} {version}" for name, version in made["versions"].items())),
        ("Machine", made["platform"]),
    ]
    if config.policy:
        rows.insert(1, ("Policy", config.policy))
    return rows
