"""Train and evaluate many configurations with several seeds, one process each.

Trainings go to ``FOLDER/runs/<config>/seed<k>``. Results, which `softgym_envs.extensions.sweeps.results` reads, go to
``FOLDER/results/<config>``: ``seed<k>.json`` for each policy and ``baselines.json`` for the agents that need no
training, all on the same unseen goals. Finished jobs are not repeated, and an interrupted training resumes from its
checkpoint. The folder keeps its configurations and numbers of goals (`softgym_envs.runs.RunFolder`); configurations and
seeds may be added.
"""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.learners import LEARNERS
from softgym_envs.config import Config, load_config
from softgym_envs.errors import ConfigError
from softgym_envs.executors import parallel_map
from softgym_envs.runs import RunFolder, check_compatible, provenance
from softgym_envs.storage import read_signed, write_signed

if TYPE_CHECKING:
    from softgym_envs.extensions.sweeps.results import Evaluations


class SweepConfig(Config):
    """What a folder of results holds.

    Attributes:
        configs: configuration of the trainings by name; their seeds do not count.
        goals: number of unseen goals on the surrogate.
        fem_goals: number of unseen goals on FEM.
    """

    configs: dict[str, TrainConfig]
    goals: int
    fem_goals: int


TEST_SEED = 2_000_003
"""Seed of the goals that are used neither for training nor for choosing policies."""


def unseen_goals(environment: EnvironmentConfig, count: int) -> tuple[list[Mapping[str, float]] | None, np.ndarray]:
    """Return bodies (None: the single body) and goals [m] (n, p, 3) of the final evaluation; n = 1 if all are equal."""
    from softgym_envs.agents.evaluation import evaluation_set

    designs, goals = evaluation_set(environment, count, TEST_SEED)
    if designs is None and (goals == goals[0]).all():
        goals = goals[:1]
    return designs, goals


def _evaluations(
    environment: EnvironmentConfig, agents: dict[str, str | Path], goals: int, fem_goals: int
) -> Evaluations:
    """Evaluate agents on the environment's backend and on FEM: ``{backend: {agent: evaluation}}``, in SI units."""
    from softgym_envs.agents.evaluation import evaluate

    counts = _counts(environment, goals, fem_goals)
    designs, paths = unseen_goals(environment, max(counts.values()))
    found: Evaluations = {}
    for backend, count in counts.items():
        found[backend] = {}
        for name, agent in agents.items():
            outcome = evaluate(
                agent,
                environment.on(backend),
                paths[:count],
                design=None if designs is None else designs[:count],
                seed=TEST_SEED,
            )
            found[backend][name] = {
                "distances": _short(outcome.distances),
                "tracking_distances": _short(outcome.tracking_distances),
                "returns": _short(outcome.returns),
                "successes": outcome.successes.astype(int).tolist(),
                "steps": outcome.steps,
                "seconds": round(outcome.seconds, 2),
            }
    return found


def _counts(environment: EnvironmentConfig, goals: int, fem_goals: int) -> dict[str, int]:
    """Return the number of goals for each backend that agents are evaluated on."""
    own = environment.backend
    expected = {"fem": fem_goals} if own == "fem" else {own: goals, "fem": fem_goals}
    return {backend: count for backend, count in expected.items() if count > 0}


def _short(values: np.ndarray) -> list[float]:
    return [float(f"{value:.6g}") for value in values]


def _finished(result: Path) -> bool:
    """Return whether a result exists; raises DataError if it is damaged, edited or renamed."""
    return result.exists() and bool(read_signed(result, "remove it to compute it again"))


def train_and_evaluate(path: Path, seed: int, folder: Path, goals: int, fem_goals: int) -> Path:
    """Train one configuration with one seed, evaluate its policy and return the file of the result."""
    from softgym_envs.agents.policy import Policy
    from softgym_envs.agents.training import train

    name = path.stem
    result = folder / "results" / name / f"seed{seed}.json"
    config = load_config(path, TrainConfig).model_copy(update={"seed": seed})
    if _finished(result):
        return result
    policy = train(config, folder / "runs" / name / f"seed{seed}", progress=False)
    card = Policy(policy).card
    write_signed(
        result,
        {
            "config": card["config"],
            "seed": seed,
            "steps": card["steps"],
            "best_step": card["best_step"],
            "cpu_seconds": card.get("cpu_seconds"),
            "horizon": config.environment.row.max_episode_steps,
            "curve": card["curve"],
            "evaluations": _evaluations(config.environment, {config.learner: policy}, goals, fem_goals),
            "provenance": provenance(),
        },
    )
    return result


