"""Clients of other libraries: what `examples/clients` has besides snippets (`make test-clients` runs those)."""

import subprocess
import sys
from pathlib import Path

CLIENTS = Path(__file__).parents[1] / "examples" / "clients"

# What CleanRL's scripts ask of a batch, which Gymnasium 1 calls otherwise.
SCRIPT = """
import sys
import gymnasium as gym
import numpy as np

def thunk():
    return gym.wrappers.RecordEpisodeStatistics(gym.make(sys.argv[1], max_episode_steps=3))

envs = gym.vector.SyncVectorEnv([thunk, thunk])
envs.reset(seed=0)
for step in range(3):
    observations, rewards, terminations, truncations, infos = envs.step(np.zeros(envs.action_space.shape))
    if "final_info" in infos:
        lengths = [int(info["episode"]["l"]) for info in infos["final_info"] if info is not None]
    for index in np.flatnonzero(truncations):
        assert (infos["final_observation"][index] != observations[index]).any()
print(truncations.tolist(), lengths)
"""


def test_a_script_of_cleanrl_gets_the_batches_that_it_expects(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, CLIENTS / "cleanrl.py", "script.py", "softgym_envs:SoftGym/FingerReach-v0"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout == "[True, True] [3, 3]\n"
