"""RL Zoo: its training script takes the package that registers the environments."""

import subprocess
import sys
import tempfile
from pathlib import Path

settings = Path(__file__).with_name("rl_zoo.yaml")
with tempfile.TemporaryDirectory() as folder:
    script = [sys.executable, "-m", "rl_zoo3.train", "--algo", "ppo", "--env", "SoftGym/FingerReach-v0"]
    given = ["--gym-packages", "softgym_envs", "--conf-file", str(settings), "--log-folder", folder, "--device", "cpu"]
    subprocess.run([*script, *given, "--eval-freq", "-1"], check=True)
    print(next(Path(folder).rglob("*.zip")).name)
