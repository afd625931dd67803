"""The modular arm: a chain of compliant modules, bent by two push-pull wires through their ports (thesis, fig. 5.7)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.errors import InfeasibleDesign, unknown_name
from softgym_envs.extensions.beams.skins import box_skin, bridge_skin
from softgym_envs.extensions.modules.base import Module
from softgym_envs.extensions.modules.closed_superelement import ClosedSuperelement, PortCavity, add_superelement
from softgym_envs.extensions.modules.learned import learned_module
from softgym_envs.extensions.modules.registry import MODULES
from softgym_envs.extensions.modules.superelement import point_masses
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.cable import Cable
from softgym_envs.mechanics.constraints.cavity import Cavity
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.base import Actuator, Robot
from softgym_envs.robots.capabilities import Learning

_QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

CELLS: dict[str, tuple[str, np.ndarray]] = {
    "leaf_x": ("leaf_spring", np.eye(3)),
    "leaf_y": ("leaf_spring", _QUARTER_TURN),
    "block": ("solid_block", np.eye(3)),
    "notch_x": ("notch_hinge", np.eye(3)),
    "notch_y": ("notch_hinge", _QUARTER_TURN),
    "tube": ("torsion_tube", np.eye(3)),
    "accordion": ("accordion", np.eye(3)),
    "bellows": ("bellows", np.eye(3)),
}
"""What a cell may be: a module, and the axes in which it stands. A ``leaf_x`` bends towards x."""

NONE = "none"
"""What a cell is that is left out, if the kinds of the cells are part of the design."""

KINDS = ("leaf_x", "leaf_y", "block")
"""What the cells may be whose kinds are part of the design, unless an option says otherwise."""


class _Shape(NamedTuple):
    """Module geometry used by the arm.

    Attributes:
        dimensions: what ``length``, ``width`` and ``depth`` of a cell set if its kind is part of the design.
        section: half the width along x and y of a bar that stands for it [m], of a complete design.
    """

    dimensions: tuple[str, str, str]
    section: Callable[[Mapping[str, float]], tuple[float, float]]


SHAPES = {
    "leaf_spring": _Shape(("leaf_length", "width", "thickness"), lambda d: (0.5 * d["thickness"], 0.5 * d["width"])),
    "solid_block": _Shape(("length", "width", "depth"), lambda d: (0.5 * d["depth"], 0.5 * d["width"])),
    "notch_hinge": _Shape(("radius", "width", "neck"), lambda d: (0.5 * d["neck"], 0.5 * d["width"])),
    "torsion_tube": _Shape(("length", "radius", "wall"), lambda d: (d["radius"], d["radius"])),
    "accordion": _Shape(("pitch", "width", "amplitude"), lambda d: (d["amplitude"], 0.5 * d["width"])),
    "bellows": _Shape(("pitch", "radius", "amplitude"), lambda d: (d["radius"], d["radius"])),
}
"""By the name of the module. A tube is drawn as a square bar around it, an accordion as one around its folds."""

MAX_CELLS = 12

BODIES = ("superelements", "solid")

WIRES = {"wire_x": (1.0, 0.0), "wire_y": (0.0, 1.0)}
"""Wires, and the direction from the axis in which each runs."""


class _Cell(NamedTuple):
    """A cell of one body: its module, the module's design, its axes, and the height at which it begins [m]."""

    module: Module
    design: Mapping[str, float]
    axes: np.ndarray
    height: float

    @property
    def length(self) -> float:
        return self.module.length(self.module.design_space.complete(self.design))


