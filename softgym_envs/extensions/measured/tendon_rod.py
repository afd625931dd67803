"""Rod of three segments with nine tendons (OpenCR, robots v6 and v4).

Dimensions, material and routing are those of the authors' configuration and data: github.com/ContinuumRoboticsLab/
opencr-mujoco (MIT), configs/generation/ftdcr_v6_sysid.json and data/sysid/ftdcr_v6, and v4 likewise. The base is at the
origin, the rod stands along z, and the tip is a marker beyond its end. The mass in their configuration carries the
simulation, so it is left out with gravity, as there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from softgym_envs.arguments import choice
from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.extensions.beams.beam import Section
from softgym_envs.extensions.beams.rods import add_rod
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.actuator import Actuator
from softgym_envs.robots.base import Robot


@dataclass(frozen=True)
class Version:
    """What the two robots differ in.

    Attributes:
        lengths: of the segments [m].
        discs: how many guide the tendons of each.
        young_modulus: of the rod [Pa].
    """

    lengths: tuple[float, float, float]
    discs: tuple[int, int, int]
    young_modulus: float


VERSIONS = {
    "v6": Version((0.100, 0.100, 0.022), (15, 15, 8), 1e10),
    "v4": Version((0.060, 0.0625, 0.064), (10, 10, 10), 5e10),
}
"""The robots by their names there."""
RADIUS = 0.0005
"""Of the rod [m]."""
OFFSET = 0.0045
"""Distance of the tendons from the axis [m]."""
ANGLES = ((0.0, 120.0, 240.0), (30.0, 150.0, 270.0), (60.0, 180.0, 300.0))
"""Where the tendons of each segment are about the axis [degrees], from x towards y."""
MARKER = 0.008
"""Distance of the marker from the end of the rod [m]."""
PULL = 0.013
"""Longest pull or slack of a tendon [m]; the recordings have up to 12.4 mm."""


class TendonRod(Robot):
    """Slender rod whose segments bend in any direction.

    Args:
        version: which of the robots, see `VERSIONS`.
        gravity: acceleration [m/s2].
        **options: options of `Robot`.
    """

    name = "tendon_rod"
    effectors = ("tip",)

    def __init__(
        self, *, version: str = "v6", gravity: tuple[float, float, float] = (0.0, 0.0, 0.0), **options: Any
    ) -> None:
        super().__init__(gravity=gravity, **options)
        self._version = VERSIONS[choice("version", version, VERSIONS)]
        self.size = sum(self._version.lengths) + MARKER
        self.design_space = DesignSpace(
            DesignVariable(
                "young_modulus", 1e9, 1e11, self._version.young_modulus, "Pa", "stiffness of the rod", log=True
            ),
            DesignVariable("offset", 0.0035, 0.0055, OFFSET, "m", "distance of the tendons from the axis"),
            DesignVariable("twist", -0.5, 0.5, 0.0, "rad", "turn of each segment's tendons beyond those before it"),
        )
        self.effector_rest = np.array([0.0, 0.0, self.size])
        self.effort_scale = np.full(9, 1.0)
        self.actuators = tuple(
            Actuator(f"tendon_{segment}{place}", -PULL, PULL, 0.001) for segment in range(1, 4) for place in range(1, 4)
        )

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Stand the rod up, thread each tendon through the discs up to the end of its segment."""
        lengths, counts = self._version.lengths, self._version.discs
        starts = np.cumsum([0.0, *lengths])
        discs = [
            s + length * np.arange(1, n + 1) / n for s, length, n in zip(starts[:-1], lengths, counts, strict=True)
        ]
        frames = np.concatenate([[0.0], *discs])
        builder = ModelBuilder(gravity=self.gravity)
        rod = add_rod(
            builder,
            [[0.0, 0.0, 0.0], [0.0, 0.0, starts[-1]]],
            section=Section.circle(RADIUS),
            elements=frames[::2],  # the discs between are the middles of elements
            up=[1.0, 0.0, 0.0],
            young_modulus=design["young_modulus"],
            poisson_ratio=0.3,
            density=6450.0,
        )
        model = builder.build()
        actuators = iter(self.actuators)
        for segment, angles in enumerate(np.deg2rad(ANGLES)):
            through = np.concatenate(discs[: segment + 1])
            for angle in angles + segment * design["twist"]:
                around = design["offset"] * np.array([np.cos(angle), np.sin(angle)])
                rod.add_tendon(model, next(actuators).name, through, around)
        model.add_effector("tip", rod.points(starts[-1], (MARKER, 0.0, 0.0), model.nodes))
        return model

    def displacements(self, fractions: np.ndarray) -> np.ndarray:
        """Return pulls that bend each segment, in any direction: antagonists are let out by what the bend needs."""
        bends = np.radians(50.0) * np.sqrt(fractions[:, 0::3]) / np.sqrt(3.0)
        towards = 2.0 * np.pi * fractions[:, 1::3]
        total = np.cumsum(bends[..., None] * np.stack([np.cos(towards), np.sin(towards)], axis=-1), axis=1)
        angles = np.deg2rad(ANGLES)
        around = OFFSET * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        return np.einsum("nsd,sjd->nsj", total, around).reshape(len(fractions), -1)
