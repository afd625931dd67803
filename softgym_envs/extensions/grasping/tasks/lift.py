"""Lift: raise a free object to a height and hold it there."""

from __future__ import annotations

import numpy as np

from softgym_envs.backends.backend import State
from softgym_envs.envs.arrays import Array
from softgym_envs.envs.tasks.base import Kinematics, Random, Task, check_length
from softgym_envs.extensions.grasping.robots.lifting import lifting_of
from softgym_envs.extensions.grasping.tasks.grasp import contact_forces
from softgym_envs.robots.base import Robot


class Lift(Task):
    """Raise the object to a height above the table and hold it; only z counts.

    The reward has a further factor, ``1 - 0.2 s``, where s is the share of the object's weight that the table carries.
    An episode is lost, and terminates, when the object was raised by ``lost_height`` and is on the table again
    (dropped), or when the hand has risen by twice that height while the object is still there (left behind).

    Args:
        robot: a robot with a `Lifting`, with contacts ``"table"`` and then the object.
        heights: smallest and largest height of the goal above the object's place on the table [m]; episodes draw it
            uniformly.
        lost_height: [m].
    """

    name = "lift"
    max_episode_steps = 30
    agents = ("close", "force", "random")
    qp_agent = "force"

    def __init__(
        self, robot: Robot, *, heights: tuple[float, float] = (0.005, 0.015), lost_height: float = 0.004
    ) -> None:
        super().__init__(robot)
        lifting = lifting_of(robot)
        if lifting is None:
            raise ValueError(f"task 'lift' needs a robot that lifts; robot '{robot.name}' does not")
        self._lifting = lifting
        low, high = (check_length(height, "heights", robot) for height in heights)
        if not low <= high:
            raise ValueError(f"heights = {tuple(heights)} m must be in increasing order")
        self.heights = (low, high)
        self.lost_height = check_length(lost_height, "lost_height", robot)
        self.axes = np.array([0.0, 0.0, 1.0])
        self._raised = False

    def begin(self, rng: np.random.Generator) -> None:
        self._raised = False

    def sample(self, rng: Random, count: int, kinematics: Kinematics) -> Array:
        goals = np.tile(np.asarray(self.robot.effector_rest), (count, 1, 1))
        goals[:, 0, 2] += rng.uniform(*self.heights, (count,))
        return goals

    def hindsight_goals(self, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        low, high = self.heights
        height = measured[..., 2] - self.robot.effector_rest[2]
        # Other coordinates than z are those of all goals.
        return np.where(self.axes > 0.0, measured, self.robot.effector_rest), (height >= low) & (height <= high)

    def is_failed(self, state: State) -> bool:
        """Whether the object was dropped or left behind; states must come in the order of the episode."""
        height = float(state.effector[0, 2] - self.robot.effector_rest[2])
        self._raised |= height > self.lost_height
        risen = self._raised or state.displacement[self._lifting.drive] > 2.0 * self.lost_height
        return bool(risen and height < 0.25 * self.lost_height)

    def state_terms(self, state: State) -> dict[str, float]:
        """Return the factor of the reward for taking the weight off the table, in [0.8, 1]."""
        table, held = contact_forces(self, state)[:2, 2] * [1.0, -1.0]
        share = table / (table + max(held, 0.0)) if table > 0.0 else 0.0
        return {"hold": 1.0 - 0.2 * share}
