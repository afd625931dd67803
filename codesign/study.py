"""Run a co-design study: screen, shared policy, trials, check on FEM."""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.agents.policy import Policy
from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.folder import StudyFolder
from softgym_envs.codesign.metrics.metric import Metric
from softgym_envs.codesign.metrics.sources import Outcome
from softgym_envs.codesign.phases.finalists import check_tests, finalist_jobs
from softgym_envs.codesign.phases.screen import kept_bodies, screen_jobs
from softgym_envs.codesign.phases.shared_policy import shared_policy_jobs
from softgym_envs.codesign.progress import Progress
from softgym_envs.codesign.records import Account, Job
from softgym_envs.codesign.result_files import write_results
from softgym_envs.codesign.results import StudyResults
from softgym_envs.codesign.sampling import make_sampler
from softgym_envs.codesign.scheduling.jobs import missing_jobs
from softgym_envs.codesign.scheduling.optuna_study import distributions, make_pruner
from softgym_envs.codesign.scheduling.processes import run_workers
from softgym_envs.codesign.scheduling.queue import TrialQueue
from softgym_envs.codesign.snapshot import load_study
from softgym_envs.envs.options import design_names
from softgym_envs.errors import ConfigError, ConvergenceError, InfeasibleDesign, SoftGymError
from softgym_envs.extras import require
from softgym_envs.wording import counted

MIRROR_INTERVAL = 1.0
"""Time between two copies of results from other machines [s]."""


def run_study(
    config: StudyConfig,
    folder: str | Path,
    *,
    objective: str | Metric | Callable[[Outcome], Any] | None = None,
    workers: int | None = None,
    progress: bool = True,
) -> StudyResults:
    """Run a study, or continue it: finished work is kept, and nothing runs twice.

    Several calls may work on one folder at the same time and, with a database as storage, on many machines. A folder
    keeps its study: from call to call only its name and title, the number of trials, how workers run, and most settings
    of the finalists may change.

    Args:
        config: the study.
        folder: where everything is written, see `StudyFolder`.
        objective: objective to use instead of that of the configuration: a name, or a function or `Metric` that
            workers can import.
        workers: number of workers; default: that of the configuration.
        progress: whether to print a line per finished trial and test.

    Returns:
        The results, as in ``results.json``.

    Raises:
        ConfigError: if the folder or the database holds another study, the database cannot be opened, the number of
            workers is not positive, the policy was trained for another environment, or the sampler fails.
        ValueError: if the environment cannot be made.
        DataError: if a file of the folder is missing, damaged or edited.
        WeightsError: if the policy to start from is missing or damaged.
        SoftGymError: if an error of the suite ended a worker.
        softgym_envs.codesign.scheduling.processes.WorkerError: if any other exception ended a worker.
    """
    require("codesign")
    if objective is not None:
        config = StudyConfig.model_validate({**config.model_dump(), "objective": objective})
    count = config.workers if workers is None else workers
    if count < 1:
        raise ConfigError(f"workers = {count} is out of bounds; allowed: 1 or more")
    config = config.model_copy(update={"workers": count})  # the report names it
    # Find mistakes before anything is written or started.
    _check_policy(config)
    known = StudyFolder(folder)
    new = not (known.path / "config.yaml").exists()
    if new:
        _try_environment(config)
        _try_sampler(config)
    if new or known.config.finalists != config.finalists:
        check_tests(config)
    study = StudyFolder.create(folder, config)
    load_study(study)  # notice damaged files before anything follows from them
    output = Progress(study, enabled=progress)
    try:
        if config.screen.enabled:
            with _timed(study, "screen"):
                _run_screen(study, count, output)
        if shared_policy_jobs(study):
            with _timed(study, "shared_policy"):
                _copy_shared_policy(study, output)
        with _timed(study, "trials"):
            _run_trials(study, count, output)
        if config.finalists.count:
            with _timed(study, "finalists"):
                _run_finalists(study, count, output)
    except KeyboardInterrupt:
        done = len(study.result_files())
        share = f"{done} of {counted(config.trials, 'trial')}" if done <= config.trials else counted(done, "trial")
        tests = len(list(study.path.glob("finalists/trial*.json")))
        more = f" and {counted(tests, 'test')} of finalists" if tests else ""
        output.say(f"interrupted: {share}{more} finished; run the same command again to continue")
        raise
    results = write_results(load_study(study))
    output.verdict(results)
    return results


def _check_policy(config: StudyConfig) -> None:
    """Raise if the policy to start from, or to score bodies with, does not fit the study."""
    if config.policy is None:
        return
    policy = Policy(config.policy)
    policy.check_environment(config.environment)
    drawn = design_names(config.space, policy.environment.sample_design, "sample_design")
    if config.plan.shares_policy and (unknown := sorted(set(config.variables) - set(drawn))):
        raise ConfigError(
            f"policy '{config.policy}' was trained without variation of {', '.join(unknown)}, so it cannot score "
            f"bodies that differ in it; allowed variables: {', '.join(drawn) or 'none'}"
        )


def _try_environment(config: StudyConfig) -> None:
    """Make the environment once, at both ends of optimised options too, to find wrong options."""
    options = {name: variable for name, variable in config.optimised.items() if "." in name}
    ends = [{n: v.low for n, v in options.items()}, {n: v.high for n, v in options.items()}] if options else [{}]
    for values in ends:
        with suppress(InfeasibleDesign, ConvergenceError):  # whether the baseline can exist is a result of its trial
            config.environment_of(values).make().close()


