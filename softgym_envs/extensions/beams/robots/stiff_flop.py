"""Stiff-Flop: a pneumatic trunk of two modules with fibre-reinforced chambers (Abidi et al. 2018; thesis, sec. 4.4).

Each module bends and stretches when its three pairs of chambers, 120 degrees apart, are filled. The model is that of
the thesis, but with geometrically exact beams: beams along the axis with chambers that act along off-axis lines
(Chaillou et al. 2023). The trunk is clamped at the origin and lies along +x. The baseline has the moduli of Chaillou et
al., 125 and 70 kPa; the thesis raised them to 150 and 90 kPa for its prototype, whose sensor stiffens it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.chamber import Chamber
from softgym_envs.extensions.beams.skins import tube_skin
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.base import Actuator, Robot
from softgym_envs.robots.mesh_tiers import choose_mesh

STIFF_MODULUS = 1.875e6
"""Young's modulus of the end pieces [Pa]."""
STIFF_LENGTH = 5e-3
"""Length of the stiff end piece of each module [m]; the chambers fill the rest."""

# The published dimensions determine neither the lever arm of the chambers nor the section that carries load. These four
# values, the same for both modules, are inferred from the compliance at rest in the authors' public data (the thesis
# has none): they make the largest relative errors of its entries about equal, none above 6 % (see the robot's page).
CHAMBER_RADIUS = 0.719e-3
"""Inner radius of one tube [m]: two of them have 3.25 mm2 (nominal 0.75 mm, 3.53 mm2)."""
CHAMBER_OFFSET = 3.45e-3
"""Distance of a pair's line of action from the axis [m]."""
AREA_SHARE = 0.288
"""Area that carries load [m2] over that of the full disc."""
INERTIA_SHARE = 0.363
"""Second moment of area that carries load [m4] over that of the full disc."""

CIRCLE_DISTANCE = 0.108
"""Distance of the reference circle's plane from the base [m]."""

MESHES = {"published": 5, "accurate": 10, "reference": 20}
"""Number of beam elements of each module, by name of the mesh."""


