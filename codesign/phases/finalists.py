"""The check on FEM: the best bodies and the baseline, with their controllers and the inverse QP, on unseen goals."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from agents.config import EnvironmentConfig
from agents.policy import policy_path
from codesign.config import StudyConfig
from codesign.folder import StudyFolder
from codesign.objectives import OBJECTIVES, rank_key, violations
from codesign.phases.shared_policy import JUDGE
from codesign.phases.trial import assess, training_config
from codesign.scheduling.jobs import Job
from softgym_envs.errors import ConfigError, ConvergenceError, InfeasibleDesign
from softgym_envs.storage import read_json, write_json

__all__ = [
    "BACKENDS",
    "Finalist",
    "best_trials",
    "check_tests",
    "choose_winner",
    "evaluations",
    "finalist_jobs",
    "finalists",
    "pareto_trials",
    "trainings",
]

BACKENDS = ("surrogate", "fem")
"""Backends every finalist is tested on; where a robot has no surrogate, FEM alone."""


@dataclass(frozen=True)
class Finalist:
    """A body in the final test.

    Args:
        number: its trial.
        role: ``"baseline"`` or ``"finalist"``.
        design: complete design [SI].
        score: score of its trial, larger is better.
        policy: policy of its trial relative to the folder, or None where the strategy has none.
    """

    number: int
    role: str
    design: dict[str, float]
    score: float
    policy: str | None

    @property
    def agents(self) -> tuple[str, ...]:
        """Controllers to test: the trial's own first."""
        return ("qp",) if self.policy is None else ("sac", "qp")


def best_trials(folder: StudyFolder) -> list[dict[str, Any]]:
    """Results of the complete trials, best first: those that keep the limits, then those that break them least."""
    complete = [result for result in folder.results() if result["state"] == "complete"]

    def key(result: dict[str, Any]) -> tuple[float, ...]:
        broken = zip(folder.config.limits.values(), result["violations"] or (), strict=False)
        excess = sum(max(0.0, value) / (abs(limit) or 1.0) for limit, value in broken)
        return (-excess, *rank_key(result["score"], result["evaluation"]), -result["number"])

    return sorted(complete, key=key, reverse=True)


def pareto_trials(folder: StudyFolder) -> list[dict[str, Any]]:
    """Results of the trials that keep the limits and that no other such trial beats in every objective."""
    allowed = [r for r in best_trials(folder) if all(value <= 0.0 for value in r["violations"] or ())]
    scores = np.array([result["scores"] for result in allowed])

    def beaten(own: np.ndarray) -> bool:
        return bool(((scores >= own).all(axis=1) & (scores > own).any(axis=1)).any())

    return [result for result, own in zip(allowed, scores, strict=True) if not beaten(own)]


def finalists(folder: StudyFolder) -> list[Finalist]:
    """The baseline and the best other bodies, best first; without the baseline if it is infeasible.

    A body that samplers proposed again and again is one body: its first trial.
    """
    config = folder.config
    bodies: dict[tuple[float, ...], dict[str, Any]] = {}
    for result in best_trials(folder):
        key = tuple(result["design"].values())
        if key not in bodies or result["origin"] == "baseline":
            bodies[key] = result
    ranked = list(bodies.values())
    baseline = [result for result in ranked if result["origin"] == "baseline"]
    others = [result for result in ranked if result["origin"] != "baseline"][: config.finalists.count]
    return [
        Finalist(
            number=result["number"],
            role="baseline" if result["origin"] == "baseline" else "finalist",
            design=result["design"],
            score=result["score"],
            policy=None if result["agent"] == "qp" else result["agent"],
        )
        for result in (baseline + others if config.finalists.count else [])
    ]


def _path(folder: StudyFolder, finalist: Finalist, agent: str, backend: str, goals: str, seed: int) -> Path:
    name = f"trial{finalist.number:04d}-{agent}{f'-seed{seed}' if seed else ''}-{backend}-{goals}.json"
    return folder.path / "finalists" / name


def seeds_of(folder: StudyFolder, agent: str) -> range:
    """Seeds of the policies that a finalist is tested with; 0 is the policy of the trial itself."""
    count = folder.config.finalists.seeds
    return range(1, count + 1) if agent == "sac" and count else range(1)


def trained_policy(folder: StudyFolder, finalist: Finalist, seed: int) -> Path:
    """The policy of a finalist trained anew with a seed, from where the policies of the trials start."""
    from agents.training import train

    config = folder.config
    training = training_config(folder, finalist.design)
    steps = config.finalists.steps or training.steps
    initial = config.policy if config.plan.trains else str(folder.path / JUDGE)
    sac = training.sac
    if initial is not None:  # its networks decide
        card = read_json(policy_path(initial).with_suffix(".json"))
        sac = sac.model_copy(update={"net_arch": card["config"]["sac"]["net_arch"]})
    training = training.model_copy(
        update={
            "sac": sac,
            "seed": training.seed + seed,
            "steps": steps,
            "report_every": min(training.report_every, steps),
        }
    )
    name = f"trial{finalist.number:04d}-seed{seed}"
    place = folder.path / "finalists" / name
    with folder.lock(f"training-{name}"):
        policy = train(training, place, initial=initial, progress=False)
        if not (place / "training.json").exists():
            objective = OBJECTIVES[config.objective]
            trained = read_json(policy.with_suffix(".json"))
            curve = trained["curve"]
            write_json(
                place / "training.json",
                {
                    "trial": finalist.number,
                    "seed": training.seed,
                    "steps": steps,
                    "report_steps": len(curve) * training.evaluation_episodes * config.episode_steps,
                    "cpu_seconds": trained["cpu_seconds"],
                    # Not every objective is followed during a training.
                    "curve": [[row["step"], objective.score(row)] for row in curve if objective.key in row],
                },
            )
        return policy


