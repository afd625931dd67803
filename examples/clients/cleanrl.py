"""Run a script of CleanRL as it is: ``python cleanrl.py cleanrl/sac_continuous_action.py --env-id softgym_envs:ID``.

CleanRL is for Gymnasium 0.29, whose batches reset in the step that ends an episode and list what its end was like.
Gymnasium 1 does so on request, and by other names. Nothing here is about these environments.
"""

import runpy
import sys

import gymnasium
from gymnasium.vector import AutoresetMode


class SyncVectorEnv(gymnasium.vector.SyncVectorEnv):
    """A batch whose steps look as those of Gymnasium 0.29."""

    def __init__(self, env_fns):
        super().__init__(env_fns, autoreset_mode=AutoresetMode.SAME_STEP)

    def step(self, actions):
        *outcome, infos = super().step(actions)
        if "final_info" in infos:
            episodes = infos["final_info"]["episode"]
            rows = [{name: episodes[name][i] for name in ("r", "l", "t")} for i in range(self.num_envs)]
            ended = infos["_final_info"]
            infos["final_info"] = [{"episode": row} if end else None for row, end in zip(rows, ended, strict=True)]
            infos["final_observation"] = infos["final_obs"]
        return *outcome, infos


if __name__ == "__main__":
    gymnasium.vector.SyncVectorEnv = SyncVectorEnv
    sys.argv = sys.argv[1:]
    sys.path[0] = ""  # cleanrl_utils, where this runs in a checkout of CleanRL
    runpy.run_path(sys.argv[0], run_name="__main__")
