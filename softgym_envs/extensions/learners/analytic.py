"""Analytic policy gradient (model-based): the policy follows the derivative of each step's own reward.

The policy acts in the batched environment on the surrogate. After each step the environment returns the exact
derivative of the logarithm of the reward in the action (`SoftRobotVectorEnv.step_with_gradient`), and the policy
ascends its mean. There is no critic, no exploration noise and no differentiation through time: a quasi-static robot
reaches a goal by improving every step.

The logarithm turns a product of reward terms into a sum, and `Task.log_reward` keeps a slope near the goal and far from
it.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from softgym_envs.agents.config import TrainConfig
from softgym_envs.envs.gradients import StepGradient
from softgym_envs.envs.vector_env import SoftRobotVectorEnv
from softgym_envs.extensions.learners.gradient import GradientLearner
from softgym_envs.extensions.learners.network import GradientConfig


class AnalyticConfig(GradientConfig):
    """Hyperparameters of the analytic policy gradient (`softgym_envs.extensions.learners.analytic`)."""

    slack_pull: float = Field(
        default=0.3, ge=0, description="how strongly commands of slack cables follow the displacement that is reached"
    )
    effort_weight: float = Field(
        default=1.0,
        ge=0,
        description="factor of the effort's share in the derivatives; above 1 for redundant actuators, which otherwise "
        "end up working against each other",
    )


class AnalyticLearner(GradientLearner):
    """Analytic policy gradient, one step deep."""

    Config = AnalyticConfig
    title = "analytic gradient"

    @classmethod
    def update_seconds(cls, config: TrainConfig) -> float:
        return 0.001

    env: SoftRobotVectorEnv

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(config, config.settings)
        self.slack_pull, self.effort_weight = config.settings.slack_pull, config.settings.effort_weight

    def advance(self, observation: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        import torch

        action = self.policy(observation)
        observation, *_, gradient = self.env.step_with_gradient(
            action.detach().numpy(), log=True, effort_weight=self.effort_weight
        )
        ascent = torch.from_numpy(self._ascent(gradient).astype(np.float32))
        self.descend(-(action * ascent).sum() / self.env.num_envs)
        return observation

    def _ascent(self, gradient: StepGradient) -> np.ndarray:
        """Return the gradient of the objective in the actions (B, n_a), one-sided at kinks.

        The exact derivative is zero for commands that are slack or held by a limit; an actor that ended there would
        never come back. So a slack actuator is tightened if that helps, and its command follows what the cable reaches.
        A command held by a limit may move back, but not further out.
        """
        tighten = np.maximum(gradient.held, 0.0)
        command = np.where(gradient.slack, tighten, gradient.command)
        command += np.where(gradient.slack, self.slack_pull * gradient.gap / self._span**2, 0.0)
        outward = gradient.limited * command > 0.0
        return np.where(outward, 0.0, command * gradient.slope)

    @property
    def _span(self) -> np.ndarray:
        return 0.5 * (self.env.robot.upper - self.env.robot.lower)
