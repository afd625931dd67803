"""Train and evaluate many configurations with several seeds, one process each.

    python -m softgym_envs.agents.sweep --configs finger_reach mine.yaml --seeds 0 1 2 --processes 16 --folder results

Trainings go to ``FOLDER/runs/<config>/seed<k>``. Results, which `softgym_envs.agents.results` reads, go to
``FOLDER/results/<config>``: ``seed<k>.json`` for each policy and ``baselines.json`` for the agents that need no
training, all on the same unseen goals. Finished jobs are not repeated, and an interrupted training resumes from its
checkpoint. A folder with results of another configuration or number of goals is refused.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.learners import LEARNERS
from softgym_envs.config import check_config, difference, load_config, shipped_configs
from softgym_envs.errors import ConfigError, DataError, SoftGymError
from softgym_envs.executors import parallel_map
from softgym_envs.runs import provenance
from softgym_envs.storage import read_json, write_json

if TYPE_CHECKING:
    from softgym_envs.agents.results import Evaluations

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


def _finished(result: Path, config: TrainConfig, goals: int, fem_goals: int) -> bool:
    """Whether the result of this configuration on these numbers of goals exists.

    Args:
        result: ``seed<k>.json``, or ``baselines.json``, for which only the environment of ``config`` is compared.
        config: the requested configuration, with its seed.
        goals: unseen goals on the environment's backend.
        fem_goals: unseen goals on FEM.

    Raises:
        DataError: if the file holds another result or cannot be read.
    """
    if not result.exists():
        return False
    stored, where = read_json(result), f"result '{result}'"
    try:
        if "config" in stored:
            old = check_config(TrainConfig, stored["config"], where)
        else:
            old = check_config(TrainConfig, {**config.model_dump(), "environment": stored["environment"]}, where)
        found = {
            backend: len(next(iter(agents.values()))["distances"]) for backend, agents in stored["evaluations"].items()
        }
    except (KeyError, TypeError, AttributeError, StopIteration) as error:
        raise DataError(f"{where} is not the result of a sweep: {type(error).__name__} {error}") from None
    other = difference(old, config)
    expected = _counts(config.environment, goals, fem_goals)
    if other is None and found != expected:
        # A task whose goals are all equal is evaluated on one of them.
        if set(found.values()) == {1} and len(unseen_goals(config.environment, 2)[1]) == 1:
            expected = dict.fromkeys(expected, 1)
        if found != expected:
            other = f"goals = {found}, got {expected}"
    if other is not None:
        raise DataError(f"{where} belongs to another sweep: {other}; choose another folder")
    return True


def train_and_evaluate(path: Path, seed: int, folder: Path, goals: int, fem_goals: int) -> Path:
    """Train one configuration with one seed, evaluate its policy and return the file of the result."""
    from softgym_envs.agents.policy import Policy
    from softgym_envs.agents.training import train

    name = path.stem
    result = folder / "results" / name / f"seed{seed}.json"
    config = load_config(path, TrainConfig).model_copy(update={"seed": seed})
    if _finished(result, config, goals, fem_goals):
        return result
    policy = train(config, folder / "runs" / name / f"seed{seed}", progress=False)
    card = Policy(policy).card
    write_json(
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
    if _finished(result, config, goals, fem_goals):
        return result
    environment = config.environment
    agents: dict[str, str | Path] = {name: name for name in environment.task_class.agents}
    write_json(
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


def sweep(
    configs: Sequence[Path],
    seeds: Sequence[int],
    processes: int,
    folder: Path,
    *,
    goals: int = 100,
    fem_goals: int = 10,
) -> int:
    """Run every configuration with every seed, and its baselines; return the number of failed jobs.

    Args:
        configs: YAML files of `TrainConfig`.
        seeds: seeds of the trainings.
        processes: number of processes.
        folder: folder of all results.
        goals: number of unseen goals on the surrogate.
        fem_goals: number of unseen goals on FEM; 0 skips FEM for environments on the surrogate.

    Raises:
        ConfigError: before anything runs, if a file is invalid or an environment would not be evaluated.
        DataError: before anything runs, if the folder holds results of another configuration or number of goals.
    """
    loaded = {path: load_config(path, TrainConfig) for path in configs}
    for path, config in loaded.items():
        if config.environment.backend == "fem" and fem_goals < 1:
            raise ConfigError(
                f"fem_goals = {fem_goals}, but the environment of '{path}' runs on FEM; allowed: 1 or more"
            )
    jobs: list[tuple[float, Callable[..., Path], tuple[Any, ...]]] = []
    environments: list[EnvironmentConfig] = []
    total = 0
    for path, config in loaded.items():
        place = folder / "results" / path.stem
        for seed in seeds:
            seeded = config.model_copy(update={"seed": seed})
            if not _finished(place / f"seed{seed}.json", seeded, goals, fem_goals):
                jobs.append((_cost(config), train_and_evaluate, (path, seed, folder, goals, fem_goals)))
        total += len(seeds)
        if config.environment in environments:
            continue  # the baselines are evaluated once for all learners in an environment
        environments.append(config.environment)
        total += 1
        if not _finished(place / "baselines.json", config, goals, fem_goals):
            jobs.append((0.0, evaluate_baselines, (path, folder, goals, fem_goals)))
    before = total - len(jobs)
    if before:
        print(f"{before} jobs are already finished", flush=True)
    jobs.sort(key=lambda job: -job[0])
    begun, failed = time.perf_counter(), 0
    finished = parallel_map(_attempt, [job[1:] for job in jobs], processes)
    for done, (label, error) in enumerate(finished, 1):
        failed += error is not None
        print(f"{time.perf_counter() - begun:7.1f} s  {done}/{len(jobs)}  {label}  {error or 'done'}", flush=True)
    return failed


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of ``python -m softgym_envs.agents.sweep``."""
    parser = argparse.ArgumentParser(
        prog="python -m softgym_envs.agents.sweep", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--configs", nargs="+", help="names of shipped configurations, or files (default: all shipped)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--goals", type=int, default=100, help="number of unseen goals on the surrogate")
    parser.add_argument(
        "--fem-goals",
        type=int,
        default=10,
        help="number of unseen goals on FEM; 0 skips FEM for environments on the surrogate",
    )
    given = parser.parse_args(arguments)
    shipped = shipped_configs("agents")
    # Worker processes read these variables when they start.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"
    if find_spec("platformdirs") is None:
        os.environ.setdefault("SOFTGYM_CACHE", str(given.folder / "cache"))
    try:
        failed = sweep(
            [shipped.get(name, Path(name)) for name in given.configs or shipped],
            given.seeds,
            given.processes,
            given.folder,
            goals=given.goals,
            fem_goals=given.fem_goals,
        )
    except SoftGymError as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        print("stopped; run the same command again to continue", file=sys.stderr)
        return 130
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
