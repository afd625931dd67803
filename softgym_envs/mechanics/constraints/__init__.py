"""Constraint functions ``delta(x)``: one class per file, each with value, jacobian and second derivative."""

from softgym_envs.mechanics.constraints.cable import Cable
from softgym_envs.mechanics.constraints.constraint import Constraint
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point

__all__ = ["Cable", "Constraint", "EmbeddedPoints", "Point"]