def _try_sampler(config: StudyConfig) -> None:
    """Propose a body after as many trials as the sampler needs first, to find wrong options.

    Raises:
        ConfigError: if the sampler fails, or the pruner cannot be made.
    """
    import optuna

    sampler, pruner = config.sampler, config.pruner
    space, rng = distributions(config.optimised), np.random.default_rng(0)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        study = optuna.create_study(directions=config.directions, sampler=make_sampler(sampler, 0))
        for _ in range(sampler.options.get("n_startup_trials", 10) + 1):
            params = {name: v.check(rng.uniform(v.low, v.high)) for name, v in config.optimised.items()}
            values = rng.random(len(study.directions)).tolist()
            study.add_trial(optuna.create_trial(params=params, distributions=space, values=values))
        study.ask(space)
    except Exception as error:  # a wrong value may cause any exception
        raise ConfigError(
            f"sampler '{sampler.name}' with sampler.options = {sampler.options} cannot propose a body: {error}"
        ) from error
    try:
        make_pruner(config)
    except ValueError as error:
        raise ConfigError(f"pruner '{pruner.name}' with pruner.options = {pruner.options}: {error}") from None


def _run_workers(
    study: StudyFolder, output: Progress, phase: str, count: int, tick: Callable[[], None] = lambda: None
) -> str | None:
    """Return what `run_workers` does; before, warn if other code began the study."""
    with study.lock("study"):
        change = study.continued()
    if change:
        output.warn(change)
    return run_workers(study, phase, count, tick)


def _run_jobs(
    study: StudyFolder,
    output: Progress,
    phase: str,
    missing: list[Job],
    workers: int,
    tick: Callable[[], None] = lambda: None,
) -> None:
    stopped = _run_workers(study, output, phase, min(workers, len(missing)), tick)
    _require(all(job.path.exists() for job in missing), phase, stopped)


def _run_screen(study: StudyFolder, workers: int, output: Progress) -> None:
    jobs = screen_jobs(study)
    if missing := missing_jobs(study, jobs):
        output.begin("screen", f"{counted(len(missing), 'body')} scored by the inverse QP", len(missing))

        def tick() -> None:
            output.screened(sum(job.path.exists() for job in missing))

        _run_jobs(study, output, "screen", missing, workers, tick)
    output.say(f"screen: kept {len(kept_bodies(study))} of {counted(len(jobs), 'body')}")


def _copy_shared_policy(study: StudyFolder, output: Progress) -> None:
    if missing := missing_jobs(study, shared_policy_jobs(study)):
        _run_jobs(study, output, "shared_policy", missing, 1)


def _run_trials(study: StudyFolder, workers: int, output: Progress) -> None:
    config = study.config
    with TrialQueue(study) as queue:
        queue.enqueue([("baseline", config.baseline_values), *kept_bodies(study)])
        queue.mirror()
        output.trials(quiet=True)
        mirrored = time.monotonic()

        def tick() -> None:
            nonlocal mirrored
            if time.monotonic() - mirrored > MIRROR_INTERVAL:
                queue.mirror()
                mirrored = time.monotonic()
            output.trials()

        queue.claimable()  # recovers the trials of dead workers, so that none counts twice
        if left := queue.left():
            finished = len(study.result_files())
            total = finished + left  # more than config.trials if a study goes on with fewer than it was begun with
            text = f"{counted(total, 'body')} of study '{config.name}', {finished} of them finished before"
            output.begin("trials", text, total, finished)
        while queue.left():
            if queue.claimable():
                stopped = _run_workers(study, output, "trials", min(workers, queue.left()), tick)
                _require(stopped is None or queue.left() == 0, "trials", stopped)
            else:  # another call is running the last ones
                tick()
                time.sleep(0.5)
        queue.mirror()
        output.trials()


def _run_finalists(study: StudyFolder, workers: int, output: Progress) -> None:
    output.tests(quiet=True)
    refinement, first = study.config.finalists.refinement, True
    while True:  # the tests on a finer mesh are known after the others
        snapshot = load_study(study)
        jobs = finalist_jobs(snapshot)
        if all(job.path.exists() for job in jobs):
            return
        tests = [job.path for job in jobs if job.path.parent.name == "finalists"]
        if missing := missing_jobs(study, jobs):
            if refinement is not None and snapshot.refinements:
                text = f"baseline and winner on {counted(refinement.goals, 'unseen goal')}, fem with a finer mesh"
            else:
                goals = counted(len(study.goals["unseen"]), "unseen goal")
                text = (
                    f"{counted(len(snapshot.finalists), 'body')} on {goals}, {' and '.join(study.config.test_backends)}"
                )
            done = sum(path.exists() for path in tests)
            before = f", {done} of {counted(len(tests), 'test')} finished before" if done and first else ""
            output.begin("test", text + before, len(tests), done)
            _run_jobs(study, output, "finalists", missing, workers, output.tests)
        first = False


def _require(done: bool, phase: str, stopped: str | None) -> None:
    """Raise SoftGymError unless a phase is complete."""
    if not done:
        raise SoftGymError(f"a worker of phase '{phase}' was {stopped}; run the same command again to continue")


@contextmanager
def _timed(study: StudyFolder, phase: str) -> Iterator[None]:
    """Add the time of a block to the account of the study."""
    started = time.perf_counter()
    try:
        yield
    finally:
        with study.lock("account"):
            wall = study.account().wall_seconds
            wall[phase] = wall.get(phase, 0.0) + time.perf_counter() - started
            Account(_command(study), wall).write(study.path / "account.json")


def _command(study: StudyFolder) -> str:
    """Return the command line that runs the study."""
    if Path(sys.argv[0]).name == "softgym" and "codesign" in sys.argv:
        return shlex.join(["softgym", *sys.argv[1:]])
    return f"softgym codesign --config {shlex.quote(os.path.relpath(study.path / 'config.yaml'))}"
