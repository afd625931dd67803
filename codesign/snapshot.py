"""All that a study has found so far, read once: who ranks first, who is tested, who wins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softgym_envs.codesign.config import JOURNAL, StudyConfig
from softgym_envs.codesign.folder import SHARED_POLICY_RECORD, StudyFolder
from softgym_envs.codesign.goals import Stratum, first_goals, missed_first
from softgym_envs.codesign.metrics.metric import Metric
from softgym_envs.codesign.records import (
    REFINED,
    Account,
    Finalist,
    FinalistTest,
    FinalistTraining,
    PlannedTest,
    ScreenResult,
    SharedPolicy,
    TestGroup,
    TrialResult,
)

if TYPE_CHECKING:
    import optuna

POOL = 3
"""Finalists are chosen among this many times as many of the best bodies."""


@dataclass(frozen=True)
class Verdict:
    """Who won."""

    winner: Finalist | None  # the best body that satisfies the constraints; it may be the baseline
    reason: str = ""  # why there is no winner, with the nearest miss


@dataclass(frozen=True)
class StudySnapshot:
    """A study as it was when `load_study` read it; it need not be finished.

    Attributes:
        folder: the folder of the study.
        trials: results of all finished trials, by number.
        screen: results of the screen, by number.
        shared_policy: the policy that scores every body, if there is one.
        all_tests: tests of all bodies that ever were finalists.
        all_trainings: policies trained anew for bodies that ever were finalists.
        account: time spent.
    """

    folder: StudyFolder
    trials: list[TrialResult]
    screen: list[ScreenResult]
    shared_policy: SharedPolicy | None
    all_tests: list[FinalistTest]
    all_trainings: list[FinalistTraining]
    account: Account

    @property
    def config(self) -> StudyConfig:
        """Configuration of the study."""
        return self.folder.config

    @property
    def objective(self) -> Metric:
        """The objective that decides who wins."""
        return self.config.primary

    @cached_property
    def ranked(self) -> list[TrialResult]:
        """Complete trials, best first: those that satisfy the constraints, then those that violate them least."""

        def key(trial: TrialResult) -> tuple[float, ...]:
            assert trial.score is not None and trial.evaluation is not None
            return (-self._excess(trial.violations), trial.score, -trial.evaluation.mean_distance, -trial.number)

        return sorted((trial for trial in self.trials if trial.state == "complete"), key=key, reverse=True)

    def _excess(self, violations: Mapping[str, float]) -> float:
        """Return the sum of all violations, each relative to its limit."""
        limits = self.config.constraints
        return sum(max(0.0, value) / (abs(limits[name]) or 1.0) for name, value in violations.items())

    @property
    def best(self) -> TrialResult | None:
        """The best trial that satisfies the constraints."""
        return next((trial for trial in self.ranked if trial.feasible), None)

    @cached_property
    def optuna_study(self) -> optuna.Study:
        """Optuna study in memory with the complete trials that satisfy the constraints, for Optuna's own analyses."""
        import optuna

        from softgym_envs.codesign.scheduling.optuna_study import distributions

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        study = optuna.create_study(directions=self.config.directions)
        space = distributions(self.config.optimised)
        for trial in self.trials:
            if trial.state == "complete":
                stored = optuna.create_trial(
                    params={name: {**trial.design, **trial.options}[name] for name in space},
                    distributions=space,
                    values=self.config.signed(trial.scores),
                    user_attrs={"number": trial.number},
                    constraints=trial.violations,
                )
                study.add_trial(stored)
        return study

    @cached_property
    def pareto(self) -> list[int]:
        """Trials that satisfy the constraints and that no other such trial beats in every objective."""
        return sorted(trial.user_attrs["number"] for trial in self.optuna_study.best_trials)

    @cached_property
    def finalists(self) -> list[Finalist]:
        """The baseline and good other bodies that differ, best first; without the baseline if it is infeasible.

        The best body is always one of them. Each further one is, among the best `POOL` times as many bodies, the one
        farthest from those chosen before, so that the check compares different bodies and not copies of the winner. A
        body that samplers proposed several times counts once, as its first trial.
        """
        bodies: dict[tuple[float, ...], TrialResult] = {}
        for trial in self.ranked:
            key = (*trial.design.values(), *trial.options.values())
            if key not in bodies or trial.origin == "baseline":
                bodies[key] = trial
        baseline = [trial for trial in bodies.values() if trial.origin == "baseline"]
        others = [trial for trial in bodies.values() if trial.origin != "baseline"]
        chosen = self._different(others, self.config.finalists.count)
        return [_finalist(trial) for trial in (baseline + chosen if self.config.finalists.count else [])]

    def _different(self, ranked: Sequence[TrialResult], count: int) -> list[TrialResult]:
        """Return ``count`` of the best trials by greedy maximin choice, best first.

        Bodies that satisfy the constraints come before all others. Distances are those in the unit cube of the
        optimised variables.
        """
        feasible = [trial for trial in ranked if trial.feasible]
        pool = (feasible if len(feasible) >= count else ranked)[: POOL * count]
        variables = [self.config.optimised[name] for name in self.config.variables]
        places = np.array(
            [[v.to_unit({**trial.design, **trial.options}[v.name]) for v in variables] for trial in pool]
        ).reshape(len(pool), len(variables))
        chosen = [0] if pool and count else []
        while chosen and len(chosen) < min(count, len(pool)):
            distances = np.linalg.norm(places[:, None] - places[None, chosen], axis=-1).min(axis=1)
            distances[chosen] = -1.0
            chosen.append(int(distances.argmax()))
        return [pool[index] for index in sorted(chosen)]

    @property
    def baseline(self) -> Finalist | None:
        """The baseline, if it is among the finalists."""
        return next((finalist for finalist in self.finalists if finalist.role == "baseline"), None)

    def seeds(self, agent: str) -> range:
        """Return the seeds of the policies that a finalist is tested with; 0 is the policy of its trial."""
        count = self.config.finalists.seeds
        return range(1, count + 1) if agent == "policy" and count else range(1)

    @cached_property
    def planned_tests(self) -> list[PlannedTest]:
        """Tests of all present finalists, the slow ones first."""
        planned = []
        for backend in self.config.test_backends:
            for finalist in self.finalists:
                kinds = [(agent, "unseen") for agent in finalist.agents]
                if self.config.finalists.choose == "fem" and backend == "fem":
                    kinds.append((finalist.agents[0], "selection"))
                planned += [
                    PlannedTest(finalist, agent, backend, goals, seed)
                    for agent, goals in kinds
                    for seed in self.seeds(agent)
                ]
        return planned

    @cached_property
    def refinements(self) -> list[PlannedTest]:
        """Tests of baseline and winner on the finer mesh; none before the `planned_tests` have found the winner."""
        done = {(test.trial, test.agent, test.backend, test.goals, test.seed) for test in self.all_tests}
        if self.config.finalists.refinement is None or any(plan.key not in done for plan in self.planned_tests):
            return []
        baseline, winner = self.baseline, self.winner
        if baseline is None or winner is None or winner.trial == baseline.trial:
            return []
        return [plan for body in (baseline, winner) for plan in self._refined(body)]

    def _refined(self, body: Finalist) -> list[PlannedTest]:
        agent, strata = body.agents[0], self.refined_goals
        numbers = None if strata is None else tuple(number for stratum in strata for number in stratum.numbers)
        return [PlannedTest(body, agent, REFINED, "unseen", seed, numbers) for seed in self.seeds(agent)]

    @cached_property
    def refined_goals(self) -> list[Stratum] | None:
        """Unseen goals of the tests on the finer mesh; None without them, and before the baseline was tested.

        What the baseline misses is what it misses with its own controller on the mesh of the study, in the test that
        the finer mesh corrects. No result on the finer mesh, and none of the winner, takes part in the choice.
        """
        refinement, baseline, total = self.config.finalists.refinement, self.baseline, len(self.folder.goals["unseen"])
        if refinement is None or baseline is None:
            return None
        if refinement.choose == "first":
            return first_goals(total, refinement.goals)
        agent = baseline.agents[0]
        key = (baseline.trial, agent, "fem", "unseen", self.seeds(agent)[0])
        for test in self.all_tests:
            if (test.trial, test.agent, test.backend, test.goals, test.seed) == key and test.evaluation is not None:
                return missed_first(~test.evaluation.successes.astype(bool), refinement.goals)
        return None

    @cached_property
    def tests(self) -> list[TestGroup]:
        """Finished tests of the present finalists, those with several training seeds together."""
        refined = [plan for body in self.finalists for plan in self._refined(body)]
        planned = {plan.key for plan in (*self.planned_tests, *refined)}
        groups: dict[tuple[int, str, str, str], list[FinalistTest]] = {}
        for test in self.all_tests:
            key = (test.trial, test.agent, test.backend, test.goals)
            if (*key, test.seed) in planned:
                groups.setdefault(key, []).append(test)
        return [TestGroup(tests) for tests in groups.values()]

    @property
    def unseen_tests(self) -> list[TestGroup]:
        """Successful tests of the present finalists on unseen goals."""
        return [group for group in self.tests if group.goals == "unseen" and group.error is None]

    @property
    def trainings(self) -> list[FinalistTraining]:
        """Policies trained anew for the present finalists."""
        numbers = [finalist.trial for finalist in self.finalists]
        return [training for training in self.all_trainings if training.trial in numbers]

    @cached_property
    def failures(self) -> dict[int, str]:
        """Why finalists cannot be simulated on FEM with the controller of their trial, by trial."""
        agents = {finalist.trial: finalist.agents[0] for finalist in self.finalists}
        return {
            test.trial: test.error
            for test in self.tests
            if test.backend == "fem" and test.agent == agents[test.trial] and test.error is not None
        }

    @cached_property
    def verdict(self) -> Verdict:
        """Who wins, decided without the unseen goals."""
        complete = self.ranked
        if not complete:
            return Verdict(None, self._nothing_complete())
        feasible = [trial.number for trial in complete if trial.feasible]
        if not feasible:
            return Verdict(None, f"no body satisfies the constraints; nearest: {self.violations_text(complete[0])}")
        if not self.config.finalists.count:
            return Verdict(None, f"no finalists were requested (finalists.count = 0); best: trial {feasible[0]}")
        failed = self.failures
        bodies = {f.trial: f for f in self.finalists if f.trial in feasible and f.trial not in failed}
        if failed and not bodies:
            trial = min(failed)
            return Verdict(None, f"no finalist can be simulated on FEM; trial {trial}: {failed[trial]}")
        tests = [g for g in self.tests if g.goals == "selection" and g.error is None and g.trial in bodies]
        if self.config.finalists.choose == "fem" and tests:
            return self._verdict_on_fem(bodies, tests)
        return Verdict(next(bodies[number] for number in feasible if number in bodies))

    def _verdict_on_fem(self, bodies: dict[int, Finalist], tests: Sequence[TestGroup]) -> Verdict:
        objective, limits, objectives = self.objective, self.config.controller_constraints, self.config.objectives

        def excess(group: TestGroup) -> float:
            return self._excess({name: objectives[name].excess(group.value(name), limits[name]) for name in limits})

        def key(group: TestGroup) -> tuple[float, ...]:
            score = objective.score(group.value(objective.name))
            return (-excess(group), score, -group.mean.mean_distance, -group.trial)

        best = max(tests, key=key)
        if excess(best) > 0.0:
            broken = self.config.violations_text({name: best.value(name) for name in limits}, limits)
            return Verdict(None, f"no finalist satisfies the constraints on FEM; nearest: trial {best.trial}, {broken}")
        return Verdict(bodies[best.trial])

    def _nothing_complete(self) -> str:
        if not self.trials:
            return "no trial is finished"
        states = [trial.state for trial in self.trials]
        counts = ", ".join(f"{states.count(s)} {s}" for s in ("pruned", "infeasible") if s in states)
        first = next((trial for trial in self.trials if trial.state == "infeasible"), self.trials[0])
        return f"no trial is complete ({counts}); trial {first.number}: {first.reason}"

    def violations_text(self, trial: TrialResult) -> str:
        """Return the constraints that a trial violates in words; empty if there are none."""
        broken = self.config.violations_text(trial.values, self.config.constraints)
        return f"trial {trial.number}, {broken}" if broken else ""

    @property
    def winner(self) -> Finalist | None:
        """The body that wins, if there is one."""
        return self.verdict.winner


