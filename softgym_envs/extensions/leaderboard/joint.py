"""Joint methods: bodies and policies that learn together, as optimisers that ask and tell."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.agents.training import train
from softgym_envs.codesign.parts import TrainingConfig
from softgym_envs.extensions.leaderboard.clock import working_seconds
from softgym_envs.extensions.leaderboard.frozen import FrozenProblem
from softgym_envs.extensions.leaderboard.problem import JudgedScore
from softgym_envs.extensions.leaderboard.proposers import PROPOSERS
from softgym_envs.storage import read_signed

STEPS = 20_000
"""Environment steps of a joint training, unless the budget allows fewer."""

WARM_UP = 4_000
"""Environment steps before a joint training proposes bodies."""

REPORTS, EPISODES = 5, 8
"""Points of the learning curve of a joint training, and episodes of each; bodies are proposed anew at each."""

SHORTEST = 200
"""Environment steps of the shortest joint training."""

POPULATION = 6
"""Bodies that inherit and pass on policies."""

MUTATION = 0.3
"""Standard deviation of a child from its parent, in unit coordinates."""


class _Folder:
    """A folder for trainings, removed with its owner."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp())
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


class JointOptimiser:
    """Trains one policy together with the bodies first, and then asks for the bodies that it found most promising.

    These are the methods ``"critic"`` (Luck et al. 2019) and ``"distribution"`` (Schaff et al. 2019); the
    search's judge scores the bodies. The steps of the training, its learning curve included, count in the ledger. After
    the at most 32 different bodies of the training, random ones follow.

    Args:
        problem: the problem, whose policies observe the body.
        seed: of the training.
        proposer: key of `softgym_envs.extensions.leaderboard.proposers.PROPOSERS`.
        steps: environment steps of the training.

    Attributes:
        steps_left: environment steps that may be spent; a training never takes more than half of them.

    Raises:
        ValueError: if the policies of the problem do not observe the body; by `ask`, if too few steps are left.
    """

    def __init__(self, problem: FrozenProblem, seed: int, proposer: str, steps: int = STEPS) -> None:
        if not problem.definition.environment.design_in_observation:
            raise ValueError(f"problem '{problem.name}': joint methods need policies that observe the body")
        self._problem, self._seed, self._proposer, self._steps = problem, seed, proposer, steps
        self._bodies: list[dict[str, float]] | None = None
        self._rng = np.random.default_rng(seed)
        self._charge = 0, 0.0
        self.steps_left = np.inf

    def ask(self) -> Mapping[str, float]:
        """Return the most promising body that was not scored yet."""
        if self._bodies is None:
            self._bodies = self._train()
        if self._bodies:
            return self._bodies.pop(0)
        return self._problem.design(self._rng.uniform(-1.0, 1.0, len(self._problem.variables)))

    def tell(self, score: JudgedScore) -> None:
        """Learn nothing: the bodies follow from the training."""

    def take_charge(self) -> tuple[int, float]:
        """Return the environment steps and CPU seconds [s] spent since the last call, for the ledger."""
        charge, self._charge = self._charge, (0, 0.0)
        return charge

    def _train(self) -> list[dict[str, float]]:
        began, definition = working_seconds(), self._problem.definition
        whole = REPORTS * EPISODES * definition.episode_steps
        steps = int(min(self._steps, self.steps_left / 2 - whole))
        if steps < SHORTEST:
            raise ValueError(
                f"problem '{self._problem.name}': {self.steps_left:g} environment steps are left, too few for a joint "
                f"training; at least {2 * (SHORTEST + whole)} are needed"
            )
        sac = {"learning_starts": min(1_000, steps // 4)}
        joint = TrainingConfig.model_validate(
            {
                "steps": steps,
                "report_every": -(-steps // REPORTS),
                "evaluation_episodes": EPISODES,
                "seed": self._seed,
                "sac": sac,
            }
        )
        config = joint.on(
            definition.environment, self._problem.training_goals, definition.baseline, list(definition.variables)
        )
        folder = _Folder()
        settings: dict[str, Any] = {"warmup": min(WARM_UP, steps // 4)}
        proposer = PROPOSERS[self._proposer](**settings)
        train(config, folder.path / "training", proposer=proposer, progress=False)
        found = read_signed(folder.path / "training" / "bodies.json")
        self._charge = steps + whole, working_seconds() - began
        order = [found["names"].index(name) for name in self._problem.variables]
        # A search by the critic ends in a corner of the box again and again.
        points = dict.fromkeys(tuple(np.round(np.array(body)[order], 4)) for body in found["bodies"])
        return [self._problem.design(point) for point in points]


class InheritanceOptimiser:
    """Evolution of bodies whose policies are inherited: the training of a child begins with its parent's policy.

    Each child changes a body of the population, the better of two drawn ones, and replaces the worst body if it is
    better; see Gupta et al. 2021 (arXiv:2102.02202) for tournaments, and evolution with inherited policies in general.
    Under judges that do not train it is evolution of the bodies alone.

    Args:
        problem: the problem, with one objective.
        seed: of draws.
    """

    def __init__(self, problem: FrozenProblem, seed: int) -> None:
        self._problem, self._rng, self._folder = problem, np.random.default_rng(seed), _Folder()
        self._population: list[tuple[float, np.ndarray, Path | None]] = []
        self._point = np.zeros(len(problem.variables))
        self._asked = 0
        #: Policy that the training of the most recently proposed design begins with; None: that of the problem.
        self.initial: Path | None = None

    @property
    def keep(self) -> Path:
        """Folder in which the policy of the most recently proposed design is kept."""
        return self._folder.path / str(self._asked)

    def ask(self) -> Mapping[str, float]:
        """Return a random body until the population is complete, then a child."""
        self._asked += 1
        size = len(self._point)
        if len(self._population) < POPULATION:
            self._point, self.initial = self._rng.uniform(-1.0, 1.0, size), None
        else:
            drawn = self._rng.choice(len(self._population), size=2, replace=False)
            _, parent, self.initial = max((self._population[i] for i in drawn), key=lambda member: member[0])
            self._point = np.clip(parent + MUTATION * self._rng.standard_normal(size), -1.0, 1.0)
        return self._problem.design(self._point)

    def tell(self, score: JudgedScore) -> None:
        """Keep a body that is better than the worst one."""
        if not score.feasible:
            return
        policy = self.keep / "policy" / "policy.safetensors"
        member = score.score, self._point, policy if policy.is_file() else None
        if len(self._population) < POPULATION:
            self._population.append(member)
            return
        worst = min(range(POPULATION), key=lambda index: self._population[index][0])
        if score.score > self._population[worst][0]:
            self._population[worst] = member
