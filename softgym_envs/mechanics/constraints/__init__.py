"""Constraint functions ``delta(x)``: one class per file, each with value, jacobian and second derivative."""

from softgym_envs.mechanics.constraints.bond import Bond
from softgym_envs.mechanics.constraints.cable import Cable
from softgym_envs.mechanics.constraints.cavity import Cavity
from softgym_envs.mechanics.constraints.chamber import Chamber
from softgym_envs.mechanics.constraints.constraint import Constraint
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.constraints.pose import Pose
from softgym_envs.mechanics.constraints.servo import Servo

__all__ = ["Bond", "Cable", "Cavity", "Chamber", "Constraint", "EmbeddedPoints", "Point", "Pose", "Servo"]
