"""Grasps of the contact-aided finger: objects to close on, and the objectives of the thesis (section 3.4.3).

The finger closes on an object that is fixed in space, angle after angle. Objectives follow from the torque of the servo
and the force on the object at each angle.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from softgym_envs.errors import ConvergenceError, InfeasibleDesign, unknown_name
from softgym_envs.extensions.beams.prism import RoundedPrism
from softgym_envs.extensions.grasping.robots.contact_aided_finger import HELD, ContactAidedFinger
from softgym_envs.mechanics.contact.contact import Contacts, ContactSettings
from softgym_envs.mechanics.contact.obstacles import IDENTITY, Obstacle, Plane, Sphere
from softgym_envs.mechanics.solvers.statics import Statics

KINDS = ("plane", "hexagon", "horizontal_hexagon", "sphere")
"""Kinds of objects."""

LENGTH = 0.200
"""Length of a hexagonal prism [m]: longer than the finger."""

UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
"""Local axes of a prism whose axis is y, as columns."""

TOUCHING = 1e-3
"""Smallest force along x that counts as contact with the object [N]."""

TOLERANCE = 1e-8
"""Largest remaining correction of a node at an equilibrium [m]."""

MAX_ITERATIONS = 1500
"""Newton iterations after which a grasp gives up; 40 angles usually take fewer than 250."""


@dataclass(frozen=True)
class GraspObject:
    """A rigid object that is fixed in front of a finger.

    Args:
        kind: ``"plane"`` across x; ``"hexagon"``, a prism along y; ``"horizontal_hexagon"``, a prism along z; or
            ``"sphere"``. A flat side of a prism faces the finger.
        distance: from the outer side of the finger's foot to the nearest point of the object, along x [m].
        height: of the middle of the object above the finger's feet [m]; without effect on a plane.
        offset: z of the middle of the object [m]; without effect on a plane.
        size: width of a prism between two flat sides, or diameter of a sphere [m].
        rounding: radius of the edges of a prism [m].
        friction: between finger and object.
    """

    kind: str = "plane"
    distance: float = 30.1e-3
    height: float = 0.050
    offset: float = 0.0
    size: float = 0.060
    rounding: float = 0.5e-3
    friction: float = 0.85

    def obstacle(self, width: float) -> Obstacle:
        """Return the object in front of a finger of a width [m].

        Raises:
            ValueError: for an unknown kind, or a size that is not allowed.
        """
        front = width + self.distance
        if self.kind == "plane":
            return Plane((front, 0.0, 0.0), (-1.0, 0.0, 0.0), name="object", friction=self.friction)
        middle = (front + 0.5 * self.size, self.height, self.offset)
        if self.kind == "sphere":
            return Sphere(middle, 0.5 * self.size, name="object", friction=self.friction)
        if self.kind not in KINDS:
            raise ValueError(unknown_name("kind of object", self.kind, KINDS))
        return RoundedPrism.hexagonal(
            self.size,
            0.5 * LENGTH,
            self.rounding,
            centre=middle,
            rotation=UPRIGHT if self.kind == "hexagon" else IDENTITY,
            name="object",
            friction=self.friction,
        )


@dataclass(frozen=True)
class Grasp:
    """What happens while a finger closes on an object.

    Attributes:
        status: ``"ok"``; ``"infeasible"``, if the body cannot be built or crosses itself or the object at rest; or
            ``"no equilibrium"``, if the finger closes only in part.
        reason: message of the error, empty if the status is ``"ok"``.
        angle: angles of the servo that were reached within its largest torque [rad], shape (k,).
        torque: of the servo [N m], shape (k,).
        force: on the object [N], shape (k, 3).
        contacts: number of points of the finger that press on the object, shape (k,).
        sliding: number of them that slide, shape (k,).
        gap: smallest gap between surfaces of the finger, or to the object [m]; inf where it is larger than the distance
            of contact; shape (k,).
        torque_limited: whether the next angle takes more than the largest torque.
        nodes: number of nodes of the body.
        iterations: Newton iterations at each angle, shape (k,).
    """

    status: str
    reason: str
    angle: np.ndarray
    torque: np.ndarray
    force: np.ndarray
    contacts: np.ndarray
    sliding: np.ndarray
    gap: np.ndarray
    torque_limited: bool
    nodes: int
    iterations: np.ndarray

    @property
    def contact_force(self) -> float:
        """The largest force on the object along x [N] (eq. 3.10), to be maximised."""
        return float(np.abs(self.force[:, 0]).max(initial=0.0))

    @property
    def grasp_resistance(self) -> float:
        """The smallest torque per force while the finger touches the object [m] (eq. 3.11), to be minimised.

        It is infinite if the finger does not reach the object.
        """
        force = np.abs(self.force[:, 0])
        touches = force > TOUCHING
        return float(np.min(np.abs(self.torque[touches]) / force[touches], initial=math.inf))

    @property
    def grasp_energy(self) -> float:
        """The sum of torque times angle [N m rad] (eq. 3.13), to be minimised.

        As published, it has the angle and not the step of the angle, so it grows with the number of angles.
        """
        return float(np.abs(self.torque) @ self.angle)


def evaluate_grasp(
    robot: ContactAidedFinger,
    design: Mapping[str, float] | None = None,
    target: GraspObject | None = None,
    *,
    angle: float = math.radians(30.0),
    angles: int = 40,
    self_friction: float = 0.85,
) -> Grasp:
    """Close a finger on an object in equal steps of the servo's angle, and stop where it takes too much torque.

    Friction depends on the path, so objectives depend a little on the number of angles.

    Args:
        robot: the finger. Its obstacles, and its distance and stiffness of contact, hold here too; its surfaces always
            touch each other, with the friction given below.
        design: its body; missing variables take their baseline.
        target: the object; default: the plane of the thesis, 30.1 mm from the finger.
        angle: largest angle [rad]; 30 degrees in the thesis, 40 for the hexagon and the sphere.
        angles: number of steps.
        self_friction: between surfaces of the finger.

    Returns:
        The grasp. Its status says whether the design can be built, and whether it closes.

    Raises:
        DesignError: for a malformed design.
        ValueError: for an angle or a number of steps that is not positive.
    """
    if not 0.0 < angle < math.pi or angles < 1:
        raise ValueError(f"angle = {angle} rad must be between 0 and pi, and angles = {angles} at least 1")
    target = GraspObject() if target is None else target
    limit = robot.actuators[0].max_effort
    steps: list[_Step] = []
    status, reason, limited, nodes = "ok", "", False, 0
    try:
        model = robot.build(design)
        nodes = len(model.nodes) - 4 * len(model.frames)
        contact = model.set_contact(
            obstacles=[target.obstacle(robot.width), *robot.obstacles],
            excluded=np.flatnonzero(model.nodes[:nodes, 1] < HELD + 1e-9),
            settings=ContactSettings(
                self_contact=True,
                self_friction=self_friction,
                distance=robot.contact_distance,
                stiffness=robot.contact_stiffness,
            ),
        )
        if crossing := contact.intersections(model.nodes):
            raise InfeasibleDesign(f"{crossing} at rest")
        statics = Statics(model, tolerance=TOLERANCE, max_iterations=60, max_halvings=5, exact_compliance=False)
        for theta in angle * np.arange(1, angles + 1) / angles:
            found = statics.solve([theta])
            limited = bool(abs(found.effort[0]) > limit)
            if limited:
                break
            assert found.contacts is not None
            steps.append(_Step(theta, found.effort[0], found.contacts, found.iterations))
            if theta < angle and sum(step.iterations for step in steps) > MAX_ITERATIONS:
                raise ConvergenceError(f"more than {MAX_ITERATIONS} Newton iterations", fraction=theta / angle)
    except InfeasibleDesign as error:
        status, reason = "infeasible", str(error)
    except ConvergenceError as error:
        reached = math.degrees(steps[-1].angle) if steps else 0.0
        status, reason = "no equilibrium", f"no equilibrium beyond {reached:.2f} degrees: {error}"
    pressing = [step.contacts.pressing > 0.0 for step in steps]
    return Grasp(
        status=status,
        reason=reason,
        angle=np.array([step.angle for step in steps]),
        torque=np.array([step.torque for step in steps]),
        force=np.array([-step.contacts.total[0] for step in steps]).reshape(-1, 3),
        contacts=np.array([chosen.sum() for chosen in pressing], dtype=int),
        sliding=np.array([step.contacts.sliding[p].sum() for step, p in zip(steps, pressing, strict=True)], dtype=int),
        gap=np.array([step.contacts.smallest_gap for step in steps]),
        torque_limited=limited,
        nodes=nodes,
        iterations=np.array([step.iterations for step in steps], dtype=int),
    )


class _Step(NamedTuple):
    """What one angle gives."""

    angle: float
    torque: float
    contacts: Contacts
    iterations: int
