"""Hands that lift: which of their actuators is the drive that raises what they hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from softgym_envs.robots.base import Robot


@dataclass(frozen=True)
class Lifting:
    """How a hand lifts.

    Attributes:
        drive: number of the actuator that raises the object; all others close the hand.
        mass: design variable that is the mass of the object [kg].
        friction: design variable that is its coefficient of friction.
    """

    drive: int
    mass: str
    friction: str


@runtime_checkable
class Lifts(Protocol):
    """A robot that lifts."""

    lifting: Lifting


def lifting_of(robot: Robot) -> Lifting | None:
    """Return how a robot lifts; None if it does not."""
    return robot.lifting if isinstance(robot, Lifts) else None
