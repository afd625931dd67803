"""Metrics of a body without a controller, read from its condensed model along one actuation.

A metric of the suite is one formula for all backends. It takes a `Course`: the states of a batch of bodies from rest to
the full command, as tensors. On the surrogate they carry gradients with respect to the design.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from softgym_envs.errors import unknown_name
from softgym_envs.estimation.information import sensor_information
from softgym_envs.estimation.posterior import Gaussian
from softgym_envs.registry import import_object
from softgym_envs.robots.grasping import Grasp
from softgym_envs.robots.sensorized_finger import SensorReadings

Direction = Literal["maximize", "minimize"]
Needs = Literal["states", "body", "sensors", "pushes", "touches", "grasps", "design"]

VOLUME_NOISE = 0.5e-9
"""Standard deviation of the measured volume of a cavity, for `information` [m3]."""
CABLE_ERROR = 1e-4
"""Standard deviation of the displacement of an actuator around its command, for `information` [m]."""
TOUCH_FORCE = 2.0
"""Standard deviation of the force of a touch before any reading, for `information` [N]."""


@dataclass(frozen=True)
class Course:
    """States of B bodies along one actuation, K of them: the first at rest, the last at the full command."""

    displacement: Tensor  # of the actuators [m, ...], shape (K, B, n_a)
    effort: Tensor  # of the actuators [N, ...], shape (K, B, n_a)
    effector: Tensor  # positions [m], shape (K, B, n_e)
    compliance: Tensor  # W, actuators before effectors, shape (K, B, n_a + n_e, n_a + n_e)
    axis: int  # coordinate along which the body lies at rest: 0, 1 or 2
    sensor: Tensor | None = None  # volumes of the cavities [m3], shape (K, B, n_s), if the body has cavities
    material: Tensor | None = None  # volume of the solid [m3], shape (B,), on FEM

    @property
    def travel(self) -> Tensor:
        """Displacement of the first effector from rest [m], shape (K, B, 3)."""
        return self.effector[..., :3] - self.effector[0, :, :3]

    @property
    def jacobian(self) -> Tensor:
        """Displacement of the first effector per actuator displacement, ``W_ea W_aa^-1``, shape (K, B, 3, n_a)."""
        n = self.effort.shape[-1]
        return torch.linalg.solve(self.compliance[..., :n, :n], self.compliance[..., n : n + 3, :n], left=False)

    @property
    def held(self) -> Tensor:
        """Compliance of the first effector with held actuators [m/N], ``-B`` of eq. 4.16, shape (K, B, 3, 3)."""
        n = self.effort.shape[-1]
        return self.compliance[..., n : n + 3, n : n + 3] - self.jacobian @ self.compliance[..., :n, n : n + 3]


def bending_angle(course: Course) -> Tensor:
    """Return the angle ``acos(|p_z| / |p(0)|)`` of the tip, with z the axis of the body (thesis, eq. 4.15)."""
    tip = course.effector[..., :3]
    return torch.acos((tip[-1, :, course.axis].abs() / tip[0].norm(dim=-1)).clamp(max=1.0))


def angular_displacement(course: Course) -> Tensor:
    """Return the angle ``acos(|p_z| / |p|)`` of the tip, with z the axis of the body (thesis, eq. 3.3)."""
    tip = course.effector[-1, :, :3]
    return torch.acos((tip[:, course.axis].abs() / tip.norm(dim=-1)).clamp(max=1.0))


def _across(course: Course) -> Tensor:
    """Return the direction in which the tip moves sideways, perpendicular to the axis of the body, shape (B, 3)."""
    sideways = course.travel[-1].clone()
    sideways[:, course.axis] = 0.0
    return sideways / sideways.norm(dim=-1, keepdim=True).clamp(min=1e-12)


def contact_force(course: Course) -> Tensor:
    """Return the sideways force on a tip that is blocked in all directions (thesis, eq. 4.16 and 4.17).

    The tip is the contact point, and ``delta_c`` is measured from its rest position. The tangent at the free state
    gives the force that brings the tip back. The thesis takes the component y, in which its finger bends. The force
    along the body differs widely from the equilibrium with a blocked tip, because the tangent ignores buckling and
    stretching.
    """
    return (torch.linalg.solve(course.held[-1], course.travel[-1]) * _across(course)).sum(-1).abs()


def _normal_forces(course: Course) -> Tensor:
    """Return the force on a tip that is blocked sideways only, at every state [N], shape (K, B)."""
    sideways = _across(course)
    return ((course.travel * sideways).sum(-1) / torch.einsum("bi,kbij,bj->kb", sideways, course.held, sideways)).abs()


def normal_force(course: Course) -> Tensor:
    """Return the force on a tip that is blocked sideways only: eq. 4.16 of the thesis without friction."""
    return _normal_forces(course)[-1]


def grasp_resistance(course: Course) -> Tensor:
    """Return the smallest actuator effort per normal force along the actuation (thesis, eq. 3.11)."""
    effort = course.effort[1:].abs().amax(dim=-1)
    return (effort / _normal_forces(course)[1:].clamp(min=1e-12)).amin(dim=0)


def travel(course: Course) -> Tensor:
    """Return how far the effector moves."""
    return course.travel[-1].norm(dim=-1)


def manipulability(course: Course) -> Tensor:
    """Return Yoshikawa's manipulability: the product of the singular values of the effector's Jacobian."""
    return torch.linalg.svdvals(course.jacobian[-1]).prod(dim=-1)


def tip_stiffness(course: Course) -> Tensor:
    """Return the smallest stiffness of the effector in any direction, with held actuators."""
    return 1.0 / torch.linalg.eigvalsh(course.held[-1])[:, -1]


def effort(course: Course) -> Tensor:
    """Return the largest effort of an actuator at the full command."""
    return course.effort[-1].abs().amax(dim=-1)


def work(course: Course) -> Tensor:
    """Return the work of the actuators from rest: the integral in eq. 3.12 of the thesis, by the trapezoidal rule."""
    mean = 0.5 * (course.effort[1:] + course.effort[:-1])
    return (mean * course.displacement.diff(dim=0)).sum(dim=(0, 2))


def material_volume(course: Course) -> Tensor:
    """Return the volume of the solid."""
    assert course.material is not None
    return course.material


def volume_change(course: Course) -> Tensor:
    """Return the change of the first cavity's volume (thesis, eq. 3.3)."""
    assert course.sensor is not None
    return (course.sensor[-1, :, 0] - course.sensor[0, :, 0]).abs()


