"""Run a co-design study: screen, trials, check on FEM."""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from agents.policy import Policy
from codesign.config import StudyConfig
from codesign.folder import StudyFolder
from codesign.objectives import OBJECTIVES
from codesign.phases.finalists import finalist_jobs
from codesign.phases.screen import kept_bodies, screen_jobs
from codesign.phases.shared_policy import judge_jobs, promising_bodies
from codesign.report.results import write_results
from codesign.scheduling.jobs import missing_jobs
from codesign.scheduling.processes import run_workers
from codesign.scheduling.queue import Ledger, distributions, make_pruner, make_sampler
from softgym_envs.envs.options import design_names
from softgym_envs.errors import ConfigError, ConvergenceError, InfeasibleDesign, SoftGymError
from softgym_envs.storage import read_json, write_json

__all__ = ["run_study"]

MIRROR_INTERVAL = 1.0
"""Time between two looks for what other machines finished [s]."""


def run_study(
    config: StudyConfig, folder: str | Path, *, workers: int | None = None, progress: bool = True
) -> dict[str, Any]:
    """Run a study, or continue it: whatever is finished is kept, and nothing is done twice.

    Several calls may work on one folder at the same time, and, with a database as storage, on many machines. A folder
    keeps its study; only how much is run and by whom may change from call to call (`codesign.folder.EXTENSIBLE`).

    Args:
        config: the study.
        folder: where everything goes, see `StudyFolder`.
        workers: processes, default those of the configuration.
        progress: print a line per finished trial and test.

    Returns:
        What is in ``results.json``.

    Raises:
        ConfigError: if the folder or the database holds another study, the database cannot be opened, the number of
            workers is not positive, the policy was trained for another environment, or the sampler cannot propose.
        ValueError: if the environment cannot be made.
        WeightsError: if the policy to start from is missing or damaged.
        SoftGymError: if a worker was stopped by an error.
    """
    count = config.workers if workers is None else workers
    if count < 1:
        raise ConfigError(f"workers = {count} is out of bounds; allowed: 1 or more")
    # What cannot go well is told before anything starts, and before the folder is taken.
    if config.policy is not None:
        policy = Policy(config.policy)
        policy.check_environment(config.environment)
        drawn = design_names(config.space, policy.environment.sample_design)
        if config.plan.judges and (strange := sorted(set(config.variables) - set(drawn))):
            raise ConfigError(
                f"policy '{config.policy}' judges bodies, and has not seen {', '.join(strange)} vary in its training; "
                f"allowed variables: {', '.join(drawn) or 'none'}"
            )
    if not (Path(folder) / "config.yaml").exists():
        _try_environment(config)
        _try_sampler(config)
    study = StudyFolder.create(folder, config)
    printer = _Printer(study, enabled=progress)
    try:
        if config.screen.enabled:
            with _timed(study, "screen"):
                _run_screen(study, count, printer)
        if judge_jobs(study):
            with _timed(study, "judge"):
                _make_judge(study, printer)
        with _timed(study, "trials"):
            _run_trials(study, count, printer)
        if config.finalists.count:
            with _timed(study, "finalists"):
                _run_finalists(study, count, printer)
    except KeyboardInterrupt:
        done = len(study.results())
        printer.say(f"interrupted: {done} of {config.trials} trials finished; run the same command again to continue")
        raise
    results = write_results(study)
    printer.verdict(results)
    return results


def _try_environment(config: StudyConfig) -> None:
    """Make the environment once, so that wrong options of it show themselves."""
    with suppress(InfeasibleDesign, ConvergenceError):  # whether the baseline can exist is for its trial to tell
        config.environment.make().close()


def _try_sampler(config: StudyConfig) -> None:
    """Propose a body after as many trials as the sampler wants to see first, so that wrong options show themselves.

    Raises:
        ConfigError: if it cannot, or the pruner cannot be made.
    """
    import optuna

    sampler, pruner = config.sampler, config.pruner
    space, rng = distributions(config), np.random.default_rng(0)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        study = optuna.create_study(directions=["maximize"] * (1 + len(config.also)), sampler=make_sampler(sampler, 0))
        for _ in range(sampler.options.get("n_startup_trials", 10) + 1):
            params = {key: float(rng.uniform(config.space[key].low, config.space[key].high)) for key in space}
            values = rng.random(len(study.directions)).tolist()
            study.add_trial(optuna.create_trial(params=params, distributions=space, values=values))
        study.ask(space)
    except Exception as error:  # whatever a wrong value happens to cause
        raise ConfigError(
            f"sampler '{sampler.name}' with sampler.options = {sampler.options} cannot propose a body: {error}"
        ) from error
    try:
        make_pruner(config)
    except ValueError as error:
        raise ConfigError(f"pruner '{pruner.name}' with pruner.options = {pruner.options}: {error}") from None


def _run_screen(study: StudyFolder, workers: int, printer: _Printer) -> None:
    jobs = screen_jobs(study)
    missing = missing_jobs(study, jobs)
    if missing:
        printer.say(f"screen: {len(missing)} bodies by the inverse QP")
        stopped = run_workers(study, "screen", min(workers, len(missing)))
        _demand(all(job.path.exists() for job in jobs), "screen", stopped)
    kept = kept_bodies(study)
    printer.say(f"screen: kept {len(kept)} of {len(jobs)} bodies")


def _make_judge(study: StudyFolder, printer: _Printer) -> None:
    jobs = judge_jobs(study)
    if missing_jobs(study, jobs):
        if study.config.plan.proposer:
            printer.say(f"judge: training bodies and policy together, {study.config.joint.steps:,} steps")
        stopped = run_workers(study, "judge", 1)
        _demand(all(job.path.exists() for job in jobs), "judge", stopped)


