"""Body and gait together: along one gradient through time, or by an evolution strategy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from softgym_envs.agents.config import TrainConfig
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.extensions.beams.neighbours import neighbours_of
from softgym_envs.extensions.walkers.learners.gait import Ascent, GaitLearner

NEAR = 1e-6
"""Half of a difference in unit coordinates, for the slope of a variable that may be logarithmic."""
SHORTEST = 0.01
"""Length of the steps of an ascent, over that of the first ones, at which it ends."""
SPREAD = 0.3
"""First standard deviation of bodies and gaits of an evolution strategy, in half ranges."""


class Found(NamedTuple):
    """The outcome of a search for body and gait.

    Attributes:
        design: the complete design [SI].
        way: that it went ahead in a motion [m].
        steps: control steps of all motions.
    """

    design: dict[str, float]
    way: float
    steps: int


class BodyAndGait:
    """A body with its gait, which change together.

    Args:
        config: of a search for a gait; it begins with the body of its environment, and its steps are those that motions
            may take.
        variables: design variables that may change.

    Raises:
        ValueError: for variables that are not the robot's, or an environment that `GaitLearner` refuses.
    """

    def __init__(self, config: TrainConfig, variables: Sequence[str]) -> None:
        self.learner = GaitLearner(config)
        self.robot = self.learner.env.robot
        space = self.robot.design_space
        if other := [name for name in variables if name not in space.names]:
            raise ValueError(f"variable '{other[0]}' is not a design variable of robot '{self.robot.name}'")
        self._columns = [space.names.index(name) for name in variables]
        self._unit = space.to_unit(space.complete(config.environment.design))
        self._motion = config.settings.period * config.settings.periods
        self._motions = -(-config.steps // self._motion)

    def _design(self, body: np.ndarray) -> Mapping[str, float]:
        unit = self._unit.copy()
        unit[self._columns] = body
        return self.robot.design_space.from_unit(unit)

    def _found(self, body: np.ndarray, way: float) -> Found:
        self.learner.close()
        return Found(dict(self._design(body)), way, self.learner.step)

    def ascend(self) -> Found:
        """Follow the gradient by commands and design variables alike, with the steps of the search for a gait."""
        learner, size, way = self.learner, self.learner.gait.size, 0.0
        ascent = Ascent(np.concatenate([learner.gait.ravel(), self._unit[self._columns]]))
        for _ in range(self._motions):
            learner.gait = ascent.point[:size].reshape(learner.gait.shape)
            design, rate = self._design(ascent.point[size:]), learner.rate()
            learner.step += self._motion
            try:
                learner.backend.reset(design)
                found = learner.climb(neighbours_of(self.robot, design))
            except (ConvergenceError, InfeasibleDesign):
                ascent.step(None, None, rate)
            else:
                by_unit = found.by_design * self._slopes(design)
                ascent.step(found.value, np.concatenate([found.by_gait.ravel(), by_unit[self._columns]]), rate)
                way = found.way if ascent.value == found.value else way
            if ascent.stride < SHORTEST:
                break
        return self._found(ascent.best[size:], way)

    def _slopes(self, design: Mapping[str, float]) -> np.ndarray:
        """Return the derivatives of the design [SI] by unit coordinates, shape (d,)."""
        space = self.robot.design_space
        inside = np.clip(space.to_unit(design), NEAR - 1.0, 1.0 - NEAR)
        ahead, back = (space.from_unit(inside + sign * NEAR).array for sign in (1.0, -1.0))
        slopes: np.ndarray = (ahead - back) / (2.0 * NEAR)
        return slopes

    def evolve(self, seed: int) -> Found:
        """Search by CMA-ES, one motion for each body with its gait.

        A gait is a change of the first one: a constant and one sine of the period for each actuator.
        """
        from cmaes import CMA

        learner, gait = self.learner, self.learner.gait
        period, actuators = gait.shape
        angle = 2.0 * np.pi * np.arange(period) / period
        waves = np.stack([np.full(period, np.sqrt(0.5)), np.cos(angle), np.sin(angle)])
        size, body = len(waves) * actuators, self._unit[self._columns]
        bounds = np.tile([-1.0, 1.0], (size + len(body), 1))
        search = CMA(mean=np.concatenate([np.zeros(size), body]), sigma=SPREAD, bounds=bounds, seed=seed)
        best, kept, way = -np.inf, body, 0.0
        while learner.step + search.population_size * self._motion <= self._motions * self._motion:
            scored = []
            for point in (search.ask() for _ in range(search.population_size)):
                change = np.tensordot(point[:size].reshape(actuators, len(waves)), waves, axes=1).T
                learner.gait = np.clip(gait + learner.straight(change), -1.0, 1.0)
                learner.step += self._motion
                try:
                    learner.backend.reset(self._design(point[size:]))
                    moved = learner.move()
                except (ConvergenceError, InfeasibleDesign):
                    scored.append((point, self.robot.size))  # worse than to stand
                    continue
                scored.append((point, -moved.value))
                if moved.value > best:
                    best, kept, way = moved.value, point[size:], moved.way
            search.tell(scored)
        return self._found(kept, way)
