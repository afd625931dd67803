"""Datasets of episodes for offline learning."""

from importlib.util import find_spec

import pytest

from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.errors import MissingLibrary
from softgym_envs.extensions.recordings.minari_dataset import record_episodes

FINGER = EnvironmentConfig(id="SoftGym/FingerReach-v0", max_episode_steps=3)


@pytest.mark.skipif(find_spec("minari") is not None, reason="Minari is installed")
def test_without_minari_one_line_says_what_to_install():
    with pytest.raises(MissingLibrary, match=r"minari is not installed; .*softgym-envs\[minari\]"):
        record_episodes("softgym/finger-reach/random-v0", "random", FINGER, episodes=2)


@pytest.mark.filterwarnings("ignore:.*(author_email|eval_env).*:UserWarning")
def test_a_dataset_holds_what_the_environment_said(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    record_episodes("softgym/finger-reach/random-v0", "random", FINGER, episodes=2, design={"length": 0.041}, seed=4)
    dataset = minari.load_dataset("softgym/finger-reach/random-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (2, 6)
    env = FINGER.make()
    for number, episode in enumerate(dataset):
        observation, _ = env.reset(seed=4 + number, options={"design": {"length": 0.041}})
        for step, action in enumerate(episode.actions):
            assert (episode.observations[step] == observation).all()
            observation, reward, _, truncated, info = env.step(action)
            assert episode.rewards[step] == reward and episode.truncations[step] == truncated
            assert episode.infos["reward_effort"][step + 1] == info["reward_effort"]


def test_a_number_of_episodes_below_one_is_refused():
    with pytest.raises(ValueError, match="episodes = 0 must be at least 1"):
        record_episodes("softgym/finger-reach/random-v0", "random", FINGER, episodes=0)
