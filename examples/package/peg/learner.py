"""A learner: it guesses linear policies and keeps the best."""

import numpy as np
from pydantic import Field

from softgym_envs.agents.learners.base import Learner, check_weights
from softgym_envs.config import Config


class GuessingConfig(Config):
    """Hyperparameters, the section ``guessing`` of a training."""

    spread: float = Field(default=1.0, gt=0, description="standard deviation of the weights")


class GuessingLearner(Learner):
    """Draws weights of a linear policy for each episode, and keeps those of the largest return."""

    Config = GuessingConfig
    title = "guessing"

    def __init__(self, config):
        super().__init__(config)
        self.env, self.step, self._largest = config.environment.make_vec(config.num_envs), 0, -np.inf
        inputs, outputs = self.env.single_observation_space.shape[0], self.env.single_action_space.shape[0]
        self._shapes = {"actor.mu.weight": (outputs, inputs), "actor.mu.bias": (outputs,)}
        self._best = {name: np.zeros(shape, dtype=np.float32) for name, shape in self._shapes.items()}

    def learn(self, target, progress):
        """Guess until there are ``target`` steps."""
        while self.step < target:
            rng = np.random.default_rng([self.config.seed, self.step])
            spread = self.config.settings.spread
            guess = {name: rng.normal(0.0, spread, shape).astype(np.float32) for name, shape in self._shapes.items()}
            observation, _ = self.env.reset(seed=int(rng.integers(2**31)))
            total, ended = 0.0, np.zeros(self.config.num_envs, dtype=bool)
            while not ended.all():
                action = np.tanh(observation @ guess["actor.mu.weight"].T + guess["actor.mu.bias"])
                observation, reward, terminated, truncated, _ = self.env.step(action)
                total += float(reward[~ended].sum())
                ended |= terminated | truncated
                self.step += self.config.num_envs
                progress(self.config.num_envs)
            if total > self._largest:
                self._largest, self._best = total, guess

    def weights(self):
        """Return the best weights."""
        return {name: value.copy() for name, value in self._best.items()}

    def load_weights(self, tensors, path):
        """Begin at the weights of a file."""
        check_weights(self._shapes, tensors, path)
        self._best = {name: tensors[name] for name in self._shapes}

    def state(self):
        """Return what a resumed training needs."""
        return {}, {"step": self.step, "largest": self._largest}

    def restore(self, tensors, meta):
        """Restore it."""
        self.step, self._largest = meta["step"], meta["largest"]

    def close(self):
        """Close the environments."""
        self.env.close()
