"""Body and gait searched together, as optimisers that ask and tell."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from scipy.stats import qmc

from softgym_envs.extensions.leaderboard.clock import working_seconds
from softgym_envs.extensions.leaderboard.frozen import FrozenProblem
from softgym_envs.extensions.leaderboard.problem import JudgedScore

MOTIONS = {"ascend": 60, "evolve": 240}
"""Motions of one search for body and gait: a gradient needs fewer."""


class TogetherOptimiser:
    """Searches for body and gait from the points of a Sobol sequence; the body that each finds is scored.

    Its gait is forgotten: the judge gives the body one as it gives one to any other. A motion counts as its environment
    steps, with a gradient or without.

    Args:
        problem: a problem of bodies that move, whose policies are gaits along gradients.
        seed: of the sequence and of the first gaits.
        way: ``"ascend"``, along the gradient by both, or ``"evolve"``, by CMA-ES.

    Attributes:
        steps_left: environment steps that the next search may spend.

    Raises:
        ValueError: for a problem with other policies.
    """

    def __init__(self, problem: FrozenProblem, seed: int, way: Literal["ascend", "evolve"]) -> None:
        definition = problem.definition
        if definition.training.learner != "gait":
            raise ValueError(
                f"problem '{problem.name}': learner '{definition.training.learner}' has no gait that is searched "
                "together with a body; allowed: gait"
            )
        self._problem, self._seed, self._way = problem, seed, way
        self._starts = qmc.Sobol(len(problem.variables), rng=np.random.default_rng(seed))
        self._searches, self._charge = 0, (0, 0.0)
        self.steps_left = np.inf

    def ask(self) -> Mapping[str, float]:
        """Return the body that a new search finds."""
        from softgym_envs.extensions.walkers.learners.together import BodyAndGait

        began, definition = working_seconds(), self._problem.definition
        training = definition.training
        motion = training.settings.period * training.settings.periods
        steps = motion * max(1, int(min(self.steps_left / motion, MOTIONS[self._way])))
        start = self._problem.design(2.0 * self._starts.random(1)[0] - 1.0)
        seed = training.seed + self._seed + self._searches
        config = training.on(
            definition.environment,
            self._problem.training_goals,
            definition.body(start)[0],
            steps=steps,
            report_every=steps,
            seed=seed,
        )
        search = BodyAndGait(config, self._problem.variables)
        found = search.ascend() if self._way == "ascend" else search.evolve(seed)
        self._searches += 1
        self._charge = found.steps, working_seconds() - began
        return {name: found.design[name] for name in self._problem.variables}

    def tell(self, score: JudgedScore) -> None:
        """Learn nothing: searches do not depend on scores."""

    def take_charge(self) -> tuple[int, float]:
        """Return the environment steps and CPU seconds [s] spent since the last call, for the ledger."""
        charge, self._charge = self._charge, (0, 0.0)
        return charge