def _run_trials(study: StudyFolder, workers: int, printer: _Printer) -> None:
    config = study.config
    with Ledger(study) as ledger:
        baseline = ("baseline", {name: config.baseline[name] for name in config.variables})
        ledger.enqueue([baseline, *promising_bodies(study), *kept_bodies(study)])
        ledger.mirror()
        printer.trials(quiet=True)
        looked = time.monotonic()

        def tick() -> None:
            nonlocal looked
            if time.monotonic() - looked > MIRROR_INTERVAL:
                ledger.mirror()
                looked = time.monotonic()
            printer.trials()

        if ledger.left():
            finished = len(study.results())
            printer.say(f"study '{config.name}': {config.trials} trials, {finished} of them finished before")
        while ledger.left():
            if ledger.claimable():
                stopped = run_workers(study, "trials", min(workers, ledger.left()), tick)
                _demand(stopped is None or ledger.left() == 0, "trials", stopped)
            else:  # another call is at the last ones
                tick()
                time.sleep(0.5)
        ledger.mirror()
        printer.trials()


def _run_finalists(study: StudyFolder, workers: int, printer: _Printer) -> None:
    jobs = finalist_jobs(study)
    missing = missing_jobs(study, jobs)
    if missing:
        bodies = len({job.path.name.partition("-")[0] for job in jobs})
        printer.say(f"test: {bodies} bodies on {study.config.goals.unseen_count} test goals, surrogate and FEM")
        printer.tests(quiet=True)
        stopped = run_workers(study, "finalists", min(workers, len(missing)), printer.tests)
        _demand(all(job.path.exists() for job in jobs), "finalists", stopped)


def _demand(done: bool, phase: str, stopped: str | None) -> None:
    """Raise unless a phase is complete."""
    if not done:
        raise SoftGymError(f"a worker of phase '{phase}' was {stopped}; run the same command again to continue")


@contextmanager
def _timed(study: StudyFolder, phase: str) -> Iterator[None]:
    """Add the time of a block to the account of the study [s]."""
    started = time.perf_counter()
    try:
        yield
    finally:
        with study.lock("account"):
            account = study.account()
            wall = account["wall_seconds"]
            wall[phase] = wall.get(phase, 0.0) + time.perf_counter() - started
            write_json(study.path / "account.json", {**account, "command": _command(study)})


def _command(study: StudyFolder) -> str:
    """The command line that runs the study."""
    if Path(sys.argv[0]).name == "softgym" and "codesign" in sys.argv:
        return shlex.join(["softgym", *sys.argv[1:]])
    return f"softgym codesign --config {shlex.quote(os.path.relpath(study.path / 'config.yaml'))}"


class _Printer:
    """Prints a line per finished trial and test."""

    def __init__(self, study: StudyFolder, *, enabled: bool) -> None:
        self.study = study
        self.enabled = enabled
        self.objective = OBJECTIVES[study.config.objective]
        self._seen: set[str] = set()
        self._best: tuple[float, int] | None = None

    def say(self, line: str) -> None:
        if self.enabled:
            print(line, flush=True)

    def trials(self, *, quiet: bool = False) -> None:
        """Tell of trials that finished since the last call."""
        fresh = [path for path in self.study.path.glob("trials/[0-9]*/result.json") if str(path) not in self._seen]
        for path in sorted(fresh, key=lambda path: path.stat().st_mtime):
            self._seen.add(str(path))
            result = read_json(path)
            if result["score"] is not None and (self._best is None or result["score"] > self._best[0]):
                self._best = (result["score"], result["number"])
            if quiet:
                continue
            label = self.objective.label.lower()
            found = result["state"] if result["score"] is None else f"{label} {self.objective.text(result['score'])}"
            best = "" if self._best is None else f", best {self.objective.text(self._best[0])} (trial {self._best[1]})"
            done = sum("result.json" in name for name in self._seen)
            self.say(
                f"[{done:>{len(str(self.study.config.trials))}}/{self.study.config.trials}] trial {result['number']} "
                f"({result['origin']}): {found}{best}, {result['seconds']:.1f} s"
            )

    def tests(self, *, quiet: bool = False) -> None:
        """Tell of tests that finished since the last call."""
        fresh = [path for path in self.study.path.glob("finalists/trial*.json") if str(path) not in self._seen]
        for path in sorted(fresh, key=lambda path: path.stat().st_mtime):
            self._seen.add(str(path))
            record = read_json(path)
            if quiet:
                continue
            found = record.get("error") or (
                f"success {100 * record['success_rate']:.1f} %, mean distance {1e3 * record['mean_distance']:.2f} mm"
            )
            seed = f" (seed {record['seed']})" if record["seed"] else ""
            which = f"{record['agent']}{seed} on {record['backend']}, {record['goals']} goals"
            self.say(f"test: trial {record['trial']}, {which}: {found}")

    def verdict(self, results: dict[str, Any]) -> None:
        """Tell who won."""
        if results["winner"] is None:
            self.say("no winner: no trial is complete, no body keeps the limits, or no finalists were asked for")
            return
        self.say(f"winner: trial {results['winner']['trial']}")
        for row in results["comparison"]:
            sure = ""
            if row["distance_change_interval"] is not None:
                low, high = (1e3 * value for value in row["distance_change_interval"])
                sure = f", 95 % interval {low:+.2f} to {high:+.2f}"
            self.say(
                f"  {row['agent']} on {row['backend']}, {row['goals']} test goals: success "
                f"{100 * row['baseline']['success_rate']:.1f} -> {100 * row['winner']['success_rate']:.1f} %, distance "
                f"{1e3 * row['baseline']['mean_distance']:.2f} -> {1e3 * row['winner']['mean_distance']:.2f} mm "
                f"(change {1e3 * row['distance_change']:+.2f} mm{sure})"
            )
