"""Screen: the inverse QP scores many bodies cheaply before the trials."""

from __future__ import annotations

from functools import partial

import numpy as np

from softgym_envs.codesign.folder import StudyFolder
from softgym_envs.codesign.phases.trial import assess, rate
from softgym_envs.codesign.records import Job, ScreenResult
from softgym_envs.codesign.scoring import scoring


def candidates(folder: StudyFolder) -> list[dict[str, float]]:
    """Return values of the optimised variables [SI], spread over their box by a Latin hypercube."""
    from scipy.stats import qmc

    config = folder.config
    if not config.screen.enabled:
        return []
    variables = config.optimised
    hypercube = qmc.LatinHypercube(len(variables), rng=np.random.default_rng(config.sampler.seed))
    points = 2.0 * hypercube.random(config.screen.candidates) - 1.0
    return [
        {
            name: float(variable.from_unit(value))
            for (name, variable), value in zip(variables.items(), point, strict=True)
        }
        for point in points
    ]


def screen_jobs(folder: StudyFolder) -> list[Job]:
    """Return one job per candidate."""
    config = folder.config

    def make(index: int, values: dict[str, float]) -> ScreenResult:
        design, options = config.body(values)
        goals = folder.goals["selection"][: config.screen.goals]
        result = ScreenResult(index, design=values)
        with scoring(result):
            found = assess("qp", config, config.environment_of(options), goals, design)
            result.evaluation = found.evaluation
            rate(result, config, found)
        return result

    return [
        Job(folder.path / "screen" / f"{index:03d}.json", partial(make, index, values))
        for index, values in enumerate(candidates(folder))
    ]


def kept_bodies(folder: StudyFolder) -> list[tuple[str, dict[str, float]]]:
    """Return origin and values of the candidates that become trials, best first."""

    def key(result: ScreenResult) -> tuple[float, float]:
        assert result.evaluation is not None
        return result.scores[0], -result.evaluation.mean_distance

    results = (ScreenResult.read(path) for path in sorted(folder.path.glob("screen/[0-9]*.json")))
    feasible = sorted((result for result in results if result.feasible), key=key, reverse=True)
    return [(f"screen {result.index}", result.design) for result in feasible[: folder.config.screen.kept]]
