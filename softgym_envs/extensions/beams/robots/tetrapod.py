"""The Tetrapod: four servos bend elastic legs that meet in a small rigid centre (thesis, sec. 5.3).

The published frame has y up. Here z is up: the published (x, y, z) is (x, z, -y) here. The robot hangs from its servos.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.optimize import brentq

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.elements import Port, PoseParts, curve_skin
from softgym_envs.extensions.beams.servo import Servo
from softgym_envs.extensions.beams.skins import box_skin, tube_skin
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.elements.rigid import sphere_inertia
from softgym_envs.mechanics.frames import frame_rows
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.base import Actuator, Robot
from softgym_envs.robots.capabilities import Learning
from softgym_envs.robots.mesh_tiers import choose_mesh

JOINT_GAP = 1.0e-3
"""Gap between the skins of the centre and of a leg where they are joined [m]: more than the distance of contact."""
CENTRE_MASS = 0.020
"""Mass of the centre part [kg]; not published."""
HANGING = -0.150
"""Published height of the centre at rest [m], from which the search for the equilibrium starts."""
UP = np.array([0.0, 0.0, 1.0])
POISSON_RATIO, DENSITY = 0.45, 1220.0
"""Of the printed legs; density [kg/m3]."""

WIDEST = 3.0
"""Largest angle of a servo to either side [rad]: at pi, both directions of turning are the same position."""

MESHES = {"published": 6, "accurate": 12, "reference": 24}
"""Number of beam elements of a leg, by name of the mesh."""


class Tetrapod(Robot):
    """Four servo-driven legs and a rigid centre.

    A leg leaves the horn of its servo downwards and reaches the centre horizontally. By default it is printed straight,
    and the assembly bends it. With the published lengths, this gives the published rest height and workspace (see the
    page of this robot). A class derived from it may have other lengths.

    Attributes:
        horn: distance of a leg's root from its servo's axis, outwards [m].
        centre_radius: distance of the legs' tips from the middle of the centre part [m]; published: 10 to 16 mm.
        effector_depth: how far the effector is below the legs' tips [m].
        baseline: length of a leg and distance of the servos from the middle [m].

    Args:
        payload: mass at the centre [kg].
        mesh: ``"published"``, ``"accurate"`` or ``"reference"``: how many elements (`MESHES`).
        elements: quadratic beam elements per leg, instead of that of the mesh.
        servo_range: largest angle of a servo to either side [rad], up to `WIDEST`. The published servos turn by 180
            degrees. Beyond 90 the centre gets farther; choose the accurate mesh, since legs fold on the published one.
        gravity: acceleration [m/s2].
        **options: options of `Robot`.
    """

    horn, centre_radius, effector_depth = 22.5e-3, 13e-3, 0.0
    baseline = 0.205, 0.100

    name = "tetrapod"
    effectors = ("centre",)
    size = 0.2
    made_of_beams = True
    learning = Learning(weights="tetrapod", parts=("leg",))
    backends = {
        "surrogate": "softgym_envs.extensions.beams.parts.backends:PartsBackend",
        "hybrid": "softgym_envs.extensions.beams.parts.backends:PartsHybridBackend",
    }
    non_mechanical_options = (*Robot.non_mechanical_options, "servo_range")

    def __init__(
        self,
        *,
        payload: float = 0.0,
        mesh: str = "published",
        elements: int | None = None,
        servo_range: float = 0.5 * math.pi,
        gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
        **options: Any,
    ) -> None:
        super().__init__(gravity=gravity, **options)
        elements = choose_mesh(MESHES, mesh) if elements is None else elements
        if not (np.isfinite(payload) and payload >= 0.0):
            raise ValueError(f"payload = {payload} kg must be finite and not negative")
        if not isinstance(elements, int) or elements < 2:
            raise ValueError(f"elements = {elements!r} is out of bounds; allowed: integers from 2")
        if not 0.0 < servo_range <= WIDEST:
            raise ValueError(f"servo_range = {servo_range} rad is out of bounds; allowed: up to {WIDEST} rad")
        self.payload = float(payload)
        self.elements = elements
        bend = [
            DesignVariable(f"curvature_{k}", -8.0, 8.0, 0.0, "1/m", f"printed curvature of the leg, {place}; inwards")
            for k, place in ((1, "at its root"), (2, "in the middle"), (3, "at its tip"))
        ]
        length, radius = self.baseline
        self.design_space = DesignSpace(
            DesignVariable("leg_length", 0.190, 0.225, length, "m", "length of a leg"),
            DesignVariable("leg_width", 0.005, 0.020, 0.010, "m", "width of its section, along the servo's axis"),
            DesignVariable("leg_thickness", 0.003, 0.008, 0.005, "m", "thickness of its section"),
            DesignVariable("servo_radius", 0.090, 0.110, radius, "m", "distance of the servos from the middle"),
            *bend,
            DesignVariable("young_modulus", 2.0e7, 6.0e7, 3.5e7, "Pa", "stiffness of the printed legs", log=True),
        )
        self.effector_rest = np.array([0.0, 0.0, HANGING])
        self.effort_scale = np.full(4, 0.2)
        self.actuators = tuple(
            Actuator(
                f"servo_{k + 1}",
                -servo_range,
                servo_range,
                math.pi / 20,
                unit="rad",
                unilateral=False,
                max_effort=1.4,
            )
            for k in range(4)
        )

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Lay out servos, legs and centre in a bent first guess; the solver finds the equilibrium."""
        radius, length = design["servo_radius"], design["leg_length"]
        assembly = ModelBuilder(gravity=self.gravity)
        middle = HANGING * UP
        centre = assembly.add_frame(middle)
        mass = CENTRE_MASS + self.payload
        assembly.add_mass(centre, CENTRE_MASS, sphere_inertia(mass, self.centre_radius), self.payload)
        section = Section.rectangle(design["leg_width"], design["leg_thickness"])
        servos, ports = [], []
        for k in range(4):
            angle = 0.5 * math.pi * k
            outwards = np.array([math.cos(angle), math.sin(angle), 0.0])
            along = np.array([-math.sin(angle), math.cos(angle), 0.0])
            servo = assembly.add_frame(radius * outwards, fixed=True, fixed_spin=np.abs(along) < 0.5)
            servos.append((servo, -along))
            root = (radius + self.horn) * outwards
            tip = middle + self.centre_radius * outwards
            if self.parts:
                ports.append(
                    (
                        Port(servo, root, np.column_stack([-UP, along, outwards])),
                        Port(centre, tip, np.column_stack([-outwards, along, -UP])),
                    )
                )
                continue
            shape = _bent(root, -UP, tip, -outwards, length, along, 2 * self.elements + 1)
            mounts = {0: servo, 2 * self.elements: centre}
            frames = [assembly.add_frame(p, r, on=mounts.get(j)) for j, (p, r) in enumerate(shape)]
            assembly.add_element(
                Beam,
                frames,
                section=section,
                young_modulus=design["young_modulus"],
                poisson_ratio=POISSON_RATIO,
                density=DENSITY,
                stress_free=_printed(root, np.column_stack([-UP, along, outwards]), design, 2 * self.elements + 1),
            )
        if self.parts:
            options = self.parts["leg"](design, np.array(self.gravity))
            ends = [port.frame for pair in ports for port in pair]
            assembly.add_element(PoseParts, ends, ports=ports, **options)
        model = assembly.build()
        for actuator, (servo, axis) in zip(self.actuators, servos, strict=True):
            model.add("a", Servo(actuator.name, servo, axis, model.nodes))
        model.add("e", Point("centre", EmbeddedPoints.in_frame(centre, -self.effector_depth * UP, model.nodes)))
        half = 0.5 * np.array([design["leg_width"], design["leg_thickness"]])
        outline = half * np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
        model.skins += [tube_skin(leg, model.nodes, outline) for leg in model.blocks if isinstance(leg, Beam)]
        model.skins += [curve_skin(near, far, length, outline, model.nodes) for near, far in ports]
        # The legs begin on the sides of the centre: it stays back, so that its skin and theirs do not touch there.
        side = self.centre_radius - JOINT_GAP
        model.skins.append(box_skin(centre, (side, side, 0.4 * self.centre_radius), model.nodes))
        return model

    def learned_mesh(self) -> Robot:
        made = copy.copy(self)
        made.elements = MESHES["accurate"]
        return made

    def reference_path(self, count: int = 60) -> np.ndarray:
        """Horizontal circle of radius 40 mm about the hanging position, 10 mm higher, shape (count, 3)."""
        angle = 2.0 * np.pi * np.arange(count) / count
        circle = 0.040 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
        return self.effector_rest + np.array([0.0, 0.0, 0.010]) + circle


