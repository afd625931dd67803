"""An agent that needs no training."""

import numpy as np


class Idle:
    """Holds every command."""

    title = "idle"

    def __init__(self, seed=0):
        pass

    def __call__(self, observation, env):
        """Return the action, shape (n_a,)."""
        return np.zeros(env.action_space.shape, dtype=np.float32)
