"""Grasp: press on an object with a wanted force."""

from __future__ import annotations

import numpy as np

from softgym_envs.backends.backend import State
from softgym_envs.envs.arrays import Array
from softgym_envs.envs.tasks.base import (
    SHARES_OF_FORCES,
    Kinematics,
    Random,
    Task,
    check_force,
    check_length,
    tolerance,
)
from softgym_envs.robots.base import Robot


def contact_forces(task: Task, state: State) -> np.ndarray:
    """Return the force of each obstacle on the robot [N], shape (o, 3).

    Raises:
        ValueError: for a robot that touches nothing.
    """
    if state.contacts is None:
        raise ValueError(f"task '{task.name}' needs contacts, but robot '{task.robot.name}' touches nothing")
    return state.contacts.total


class Grasp(Task):
    """Press on the first object with a wanted force along x [N], with little torque.

    Goals are forces ``(F, 0, 0)`` on the object; only x counts. The distance is the error of the force over the wanted
    one, ``|f - F| / F``. The factors of the reward follow the objectives of the thesis (section 3.4):

    * contact force: ``(t(distance, tolerance) + t(distance, 1)) / 2``, t as for the other tasks;
    * grasp resistance, the torque over the force: ``1 - 0.1 r / (r + r0)``, where r0 is ``resistance`` and without
      contact ``r / (r + r0)`` is 1;
    * grasp energy, of which each step adds the torque times the angle: ``1 - 0.1 w``, w relative to the largest torque
      and angle of the servo;
    * effort: as for the other tasks.

    Args:
        robot: a robot with one servo and an object in front of it.
        forces: smallest and largest wanted force [N]; episodes draw it uniformly.
        tolerance: largest distance at which the force counts as reached [1].
        resistance: torque over force at which half of the reward for a small grasp resistance is lost [m].
    """

    name = "grasp"
    max_episode_steps = 25
    agents = ("close", "force", "random")
    qp_agent = "force"
    distance_scale = SHARES_OF_FORCES

    def __init__(
        self,
        robot: Robot,
        *,
        forces: tuple[float, float] = (0.1, 0.6),
        tolerance: float = 0.05,
        resistance: float = 0.2,
    ) -> None:
        super().__init__(robot)
        low, high = forces
        if not 0.0 < low <= high < np.inf:
            raise ValueError(f"forces = {tuple(forces)} N must be positive, finite and in increasing order")
        for name, value, unit in (("tolerance", tolerance, ""), ("resistance", resistance, " m")):
            if not 0.0 < value < np.inf:
                raise ValueError(f"{name} = {value}{unit} must be positive and finite")
        self.forces = (check_force(low, "forces", robot), check_force(high, "forces", robot))
        self.axes = np.array([1.0, 0.0, 0.0])
        self.success_distance = tolerance
        self.resistance = check_length(resistance, "resistance", robot)
        self.goal_scale = 2.0 * self.forces[1]
        self.measured_scale = self.forces[1]
        self.error_scale = 0.1 * self.forces[1]

    def sample(self, rng: Random, count: int, kinematics: Kinematics) -> Array:
        goals = np.zeros((count, 1, 3))
        goals[:, 0, 0] = rng.uniform(*self.forces, (count,))
        return goals

    def check_paths(self, goals: object, leading: tuple[int, ...] = ()) -> np.ndarray:
        """Return the wanted forces of episodes [N] as an array (*leading, 1, 3).

        Raises:
            ValueError: for another shape, or a force along x that is not positive and finite.
        """
        array = np.asarray(goals, dtype=float)
        if array.shape == (*leading, 3):
            array = array[..., None, :]
        if array.shape != (*leading, 1, 3) or not np.isfinite(array).all() or not (array[..., 0] > 0.0).all():
            raise ValueError(
                f"goal must be a force (F, 0, 0) [N] with F > 0 and finite, got {np.asarray(goals).tolist()}"
            )
        check_force(array[..., 0].max(), "goal", self.robot)
        return array

    def measure(self, state: State) -> np.ndarray:
        """Return the force of the robot on the object [N], shape (3,)."""
        return -contact_forces(self, state)[0]

    def hindsight_goals(self, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        low, high = self.forces
        return measured * self.axes, (measured[..., 0] >= low) & (measured[..., 0] <= high)

    def distance(self, effector: Array, goal: Array) -> Array:
        return abs(effector[..., 0] - goal[..., 0]) / goal[..., 0]

    def reward_terms(self, distance: Array, effort_share: Array) -> dict[str, Array]:
        reached = 0.5 * tolerance(distance, self.success_distance) + 0.5 * tolerance(distance, 1.0)
        return {"force": reached, "effort": 1.0 - 0.05 * effort_share.clip(0.0, 1.0)}

    def state_terms(self, state: State) -> dict[str, float]:
        """Return the factors of the reward for a small resistance and a small energy, each in [0.9, 1]."""
        servo = self.robot.actuators[0]
        torque, angle = abs(float(state.effort[0])), float(state.displacement[0])
        force = float(np.abs(self.axes @ self.measure(state)))
        # torque / force over itself plus the scale, without dividing by a force of zero
        lost = torque / (torque + self.resistance * force) if force > 0.0 else 1.0
        spent = min(1.0, torque * abs(angle) / (servo.max_effort * servo.high))
        return {"resistance": 1.0 - 0.1 * lost, "energy": 1.0 - 0.1 * spent}
