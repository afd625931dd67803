"""The check on FEM: the best bodies and the baseline, with their controllers and the inverse QP, on unseen goals."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from codesign.folder import StudyFolder
from codesign.jobs import Job
from codesign.objectives import OBJECTIVES, rank_key
from codesign.trial import assess

__all__ = ["BACKENDS", "Finalist", "best_trials", "choose_winner", "evaluations", "finalist_jobs", "finalists"]

BACKENDS = ("surrogate", "fem")
"""Backends every finalist is tested on, the one of the trials first."""


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
    """Results of the complete trials, best first."""
    complete = [result for result in folder.results() if result["state"] == "complete"]
    return sorted(complete, key=lambda r: (*rank_key(r["score"], r["evaluation"]), -r["number"]), reverse=True)


def finalists(folder: StudyFolder) -> list[Finalist]:
    """The baseline and the best other bodies, best first; without the baseline if it is infeasible."""
    config = folder.config
    ranked = best_trials(folder)
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


def _path(folder: StudyFolder, finalist: Finalist, agent: str, backend: str, goals: str) -> Path:
    return folder.path / "finalists" / f"trial{finalist.number:04d}-{agent}-{backend}-{goals}.json"


def finalist_jobs(folder: StudyFolder) -> list[Job]:
    """One job per body, controller and backend, the slow ones first."""
    config = folder.config
    own = config.environment
    options = {"surrogate": {}, "fem": config.finalists.fem_options, own.backend: own.backend_options}
    environments = {
        backend: own.model_copy(update={"backend": backend, "backend_options": options[backend]})
        for backend in BACKENDS
    }

    def make(finalist: Finalist, agent: str, backend: str, goals: str) -> dict[str, Any]:
        controller = folder.path / finalist.policy if agent == "sac" and finalist.policy else agent
        return {
            "trial": finalist.number,
            "agent": agent,
            "backend": backend,
            "goals": goals,
            **assess(controller, environments[backend], folder.goals[goals], finalist.design),
        }

    jobs = []
    for backend in reversed(BACKENDS):
        for finalist in finalists(folder):
            tests = [(agent, "unseen") for agent in finalist.agents]
            if config.finalists.choose == "fem" and backend == "fem":
                tests.append((finalist.agents[0], "selection"))
            for agent, goals in tests:
                arguments = (finalist, agent, backend, goals)
                jobs.append(Job(_path(folder, *arguments), partial(make, *arguments)))
    return jobs


def evaluations(folder: StudyFolder) -> list[dict[str, Any]]:
    """All evaluations of the present finalists that are done."""
    paths = [job.path for job in finalist_jobs(folder)]
    return [json.loads(path.read_text()) for path in sorted(paths) if path.exists()]


def choose_winner(folder: StudyFolder, records: list[dict[str, Any]]) -> Finalist | None:
    """Name the winner without a look at the unseen goals; it may be the baseline.

    Args:
        folder: the study.
        records: what `evaluations` returns.
    """
    bodies = {finalist.number: finalist for finalist in finalists(folder)}
    if not bodies:
        return None
    if folder.config.finalists.choose == "fem":
        objective = OBJECTIVES[folder.config.objective]
        chosen = [r for r in records if r["goals"] == "selection" and "error" not in r and r["trial"] in bodies]
        if chosen:
            best = max(chosen, key=lambda r: (*rank_key(objective.score(r), r), -r["trial"]))
            return bodies[best["trial"]]
    ranked = [result["number"] for result in best_trials(folder)]
    return bodies[next(number for number in ranked if number in bodies)]
