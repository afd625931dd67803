"""What a body is worth, read from its condensed model along one actuation: one formula for all backends.

A formula takes a `Course`, the states of a batch of bodies from rest to the full command, as tensors. On the surrogate
they carry gradients with respect to the design; from FEM they are numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

__all__ = ["METRICS", "Course", "Metric"]


@dataclass(frozen=True)
class Course:
    """States of B bodies along one actuation, K of them: the first at rest, the last at the full command.

    Attributes:
        displacement: actuator displacements [m, ...], shape (K, B, n_a).
        effort: actuator efforts [N, ...], shape (K, B, n_a).
        effector: effector positions [m], shape (K, B, n_e).
        compliance: W, actuators before effectors, shape (K, B, n_a + n_e, n_a + n_e).
        axis: coordinate along which the body lies at rest: 0, 1 or 2.
        sensor: volumes of the cavities [m3], shape (K, B, n_s), where the body has any.
        material: volume of the solid [m3], shape (B,), where it is known.
    """

    displacement: Tensor
    effort: Tensor
    effector: Tensor
    compliance: Tensor
    axis: int
    sensor: Tensor | None = None
    material: Tensor | None = None

    @property
    def travel(self) -> Tensor:
        """Displacement of the first effector from rest [m], shape (K, B, 3)."""
        return self.effector[..., :3] - self.effector[0, :, :3]

    @property
    def jacobian(self) -> Tensor:
        """Motion of the first effector per actuator displacement, ``W_ea W_aa^-1``, shape (K, B, 3, n_a)."""
        n = self.effort.shape[-1]
        return torch.linalg.solve(self.compliance[..., :n, :n], self.compliance[..., n : n + 3, :n], left=False)

    @property
    def held(self) -> Tensor:
        """Compliance of the first effector with held actuators [m/N], ``-B`` of eq. 4.16, shape (K, B, 3, 3)."""
        n = self.effort.shape[-1]
        return self.compliance[..., n : n + 3, n : n + 3] - self.jacobian @ self.compliance[..., :n, n : n + 3]


def bending_angle(course: Course) -> Tensor:
    """Eq. 4.15: ``acos(|p_z| / |p(0)|)`` of the tip, with z the axis of the body."""
    tip = course.effector[..., :3]
    return torch.acos((tip[-1, :, course.axis].abs() / tip[0].norm(dim=-1)).clamp(max=1.0))


def angular_displacement(course: Course) -> Tensor:
    """Eq. 3.3: ``acos(|p_z| / |p|)`` of the tip, with z the axis of the body."""
    tip = course.effector[-1, :, :3]
    return torch.acos((tip[:, course.axis].abs() / tip.norm(dim=-1)).clamp(max=1.0))


def across(course: Course) -> Tensor:
    """Direction of the tip's way across the axis of the body, shape (B, 3)."""
    way = course.travel[-1].clone()
    way[:, course.axis] = 0.0
    return way / way.norm(dim=-1, keepdim=True).clamp(min=1e-12)


def contact_force(course: Course) -> Tensor:
    """Eq. 4.16 and 4.17: force on the tip, blocked in all directions, along its way across the body.

    The tip is the contact point and ``delta_c`` counts from its rest position; the tangent at the free state says what
    it takes to bring the tip back. The thesis reads the component y, in which its finger bends. Against the equilibrium
    with a blocked tip the force along the body is far off, for the tangent does not know that it buckles or stretches.
    """
    return (torch.linalg.solve(course.held[-1], course.travel[-1]) * across(course)).sum(-1).abs()


def normal_forces(course: Course) -> Tensor:
    """Eq. 4.16 for a tip blocked along its way across the body alone, at every state [N], shape (K, B)."""
    way = across(course)
    return ((course.travel * way).sum(-1) / torch.einsum("bi,kbij,bj->kb", way, course.held, way)).abs()


def normal_force(course: Course) -> Tensor:
    """Eq. 4.16 for a contact without friction: force on the tip, blocked along its way across the body alone."""
    return normal_forces(course)[-1]


