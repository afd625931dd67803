"""What a running study prints: its phases with the time left, a line per finished trial and test, and who won."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from softgym_envs.codesign.folder import StudyFolder
from softgym_envs.codesign.records import REFINED, FinalistTest, TestGroup, TrialResult
from softgym_envs.codesign.results import Comparison, StudyResults
from softgym_envs.units import present
from softgym_envs.wording import counted

PHYSICS = {REFINED: "fem with a finer mesh"}
"""Names of physics whose key does not say what they are."""

SCREEN_INTERVAL = 10.0
"""Least time between two lines about the screen, whose bodies take a moment each [s]."""


class Countdown:
    """Counts what is finished of a phase, and estimates the time left from the mean time so far.

    Args:
        total: number of parts of the phase.
        done: how many were finished before.
        clock: returns the time [s].
    """

    def __init__(self, total: int, done: int = 0, clock: Callable[[], float] = time.monotonic) -> None:
        self.total, self._clock = total, clock
        self._first, self._began = done, clock()

    def text(self, done: int) -> str:
        """Return ``"[ 7/24, 3 min left]"`` for a number of finished parts."""
        left = ""
        if self._first < done < self.total:
            seconds = (self._clock() - self._began) / (done - self._first) * (self.total - done)
            left = f", {duration(seconds)} left"
        return f"[{done:>{len(str(self.total))}}/{self.total}{left}]"


def duration(seconds: float) -> str:
    """Return a rough duration: ``"50 s"``, ``"12 min"`` or ``"3.4 h"``."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"


class Progress:
    """Prints the progress of a study, if ``enabled``."""

    def __init__(self, study: StudyFolder, *, enabled: bool) -> None:
        self.study = study
        self.config = study.config
        self.objective = self.config.primary
        self.enabled = enabled
        self._seen: set[Path] = set()
        self._warned: set[str] = set()
        self._best: TrialResult | None = None
        config = study.config
        phases = {
            "screen": config.screen.enabled,
            "trials": True,
            "test": config.finalists.count > 0,
        }
        self._phases = [name for name, runs in phases.items() if runs]
        self._countdown = Countdown(config.trials)
        self._said = 0.0
        self._done = 0

    def begin(self, phase: str, text: str, total: int, done: int = 0) -> None:
        """Print the head of a phase.

        Args:
            phase: ``"screen"``, ``"trials"`` or ``"test"``.
            text: what it does.
            total: number of its parts.
            done: how many of them were finished before.
        """
        self._countdown, self._done = Countdown(total, done), done
        self.say(f"phase {self._phases.index(phase) + 1} of {len(self._phases)}, {phase}: {text}")

    def say(self, line: str) -> None:
        """Print a line."""
        if self.enabled:
            print(line, flush=True)

    def warn(self, text: str) -> None:
        """Print a warning, once."""
        if text not in self._warned:
            self._warned.add(text)
            self.say(f"warning: {text}")

    def _fresh(self, pattern: str) -> list[Path]:
        """Return files that appeared since the last call, in the order in which they were written."""
        fresh = [path for path in self.study.path.glob(pattern) if path not in self._seen]
        self._seen.update(fresh)
        return sorted(fresh, key=lambda path: path.stat().st_mtime)

    def screened(self, done: int) -> None:
        """Print how many bodies of the screen are scored, now and then."""
        if done and time.monotonic() - self._said > SCREEN_INTERVAL:
            self._said = time.monotonic()
            self.say(f"{self._countdown.text(done)} bodies scored")

    def trials(self, *, quiet: bool = False) -> None:
        """Print the trials that finished since the last call; with ``quiet`` only count them."""
        for path in self._fresh("trials/[0-9]*/result.json"):
            trial = TrialResult.read(path)
            self._done += not quiet
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
        return (
            f"{self._countdown.text(self._done)} trial {trial.number} ({trial.origin}): {found}; {best}; "
            f"{trial.seconds:.1f} s"
        )

    def tests(self, *, quiet: bool = False) -> None:
        """Print the tests that finished since the last call."""
        for path in self._fresh("finalists/trial*.json"):
            test = FinalistTest.read(path)
            if quiet:
                continue
            self._done += 1
            seed = f" (seed {test.seed})" if test.seed else ""
            which = f"{test.agent}{seed} on {PHYSICS.get(test.backend, test.backend)}, {test.goals} goals"
            self.say(f"{self._countdown.text(self._done)} test of trial {test.trial}, {which}: {self._test_text(test)}")

    def _test_text(self, test: FinalistTest) -> str:
        if test.evaluation is None:
            return f"failed ({test.error})"
        found = f"success {100 * test.evaluation.success_rate:.1f} %, "
        measure = self.config.distance
        found += f"{measure.label.lower()} {measure.text(test.evaluation.mean_distance)}"
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
        measure = self.config.distance
        changes.append(
            f"{self.config.distance_scale.name} {measure.number(row.baseline.mean_distance)} -> "
            f"{measure.text(row.winner.mean_distance)}"
        )
        interval = ""
        if row.distance_change_interval is not None:
            low, high = sorted(row.distance_change_interval)
            interval = f", 95 % interval {measure.number(low, '+')} to {measure.text(high, '+')}"
        if row.distance_mesh is not None and row.distance_mesh.interval is not None:
            low, high = sorted(row.distance_mesh.interval)
            interval += f", with the error of the mesh {measure.number(low, '+')} to {measure.text(high, '+')}"
        return (
            f"{row.agent} on {PHYSICS.get(row.backend, row.backend)}, {counted(row.goals, 'test goal')}: "
            f"{', '.join(changes)} (change {measure.text(row.distance_change, '+')}{interval})"
        )