class StiffFlop(Robot):
    """Pneumatic trunk.

    Args:
        mesh: ``"published"``, ``"accurate"`` or ``"reference"``: how many elements (`MESHES`).
        elements: quadratic beam elements along the chambers of each module, instead of that of the mesh.
        gravity: acceleration [m/s2]; the published work has none.
        unilateral: whether pressures must not be negative (default): a chamber that the others stretch beyond its
            commanded volume is open, without pressure.
        largest_volume: largest growth of a pair of chambers [m3]. The default is that of the authors' public code, and
            the range of the shipped surrogate. Target A of the thesis (fig. 4.11) needs 35 mm3: pass 40e-9.
            The larger the volumes, the more bodies buckle.
        largest_pressure: largest commanded pressure of a pair of chambers [Pa], which changes by a twentieth of it in a
            step: chambers on valves. By default they are commanded in volume.
        **options: options of `Robot`.
    """

    name = "trunk"
    effectors = ("tip",)
    size = 0.11
    made_of_beams = True
    non_mechanical_options = (*Robot.non_mechanical_options, "largest_volume", "largest_pressure")
    design_boxes = {
        # 30 % about the baseline, except where chambers would leave the body.
        "wide": {
            "module_length": (0.0385, 0.0715),
            "outer_radius": (0.0052, 0.0075),
            "chamber_offset": (0.0024, 0.0042),
            "chamber_radius": (0.0005, 0.00094),
        }
    }

    def __init__(
        self,
        *,
        mesh: str = "published",
        elements: int | None = None,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        unilateral: bool = True,
        largest_volume: float = 30e-9,
        largest_pressure: float | None = None,
        **options: Any,
    ) -> None:
        super().__init__(gravity=gravity, **options)
        if not 0.0 < largest_volume <= 100e-9:
            raise ValueError(f"largest_volume = {largest_volume!r} m3 is out of bounds; allowed: up to 1e-7 (100 mm3)")
        elements = choose_mesh(MESHES, mesh) if elements is None else elements
        if not isinstance(elements, int) or elements < 1:
            raise ValueError(f"elements = {elements!r} is out of bounds; allowed: integers from 1")
        self.elements = elements
        self.design_space = DesignSpace(
            DesignVariable("module_length", 0.045, 0.065, 0.055, "m", "length of one of the two modules"),
            DesignVariable(
                "outer_radius", 0.0052, 0.0065, 0.00575, "m", "radius of the body, in proportion to its wall"
            ),
            DesignVariable(
                "chamber_offset", 0.0030, 0.0040, CHAMBER_OFFSET, "m", "distance of the chambers to the axis"
            ),
            DesignVariable("chamber_radius", 0.00060, 0.00085, CHAMBER_RADIUS, "m", "radius of a tube, two in a pair"),
            DesignVariable("base_modulus", 0.8e5, 2.0e5, 1.25e5, "Pa", "stiffness of the base module", log=True),
            DesignVariable("tip_modulus", 0.45e5, 1.2e5, 0.70e5, "Pa", "stiffness of the tip module", log=True),
            DesignVariable("poisson_ratio", 0.0, 0.45, 0.15, "1", "0.5 is incompressible"),
        )
        self.effector_rest = np.array([0.11, 0.0, 0.0])
        self.effort_scale = np.full(6, 1e5)
        drive: dict[str, Any] = {"unit": "m3", "unilateral": unilateral}
        if largest_pressure is not None:
            drive |= {"max_effort": float(largest_pressure), "effort_rate": 0.05 * largest_pressure}
        self.actuators = tuple(
            Actuator(f"{module}_{pair + 1}", 0.0, float(largest_volume), 1.5e-9, **drive)
            for module in ("base", "tip")
            for pair in range(3)
        )

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Lay out the frames along the axis, the beam elements, the chambers and the tip."""
        length, radius = design["module_length"], design["outer_radius"]
        soft = length - STIFF_LENGTH
        assembly = ModelBuilder(gravity=self.gravity)
        # Two half elements per element; each module is a soft part and a stiff end piece of one element.
        soft_ends = np.linspace(0.0, soft, 2 * self.elements + 1)
        stations = [0.0]
        for module in (0.0, length):
            stations += [*(module + soft_ends[1:]), module + 0.5 * (soft + length), module + length]
        frames = [assembly.add_frame([x, 0.0, 0.0], fixed=k == 0, fixed_spin=k == 0) for k, x in enumerate(stations)]
        disc = math.pi * radius**2
        inertia = INERTIA_SHARE * 0.25 * math.pi * radius**4
        material = disc - 6.0 * math.pi * design["chamber_radius"] ** 2
        section = Section(AREA_SHARE * disc, (inertia, inertia), 2.0 * inertia, (0.5, 0.5), mass_area=material)
        moduli = [
            modulus
            for soft_modulus in (design["base_modulus"], design["tip_modulus"])
            for modulus in [*[soft_modulus] * self.elements, STIFF_MODULUS]
        ]
        assembly.add_element(
            Beam, frames, section=section, young_modulus=moduli, poisson_ratio=design["poisson_ratio"], density=1070.0
        )
        model = assembly.build()
        beam = model.blocks[0]
        assert isinstance(beam, Beam)
        area = 2.0 * math.pi * design["chamber_radius"] ** 2
        actuators = iter(self.actuators)
        for first in (0, self.elements + 1):
            for pair in range(3):
                # The first pair lies on +z, so that filling it bends the tip towards -z.
                angle = 2.0 * math.pi / 3.0 * pair
                offset = (design["chamber_offset"] * math.sin(angle), design["chamber_offset"] * math.cos(angle))
                line = beam.line(range(first, first + self.elements), offset, model.nodes)
                actuator = next(actuators)
                chamber = Chamber(actuator.name, [line], area)
                chamber.unilateral = actuator.unilateral
                model.add("a", chamber)
        model.add("e", Point("tip", EmbeddedPoints.in_frame(frames[-1], np.zeros(3), model.nodes)))
        turn = 2.0 * np.pi * np.arange(24) / 24
        model.skins.append(tube_skin(beam, model.nodes, radius * np.column_stack([np.cos(turn), np.sin(turn)])))
        return model

    def reference_path(self, count: int = 50) -> np.ndarray:
        """Circle of radius 40 mm about the axis (thesis, sec. 4.4.3) that the baseline reaches, shape (count, 3)."""
        angle = 2.0 * np.pi * np.arange(count) / count
        return np.column_stack([np.full(count, CIRCLE_DISTANCE), 0.040 * np.cos(angle), 0.040 * np.sin(angle)])