def grasp_resistance(course: Course) -> Tensor:
    """Eq. 3.11 with the normal force: the least effort per force along the actuation."""
    effort = course.effort[1:].abs().amax(dim=-1)
    return (effort / normal_forces(course)[1:].clamp(min=1e-12)).amin(dim=0)


def travel(course: Course) -> Tensor:
    """How far the effector moves."""
    return course.travel[-1].norm(dim=-1)


def manipulability(course: Course) -> Tensor:
    """Yoshikawa's measure of the effector's Jacobian: the product of its singular values."""
    return torch.linalg.svdvals(course.jacobian[-1]).prod(dim=-1)


def tip_stiffness(course: Course) -> Tensor:
    """Smallest stiffness of the effector in any direction, with held actuators."""
    return 1.0 / torch.linalg.eigvalsh(course.held[-1])[:, -1]


def effort(course: Course) -> Tensor:
    """Largest effort of an actuator at the full command."""
    return course.effort[-1].abs().amax(dim=-1)


def work(course: Course) -> Tensor:
    """Work of the actuators from rest, by the trapezoidal rule: the integral behind eq. 3.12."""
    mean = 0.5 * (course.effort[1:] + course.effort[:-1])
    return (mean * course.displacement.diff(dim=0)).sum(dim=(0, 2))


def material_volume(course: Course) -> Tensor:
    """Volume of the solid."""
    assert course.material is not None
    return course.material


def volume_change(course: Course) -> Tensor:
    """Eq. 3.3: the change of the first cavity's volume."""
    assert course.sensor is not None
    return (course.sensor[-1, :, 0] - course.sensor[0, :, 0]).abs()


def relative_volume_change(course: Course) -> Tensor:
    """Eq. 3.4: that change relative to the actuated volume, the relative change of pressure when it is closed."""
    assert course.sensor is not None
    return volume_change(course) / course.sensor[-1, :, 0]


def cavity_volume(course: Course) -> Tensor:
    """Eq. 3.4: the first cavity's volume at rest."""
    assert course.sensor is not None
    return course.sensor[0, :, 0]


@dataclass(frozen=True)
class Metric:
    """One number of a body.

    Args:
        formula: its values (B,) from a `Course`.
        unit: of the value.
        better: what a designer usually wants of it.
        needs: ``"sensors"``: a body with sensing cavities, on FEM; ``"body"``: a meshed body, on FEM; ``"states"``: a
            surrogate is enough.
    """

    formula: Callable[[Course], Tensor]
    unit: str
    better: Literal["larger", "smaller"]
    needs: Literal["states", "body", "sensors"] = "states"

    @property
    def description(self) -> str:
        """First line of the formula's documentation."""
        return (self.formula.__doc__ or "").splitlines()[0]

    def shown(self, value: float) -> tuple[float, str]:
        """Return a value as people read it, and its unit."""
        scale, unit = SHOWN.get(self.unit, (1.0, self.unit))
        return scale * value, unit


SHOWN = {"m": (1e3, "mm"), "m3": (1e9, "mm3"), "rad": (180.0 / math.pi, "deg"), "J": (1e3, "mJ")}

METRICS: dict[str, Metric] = {
    "bending_angle": Metric(bending_angle, "rad", "larger"),
    "angular_displacement": Metric(angular_displacement, "rad", "larger"),
    "contact_force": Metric(contact_force, "N", "larger"),
    "normal_force": Metric(normal_force, "N", "larger"),
    "grasp_resistance": Metric(grasp_resistance, "effort/N", "smaller"),
    "travel": Metric(travel, "m", "larger"),
    "manipulability": Metric(manipulability, "1", "larger"),
    "tip_stiffness": Metric(tip_stiffness, "N/m", "larger"),
    "effort": Metric(effort, "effort", "smaller"),
    "work": Metric(work, "J", "smaller"),
    "material_volume": Metric(material_volume, "m3", "smaller", needs="body"),
    "volume_change": Metric(volume_change, "m3", "larger", needs="sensors"),
    "relative_volume_change": Metric(relative_volume_change, "1", "larger", needs="sensors"),
    "cavity_volume": Metric(cavity_volume, "m3", "larger", needs="sensors"),
}
"""Registry: name to metric."""