def printed_leg(curvatures: Sequence[float], length: float, count: int) -> np.ndarray:
    """Return the frames of a leg as printed, evenly spaced, in the axes of its root.

    It begins along the first axis and bends in the plane of the first and third one, with a curvature that is quadratic
    along it.

    Args:
        curvatures: at its root, in its middle and at its tip [1/m]; positive against the third axis.
        length: [m].
        count: number of frames.

    Returns:
        Rows of the frames [m], shape (count, 4, 3).
    """
    turn = np.polynomial.Polynomial.fit([0.0, 0.5 * length, length], curvatures, 2).integ(lbnd=0.0)
    fine = np.linspace(0.0, length, 20 * (count - 1) + 1)
    angles = turn(fine)
    directions = np.column_stack([np.cos(angles), np.zeros(len(fine)), -np.sin(angles)])
    steps = 0.5 * (directions[1:] + directions[:-1]) * np.diff(fine)[:, None]
    points = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    across = np.array([0.0, 1.0, 0.0])
    return np.array(
        [
            frame_rows(p, np.column_stack([d, across, np.cross(d, across)]))
            for p, d in zip(points[::20], directions[::20], strict=True)
        ]
    )


def _printed(root: np.ndarray, axes: np.ndarray, design: Mapping[str, float], count: int) -> np.ndarray:
    """Return rows of the printed frames of a leg [m] (count, 4, 3) with axes at its root as columns (3, 3)."""
    rows = printed_leg([design[f"curvature_{k}"] for k in (1, 2, 3)], design["leg_length"], count) @ axes.T
    rows[:, 0] += root
    return rows


