"""What a running study prints: a line per finished trial and test, and who won."""

from __future__ import annotations

from pathlib import Path

from codesign.folder import StudyFolder
from codesign.records import FinalistTest, TestGroup, TrialResult
from codesign.report.results import Comparison, StudyResults
from codesign.report.units import present


class Progress:
    """Prints the progress of a study, if ``enabled``."""

    def __init__(self, study: StudyFolder, *, enabled: bool) -> None:
        self.study = study
        self.config = study.config
        self.objective = self.config.primary
        self.enabled = enabled
        self._seen: set[Path] = set()
        self._finished = 0
        self._best: TrialResult | None = None

    def say(self, line: str) -> None:
        """Print a line."""
        if self.enabled:
            print(line, flush=True)

    def _fresh(self, pattern: str) -> list[Path]:
        """Return files that appeared since the last call, in the order in which they were written."""
        fresh = [path for path in self.study.path.glob(pattern) if path not in self._seen]
        self._seen.update(fresh)
        return sorted(fresh, key=lambda path: path.stat().st_mtime)

    def trials(self, *, quiet: bool = False) -> None:
        """Print the trials that finished since the last call; with ``quiet`` only count them."""
        for path in self._fresh("trials/[0-9]*/result.json"):
            trial = TrialResult.read(path)
            self._finished += 1
            best = self._best
            if trial.feasible and (best is None or (trial.score or 0.0) > (best.score or 0.0)):
                self._best = trial
            if not quiet:
                self.say(self.trial_line(trial))

    def trial_line(self, trial: TrialResult) -> str:
        """Return the line of a finished trial: what it found, constraints that it violates, and the best so far."""
        label, text = self.objective.label.lower(), self.objective.text
        found = trial.state if trial.score is None else f"{label} {text(trial.values[self.objective.name])}"
        if trial.state == "infeasible":
            found += f" ({trial.reason})"
        broken = self.config.violations_text(trial.values, self.config.constraints) if trial.score is not None else ""
        if broken:
            found += f", violates a constraint: {broken}"
        if self._best is not None:
            best = f"best {text(self._best.values[self.objective.name])} (trial {self._best.number})"
        else:
            best = "no body satisfies the constraints yet" if self.config.constraints else "no complete trial yet"
        total = self.config.trials
        return (
            f"[{self._finished:>{len(str(total))}}/{total}] trial {trial.number} ({trial.origin}): {found}; {best}; "
            f"{trial.seconds:.1f} s"
        )

    def tests(self, *, quiet: bool = False) -> None:
        """Print the tests that finished since the last call."""
        for path in self._fresh("finalists/trial*.json"):
            test = FinalistTest.read(path)
            if quiet:
                continue
            seed = f" (seed {test.seed})" if test.seed else ""
            which = f"{test.agent}{seed} on {test.backend}, {test.goals} goals"
            self.say(f"test: trial {test.trial}, {which}: {self._test_text(test)}")

    def _test_text(self, test: FinalistTest) -> str:
        if test.evaluation is None:
            return f"failed ({test.error})"
        found = f"success {100 * test.evaluation.success_rate:.1f} %, "
        found += f"mean distance {1e3 * test.evaluation.mean_distance:.2f} mm"
        if self.objective.name not in ("mean_distance", "success_rate"):
            value = TestGroup([test]).value(self.objective.name)
            found = f"{self.objective.label.lower()} {self.objective.text(value)}, {found}"
        limits = self.config.controller_constraints
        broken = self.config.violations_text(test.values, limits)
        return found + (f", violates a constraint: {broken}" if broken else "")

    def verdict(self, results: StudyResults) -> None:
        """Print who won, by how much, and with which dimensions."""
        if results.winner is None:
            self.say(f"no winner: {results.no_winner}")
            return
        self.say(f"winner: trial {results.winner.trial}")
        for variable in results.variables:
            if variable.optimised and variable.winner is not None:
                limit = f", at its {variable.at_limit} limit" if variable.at_limit else ""
                self.say(
                    f"  {variable.name} {present(variable.winner, variable.unit)} "
                    f"(baseline {present(variable.baseline, variable.unit)}){limit}"
                )
        for row in results.comparison:
            self.say(f"  {self.comparison_line(row)}")
        if results.few_goals:
            self.say(f"  {results.few_goals}")

    def comparison_line(self, row: Comparison) -> str:
        """Return how the winner compares with the baseline for one controller and backend."""
        changes = []
        if self.objective.name not in ("mean_distance", "success_rate"):
            text = self.objective.text
            changes.append(
                f"{self.objective.label.lower()} {text(row.baseline.objective)} -> {text(row.winner.objective)}"
            )
        changes.append(f"success {100 * row.baseline.success_rate:.1f} -> {100 * row.winner.success_rate:.1f} %")
        changes.append(f"distance {1e3 * row.baseline.mean_distance:.2f} -> {1e3 * row.winner.mean_distance:.2f} mm")
        interval = ""
        if row.distance_change_interval is not None:
            low, high = (1e3 * value for value in row.distance_change_interval)
            interval = f", 95 % interval {low:+.2f} to {high:+.2f} mm"
        return (
            f"{row.agent} on {row.backend}, {row.goals} test goals: {', '.join(changes)} "
            f"(change {1e3 * row.distance_change:+.2f} mm{interval})"
        )
