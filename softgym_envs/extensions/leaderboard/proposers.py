"""Design proposers: body and policy are optimised together in one training.

A policy that observes the body is trained on many bodies, and a proposer draws them. `CriticProposer` prefers bodies
with a high value of the critic (Luck, Ben Amor and Calandra 2019, arXiv:1911.06832); `DistributionProposer` moves a
mixture of Gaussians over bodies towards larger returns (Schaff et al. 2019, arXiv:1801.01432).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.envs.vector_env import SoftRobotVectorEnv
from softgym_envs.storage import read_signed, write_signed

if TYPE_CHECKING:
    from stable_baselines3 import SAC


class DesignProposer(ABC):
    """Draws the bodies of a training (`softgym_envs.agents.training`), in unit coordinates [-1, 1] of its variables."""

    def attach(self, model: SAC, config: TrainConfig, folder: Path) -> None:
        """Start drawing the bodies of a training, continuing where an interrupted run stopped.

        Raises:
            ValueError: if the environment does not sample bodies, or is not batched.
        """
        if not config.environment.sample_design:
            raise ValueError("joint training needs environment.sample_design, the names of the variables to optimise")
        env: Any = model.get_env()
        vector = env.env.unwrapped
        if not isinstance(vector, SoftRobotVectorEnv):
            raise ValueError(
                f"joint training needs a batched environment, but {config.environment.title} on backend "
                f"'{config.environment.backend}' is not"
            )
        self.config, self.folder = config, folder
        self.names: tuple[str, ...] = tuple(vector.sampled_variables)
        self.size = len(self.names)
        #: Bodies of the present and of the previous episode of each sub-environment.
        self._bodies = np.zeros((2, vector.num_envs, self.size))
        vector.set_design_sampler(self._sample)
        env.on_episode = self._ended
        self.restore(model)

    def _sample(self, rng: np.random.Generator, index: np.ndarray) -> np.ndarray:
        drawn = np.clip(self.draw(rng, len(index)), -1.0, 1.0)
        self._bodies[1, index] = self._bodies[0, index]
        self._bodies[0, index] = drawn
        return drawn

    def _ended(self, index: int, total: float) -> None:
        # The next episode of this sub-environment has already begun, so this one is the previous.
        self.episode(self._bodies[1, index].copy(), total)

    def finish(self, model: SAC) -> None:
        """Write the most promising bodies to ``bodies.json``, in unit coordinates."""
        found = self.best(model, 32)
        write_signed(self.folder / "bodies.json", {"names": list(self.names), "bodies": found.tolist()})

    def restore(self, model: SAC) -> None:  # noqa: B027 - optional, for proposers with a state
        """Restore what `save` wrote at the model's step."""

    def begin(self, model: SAC) -> None:  # noqa: B027
        """Prepare for the next part of the training."""

    def save(self, step: int) -> None:  # noqa: B027
        """Write what `restore` needs to continue from ``step``."""

    def episode(self, body: np.ndarray, total: float) -> None:  # noqa: B027
        """Learn from the return of an episode."""

    @abstractmethod
    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw the bodies of ``count`` episodes, shape (count, k)."""

    @abstractmethod
    def best(self, model: SAC, count: int) -> np.ndarray:
        """Return the most promising bodies so far, best first, shape (<= count, k)."""


class CriticProposer(DesignProposer):
    """Proposes bodies whose first states have the largest value of the critic.

    A share of the episodes explores with uniformly drawn bodies; the others use the best bodies of a cross-entropy
    search on the critic's value. The search takes no environment steps and depends on the weights alone, so a resumed
    training draws the same bodies.

    Args:
        explore: share of episodes with a uniform draw.
        candidates: bodies in each generation of the search.
        generations: number of generations.
        goals: first states per body.
        warmup: environment steps before the first search.
    """

    def __init__(
        self, explore: float = 0.5, candidates: int = 128, generations: int = 4, goals: int = 16, warmup: int = 8_000
    ) -> None:
        self.explore, self.candidates, self.generations = explore, candidates, generations
        self.goals, self.warmup = goals, warmup
        self._elite: np.ndarray | None = None

    def begin(self, model: SAC) -> None:
        self._elite = self.best(model, 16) if model.num_timesteps >= self.warmup else None

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        drawn = rng.uniform(-1.0, 1.0, (count, self.size))
        if self._elite is not None:
            chosen = self._elite[rng.integers(len(self._elite), size=count)]
            drawn = np.where(rng.random(count)[:, None] < self.explore, drawn, chosen)
        return drawn

    def best(self, model: SAC, count: int) -> np.ndarray:
        from scipy.stats import qmc

        rng = np.random.default_rng([self.config.seed, int(model.num_timesteps)])
        bodies = 2.0 * qmc.Halton(self.size, rng=rng).random(self.candidates) - 1.0
        seen, values = np.zeros((0, self.size)), np.zeros(0)
        for generation in range(self.generations):
            seen = np.concatenate([seen, bodies])
            values = np.concatenate(
                [values, critic_values(model, self.config.environment, self.names, bodies, self.goals)]
            )
            elite = seen[np.argsort(-values)[: max(8, self.candidates // 8)]]
            if generation + 1 < self.generations:
                spread = np.maximum(elite.std(axis=0), 0.02)
                bodies = np.clip(rng.normal(elite.mean(axis=0), spread, (self.candidates, self.size)), -1.0, 1.0)
        return seen[np.argsort(-values)[:count]]


class DistributionProposer(DesignProposer):
    """Proposes bodies from a mixture of Gaussians that follows the natural gradient of the expected rank of returns.

    Ranks in place of returns and natural steps come from separable natural evolution strategies (Wierstra et al. 2014,
    JMLR 15, 949); the mixture that learns along with the policy comes from Schaff et al.

    Args:
        components: number of Gaussians.
        batch: episodes per step of the mixture.
        warmup: environment steps with uniform draws, in which the policy learns its first motions.
        rate: step size of the means, relative to the reference.
        smallest: lower bound of the standard deviations, in unit coordinates.
    """

    def __init__(
        self, components: int = 4, batch: int = 32, warmup: int = 8_000, rate: float = 1.0, smallest: float = 0.05
    ) -> None:
        self.components, self.batch, self.warmup = components, batch, warmup
        self.rate, self.smallest = rate, smallest
        self._episodes: list[tuple[np.ndarray, float]] = []
        self._warm = False

    def restore(self, model: SAC) -> None:
        rng = np.random.default_rng([self.config.seed, self.size])
        path = self._path(model.num_timesteps)
        if path.exists():
            stored = read_signed(path)
            self.logits, self.means, self.spreads = (np.array(stored[k]) for k in ("logits", "means", "spreads"))
        else:
            self.logits = np.zeros(self.components)
            self.means = rng.uniform(-0.5, 0.5, (self.components, self.size))
            self.spreads = np.full((self.components, self.size), 0.5)

    def _path(self, step: int) -> Path:
        return self.folder / f"bodies-{step}.json"

    def begin(self, model: SAC) -> None:
        self._warm = model.num_timesteps >= self.warmup
        self._episodes = []  # all episodes restart here, so none is counted twice after an interruption

    def save(self, step: int) -> None:
        write_signed(
            self._path(step),
            {
                "names": list(self.names),
                "logits": self.logits.tolist(),
                "means": self.means.tolist(),
                "spreads": self.spreads.tolist(),
            },
        )

    @property
    def weights(self) -> np.ndarray:
        """Weight of each component, shape (components,)."""
        shifted = np.exp(self.logits - self.logits.max())
        return shifted / shifted.sum()

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        if not self._warm:
            return rng.uniform(-1.0, 1.0, (count, self.size))
        component = rng.choice(self.components, size=count, p=self.weights)
        return rng.normal(self.means[component], self.spreads[component])

    def episode(self, body: np.ndarray, total: float) -> None:
        if not self._warm:
            return
        self._episodes.append((body, total))
        if len(self._episodes) >= self.batch:
            self._step(np.array([b for b, _ in self._episodes]), np.array([r for _, r in self._episodes]))
            self._episodes = []

    def _step(self, bodies: np.ndarray, returns: np.ndarray) -> None:
        count, k = len(bodies), self.size
        ranks = np.empty(count)
        ranks[np.argsort(-returns)] = np.arange(1, count + 1)
        utility = np.maximum(0.0, np.log(count / 2 + 1) - np.log(ranks))
        utility = utility / utility.sum() - 1.0 / count
        scaled = (bodies[:, None] - self.means) / self.spreads  # (count, components, k)
        weights = self.weights
        log_density = -0.5 * (scaled**2).sum(axis=2) - np.log(self.spreads).sum(axis=1) + np.log(weights)
        share = np.exp(log_density - log_density.max(axis=1, keepdims=True))
        share /= share.sum(axis=1, keepdims=True)
        pull = utility[:, None] * share / weights  # pull of each body on each component
        rate_spread = (3.0 + np.log(k)) / (5.0 * np.sqrt(k))
        self.means = np.clip(
            self.means + self.rate * self.spreads * np.einsum("bc,bck->ck", pull, scaled).clip(-1.0, 1.0), -1.0, 1.0
        )
        change = np.einsum("bc,bck->ck", pull, scaled**2 - 1.0).clip(-1.0, 1.0)
        self.spreads = np.clip(self.spreads * np.exp(0.5 * rate_spread * change), self.smallest, 1.0)
        self.logits = self.logits + rate_spread * (utility @ (share - weights))

    def best(self, model: SAC, count: int) -> np.ndarray:
        """Return the means, those of the largest weights first, and then draws."""
        means = self.means[np.argsort(-self.weights)]
        rng = np.random.default_rng([self.config.seed, int(model.num_timesteps)])
        component = rng.choice(self.components, size=max(0, count - len(means)), p=self.weights)
        drawn = np.clip(rng.normal(self.means[component], self.spreads[component]), -1.0, 1.0)
        return np.concatenate([means, drawn])[:count]


PROPOSERS: dict[str, type[DesignProposer]] = {"critic": CriticProposer, "distribution": DistributionProposer}
"""Registry: name to proposer."""


def critic_values(
    model: SAC, environment: EnvironmentConfig, names: tuple[str, ...], bodies: np.ndarray, goals: int
) -> np.ndarray:
    """Return the mean over goals of the smaller critic value of an episode's first state, under the mean action.

    Args:
        model: policy and critics that observe the body.
        environment: the environment; its goals are drawn with a fixed seed, the same for every body.
        names: variables of the bodies.
        bodies: bodies in unit coordinates, shape (n, k).
        goals: number of goals.

    Returns:
        Values, shape (n,).
    """
    import torch

    count = len(bodies)
    env: Any = environment.make_vec(count * goals, sample_design=False)
    try:
        space = env.unwrapped.design_space
        designs = [
            {name: float(space[name].from_unit(value)) for name, value in zip(names, body, strict=True)}
            for body in bodies
        ]
        one: Any = environment.make_vec(goals, sample_design=False)
        one.reset(seed=0)
        paths = np.asarray(one.unwrapped.paths)
        one.close()
        observation, _ = env.reset(
            seed=0,
            options={"design": [d for d in designs for _ in range(goals)], "goal": np.tile(paths, (count, 1, 1))},
        )
    finally:
        env.close()
    with torch.no_grad():
        states = torch.as_tensor(observation)
        values = torch.cat(model.critic(states, model.actor(states, deterministic=True)), dim=1).min(dim=1).values
    return values.numpy().reshape(count, goals).mean(axis=1)
