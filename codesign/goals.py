"""Goals that compare bodies: the same for all of them, whoever can reach them."""

from __future__ import annotations

from typing import Any

import numpy as np

from codesign.config import StudyConfig

__all__ = ["draw_goals", "family_goals", "zone_goals"]

STREAM = 0x60A15
"""Sets the seeds of goals that a task draws apart from those of trainings, whose environments it draws for as well."""


def family_goals(config: StudyConfig, count: int) -> np.ndarray:
    """Effector positions [m] (count, 3) of random bodies under random commands, on the surrogate.

    The bodies differ from the baseline of the study in the variables ``goals.vary``.
    """
    from softgym_envs.backends.surrogate import solve_displacements
    from softgym_envs.surrogate.pretrained import pretrained_model

    robot, goals = config.robot, config.goals
    rng = np.random.default_rng(goals.seed)
    vary = tuple(config.variables if goals.vary is None else goals.vary)
    drawn = [robot.design_space.sample(rng, vary) for _ in range(count)]
    designs = [[body[n] if n in vary else value for n, value in config.baseline.items()] for body in drawn]
    low = robot.lower + goals.command_low * (robot.upper - robot.lower)
    commands = rng.uniform(low, robot.upper, (count, len(low)))
    model = pretrained_model(robot, config.environment.backend_options.get("weights"))
    unilateral = robot.unilateral
    settled = solve_displacements(
        model, model.context(np.array(designs)), commands, np.zeros_like(commands), unilateral
    )
    return settled.effector[:, :3]


def zone_goals(config: StudyConfig, count: int) -> np.ndarray:
    """Points [m] (count, 3) spread evenly (scrambled Halton) over the work zone of a study."""
    from scipy.stats import qmc

    zone = config.goals.zone
    assert zone is not None  # the configuration was checked
    unit = qmc.Halton(3, rng=np.random.default_rng(config.goals.seed)).random(count)
    # Shuffled, so that any part of them fills the zone.
    np.random.default_rng([config.goals.seed, 1]).shuffle(unit)
    return np.asarray(zone.center) + (2.0 * unit - 1.0) * np.asarray(zone.half_size)


def draw_goals(config: StudyConfig) -> dict[str, Any]:
    """Draw the three disjoint sets of goals of a study [m], as plain data.

    Where trainings draw their own goals as the task does, these are of other seeds than any training has.

    Returns:
        ``training`` (k, 3), empty where the task draws its own; ``selection`` and ``unseen`` (k, p, 3), both the one
        path of a task that has no other.
    """
    goals = config.goals
    count = goals.count + goals.unseen_count
    if goals.source == "task":
        from agents.evaluation import sample_goals

        # Beyond 32 bits, where no training has a seed.
        seed = (1 << 64) + int(np.random.SeedSequence([goals.seed, STREAM]).generate_state(1, np.uint64)[0])
        paths, training = sample_goals(config.environment, count, seed), np.zeros((0, 3))
    else:
        draw = family_goals if goals.source == "family" else zone_goals
        points = draw(config, count + goals.training_count)
        paths, training = points[:count, None], points[count:]
    drawn = {"training": training, "selection": paths[: goals.count], "unseen": paths[goals.count :]}
    if (paths == paths[0]).all():  # a published path: once is enough, and there is no other to test on
        drawn |= {"selection": paths[:1], "unseen": paths[:1]}
    return {"unit": "m", **{name: array.tolist() for name, array in drawn.items()}}
