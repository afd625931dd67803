"""One trial: from a body to a score."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.config import EnvironmentConfig, TrainConfig
from codesign.config import StudyConfig
from codesign.folder import StudyFolder
from codesign.objectives import OBJECTIVES, Objective, violations
from codesign.phases.shared_policy import JUDGE, judge_policy
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.storage import read_json, write_json

if TYPE_CHECKING:
    import optuna

    from agents.evaluation import Evaluation

__all__ = ["assess", "merge", "run_trial", "training_config"]

PIECES = 4
"""Into so many parts, of at most eight goals, the goals of a trial that trains nothing are divided; after each the
pruner is asked."""


def assess(
    agent: str | Path,
    environment: EnvironmentConfig,
    goals: np.ndarray,
    design: Mapping[str, float],
) -> dict[str, Any]:
    """Evaluate an agent on a body.

    Args:
        agent: ``"qp"``, ``"random"`` or a policy file.
        environment: environment of the trials.
        goals: goals [m], shape (k, p, 3).
        design: complete design [SI].

    Returns:
        The evaluation as plain data [SI], with its cost, or only ``"error"`` if the body cannot be simulated.
    """
    from agents.evaluation import evaluate

    started, cpu = time.perf_counter(), time.process_time()
    try:
        evaluation = evaluate(agent, environment, goals, design=dict(design), seed=0)
    except (InfeasibleDesign, ConvergenceError) as error:
        return {"error": str(error)}
    return {
        "success_rate": float(evaluation.success_rate),
        "mean_distance": float(evaluation.mean_distance),
        "worst_distance": float(evaluation.worst_distance),
        "mean_return": float(evaluation.mean_return),
        "distances": np.asarray(evaluation.distances, dtype=float).tolist(),
        "returns": np.asarray(evaluation.returns, dtype=float).tolist(),
        "mean_distances": np.asarray(evaluation.mean_distances, dtype=float).tolist(),
        "efforts": np.asarray(evaluation.efforts, dtype=float).tolist(),
        "successes": np.asarray(evaluation.successes, dtype=bool).tolist(),
        "mean_tracking_distance": float(evaluation.mean_distances.mean()),
        "mean_effort": float(evaluation.efforts.mean()),
        "steps": int(evaluation.steps),
        "seconds": time.perf_counter() - started,
        "cpu_seconds": time.process_time() - cpu,
    }


def training_config(folder: StudyFolder, design: Mapping[str, float]) -> TrainConfig:
    """Configuration of the training of one body, on the training goals of the study."""
    config, goals = folder.config, folder.goals["training"]
    update: dict[str, Any] = {"design": dict(design), "sample_design": False}
    if len(goals):
        update["task_options"] = {**config.environment.task_options, "goals": goals.tolist()}
    training = config.training
    return TrainConfig(
        environment=config.environment.model_copy(update=update),
        sac=training.sac,
        steps=training.steps,
        num_envs=training.num_envs,
        seed=training.seed,
        evaluation_episodes=training.evaluation_episodes,
        report_every=training.report_every,
    )


def merge(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """One evaluation from those of parts of its goals."""
    counts = [len(part["distances"]) for part in parts]
    merged: dict[str, Any] = {}
    for key in parts[0]:
        values = [part[key] for part in parts]
        if key == "worst_distance":
            merged[key] = max(values)
        elif isinstance(values[0], list):
            merged[key] = [value for part in values for value in part]
        elif key in ("steps", "seconds", "cpu_seconds"):
            merged[key] = sum(values)
        else:
            merged[key] = float(np.average(values, weights=counts))
    return merged


def _assess_by_goals(
    folder: StudyFolder, trial: optuna.Trial, agent: str | Path, design: Mapping[str, float]
) -> tuple[dict[str, Any], bool]:
    """Evaluate an agent on a body, a few goals at a time, until the pruner has seen enough.

    Returns:
        The evaluation of the goals so far, and whether the pruner stopped it.
    """
    config, goals = folder.config, folder.goals["selection"]
    if config.pruner.name == "none":
        return assess(agent, config.environment, goals, design), False
    objective = OBJECTIVES[config.objective]
    parts: list[dict[str, Any]] = []
    piece = min(8, max(1, len(goals) // PIECES))
    known = set(trial.study.get_trials(deepcopy=False)[trial.number].intermediate_values)
    for start in range(0, len(goals), piece):
        part = assess(agent, config.environment, goals[start : start + piece], design)
        if "error" in part:
            return part, False
        parts.append(part)
        for k, value in enumerate(part[objective.per_goal]):
            if start + k not in known:
                trial.report(objective.sign * float(value), start + k)
        if trial.user_attrs.get("origin") != "baseline" and start + piece < len(goals) and trial.should_prune():
            return merge(parts), True
    return merge(parts), False


class _Reporter:
    """Passes learning progress on to the pruner, and keeps the learning curve."""

    def __init__(self, trial: optuna.Trial, objective: Objective) -> None:
        self.trial = trial
        self.objective = objective
        self.curve: dict[int, float] = dict(trial.study.get_trials(deepcopy=False)[trial.number].intermediate_values)
        self.pruned = False
        # Everything is compared with the baseline, so it is always trained to the end.
        self.prunable = trial.user_attrs.get("origin") != "baseline"

    def __call__(self, step: int, outcome: Evaluation) -> bool:
        value = self.objective.score(outcome.to_json())
        if step not in self.curve and np.isfinite(value):
            self.curve[step] = float(value)
            self.trial.report(float(value), step)
        self.pruned = self.prunable and self.trial.should_prune()
        return self.pruned


def run_trial(folder: StudyFolder, trial: optuna.Trial) -> dict[str, Any]:
    """Run a claimed trial, write its ``result.json`` and return it.

    Returns:
        ``state`` is ``"complete"``, ``"pruned"`` or ``"infeasible"``; ``score`` is larger for better bodies;
        ``evaluation`` is that of the trial's controller, ``qp`` that of the inverse QP, on the selection goals.
    """
    config = folder.config
    design = dict(config.space.complete(trial.params, config.baseline))
    goals = folder.goals["selection"]
    started, cpu = time.perf_counter(), time.process_time()
    result: dict[str, Any] = {
        "number": trial.number,
        "origin": trial.user_attrs["origin"],
        "sampler_seed": trial.user_attrs.get("sampler_seed"),
        "process": trial.user_attrs["process"],
        "design": design,
        "state": "complete",
        "score": None,
        "scores": None,
        "violations": None,
        "reason": None,
        "agent": "qp",
        "evaluation": None,
        "qp": None,
        "curve": [],
        "training_steps": 0,
        "cpu_seconds": 0.0,  # of earlier processes
    }
    evaluation: dict[str, Any] | None
    try:
        if config.strategy == "qp":
            result["qp"] = evaluation = _judged(folder, trial, "qp", result)
        else:
            result["qp"] = assess("qp", config.environment, goals, design)
            if "error" in result["qp"]:
                raise InfeasibleDesign(result["qp"]["error"])
            if config.plan.trains:
                evaluation = _train_and_assess(folder, trial, result)
            else:
                result["agent"] = JUDGE
                evaluation = _judged(folder, trial, judge_policy(folder), result)
        if evaluation is not None:
            _score(config, evaluation, result)
            for name, value in zip(config.limits, result["violations"] or (), strict=False):
                trial.set_constraint(name, value)
    except (InfeasibleDesign, ConvergenceError) as error:
        result.update(state="infeasible", reason=str(error))
        result["qp"] = result["qp"] or {"error": str(error)}
    if result["scores"] is not None and not np.isfinite(result["scores"]).all():
        result.update(state="infeasible", reason=f"the scores are {result['scores']}", score=None, scores=None)
    result["cpu_seconds"] += time.process_time() - cpu
    result.update(seconds=time.perf_counter() - started, finished_at=time.time())
    write_json(folder.trial(trial.number) / "result.json", result)
    return result


def _judged(folder: StudyFolder, trial: optuna.Trial, agent: str | Path, result: dict[str, Any]) -> dict[str, Any]:
    """Evaluate an agent that is the same for all bodies; ``result`` tells if the pruner stopped it."""
    evaluation, pruned = _assess_by_goals(folder, trial, agent, result["design"])
    if "error" in evaluation:
        raise InfeasibleDesign(evaluation["error"])
    if pruned:
        seen, count = len(evaluation["distances"]), len(folder.goals["selection"])
        result.update(state="pruned", reason=f"stopped by the pruner after {seen} of {count} goals")
    return evaluation


def _score(config: StudyConfig, evaluation: dict[str, Any], result: dict[str, Any]) -> None:
    """Enter an evaluation, with what it says of the objectives and the limits."""
    if "material_volume" in (config.objective, *config.also, *config.limits):
        evaluation["material_volume"] = config.robot.build(result["design"]).volume
    result["evaluation"] = evaluation
    if result["state"] == "complete":
        scores = [OBJECTIVES[name].score(evaluation) for name in (config.objective, *config.also)]
        result.update(score=scores[0], scores=scores, violations=violations(config.limits, evaluation))


def _train_and_assess(folder: StudyFolder, trial: optuna.Trial, result: dict[str, Any]) -> dict[str, Any] | None:
    """Train the controller of a body and evaluate it; None if the pruner stopped it."""
    from agents.training import cpu_before, train

    config = folder.config
    reporter = _Reporter(trial, OBJECTIVES[config.objective])
    cpu = time.process_time()
    policy = train(
        training_config(folder, result["design"]),
        folder.trial(trial.number),
        initial=config.policy,
        report=reporter,
        progress=False,
    )
    before = cpu_before(policy, cpu)
    # A trial that goes on after its worker died may have been stopped before.
    pruned = reporter.pruned or read_json(policy.with_suffix(".json"))["stopped_early"]
    steps = max(reporter.curve, default=0) if pruned else config.training.steps
    result.update(
        agent=Path(policy).resolve().relative_to(folder.path).as_posix(),
        curve=[[step, value] for step, value in sorted(reporter.curve.items())],
        training_steps=steps,
        cpu_seconds=before,
    )
    if pruned:
        result.update(state="pruned", reason=f"stopped by the pruner after {steps} steps")
        return None
    evaluation = assess(policy, config.environment, folder.goals["selection"], result["design"])
    if "error" in evaluation:
        raise ConvergenceError(evaluation["error"])
    return evaluation
