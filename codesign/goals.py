"""Goals of a study: the same for all bodies, reachable or not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.variables import is_option

STREAM = 0x60A15
"""Separates the seeds of a study's goals from those of trainings, which draw goals from the same task."""


@dataclass(frozen=True)
class Stratum:
    """Goals of one kind, some of which stand for all of them.

    Attributes:
        share: of these goals among all.
        numbers: which goals were chosen, from 0.
    """

    share: float
    numbers: tuple[int, ...]


def first_goals(total: int, count: int) -> list[Stratum]:
    """Return the first ``count`` of ``total`` goals, which stand for all: goals are drawn in random order."""
    return [Stratum(1.0, tuple(range(min(count, total))))]


def missed_first(missed: np.ndarray, count: int) -> list[Stratum]:
    """Choose half of ``count`` goals among those missed and half among the others, the first ones of each kind.

    If one kind has too few, the other one has more. A mean over all goals is that of the kinds, weighted by their
    shares, so it has no bias, however the kinds were told apart.

    Args:
        missed: whether each goal is missed, shape (k,).
        count: number of goals to choose, from 2.
    """
    kinds = [np.flatnonzero(missed), np.flatnonzero(~np.asarray(missed))]
    first = min(len(kinds[0]), max(count // 2, count - len(kinds[1])))
    counts = [first, min(len(kinds[1]), count - first)]
    return [
        Stratum(len(kind) / len(missed), tuple(kind[:chosen].tolist()))
        for kind, chosen in zip(kinds, counts, strict=True)
        if len(kind)
    ]


def family_goals(config: StudyConfig, count: int) -> np.ndarray:
    """Return effector positions [m] (count, 3) of random bodies under random commands, on the surrogate.

    The bodies differ from the baseline of the study in the variables ``goals.vary``.
    """
    from softgym_envs.backends.surrogate import solve_displacements
    from softgym_envs.surrogate.pretrained import pretrained_model

    robot, goals = config.robot, config.goals
    rng = np.random.default_rng(goals.seed)
    optimised = [name for name in config.variables if not is_option(name)]
    vary = tuple(optimised if goals.vary is None else goals.vary)
    drawn = [robot.design_space.sample(rng, vary) for _ in range(count)]
    designs = [[body[n] if n in vary else value for n, value in config.baseline.items()] for body in drawn]
    low = robot.lower + goals.command_low * (robot.upper - robot.lower)
    commands = robot.balanced(rng.uniform(low, robot.upper, (count, len(low))))
    model = pretrained_model(robot, config.environment.backend_options.get("weights"))
    unilateral = robot.unilateral
    settled = solve_displacements(
        model, model.context(np.array(designs)), commands, np.zeros_like(commands), unilateral
    )
    return settled.effector[:, :3]


def zone_goals(config: StudyConfig, count: int) -> np.ndarray:
    """Return points [m] (count, 3) spread evenly (scrambled Halton) over the work zone of a study."""
    from scipy.stats import qmc

    zone = config.goals.zone
    assert zone is not None  # checked by the configuration
    unit = qmc.Halton(3, rng=np.random.default_rng(config.goals.seed)).random(count)
    # Shuffle the points so that any subset fills the zone.
    np.random.default_rng([config.goals.seed, 1]).shuffle(unit)
    return np.asarray(zone.center) + (2.0 * unit - 1.0) * np.asarray(zone.half_size)


def draw_goals(config: StudyConfig) -> dict[str, Any]:
    """Return three disjoint sets of goals of a study [m], as plain data.

    If the task draws the goals, their seeds differ from those of every training.

    Returns:
        ``training`` (k, 3), empty if trainings draw goals from the task; ``selection`` and ``unseen`` (k, p, 3), which
        are equal if the task has only one path.
    """
    goals = config.goals
    count = goals.count + goals.unseen_count
    if goals.source == "task":
        from softgym_envs.agents.evaluation import sample_goals

        # Larger than 32 bits, unlike the seeds of trainings.
        seed = (1 << 64) + int(np.random.SeedSequence([goals.seed, STREAM]).generate_state(1, np.uint64)[0])
        paths, training = sample_goals(config.environment, count, seed), np.zeros((0, 3))
    else:
        draw = family_goals if goals.source == "family" else zone_goals
        points = draw(config, count + goals.training_count)
        paths, training = points[:count, None], points[count:]
    drawn = {"training": training, "selection": paths[: goals.count], "unseen": paths[goals.count :]}
    if (paths == paths[0]).all():  # the task has only one path
        drawn |= {"selection": paths[:1], "unseen": paths[:1]}
    return {"unit": "m", **{name: array.tolist() for name, array in drawn.items()}}
