"""A task and an environment ID."""

from softgym_envs.envs.registration import EnvironmentRow
from softgym_envs.envs.tasks.reach import Reach


class Hover(Reach):
    """Reach whose reward has no bonus close to the goal."""

    name = "hover"
    max_episode_steps = 6

    def reward_terms(self, distance, effort_share):
        """Return the parts of the reward by name."""
        return {"distance": 1.0 / (1.0 + distance / self.robot.workspace_scale)}


ENVIRONMENTS = {"Example/PegHover-v0": EnvironmentRow("peg", "hover", 6)}