def trainings(folder: StudyFolder) -> list[dict[str, Any]]:
    """What is told of the policies that were trained anew for the present finalists."""
    numbers = [body.number for body in finalists(folder)]
    told = [read_json(path) for path in sorted(folder.path.glob("finalists/*/training.json"))]
    return [row for row in told if row["trial"] in numbers]


def fetch_policies(folder: StudyFolder) -> None:
    """Copy the policies of finalists that were trained on other machines into the folder.

    Raises:
        DataError: if one is nowhere.
    """
    for body in finalists(folder):
        if body.policy is not None:
            folder.policy(body.policy)


def _environments(config: StudyConfig) -> dict[str, EnvironmentConfig]:
    """What finalists are tested in, by backend."""
    own = config.environment
    options: dict[str, dict[str, Any]] = {"surrogate": {}, "fem": {}, own.backend: own.backend_options}
    options["fem"] = {**options["fem"], **config.finalists.fem_options}
    backends = BACKENDS if own.has_surrogate else ("fem",)
    return {
        backend: own.model_copy(update={"backend": backend, "backend_options": options[backend]})
        for backend in backends
    }


def check_tests(config: StudyConfig) -> None:
    """Build the baseline on FEM as for the tests of the finalists, where they have options of their own (seconds).

    Raises:
        ConfigError: for an option that the backend does not take.
    """
    options = config.finalists.fem_options
    if not (options and config.finalists.count):
        return
    try:
        _environments(config)["fem"].make(sample_design=False).close()
    except ValueError as error:
        raise ConfigError(f"finalists cannot be tested with finalists.fem_options = {options}: {error}") from None
    except (InfeasibleDesign, ConvergenceError):  # of the baseline: a result of the test
        pass


def finalist_jobs(folder: StudyFolder) -> list[Job]:
    """One job per body, controller and backend, the slow ones first."""
    config = folder.config
    environments = _environments(config)

    def make(finalist: Finalist, agent: str, backend: str, goals: str, seed: int) -> dict[str, Any]:
        controller: str | Path = agent
        if agent == "sac" and finalist.policy:
            controller = trained_policy(folder, finalist, seed) if seed else folder.path / finalist.policy
        return {
            "trial": finalist.number,
            "agent": agent,
            "backend": backend,
            "goals": goals,
            "seed": seed,
            **assess(controller, environments[backend], folder.goals[goals], finalist.design),
        }

    jobs = []
    for backend in reversed(environments):
        for finalist in finalists(folder):
            tests = [(agent, "unseen") for agent in finalist.agents]
            if config.finalists.choose == "fem" and backend == "fem":
                tests.append((finalist.agents[0], "selection"))
            for agent, goals in tests:
                for seed in seeds_of(folder, agent):
                    arguments = (finalist, agent, backend, goals, seed)
                    jobs.append(Job(_path(folder, *arguments), partial(make, *arguments)))
    return jobs


def evaluations(folder: StudyFolder) -> list[dict[str, Any]]:
    """All evaluations of the present finalists that are done; those with several seeds as their mean, goal by goal."""
    paths = [job.path for job in finalist_jobs(folder)]
    groups: dict[tuple, list[dict[str, Any]]] = {}
    for path in sorted(path for path in paths if path.exists()):
        record = read_json(path)
        groups.setdefault(tuple(record[key] for key in ("trial", "agent", "backend", "goals")), []).append(record)
    return [_mean(records) for records in groups.values()]


def _mean(records: list[dict[str, Any]]) -> dict[str, Any]:
    """One record of several seeds."""
    failed = [record for record in records if "error" in record]
    if failed or len(records) == 1:
        return (failed or records)[0]
    merged: dict[str, Any] = {key: records[0][key] for key in ("trial", "agent", "backend", "goals")}
    merged["seeds"] = [record["seed"] for record in records]
    for key in records[0]:
        if key in merged or key == "seed":
            continue
        values = [record[key] for record in records]
        if key in ("steps", "seconds", "cpu_seconds"):
            merged[key] = sum(values)
        elif key == "worst_distance":
            merged[key] = max(values)
        else:
            merged[key] = np.mean(np.array(values, dtype=float), axis=0).tolist()
    # Seeds and goals, for intervals over both.
    merged["of_seeds"] = {k: [record[k] for record in records] for k in records[0] if isinstance(records[0][k], list)}
    return merged


def choose_winner(folder: StudyFolder, records: list[dict[str, Any]]) -> Finalist | None:
    """Name the winner without a look at the unseen goals; it may be the baseline. None if no body keeps the limits.

    Args:
        folder: the study.
        records: what `evaluations` returns.
    """
    config = folder.config
    ranked = [r["number"] for r in best_trials(folder) if all(value <= 0.0 for value in r["violations"] or ())]
    bodies = {finalist.number: finalist for finalist in finalists(folder) if finalist.number in ranked}
    if config.finalists.choose == "fem":
        objective = OBJECTIVES[config.objective]
        chosen = [r for r in records if r["goals"] == "selection" and "error" not in r and r["trial"] in bodies]
        measured = {name: limit for name, limit in config.limits.items() if not OBJECTIVES[name].of_body}
        kept = [r for r in chosen if all(value <= 0.0 for value in violations(measured, r))]
        if chosen:
            best = max(kept, key=lambda r: (*rank_key(objective.score(r), r), -r["trial"]), default=None)
            return None if best is None else bodies[best["trial"]]
    return next((bodies[number] for number in ranked if number in bodies), None)
