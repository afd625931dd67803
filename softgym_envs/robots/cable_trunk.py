"""The cable trunk: a slender tapered silicone arm whose two halves are bent independently by eight cables.

Dimensions are those of the public model of an elephant's trunk, without its folds. The trunk stands on its
clamped base along +z. Four cables run to the tip and four to the middle, each pair in one of the planes xz and yz.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.errors import unknown_name
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.materials import resolve_material
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solids import SOLIDS
from softgym_envs.robots.base import Actuator, Robot
from softgym_envs.robots.capabilities import Learning
from softgym_envs.robots.geometry.symmetry import square_symmetries
from softgym_envs.robots.mesh_tiers import choose_mesh

MASS = 0.042  # of the published body [kg]
TIP_FRACTION = 0.4  # radius of the long cables at the tip over the half-width there
LONG_GUIDES, SHORT_GUIDES = 20, 10


@dataclass(frozen=True)
class TrunkMesh:
    """Mesh of the trunk.

    Attributes:
        layers: number of elements along it.
        rings: number of rings of elements about its axis.
        element: name of the solid element.
        guide_radius: radius of the channels on which cables act [m]; 0 for single points.
        strokes: largest displacement of the long and of the short cables [m].
    """

    layers: int
    rings: int
    element: str
    guide_radius: float
    strokes: tuple[float, float]


MESHES = {
    "published": TrunkMesh(24, 2, "linear", 0.0, (0.035, 0.020)),
    "coarse": TrunkMesh(12, 1, "quadratic", 3.0e-3, (0.021, 0.012)),
    "accurate": TrunkMesh(24, 2, "quadratic", 3.0e-3, (0.021, 0.012)),
    "reference": TrunkMesh(36, 3, "quadratic", 3.0e-3, (0.021, 0.012)),
}
"""Meshes by name. No source states the radius of the cables' channels. The whole tension acts on the soft tip where a
long cable ends, and with a small radius it cuts in: with 2 mm, elements of half the length there move the tip by 4 % of
its way (one long cable pulled by 15 mm, a short one by 5 mm), and with a third there is no equilibrium. With 3 mm a
third of the length moves it by 0.3 %. The tips of `coarse` are within 0.8 % of those of `accurate`, and a state takes a
tenth of the time, so it is the mesh that surrogates are learned from."""


def stretched(share: np.ndarray, short_fraction: float) -> np.ndarray:
    """Return heights over the length for equal steps along the trunk; the first half ends with the short cables.

    Sections and guides move with that end. On a fixed mesh, the force at the end would pass from one element to the
    next as the design changes. Strains jump between elements, so even the sign of the tip's derivative changed within
    2 % of the range.
    """
    return np.interp(share, [0.0, 0.5, 1.0], [0.0, short_fraction, 1.0])


def octagonal_bar(layers: int, rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Mesh a bar of octagonal section on z = 0, of half-width 1 and length 1, by prisms of three tetrahedra each.

    Rings about the axis divide each section into triangles. Prisms are divided by the order of their node numbers,
    which count from the axis outwards and, on each ring, from the middles of the sides to the corners. This makes the
    mesh as symmetric as the octagon.

    Args:
        layers: number of prisms along the bar.
        rings: number of rings of triangles in a section.

    Returns:
        Nodes, shape (n, 3), section after section, and tetrahedra, shape (m, 4).
    """
    eighth = np.pi / 4
    angles = np.concatenate([np.arange(0, 8, 2) * eighth, np.arange(1, 8, 2) * eighth, (np.arange(8) + 0.5) * eighth])
    radii = np.repeat([1.0, 1.0, 1.0 / np.cos(eighth / 2)], [4, 4, 8])
    ring = np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])
    section = np.concatenate([np.zeros((1, 2)), *((k + 1) / rings * ring for k in range(rings))])
    order = np.argsort(angles)
    sides = np.column_stack([order, np.roll(order, -1)]) + 1  # pairs of neighbours on the first ring
    triangles = [np.insert(sides, 0, 0, axis=1)]
    for k in range(rings - 1):
        inner = np.sort(sides, axis=1) + 16 * k
        outer = inner + 16
        triangles += [np.column_stack([inner, outer[:, 1]]), np.column_stack([inner[:, 0], outer])]
    a, b, c = np.sort(np.concatenate(triangles), axis=1).T
    count = len(section)
    prism = np.concatenate(
        [
            np.column_stack([a, b, c, a + count]),
            np.column_stack([b, c, a + count, b + count]),
            np.column_stack([c, a + count, b + count, c + count]),
        ]
    )
    height = np.repeat(np.linspace(0.0, 1.0, layers + 1), count)
    nodes = np.column_stack([np.tile(section, (layers + 1, 1)), height])
    tetrahedra = (prism + count * np.arange(layers)[:, None, None]).reshape(-1, 4)
    edges = nodes[tetrahedra[:, 1:]] - nodes[tetrahedra[:, :1]]
    inside_out = np.linalg.det(edges) < 0.0
    tetrahedra[inside_out] = tetrahedra[inside_out][:, [0, 2, 1, 3]]
    return nodes, tetrahedra


