"""The inverse QP for tasks that hide the effector: on what an estimator finds from all sensors."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from softgym_envs.agents.baselines import InverseQPAgent
from softgym_envs.backends.surrogate import SurrogateBackend
from softgym_envs.control.inverse_qp import InverseQP
from softgym_envs.extensions.sensing.estimator import Estimator
from softgym_envs.extensions.sensing.learned import LearnedEstimator
from softgym_envs.extensions.sensing.loads import Touch
from softgym_envs.extensions.sensing.readings import Noise


class EstimatedQPAgent(InverseQPAgent):
    """Inverse QP on the effector and the condensed model that the estimator finds from all sensors."""

    title = "QP, estimator"

    def __init__(self, seed: int = 0) -> None:
        super().__init__(seed)
        self._estimators: WeakKeyDictionary[Any, Estimator | LearnedEstimator] = WeakKeyDictionary()

    def _begin(self, env: Any) -> None:
        if not env.task.sensors:
            raise ValueError(f"agent 'qp_estimated' needs a task that shows sensors; '{env.task.name}' does not")
        super()._begin(env)
        # A tenth of a percent stands for the differences between touches of the plant and of the estimator.
        level = max(env.plant.noise, 1e-3) * float(np.mean(env.robot.sensing.scale))
        # A body has sensors of one kind; the other level is not used.
        noise = Noise(displacement=1e-5, volume=level, pressure=level)
        if isinstance(env.backend, SurrogateBackend):
            # The plant is the learned model itself, so the errors of its volumes do not count.
            self._estimators[env] = LearnedEstimator(
                env.robot, design=env.design, noise=noise, model=env.backend.model, exact=True
            )
        else:
            self._estimators[env] = Estimator(env.robot, design=env.design, noise=noise)

    def _solve(self, env: Any, controller: InverseQP, present: np.ndarray) -> np.ndarray:
        estimator, task = self._estimators[env], env.task
        touch = task.touch
        load = None if touch.cell is None else Touch(touch.grid, touch.cell, touch.largest)
        if load != estimator.load:
            estimator.touch(load)
        found = estimator.update(estimator.reading(present, env.sensed.sensors * env.robot.sensing.scale))
        aim = env.observed_goal + found.condensed.delta.e[:3] - found.effector[:3]
        return controller.solve(found.condensed, aim, present, found.slack)
