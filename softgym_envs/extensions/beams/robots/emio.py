"""Emio of Compliance Robotics: a Tetrapod that can be bought, with Dynamixel servos."""

from __future__ import annotations

from softgym_envs.extensions.beams.robots.tetrapod import Tetrapod


class Emio(Tetrapod):
    """Emio with its straight (blue) legs pointing down and its rigid (blue) connector.

    Dimensions are those of the maker's public model: the servos' axes are 97.5 mm from the middle, a leg begins 22 mm
    outside its axis and is straight and elastic for 202.4 mm, the tips meet the connector 10 mm from its middle and
    3 mm above its origin, which is the effector. All else is as in `Tetrapod`.
    """

    name = "emio"
    horn, centre_radius, effector_depth = 22e-3, 10e-3, 3e-3
    baseline = 0.2024, 0.0975