class ModularArm(Robot):
    """Modules in a row on a clamped base. Wires that pull and push run through guides that are fixed to the ports.

    If ``cells`` is a list of kinds, arms of other structures are other robots, and the dimensions of the cells are the
    design. If it is a number, the structure is part of the design: the whole part of ``kind_1`` says which of ``kinds``
    the first cell is, and after the last of them that it is left out. ``length_1``, ``width_1`` and ``depth_1`` are its
    dimensions as shares of their learned ranges, because each kind has its own (`SHAPES`).

    Args:
        cells: what each cell is, from the base to the tip: names in `CELLS`; or the largest number of cells.
        kinds: what the cells may be if ``cells`` is a number: names in `CELLS`.
        body: ``"superelements"``, learned modules with six unknowns for each port; or ``"solid"``, finite elements of
            the whole body, by which designs are judged.
        stroke: largest displacement of a wire either way [m].
        max_effort: largest force of a wire [N].
        refine: divides the edges of the finite elements of a solid body.
        largest_volume: by which the cavity of a bellows may grow or shrink [m3].
        max_pressure: in a bellows, either way [Pa].
        **options: options of `Robot`.

    Raises:
        ValueError: for an unknown cell, kind or body, or bellows as a kind: their number is that of the actuators.
    """

    name = "modular_arm"
    effectors = ("tip",)
    size = 0.1
    learning = Learning(stiffness_variable="young_modulus")
    backends = {
        "surrogate": "softgym_envs.extensions.modules.backends:ModularBackend",
        "hybrid": "softgym_envs.extensions.modules.backends:ModularHybridBackend",
    }

    def __init__(
        self,
        *,
        cells: Sequence[str] | int = ("leaf_x", "leaf_y", "leaf_x", "leaf_y"),
        kinds: Sequence[str] = KINDS,
        body: str = "superelements",
        stroke: float = 0.006,
        max_effort: float = 1.0,
        refine: float = 1.0,
        largest_volume: float = 2.0e-7,
        max_pressure: float = 2.0e4,
        **options: Any,
    ) -> None:
        if isinstance(cells, int) and not isinstance(cells, bool):
            if not 1 <= cells <= MAX_CELLS:
                raise ValueError(f"cells = {cells} is out of bounds; allowed: 1 to {MAX_CELLS}")
        elif not isinstance(cells, Sequence) or isinstance(cells, str) or not cells:
            raise ValueError(f"cells must be a number or a list of names, got {cells!r}; allowed: {', '.join(CELLS)}")
        elif unknown := [cell for cell in cells if cell not in CELLS]:
            raise ValueError(unknown_name("cell", unknown[0], CELLS))
        if isinstance(kinds, str) or not kinds:
            raise ValueError(f"kinds must be a list of names, got {kinds!r}; allowed: {', '.join(CELLS)}")
        if unknown := [kind for kind in kinds if kind not in CELLS]:
            raise ValueError(unknown_name("kind", unknown[0], CELLS))
        if closed := [kind for kind in kinds if MODULES.class_of(CELLS[kind][0]).closed]:
            raise ValueError(f"kinds must not contain '{closed[0]}', which is an actuator; allowed: in a list of cells")
        if body not in BODIES:
            raise ValueError(unknown_name("body", body, BODIES))
        super().__init__(**options)
        self.cells = cells if isinstance(cells, int) else tuple(cells)
        self._kinds = (*kinds, NONE)
        self.body = body
        self.refine = float(refine)
        self.stroke = float(stroke)
        self.max_effort = float(max_effort)
        self.design_space = DesignSpace(
            *self._dimensions(),
            DesignVariable("wire_radius", 0.010, 0.016, 0.012, "m", "distance of the wires from the axis"),
            DesignVariable("young_modulus", 1.0e7, 4.0e7, 2.0e7, "Pa", "stiffness of the printed material", log=True),
        )
        self.effector_rest = np.array([0.0, 0.0, self._height(self.design_space.baseline)])
        volume = float(largest_volume)
        listed = () if isinstance(self.cells, int) else self.cells
        closed_cells = [number for number, cell in enumerate(listed, start=1) if cell == "bellows"]
        self.actuators = (
            *(
                Actuator(name, -self.stroke, self.stroke, self.stroke / 10.0, "m", False, self.max_effort)
                for name in WIRES
            ),
            *(
                Actuator(f"pressure_{n}", -volume, volume, volume / 10.0, "m3", False, float(max_pressure))
                for n in closed_cells
            ),
        )
        self.effort_scale = np.array([0.2] * len(WIRES) + [0.2 * float(max_pressure)] * len(closed_cells))

    def _dimensions(self) -> Iterator[DesignVariable]:
        if isinstance(self.cells, int):
            yield from _free_cells(self.cells, self._kinds)
            return
        for number, cell in enumerate(self.cells, start=1):
            name, _ = CELLS[cell]
            variables = MODULES[name]().design_space
            for dimension, (low, high) in learned_module(name).box.items():
                described = f"{variables[dimension].description} (cell {number})"
                yield DesignVariable(f"{dimension}_{number}", low, high, _typical(name, dimension), "m", described)

    def kinds(self, design: Mapping[str, float] | None = None) -> tuple[str, ...]:
        """Return what each cell of a design is, from the base to the tip: names in `CELLS`, or ``"none"``."""
        if not isinstance(self.cells, int):
            return self.cells
        complete = self.design_space.complete(design)
        names = [f"kind_{number}" for number in range(1, self.cells + 1)]
        return tuple(self.design_space[name].choice(complete[name]) for name in names)

    def _modules(self, design: Mapping[str, float]) -> Iterator[_Cell]:
        """Yield the cells of a complete design from the base to the tip."""
        height = 0.0
        for number, cell in enumerate(self.kinds(design), start=1):
            if cell == NONE:
                continue
            name, axes = CELLS[cell]
            own = self._size(design, name, number)
            own["young_modulus"] = design["young_modulus"]
            part = _Cell(MODULES[name](), own, axes, height)
            yield part
            height += part.length

    def _size(self, design: Mapping[str, float], module: str, number: int) -> dict[str, float]:
        """Return the dimensions of a cell that is a module [m]."""
        box = learned_module(module).box
        if not isinstance(self.cells, int):
            return {dimension: design[f"{dimension}_{number}"] for dimension in box}
        shares = dict(zip(SHAPES[module].dimensions, ("length", "width", "depth"), strict=True))
        return {d: low + design[f"{shares[d]}_{number}"] * (high - low) for d, (low, high) in box.items()}

    def with_body(self, body: str) -> ModularArm:
        """Return the arm with another ``body``."""
        options: dict[str, Any] = {**self._options, "body": body}
        return ModularArm(**options)

    def printable(self) -> ModularArm:
        return self.with_body("solid")

    def learned_mesh(self) -> ModularArm:
        return self.with_body("solid")

    def _height(self, design: Mapping[str, float]) -> float:
        return sum(part.length for part in self._modules(design))

    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Stack the modules on a clamped port, and thread the wires through all ports above it."""
        if set(self.kinds(design)) == {NONE}:
            raise InfeasibleDesign("all cells of the arm are left out; allowed: at least one that is not 'none'")
        builder = ModelBuilder(gravity=self.gravity)
        ports = [builder.add_frame(np.zeros(3), fixed=True, fixed_spin=True)]
        cavities: list[np.ndarray | ClosedSuperelement] = []
        for part in self._modules(design):
            origin = np.array([0.0, 0.0, part.height])
            if self.body == "solid":
                placed = part.module.add_to(
                    builder, part.design, near=ports[-1], origin=origin, rotation=part.axes, refine=self.refine
                )
                ports.append(placed.far)
                cavities += [] if placed.cavity is None else [placed.cavity]
                continue
            learned = learned_module(part.module.name)
            far = builder.add_frame(origin + [0.0, 0.0, part.length])
            add_superelement(
                builder,
                ports[-1],
                far,
                learned.energy(part.design),
                length=part.length,
                rotation=part.axes,
                young_modulus=part.design["young_modulus"],
                inertia=point_masses(part.module.mass(part.design)) if any(self.gravity) else None,
                cavity=learned.cavity(part.design) if part.module.closed else None,
            )
            ports.append(far)
        model = builder.build()
        rows = np.array(ports[1:])[:, None] + np.arange(4)
        for actuator, direction in zip(self.actuators, WIRES.values(), strict=False):
            guide = design["wire_radius"] * np.array([*direction, 0.0])
            points = EmbeddedPoints.from_weights(rows, np.tile([1.0, *guide], (len(rows), 1)), model.nodes)
            model.add("a", Cable(actuator.name, points, guide, unilateral=actuator.unilateral))
        cavities += [block for block in model.blocks if isinstance(block, ClosedSuperelement)]
        for actuator, cavity in zip(self.actuators[len(WIRES) :], cavities, strict=True):
            if isinstance(cavity, ClosedSuperelement):
                model.add("a", PortCavity(actuator.name, cavity))
            else:
                model.add("a", Cavity(actuator.name, cavity, model.nodes))
        model.add("e", Point("tip", EmbeddedPoints.in_frame(ports[-1], np.zeros(3), model.nodes)))
        if self.body == "superelements":
            half = design["wire_radius"]
            model.skins += [box_skin(port, (half, half, 0.001), model.nodes) for port in ports]
            for part, near, far in zip(self._modules(design), ports[:-1], ports[1:], strict=True):
                section = SHAPES[part.module.name].section(part.design)
                model.skins.append(bridge_skin(near, far, section, part.axes, model.nodes))
        return model


def _typical(module: str, dimension: str) -> float:
    """Return a module's baseline of a dimension, or the nearest value that was learned [m]."""
    low, high = learned_module(module).box[dimension]
    return min(max(MODULES[module]().design_space[dimension].baseline, low), high)


def _free_cells(count: int, kinds: Sequence[str]) -> Iterator[DesignVariable]:
    """Yield the variables of cells whose kinds are part of the design; at the baseline, the first two take turns."""
    for number in range(1, count + 1):
        kind = (number - 1) % min(2, len(kinds) - 1)
        module, _ = CELLS[kinds[kind]]
        box = learned_module(module).box
        described = (
            f"what the cell is: {', '.join(f'{k} from {place}' for place, k in enumerate(kinds))} (cell {number})"
        )
        bounds = 0.0, float(len(kinds))
        yield DesignVariable(f"kind_{number}", *bounds, kind + 0.5, "1", described, choices=tuple(kinds))
        for name, dimension in zip(("length", "width", "depth"), SHAPES[module].dimensions, strict=True):
            low, high = box[dimension]
            share = (_typical(module, dimension) - low) / (high - low)
            described = f"{name} as a share of its range (cell {number})"
            yield DesignVariable(f"{name}_{number}", 0.0, 1.0, share, "1", described)