def _finalist(trial: TrialResult) -> Finalist:
    assert trial.score is not None
    return Finalist(
        trial=trial.number,
        role="baseline" if trial.origin == "baseline" else "finalist",
        design=trial.design,
        options=trial.options,
        score=trial.score,
        policy=None if trial.controller == "qp" else trial.controller,
    )


def load_study(folder: str | Path | StudyFolder) -> StudySnapshot:
    """Read all that a study has found so far; it need not be finished.

    Raises:
        DataError: if the folder has no study, a file is damaged, or the results are not those of the journal.
    """
    study = folder if isinstance(folder, StudyFolder) else StudyFolder(folder)
    path = study.path
    study.config  # noqa: B018 - raises where there is no study
    trials = study.results()
    if study.config.storage == JOURNAL and (path / "journal.log").exists():
        from softgym_envs.codesign.scheduling.agreement import check_journal

        check_journal(study, trials)
    shared = path / SHARED_POLICY_RECORD
    return StudySnapshot(
        folder=study,
        trials=trials,
        screen=[ScreenResult.read(file) for file in sorted(path.glob("screen/[0-9]*.json"))],
        shared_policy=SharedPolicy.read(shared) if shared.exists() else None,
        all_tests=[FinalistTest.read(file) for file in sorted(path.glob("finalists/trial*.json"))],
        all_trainings=[FinalistTraining.read(file) for file in sorted(path.glob("finalists/*/training.json"))],
        account=study.account(),
    )
