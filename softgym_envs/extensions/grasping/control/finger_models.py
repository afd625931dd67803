"""Models of one finger, with finite elements or learned, from which `fingers` builds grippers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from softgym_envs.extensions.grasping.robots.contact_finger import ContactFinger
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.surrogate.model import Context, SurrogateModel


class FingerModel(Protocol):
    """A model of identical fingers, which are evaluated together.

    Attributes:
        origin: origin of the pose at rest, in the finger's axes [m], shape (3,).
        span: width of the range of each coordinate, shape (8,); steps are limited to a quarter of it.
    """

    origin: np.ndarray
    span: np.ndarray

    def evaluate(self, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return efforts (F, 8), compliance W (F, n, n) and tips [m] (F, 3) at coordinates (F, 8), cables first.

        The first eight rows of W belong to the coordinates. Cables can push.

        Raises:
            ConvergenceError: if there is no such state.
        """
        ...

    def trust(self, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the uncertainty of the tips [m] (F,), and whether the states are in the model's domain (F,)."""
        ...


class FEMFingers:
    """Finite-element fingers; the solver of each follows its own path.

    Args:
        robot: the finger.
        design: its design; missing variables take their baseline.
        tolerance: accuracy of its equilibria [m].
    """

    def __init__(
        self, robot: ContactFinger, design: Mapping[str, float] | None = None, *, tolerance: float = 1e-10
    ) -> None:
        complete = robot.design_space.complete(design)
        self.model = robot.build(complete)
        self.origin = robot.object_frame(complete)
        self.span = robot.upper - robot.lower
        self.tolerance = tolerance
        self._fingers: list[Statics] = []

    def evaluate(self, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        while len(self._fingers) < len(displacement):
            finger = Statics(self.model, tolerance=self.tolerance)
            finger.unilateral = np.zeros_like(finger.unilateral)
            self._fingers.append(finger)
        states = [finger.solve(row) for finger, row in zip(self._fingers, displacement, strict=False)]
        count = displacement.shape[1]
        return (
            np.stack([state.effort[:count] for state in states]),
            np.stack([state.condensed.compliance for state in states]),
            np.stack([state.condensed.delta.e[:3] for state in states]),
        )

    def trust(self, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(len(displacement)), np.ones(len(displacement), dtype=bool)


class SurrogateFingers:
    """Learned fingers, all evaluated in one call of the model.

    Args:
        model: learned model of a `ContactFinger`.
        design: design of the fingers; missing variables take their baseline.
    """

    def __init__(self, model: SurrogateModel, design: Mapping[str, float] | None = None) -> None:
        robot = model.robot
        if not isinstance(robot, ContactFinger):
            raise ValueError(f"the model must be of robot 'contact_finger', got one of robot '{robot.name}'")
        complete = robot.design_space.complete(design)
        self.model = model
        self.origin = robot.object_frame(complete)
        self.span = robot.upper - robot.lower
        self._context = model.context(complete.array[None])

    def evaluate(self, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        context = Context.shared(self._context, len(displacement))
        effort, effector = self.model.state(context, displacement)[:2]
        return effort, self.model.compliance(context, displacement), effector

    def trust(self, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        context = Context.shared(self._context, len(displacement))
        return self.model.trust(context, displacement, self.model.effector(context, displacement)[1])