class CableTrunk(Robot):
    """Tapered arm with four cables along its whole length and four to its middle.

    The mesh is regular on both sides of the end of the short cables. It follows the design exactly and is as symmetric
    as the body.

    Args:
        mesh: ``"published"`` (825 nodes and 3456 linear tetrahedra), ``"coarse"`` (221 nodes, quadratic
            elements), ``"accurate"`` or ``"reference"``.
        layers: number of elements along the trunk, instead of that of the mesh.
        rings: number of rings of elements about the axis, instead of that of the mesh.
        element: name of the solid element, instead of that of the mesh.
        material: name of a material of `softgym_envs.mechanics.materials`.
        strokes: largest displacement of the long and of the short cables [m], instead of those of the mesh. On the
            published one they are half of the public model's (0.070, 0.040): from 37 mm on, two opposite long cables
            crush the thin tip and no equilibrium is found; one long cable alone can be pulled by 57 mm. On the others
            they are (0.021, 0.012), because their elements, as soft as the body, are crushed earlier.
        unilateral: whether cables cannot push (default). False reproduces published scenes, where they can.
        gravity: acceleration [m/s2]; the baseline body weighs 42 g.
        **options: options of `Robot`.
    """

    name = "cable_trunk"
    effectors = ("tip",)
    size = 0.195
    learning = Learning(stiffness_variable="young_modulus")
    design_boxes = {
        # 30 % about the baseline.
        "wide": {"length": (0.1365, 0.2535), "base_half_width": (0.0091, 0.0169), "tip_half_width": (0.0035, 0.007)}
    }

    def __init__(
        self,
        *,
        mesh: str = "published",
        layers: int | None = None,
        rings: int | None = None,
        element: str | None = None,
        material: str = "corotational",
        strokes: tuple[float, float] | None = None,
        unilateral: bool = True,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        **options: Any,
    ) -> None:
        tier = choose_mesh(MESHES, mesh)
        layers = tier.layers if layers is None else layers
        rings = tier.rings if rings is None else rings
        element = tier.element if element is None else element
        if element not in SOLIDS:
            raise ValueError(unknown_name("element", element, SOLIDS))
        if not (isinstance(layers, int) and layers >= 1 and isinstance(rings, int) and rings >= 1):
            raise ValueError(f"layers = {layers!r} and rings = {rings!r} must be positive integers")
        resolve_material(material)
        strokes = tier.strokes if strokes is None else strokes
        if len(strokes) != 2 or not all(0.0 < stroke < np.inf for stroke in strokes):
            raise ValueError(f"strokes must be two positive lengths [m], got {strokes!r}")
        super().__init__(gravity=gravity, **options)
        self.layers = layers
        self.rings = rings
        self.element = element
        published = MESHES["published"]
        self.reproduces_scene = (layers, rings, element) == (published.layers, published.rings, published.element)
        self.guide_radius = tier.guide_radius
        self.material = material
        self.strokes = (float(strokes[0]), float(strokes[1]))
        self.design_space = DesignSpace(
            DesignVariable("length", 0.160, 0.230, 0.195, "m", "length of the trunk"),
            DesignVariable("base_half_width", 0.011, 0.016, 0.013, "m", "half the width of the section at the base"),
            DesignVariable("tip_half_width", 0.004, 0.007, 0.005, "m", "half the width of the section at the tip"),
            DesignVariable(
                "cable_fraction", 0.60, 0.90, 10.0 / 13.0, "1", "radius of the cables at the base over the half-width"
            ),
            DesignVariable("short_fraction", 0.35, 0.65, 0.5, "1", "length of the short cables over that of the trunk"),
            DesignVariable("young_modulus", 1.0e5, 2.0e6, 4.5e5, "Pa", "stiffness of the silicone", log=True),
            DesignVariable("poisson_ratio", 0.40, 0.499, 0.45, "1", "0.5 is incompressible"),
        )
        baseline = self.design_space.baseline
        self.effector_rest = np.array([0.0, 0.0, baseline["length"]])
        self.effort_scale = np.full(8, 10.0)
        if not any(gravity[:2]) and not self.obstacles:
            self.learning = replace(self.learning, symmetries=square_symmetries(2))
        self.density = MASS / self.volume(baseline)
        self.actuators = tuple(
            # A twentieth of the stroke per control step.
            Actuator(f"{length}_{side}", 0.0, stroke, stroke / 20.0, unilateral=unilateral)
            for length, stroke in zip(("long", "short"), self.strokes, strict=True)
            for side in ("north", "west", "south", "east")
        )

    @staticmethod
    def volume(design: Mapping[str, float]) -> float:
        """Exact volume of the body [m3]: a frustum of an octagon."""
        base, tip = design["base_half_width"], design["tip_half_width"]
        return 8.0 * np.tan(np.pi / 8) * design["length"] * (base * base + base * tip + tip * tip) / 3.0

    def mesh(self, design: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """Nodes [m] (n, 3) and tetrahedra (m, 4) of a complete design: the bar, stretched and tapered."""
        nodes, tetrahedra = octagonal_bar(self.layers, self.rings)
        nodes[:, 2] = stretched(nodes[:, 2], design["short_fraction"])
        half_width = np.interp(nodes[:, 2], [0.0, 1.0], [design["base_half_width"], design["tip_half_width"]])
        return nodes * np.column_stack([half_width, half_width, np.full(len(nodes), design["length"])]), tetrahedra

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Clamp the base, thread the cables through their guides, put the effector at the middle of the tip."""
        nodes, tetrahedra = self.mesh(design)
        builder = ModelBuilder(gravity=self.gravity)
        builder.add_solid(
            nodes,
            tetrahedra,
            fixed=nodes[:, 2] == 0.0,
            element=self.element,
            material=self.material,
            young_modulus=design["young_modulus"],
            poisson_ratio=design["poisson_ratio"],
            density=self.density,
        )
        model = builder.build()
        base = design["cable_fraction"] * design["base_half_width"]
        tip = TIP_FRACTION * design["tip_half_width"]
        actuators = iter(self.actuators)
        for reach, count in ((1.0, LONG_GUIDES), (0.5, SHORT_GUIDES)):
            share = stretched(np.linspace(0.0, reach, count + 1), design["short_fraction"])
            radius, height = base + share * (tip - base), share * design["length"]
            for x, y in ((0, 1), (-1, 0), (0, -1), (1, 0)):
                points = np.column_stack([x * radius, y * radius, height])
                actuator = next(actuators)
                model.add_cable(
                    actuator.name, points[1:], points[0], unilateral=actuator.unilateral, radius=self.guide_radius
                )
        model.add_effector("tip", np.array([0.0, 0.0, design["length"]]), radius=self.guide_radius)
        return model

    def reference_path(self, count: int = 30) -> np.ndarray:
        """Circle of radius 60 mm about the axis, 30 mm below the tip of the baseline body and inside its workspace."""
        angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
        return np.column_stack([0.060 * np.cos(angle), 0.060 * np.sin(angle), np.full(count, 0.165)])
