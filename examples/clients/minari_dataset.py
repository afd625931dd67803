"""Minari: record episodes of a policy, and write them as plain arrays too, for libraries that cannot read Minari.

Usage: ``python minari_dataset.py [FILE.npz]``
"""

import sys

import gymnasium
import minari
import numpy as np

import softgym_envs  # noqa: F401 - registers the environments

env = minari.DataCollector(gymnasium.make("SoftGym/FingerReach-v0"), record_infos=True)
env.action_space.seed(0)
for seed in range(4):
    env.reset(seed=seed)
    ended = False
    while not ended:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        ended = terminated or truncated
dataset = env.create_dataset("softgym/finger-reach/random-v0", algorithm_name="random", author="you")
print(dataset.total_episodes, dataset.total_steps)
if len(sys.argv) > 1:
    episodes = list(dataset)
    np.savez(
        sys.argv[1],
        observations=np.concatenate([one.observations[:-1] for one in episodes]),
        actions=np.concatenate([one.actions for one in episodes]),
        rewards=np.concatenate([one.rewards for one in episodes]),
        terminals=np.concatenate([one.terminations for one in episodes]),
        timeouts=np.concatenate([one.truncations for one in episodes]),
    )
minari.delete_dataset(dataset.spec.dataset_id)
