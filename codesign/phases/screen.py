"""The screen: many bodies scored cheaply by the inverse QP before any training."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from codesign.folder import StudyFolder
from codesign.objectives import OBJECTIVES, rank_key
from codesign.phases.trial import assess
from codesign.scheduling.jobs import Job
from softgym_envs.storage import read_json

__all__ = ["candidates", "kept_bodies", "screen_jobs", "screen_records"]


def candidates(folder: StudyFolder) -> list[dict[str, float]]:
    """Values of the optimised variables [SI], spread over the box by a Latin hypercube."""
    from scipy.stats import qmc

    config, space = folder.config, folder.config.space
    if not config.screen.enabled:
        return []
    hypercube = qmc.LatinHypercube(len(config.variables), rng=np.random.default_rng(config.sampler.seed))
    points = 2.0 * hypercube.random(config.screen.candidates) - 1.0
    return [
        {name: float(space[name].from_unit(value)) for name, value in zip(config.variables, point, strict=True)}
        for point in points
    ]


def screen_jobs(folder: StudyFolder) -> list[Job]:
    """One job per candidate."""
    config = folder.config

    def make(values: dict[str, float]) -> dict[str, Any]:
        design = dict(config.space.complete(values, config.baseline))
        goals = folder.goals["selection"][: config.screen.goals]
        return {"values": values, "qp": assess("qp", config.environment, goals, design)}

    return [
        Job(folder.path / "screen" / f"{index:03d}.json", partial(make, values))
        for index, values in enumerate(candidates(folder))
    ]


def screen_records(folder: StudyFolder) -> list[dict[str, Any]]:
    """What is known of the candidates, in order, each with its ``index`` and its ``score`` (None: infeasible)."""
    objective = OBJECTIVES[folder.config.objective]
    records = []
    for path in sorted((folder.path / "screen").glob("[0-9]*.json")):
        record = read_json(path)
        score = None if "error" in record["qp"] else objective.score(record["qp"])
        records.append({"index": int(path.stem), "score": score, **record})
    return records


def kept_bodies(folder: StudyFolder) -> list[tuple[str, dict[str, float]]]:
    """Origin and values of the candidates that become trials, best first."""
    feasible = [record for record in screen_records(folder) if record["score"] is not None]
    feasible.sort(key=lambda record: rank_key(record["score"], record["qp"]), reverse=True)
    return [(f"screen {record['index']}", record["values"]) for record in feasible[: folder.config.screen.kept]]
