"""Metrics of a body without a controller, read from its condensed model along one actuation.

One formula serves all backends. It takes an `ActuationPath`: the states of a batch of bodies from rest to the full
command, as tensors. On the surrogate they carry gradients with respect to the design.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from softgym_envs.codesign.metrics.metric import metric


@dataclass(frozen=True)
class ActuationPath:
    """States of B bodies along one actuation, K of them: the first at rest, the last at the full command."""

    displacement: Tensor  # of the actuators [m, ...], shape (K, B, n_a)
    effort: Tensor  # of the actuators [N, ...], shape (K, B, n_a)
    effector: Tensor  # positions [m], shape (K, B, n_e)
    compliance: Tensor  # W, actuators before effectors, shape (K, B, n_a + n_e, n_a + n_e)
    axis: int  # axis of the undeformed robot: 0, 1 or 2

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


@metric("rad", "maximize", "states")
def bending_angle(course: ActuationPath) -> Tensor:
    """Return the angle ``acos(|p_z| / |p(0)|)`` of the tip, with z the axis of the body (thesis, eq. 4.15)."""
    tip = course.effector[..., :3]
    return torch.acos((tip[-1, :, course.axis].abs() / tip[0].norm(dim=-1)).clamp(max=1.0))


@metric("rad", "maximize", "states")
def angular_displacement(course: ActuationPath) -> Tensor:
    """Return the angle ``acos(|p_z| / |p|)`` of the tip, with z the axis of the body (thesis, eq. 3.3)."""
    tip = course.effector[-1, :, :3]
    return torch.acos((tip[:, course.axis].abs() / tip.norm(dim=-1)).clamp(max=1.0))


def _across(course: ActuationPath) -> Tensor:
    """Return the direction in which the tip moves sideways, perpendicular to the axis of the body, shape (B, 3)."""
    sideways = course.travel[-1].clone()
    sideways[:, course.axis] = 0.0
    return sideways / sideways.norm(dim=-1, keepdim=True).clamp(min=1e-12)


@metric("N", "maximize", "states")
def contact_force(course: ActuationPath) -> Tensor:
    """Return the sideways force on a tip that is blocked in all directions (thesis, eq. 4.16 and 4.17).

    The tip is the contact point, and ``delta_c`` is measured from its rest position. The tangent at the free state
    gives the force that brings the tip back. The thesis takes the component y, in which its finger bends. The force
    along the body differs widely from the equilibrium with a blocked tip, because the tangent ignores buckling and
    stretching.
    """
    return (torch.linalg.solve(course.held[-1], course.travel[-1]) * _across(course)).sum(-1).abs()


def _normal_forces(course: ActuationPath) -> Tensor:
    """Return the force on a tip that is blocked sideways only, at every state [N], shape (K, B)."""
    sideways = _across(course)
    return ((course.travel * sideways).sum(-1) / torch.einsum("bi,kbij,bj->kb", sideways, course.held, sideways)).abs()


@metric("N", "maximize", "states")
def normal_force(course: ActuationPath) -> Tensor:
    """Return the force on a tip that is blocked sideways only: eq. 4.16 of the thesis without friction."""
    return _normal_forces(course)[-1]


@metric("effort/N", "minimize", "states")
def grasp_resistance(course: ActuationPath) -> Tensor:
    """Return the smallest actuator effort per normal force along the actuation (thesis, eq. 3.11)."""
    effort = course.effort[1:].abs().amax(dim=-1)
    return (effort / _normal_forces(course)[1:].clamp(min=1e-12)).amin(dim=0)


@metric("m", "maximize", "states")
def travel(course: ActuationPath) -> Tensor:
    """Return how far the effector moves."""
    return course.travel[-1].norm(dim=-1)


@metric("1", "maximize", "states")
def manipulability(course: ActuationPath) -> Tensor:
    """Return Yoshikawa's manipulability: the product of the singular values of the effector's Jacobian."""
    return torch.linalg.svdvals(course.jacobian[-1]).prod(dim=-1)


@metric("N/m", "maximize", "states")
def tip_stiffness(course: ActuationPath) -> Tensor:
    """Return the smallest stiffness of the effector in any direction, with held actuators."""
    return 1.0 / torch.linalg.eigvalsh(course.held[-1])[:, -1]


@metric("effort", "minimize", "states")
def effort(course: ActuationPath) -> Tensor:
    """Return the largest effort of an actuator at the full command."""
    return course.effort[-1].abs().amax(dim=-1)


@metric("J", "minimize", "states")
def work(course: ActuationPath) -> Tensor:
    """Return the work of the actuators from rest: the integral in eq. 3.12 of the thesis, by the trapezoidal rule."""
    mean = 0.5 * (course.effort[1:] + course.effort[:-1])
    return (mean * course.displacement.diff(dim=0)).sum(dim=(0, 2))
