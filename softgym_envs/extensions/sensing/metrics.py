"""Metrics of the sensing cavities of a robot."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from softgym_envs.codesign.metrics.metric import metric
from softgym_envs.codesign.metrics.sources import Source, needs_fem
from softgym_envs.extensions.sensing.information import sensor_information, touch_slopes
from softgym_envs.extensions.sensing.posterior import Gaussian
from softgym_envs.extensions.sensing.sensorized_finger import SensorizedFinger, SensorReadings
from softgym_envs.extensions.sensing.walls import check_cavities
from softgym_envs.mechanics.constraints.cavity import Cavity
from softgym_envs.units import Display

if TYPE_CHECKING:
    from softgym_envs.extensions.design.bodies import Body
    from softgym_envs.robots.base import Robot

VOLUME_NOISE = 0.5e-9
"""Standard deviation of the measured volume of a cavity, for `information` [m3]."""
CABLE_ERROR = 1e-4
"""Standard deviation of the displacement of an actuator around its command, for `information` [m]."""
TOUCH_FORCE = 2.0
"""Standard deviation of the force of a touch before any reading, for `information` [N]."""

CUBIC_MILLIMETRES = Display("mm3", 1e9, 1)


def _refuse_without_cavities(robot: Robot, backend: str) -> str:
    lacking = "" if hasattr(robot, "cavities") else f"a robot with sensing cavities, got '{robot.name}'"
    return needs_fem(robot, backend) or lacking


def _refuse_other_fingers(robot: Robot, backend: str) -> str:
    lacking = "" if isinstance(robot, SensorizedFinger) else f"robot 'sensorized_finger', got '{robot.name}'"
    return needs_fem(robot, backend) or lacking


def _refuse_two_cavities(robot: Robot, backend: str) -> str:
    four = getattr(robot, "cavities", None) == 4
    lacking = "" if four else "robot 'sensorized_finger' with robot_options cavities: 4"
    return _refuse_other_fingers(robot, backend) or lacking


def _volumes(body: Body) -> np.ndarray:
    """Return the volumes of the cavities [m3] in all states, shape (K, n_s).

    Raises:
        InfeasibleDesign: if the walls of a cavity pass through each other.
    """
    rows = body.model.constraints["s"]
    for state in body.states:
        assert state.nodes is not None
        check_cavities(rows, state.nodes)
    rest = [row.rest_volume for row in rows if isinstance(row, Cavity)]
    return np.array([rest + state.condensed.delta.s for state in body.states])


def _readings(body: Body) -> SensorReadings:
    assert isinstance(body.robot, SensorizedFinger)
    return body.robot.readings(body.variables, pull=float(body.command[0]))


def _touch_slopes(body: Body) -> np.ndarray:
    """Return `touch_slopes` of touches at the centres of ten cells of the back, 20 by 7.5 mm, at the full command."""
    heights = -0.015 - 0.020 * (np.arange(5) + 0.5)
    places = np.array([[side * 3.75e-3, 0.0, height] for height in heights for side in (-1.0, 1.0)])
    return touch_slopes(body.robot, places, np.array([0.0, 1.0, 0.0]), body.command, body.variables)


CAVITIES = Source("cavities", _volumes, _refuse_without_cavities)
"""Volumes of the cavities from rest to the full command [m3], shape (K, n_s)."""
PUSHES = Source("pushes", _readings, _refuse_two_cavities)
"""A sensorized finger with four cavities that is pushed sideways, its `SensorReadings`."""
TOUCHES = Source("touches", _touch_slopes, _refuse_other_fingers)
"""A sensorized finger that is touched on its back, the slopes of `touch_slopes`, shape (p, n_s, n_a + 1)."""


@metric("m3", "maximize", CAVITIES, shown=CUBIC_MILLIMETRES)
def volume_change(volumes: np.ndarray) -> float:
    """Return the change of the first cavity's volume (thesis, eq. 3.3)."""
    return abs(float(volumes[-1, 0] - volumes[0, 0]))


@metric("1", "maximize", CAVITIES)
def relative_volume_change(volumes: np.ndarray) -> float:
    """Return the volume change relative to the actuated volume: the pressure change of a closed cavity (eq. 3.4)."""
    return volume_change(volumes) / float(volumes[-1, 0])


@metric("m3", "maximize", CAVITIES, shown=CUBIC_MILLIMETRES)
def cavity_volume(volumes: np.ndarray) -> float:
    """Return the first cavity's volume at rest (thesis, eq. 3.4)."""
    return float(volumes[0, 0])


@metric("1", "maximize", PUSHES)
def pressure_sensitivity(readings: SensorReadings) -> float:
    """Return the smaller relative volume change of the first cavity, under the pull or a lateral force (sec. 3.3.6)."""
    assert readings.pressure_sensitivity is not None
    return readings.pressure_sensitivity


@metric("nat", "maximize", TOUCHES)
def information(slopes: np.ndarray) -> float:
    """Return the information that one reading of all cavities adds on the force of a touch and the cable [nat].

    It is the mean over touched places of half of ``log det(I + P J^T R^-1 J)``, where ``J`` (one of the slopes, shape
    (p, n_s, n_a + 1)) is the derivative of the volumes by the displacements of the actuators and by the force.
    """
    count = slopes.shape[-1]
    spread = np.full(count, CABLE_ERROR)
    spread[-1] = TOUCH_FORCE
    limits = np.full(count, np.inf)
    prior = Gaussian(np.zeros(count), np.diag(spread**2), -limits, limits)
    noise = np.full(slopes.shape[1], VOLUME_NOISE)
    return float(np.mean([sensor_information(slope, noise, prior) for slope in slopes]))
