"""Datasets of episodes for offline learning, in the format of Minari."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from softgym_envs.agents.baselines import BASELINES
from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.evaluation import make_agent
from softgym_envs.extras import require

if TYPE_CHECKING:
    from minari import MinariDataset


def record_episodes(
    name: str,
    agent: str | Path,
    environment: EnvironmentConfig,
    *,
    episodes: int,
    design: dict[str, float] | None = None,
    seed: int = 0,
) -> MinariDataset:
    """Record episodes with random goals as a Minari dataset on this machine.

    Args:
        name: of the dataset, such as ``"softgym/finger-reach/qp-v0"``.
        agent: one of `BASELINES`, a policy file, or the name of a shipped policy.
        environment: the environment.
        episodes: number of episodes.
        design: body of all episodes; by default that of the environment.
        seed: of the first episode; each later one has the next integer.

    Returns:
        The dataset, whose steps also hold the environment's information.

    Raises:
        ValueError: for fewer than one episode, or a name that is taken or malformed.
        MissingLibrary: without Minari.
    """
    if episodes < 1:
        raise ValueError(f"episodes = {episodes} must be at least 1")
    require("minari")
    import minari

    act = make_agent(agent, seed)
    made = environment.uncorrected if agent in BASELINES else environment
    env = minari.DataCollector(made.make(), record_infos=True)
    try:
        for number in range(episodes):
            observation, _ = env.reset(seed=seed + number, options=None if design is None else {"design": design})
            ended = False
            while not ended:
                observation, _, terminated, truncated, _ = env.step(act(observation, env.unwrapped))
                ended = terminated or truncated
        return env.create_dataset(
            name, algorithm_name=str(agent), description=f"{episodes} episodes of agent '{agent}' in {environment.id}"
        )
    finally:
        env.close()
