"""One trial: from a body to a score."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.evaluation import Evaluation, evaluate
from softgym_envs.agents.training import cpu_before, train
from softgym_envs.codesign.folder import SHARED_POLICY, StudyFolder
from softgym_envs.codesign.metrics.metric import Metric
from softgym_envs.codesign.metrics.sources import Outcome
from softgym_envs.codesign.phases.shared_policy import shared_policy
from softgym_envs.codesign.problem import StudyProblem
from softgym_envs.codesign.records import Assessment, Score, TrialResult
from softgym_envs.codesign.scoring import scoring
from softgym_envs.envs.parallel import cpu_seconds
from softgym_envs.storage import read_json
from softgym_envs.wording import counted

if TYPE_CHECKING:
    import optuna

GOAL_BATCHES = 4
"""Number of parts, of at most eight goals each, after which the pruner may stop a trial that does not train."""


def assess(
    agent: str | Path,
    config: StudyProblem,
    environment: EnvironmentConfig,
    goals: np.ndarray,
    design: Mapping[str, float],
) -> Assessment:
    """Evaluate an agent (``"qp"``, ``"random"`` or a policy file), and measure the objectives of a study.

    Goals [m] have the shape (k, p, 3), and the design is complete [SI].

    Raises:
        InfeasibleDesign: if the body cannot exist.
        ConvergenceError: if it cannot be simulated.
    """
    evaluation = evaluate(agent, environment, goals, design=dict(design), seed=0)
    return measure(config, environment, evaluation, design)


def measure(
    config: StudyProblem, environment: EnvironmentConfig, evaluation: Evaluation, design: Mapping[str, float]
) -> Assessment:
    """Measure the objectives of a study in an evaluation of one body."""
    outcome = Outcome(evaluation, design, environment.make_robot())
    return Assessment(evaluation, {name: each.measure(outcome) for name, each in config.objectives.items()})


def rate(score: Score, problem: StudyProblem, found: Assessment) -> None:
    """Write the objectives of an assessment into a score."""
    score.values = {name: float(value) for name, value in found.values.items()}
    score.scores = [problem.objectives[name].score(score.values[name]) for name in problem.score_names]


def body_training(folder: StudyFolder, design: Mapping[str, float], options: Mapping[str, float]) -> TrainConfig:
    """Return the configuration for training on one body and the training goals of the study."""
    config = folder.config
    return config.training.on(config.environment_of(options), folder.goals["training"], design)


def run_trial(folder: StudyFolder, trial: optuna.Trial) -> TrialResult:
    """Run a claimed trial; write its ``result.json`` and return it.

    Only `InfeasibleDesign` and `ConvergenceError` make a body infeasible; other exceptions are bugs.
    """
    result = _new_result(folder, trial)
    with scoring(result):
        _Runner(folder, trial, result).run()
    if result.reason is not None and result.state == "complete":
        result.state = "infeasible"
    result.finished_at = time.time()
    result.write(folder.trial(trial.number) / "result.json")
    return result


def give_up(folder: StudyFolder, trial: optuna.Trial) -> TrialResult:
    """Write and return the result of a body whose evaluation crashed too many workers; see `run_trial`."""
    result = _new_result(folder, trial)
    result.state, result.reason = "infeasible", f"evaluation crashed {counted(folder.config.attempts, 'worker')}"
    result.finished_at = time.time()
    result.write(folder.trial(trial.number) / "result.json")
    return result


def _new_result(folder: StudyFolder, trial: optuna.Trial) -> TrialResult:
    design, options = folder.config.body(trial.params)
    attributes = trial.user_attrs
    return TrialResult(
        number=trial.number,
        origin=attributes["origin"],
        process=attributes["process"],
        design=design,
        options=options,
        sampler_seed=attributes.get("sampler_seed"),
    )


class _Runner:
    """Runs one trial and fills its result."""

    def __init__(self, folder: StudyFolder, trial: optuna.Trial, result: TrialResult) -> None:
        self.folder = folder
        self.config = folder.config
        self.trial = trial
        self.result = result
        self.environment = self.config.environment_of(result.options)
        self.goals = folder.goals["selection"]
        # Everything is compared with the baseline, so it always runs to the end.
        self.prunable = result.origin != "baseline"

    def run(self) -> None:
        """Evaluate the body by the strategy of the study."""
        result, config = self.result, self.config
        if config.strategy == "qp":
            assessment = self._assess_by_goals("qp")
            self._keep_qp(assessment)
        else:
            self._keep_qp(self._assess("qp", self.goals))
            if config.plan.trains:
                if config.policy:  # how well the shared policy would have judged this one
                    judged = self._assess(config.policy, self.goals)
                    result.judge, result.judge_value = judged.evaluation, judged.values[config.objective]
                policy = self._train()
                if policy is None:
                    return
                assessment = self._assess(policy, self.goals)
            else:
                result.controller = SHARED_POLICY
                assessment = self._assess_by_goals(shared_policy(self.folder))
        self._score(assessment)

    def _assess(self, agent: str | Path, goals: np.ndarray) -> Assessment:
        return assess(agent, self.config, self.environment, goals, self.result.design)

    def _keep_qp(self, assessment: Assessment) -> None:
        self.result.qp = assessment.evaluation
        self.result.qp_value = assessment.values[self.config.objective]

    def _score(self, assessment: Assessment) -> None:
        """Record an evaluation, and for a complete trial its scores and violations."""
        config, result = self.config, self.result
        rate(result, config, assessment)
        result.evaluation = assessment.evaluation
        if result.state != "complete":
            result.scores = []
            return
        for name, limit in config.constraints.items():
            result.violations[name] = config.objectives[name].excess(result.values[name], limit)
            self.trial.set_constraint(name, result.violations[name])

    def _assess_by_goals(self, agent: str | Path) -> Assessment:
        """Evaluate an agent a few goals at a time, until the pruner stops the trial."""
        if self.config.pruner.name == "none":
            return self._assess(agent, self.goals)
        objective, trial, count = self.config.primary, self.trial, len(self.goals)
        parts: list[Evaluation] = []
        batch = min(8, max(1, count // GOAL_BATCHES))
        known = set(trial.study.get_trials(deepcopy=False)[trial.number].intermediate_values)
        for start in range(0, count, batch):
            part = self._assess(agent, self.goals[start : start + batch])
            parts.append(part.evaluation)
            values = part.measurements[objective.name].per_goal
            if values is None:
                raise ValueError(
                    f"objective '{objective.name}' returns one number, but pruner '{self.config.pruner.name}' needs "
                    "one for each goal"
                )
            for k, value in enumerate(values):
                if start + k not in known:
                    trial.report(value, start + k)
            if self.prunable and start + batch < count and trial.should_prune():
                seen = start + len(values)
                self.result.state = "pruned"
                self.result.reason = f"stopped by the pruner after {seen} of {counted(count, 'goal')}"
                break
        return measure(self.config, self.environment, Evaluation.merge(parts), self.result.design)

    def _train(self) -> Path | None:
        """Train the policy of the body; None if the pruner stopped the training."""
        config, result = self.config, self.result
        reporter = _Reporter(self.trial, config.primary, result, self.environment, prunable=self.prunable)
        cpu = cpu_seconds()
        policy = train(
            body_training(self.folder, result.design, result.options),
            self.folder.trial(result.number),
            initial=config.policy,
            report=reporter,
            progress=False,
        )
        result.cpu_seconds = cpu_before(policy, cpu)
        # A trial that continues after its worker died may have been stopped before.
        pruned = reporter.pruned or read_json(policy.with_suffix(".json"))["stopped_early"]
        result.controller = Path(policy).resolve().relative_to(self.folder.path).as_posix()
        result.curve = [[step, value] for step, value in sorted(reporter.curve.items())]
        result.training_steps = max(reporter.curve, default=0) if pruned else config.training.steps
        if not pruned:
            return policy
        result.state, result.reason = "pruned", f"stopped by the pruner after {counted(result.training_steps, 'step')}"
        return None


class _Reporter:
    """Reports the progress of a training to the pruner, and keeps the learning curve."""

    def __init__(
        self,
        trial: optuna.Trial,
        objective: Metric,
        result: TrialResult,
        environment: EnvironmentConfig,
        *,
        prunable: bool,
    ) -> None:
        self.trial = trial
        self.objective = objective
        self.design = result.design
        self.robot = environment.make_robot()
        reported = trial.study.get_trials(deepcopy=False)[trial.number].intermediate_values
        self.curve = {step: objective.score(value) for step, value in reported.items()}
        self.pruned = False
        self.prunable = prunable

    def __call__(self, step: int, evaluation: Evaluation) -> bool:
        """Report an evaluation; return whether the training should stop."""
        value = self.objective.measure(Outcome(evaluation, self.design, self.robot)).value
        if step not in self.curve and np.isfinite(value):
            self.curve[step] = self.objective.score(value)
            self.trial.report(value, step)
        self.pruned = self.prunable and self.trial.should_prune()
        return self.pruned
