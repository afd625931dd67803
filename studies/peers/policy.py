"""Steps per second and time to a policy of any Gymnasium environment: the same script, in each package's environment.

    python studies/peers/policy.py gym_softrobot:TendonArmReach-v0 --distance distance_to_target
    python studies/peers/policy.py softgym_envs:SoftGym/TrunkReach-v0 --distance distance --option backend=fem

It imports Gymnasium and stable-baselines3 only, so that it runs where a peer is installed. SAC has the hyperparameters
of stable-baselines3 everywhere. All times are CPU seconds of the process.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback

TEST_SEED = 1_000_000
"""Seed of the first test episode, far from those of the training."""


class Budget(BaseCallback):
    """Ends a training after a number of CPU seconds."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.end = time.process_time() + seconds

    def _on_step(self) -> bool:
        return time.process_time() < self.end


def parsed(option: str) -> tuple[str, Any]:
    """Return the name and the value of ``name=VALUE``."""
    name, text = option.split("=", 1)
    try:
        return name, json.loads(text)
    except json.JSONDecodeError:
        return name, text


def steps_per_second(env: gymnasium.Env, seconds: float) -> float:
    """Return the steps per CPU second with random actions, resets included."""
    env.reset(seed=0)
    env.action_space.seed(0)
    env.step(env.action_space.sample())  # compiles
    env.reset(seed=0)
    began, count = time.process_time(), 0
    while time.process_time() - began < seconds:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        count += 1
        if terminated or truncated:
            env.reset()
    return count / (time.process_time() - began)


def distances(env: gymnasium.Env, model: SAC, name: str, episodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances to the goal at the beginning and at the end of test episodes [m], each of shape (n,)."""
    first, last = [], []
    for episode in range(episodes):
        observation, info = env.reset(seed=TEST_SEED + episode)
        first.append(info[name])
        ended = False
        while not ended:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
        last.append(info[name])
    return np.array(first), np.array(last)


def main() -> None:
    """Measure one environment and print a line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("id", help="MODULE:ID")
    parser.add_argument("--distance", required=True, help="name of the distance to the goal in info")
    parser.add_argument("--option", action="append", default=[], help="name=VALUE for gymnasium.make, as JSON if it is")
    parser.add_argument("--seconds", type=float, default=10.0, help="CPU time of random steps [s]")
    parser.add_argument("--training", type=float, default=60.0, help="CPU time of the training [s]")
    parser.add_argument("--episodes", type=int, default=5, help="test episodes")
    arguments = parser.parse_args()
    env = gymnasium.make(arguments.id, **dict(map(parsed, arguments.option)))
    rate = steps_per_second(env, arguments.seconds)
    model = SAC("MlpPolicy", env, seed=0)
    model.learn(10**9, callback=Budget(arguments.training))
    first, last = distances(env, model, arguments.distance, arguments.episodes)
    row = {"id": arguments.id, "options": arguments.option, "steps_per_cpu_second": round(rate, 1)}
    row |= {"training_cpu_seconds": arguments.training, "training_steps": model.num_timesteps}
    row |= {"mean_first_distance": round(float(first.mean()), 5), "mean_last_distance": round(float(last.mean()), 5)}
    print(json.dumps(row))


if __name__ == "__main__":
    main()