def relative_volume_change(course: Course) -> Tensor:
    """Return the volume change relative to the actuated volume: the pressure change of a closed cavity (eq. 3.4)."""
    assert course.sensor is not None
    return volume_change(course) / course.sensor[-1, :, 0]


def cavity_volume(course: Course) -> Tensor:
    """Return the first cavity's volume at rest (thesis, eq. 3.4)."""
    assert course.sensor is not None
    return course.sensor[0, :, 0]


def pressure_sensitivity(readings: SensorReadings) -> float:
    """Return the smaller relative volume change of the first cavity, under the pull or a lateral force (sec. 3.3.6)."""
    assert readings.pressure_sensitivity is not None
    return readings.pressure_sensitivity


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


def grip_force(grasp: Grasp) -> float:
    """Return the largest force on the object along x (thesis, eq. 3.10)."""
    return grasp.contact_force


def grip_resistance(grasp: Grasp) -> float:
    """Return the smallest torque per force on the object (thesis, eq. 3.11)."""
    return grasp.grasp_resistance


def grip_energy(grasp: Grasp) -> float:
    """Return the sum of torque times angle over all angles (thesis, eq. 3.13)."""
    return grasp.grasp_energy


@dataclass(frozen=True)
class Metric:
    """One number of a body.

    Args:
        name: identifier, as in configurations and tables.
        function: ``Course -> values`` of shape (B,); with ``needs="design"``, ``{variable: value} -> value``; with
            ``needs="grasps"``, ``Grasp -> value``, of which the mean over all grasps is taken; with ``"pushes"``,
            ``SensorReadings -> value``; with ``"touches"``, ``slopes -> value``, see `touch_slopes`.
        unit: SI unit, or ``"1"``.
        direction: what a designer usually wants: ``"maximize"`` or ``"minimize"``.
        needs: ``"states"``: any backend; ``"body"``: a meshed body, on FEM; ``"sensors"``: sensing cavities, on FEM;
            ``"pushes"``: a sensorized finger with four cavities that is pushed sideways, on FEM; ``"touches"``: a
            sensorized finger that is touched on its back, on FEM; ``"grasps"``: a contact-aided finger that closes on
            objects, on FEM; ``"design"``: the values of the variables alone.
        description: one line for tables; default: the first line of the function's documentation.
    """

    name: str
    function: Callable[[Any], Any]
    unit: str
    direction: Direction
    needs: Needs = "states"
    description: str = ""

    def __post_init__(self) -> None:
        if self.direction not in ("maximize", "minimize"):
            raise ValueError(f"metric '{self.name}': direction = {self.direction!r}; allowed: maximize, minimize")
        if self.needs not in get_args(Needs):
            raise ValueError(f"metric '{self.name}': needs = {self.needs!r}; allowed: {', '.join(get_args(Needs))}")
        if not self.description:
            object.__setattr__(self, "description", (self.function.__doc__ or self.name).splitlines()[0])

    def __call__(self, argument: Any) -> Any:
        """Return what the function returns."""
        return self.function(argument)

    @property
    def display_unit(self) -> str:
        """The unit in which people read the metric."""
        return _DISPLAY.get(self.unit, (1.0, self.unit))[1]

    @property
    def display_scale(self) -> float:
        """The factor from SI to the display unit."""
        return _DISPLAY.get(self.unit, (1.0, self.unit))[0]

    @property
    def label(self) -> str:
        """The name in words, with the display unit."""
        words = self.name.replace("_", " ")
        return words if self.display_unit == "1" else f"{words} [{self.display_unit}]"