def _bent(
    start: np.ndarray,
    first: np.ndarray,
    end: np.ndarray,
    last: np.ndarray,
    length: float,
    across: np.ndarray,
    count: int,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return evenly spaced frames on a cubic curve of a length [m] between two points with given directions."""
    t = np.linspace(0.0, 1.0, 20 * count)[:, None]

    def curve(reach: float) -> np.ndarray:
        return (
            (2 * t**3 - 3 * t**2 + 1) * start
            + (t**3 - 2 * t**2 + t) * reach * first
            + (3 * t**2 - 2 * t**3) * end
            + (t**3 - t**2) * reach * last
        )

    def excess(reach: float) -> float:
        return float(np.linalg.norm(np.diff(curve(reach), axis=0), axis=1).sum()) - length

    # A leg that is too short for the gap starts stretched, on the shortest of these curves.
    reaches = np.linspace(0.5, 4.0, 36) * length
    lengths = [excess(reach) for reach in reaches]
    shortest = int(np.argmin(lengths))
    longer = next((k for k in range(shortest, len(reaches)) if lengths[k] > 0.0), shortest)
    reach = reaches[shortest] if lengths[shortest] >= 0.0 else brentq(excess, reaches[longer - 1], reaches[longer])
    points = curve(reach)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    even = np.linspace(0.0, arc[-1], count)
    slopes = np.gradient(points, arc, axis=0)
    slopes[0], slopes[-1] = first, last  # exactly: the ends are clamped
    frames = []
    for s in even:
        point, direction = (np.array([np.interp(s, arc, field[:, d]) for d in range(3)]) for field in (points, slopes))
        direction /= np.linalg.norm(direction)
        frames.append((point, np.column_stack([direction, across, np.cross(direction, across)])))
    return frames