def evaluate_baselines(path: Path, folder: Path, goals: int, fem_goals: int) -> Path:
    """Evaluate the agents that need no training on the goals of a configuration; return the file of the result."""
    result = folder / "results" / path.stem / "baselines.json"
    config = load_config(path, TrainConfig)
    if _finished(result):
        return result
    environment = config.environment
    agents: dict[str, str | Path] = {name: name for name in environment.task_class.agents}
    write_signed(
        result,
        {
            "environment": environment.model_dump(mode="json"),
            "horizon": environment.row.max_episode_steps,
            "evaluations": _evaluations(environment, agents, goals, fem_goals),
            "provenance": provenance(),
        },
    )
    return result


def _attempt(function: Callable[..., Path], arguments: tuple[Any, ...]) -> tuple[str, str | None]:
    """Run a job and return its label and traceback, so that an error in one job does not stop the others."""
    label = " ".join(str(a) for a in arguments[:2] if not isinstance(a, Path)) or "baselines"
    label = f"{arguments[0].stem} {label}"
    try:
        function(*arguments)
    except Exception:
        return label, traceback.format_exc()
    return label, None


def _cost(config: TrainConfig) -> float:
    """Return the rough CPU time of a training [s]; the longest trainings run first."""
    step = 0.02 if config.environment.backend == "fem" else 1e-4
    return config.steps * (step + LEARNERS[config.learner].update_seconds(config) / config.num_envs)


def run_sweep(
    configs: Sequence[Path],
    seeds: Sequence[int],
    workers: int,
    folder: Path,
    *,
    goals: int = 100,
    fem_goals: int = 10,
) -> int:
    """Run every configuration with every seed, and its baselines; return the number of failed jobs.

    Args:
        configs: YAML files of `TrainConfig`.
        seeds: seeds of the trainings.
        workers: number of processes.
        folder: folder of all results.
        goals: number of unseen goals on the surrogate.
        fem_goals: number of unseen goals on FEM; 0 skips FEM for environments on the surrogate.

    Raises:
        ConfigError: before anything runs, if a file is invalid, an environment would not be evaluated, the folder holds
            another configuration of a name or other numbers of goals, or another process uses it.
        DataError: before anything runs, if a result is damaged or edited.
    """
    loaded = {path: load_config(path, TrainConfig) for path in configs}
    for path, config in loaded.items():
        if config.environment.backend == "fem" and fem_goals < 1:
            raise ConfigError(
                f"fem_goals = {fem_goals}, but the environment of '{path}' runs on FEM; allowed: 1 or more"
            )
    run = RunFolder(folder, SweepConfig, "a sweep")
    known = run.config.configs if run.begun else {}
    named = {path.stem: config for path, config in loaded.items()}
    whole = SweepConfig(configs={**known, **named}, goals=goals, fem_goals=fem_goals)
    if run.begun:
        here = whole.model_copy(update={"configs": {name: named[name] for name in named if name in known}})
        before = run.config.model_copy(update={"configs": {name: known[name] for name in here.configs}})
        may_change = [f"configs.{name}.seed" for name in known]
        check_compatible(before, here, f"folder '{folder}' holds a sweep", may_change=may_change)
    with run.alone():
        if run.begun:
            run.keep(whole)
            if change := run.continued():
                print(f"warning: {change}", file=sys.stderr)
        else:
            run.begin(whole)
        return _run(loaded, seeds, workers, folder, goals, fem_goals)


def _run(
    loaded: Mapping[Path, TrainConfig], seeds: Sequence[int], workers: int, folder: Path, goals: int, fem_goals: int
) -> int:
    jobs: list[tuple[float, Callable[..., Path], tuple[Any, ...]]] = []
    environments: list[EnvironmentConfig] = []
    total = 0
    for path, config in loaded.items():
        place = folder / "results" / path.stem
        for seed in seeds:
            if not _finished(place / f"seed{seed}.json"):
                jobs.append((_cost(config), train_and_evaluate, (path, seed, folder, goals, fem_goals)))
        total += len(seeds)
        if config.environment in environments:
            continue  # the baselines are evaluated once for all learners in an environment
        environments.append(config.environment)
        total += 1
        if not _finished(place / "baselines.json"):
            jobs.append((0.0, evaluate_baselines, (path, folder, goals, fem_goals)))
    before = total - len(jobs)
    if before:
        print(f"{before} jobs are already finished", flush=True)
    jobs.sort(key=lambda job: -job[0])
    begun, failed = time.perf_counter(), 0
    finished = parallel_map(_attempt, [job[1:] for job in jobs], workers)
    for done, (label, error) in enumerate(finished, 1):
        failed += error is not None
        print(f"{time.perf_counter() - begun:7.1f} s  {done}/{len(jobs)}  {label}  {error or 'done'}", flush=True)
    return failed