_DISPLAY = {"m": (1e3, "mm"), "m3": (1e9, "mm3"), "rad": (180.0 / math.pi, "deg"), "J": (1e3, "mJ")}

METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric("bending_angle", bending_angle, "rad", "maximize"),
        Metric("angular_displacement", angular_displacement, "rad", "maximize"),
        Metric("contact_force", contact_force, "N", "maximize"),
        Metric("normal_force", normal_force, "N", "maximize"),
        Metric("grasp_resistance", grasp_resistance, "effort/N", "minimize"),
        Metric("travel", travel, "m", "maximize"),
        Metric("manipulability", manipulability, "1", "maximize"),
        Metric("tip_stiffness", tip_stiffness, "N/m", "maximize"),
        Metric("effort", effort, "effort", "minimize"),
        Metric("work", work, "J", "minimize"),
        Metric("material_volume", material_volume, "m3", "minimize", needs="body"),
        Metric("volume_change", volume_change, "m3", "maximize", needs="sensors"),
        Metric("relative_volume_change", relative_volume_change, "1", "maximize", needs="sensors"),
        Metric("cavity_volume", cavity_volume, "m3", "maximize", needs="sensors"),
        Metric("pressure_sensitivity", pressure_sensitivity, "1", "maximize", needs="pushes"),
        Metric("information", information, "nat", "maximize", needs="touches"),
        Metric("grip_force", grip_force, "N", "maximize", needs="grasps"),
        Metric("grip_resistance", grip_resistance, "m", "minimize", needs="grasps"),
        Metric("grip_energy", grip_energy, "N m", "minimize", needs="grasps"),
    )
}
"""Metrics of the suite by name."""


def design_metric(unit: str, direction: Direction) -> Callable[[Callable[[Any], float]], Metric]:
    """Return a decorator that makes a metric of a function of the design.

    The decorated function takes ``{variable: value}`` [SI], with all variables of the body, and returns a number. Name
    it in a configuration as ``my_module:my_function``.

    Examples:
        >>> @design_metric(unit="kg", direction="minimize")
        ... def mass(design):
        ...     return 1.1e3 * design["length"] * design["height"] ** 2
    """
    return lambda function: Metric(getattr(function, "__name__", "metric"), function, unit, direction, needs="design")


def find_metric(name: str | Metric) -> Metric:
    """Return a metric by its name or its path ``"my_module:my_metric"``; a metric is returned as it is.

    Raises:
        ValueError: for an unknown name, or a path that does not lead to a metric.
    """
    if isinstance(name, Metric):
        return name
    if name in METRICS:
        return METRICS[name]
    if ":" not in name:
        message = unknown_name("metric", name, METRICS)
        own = "" if message.endswith("?") else ", or a metric of your own as my_module:my_metric"
        raise ValueError(message + own)
    found = import_object("metric", name)
    if not isinstance(found, Metric):
        raise ValueError(
            f"metric '{name}' is a {type(found).__name__} without a unit; decorate the function with "
            "@design_metric(unit=..., direction=...), or make it a Metric"
        )
    return found


def find_metrics(names: tuple[str | Metric, ...]) -> tuple[Metric, ...]:
    """Return several metrics, as `find_metric`; two of the same name are a ValueError."""
    metrics = tuple(find_metric(name) for name in names)
    shown = [metric.name for metric in metrics]
    repeated = [name for name in shown if shown.count(name) > 1]
    if repeated:
        raise ValueError(f"metric '{repeated[0]}' is named twice")
    return metrics
