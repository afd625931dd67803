"""Casting moulds, derived from the design: of any body that gmsh draws, and those of the fingers.

Any body is cast in two halves of a block, ``low`` and ``high``, which meet in the middle of its thinnest side and are
open where it is clamped. Each chamber is a part ``core_NAME``, of wax or another material that is melted or washed out,
and is held in its place by wires.

The moulds of fingers are those of the thesis (sec. 3.2.3 and 3.3.2). They are cast upside down: their flat bottom
(y = 0) is the open face of the mould.

* ``box``: a block with the outer shape of the finger cut out, and bores for wires that keep the cable channels free.
* ``lid``: closes the bottom. It carries the cores of the cavities, overlaps the rim of the box, and has a window over
  each segment through which silicone is poured and air escapes.
* ``cork``: a tray for casting the plugs that are glued into the openings left by the cores.
* ``clamp``: a yoke with two screw holes that holds the flange of the finished finger against a wall.

Together, the silicone parts form the simulated body except for the cable channels. Lengths are in millimetres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from softgym_envs.errors import InfeasibleDesign
from softgym_envs.extensions.deployment.cad import FORMATS, write_drawing
from softgym_envs.extensions.sensing.sensorized_finger import SensorizedFinger
from softgym_envs.robots.base import Drawing, Robot
from softgym_envs.robots.geometry.finger_shape import FLANGE, THICKNESS, draw_finger
from softgym_envs.robots.gmsh_robot import FIXED, GmshRobot
from softgym_envs.robots.soft_finger import SoftFinger

MOULD_PARTS = ("box", "lid", "cork", "clamp")
"""Parts of a mould."""

WALL = 3.0  # thickness of the moulds
WIRE_RADIUS = 0.6  # thinner than the gap between cable and bellow, so that the bore does not open the bellow
TOLERANCE = 0.1  # gap between parts that slide over each other
RIM = 4.0  # overlap of the lid on the sides of the box
WINDOW = 0.4  # length of a window of the lid as a share of that of the segment
SCREW_RADIUS = 1.7  # M3


def mould_parts(robot: Robot, design: Mapping[str, float] | None = None) -> dict[str, Drawing]:
    """Return the drawings of the parts of a body's mould.

    Args:
        robot: a `SoftFinger`, a `SensorizedFinger`, or a `GmshRobot` that draws its body.
        design: the body; missing variables take their baseline.

    Returns:
        Drawing function and parameters of each part, by name.

    Raises:
        DesignError: for a malformed design.
        InfeasibleDesign: if the body cannot exist.
        ValueError: for another robot.
    """
    complete = robot.design_space.complete(design)
    if isinstance(robot, GmshRobot) and type(robot).draw is not GmshRobot.draw:
        body = robot.drawing(complete)
        chambers = [actuator.name for actuator in robot.actuators if actuator.unit == "m3"]
        parts = ["low", "high", *(f"core_{name}" for name in chambers)]
        return {part: (draw_cast, {"body": body, "part": part}) for part in parts}
    if isinstance(robot, SensorizedFinger):
        wires = [[0.0, 1e3 * robot.cable_height(complete)]]
    elif isinstance(robot, SoftFinger):
        wires = [[1e3 * x, 1e3 * robot.cable_height] for x in robot.cable_offsets]
    else:
        raise ValueError(
            f"robot '{robot.name}' has no moulds; allowed: robots that draw their body (GmshRobot), finger, "
            "sensorized_finger"
        )
    robot.drawing(complete)  # raises if the finger cannot exist
    lengths = {"split": 0.0, **robot.lengths(complete)}
    return {
        "box": (draw_box, {"lengths": lengths, "wires": wires}),
        "lid": (draw_lid, {"lengths": lengths}),
        "cork": (draw_cork, {"lengths": lengths}),
        "clamp": (draw_clamp, {"height": lengths["height"]}),
    }


def export_moulds(
    robot: Robot,
    folder: str | Path,
    design: Mapping[str, float] | None = None,
    *,
    formats: Sequence[str] = FORMATS,
    time_limit: float = 120.0,
) -> list[Path]:
    """Write all parts of a body's mould into a folder, in millimetres.

    Args:
        robot: a `SoftFinger`, a `SensorizedFinger`, or a `GmshRobot` that draws its body.
        folder: output folder, which is created if necessary.
        design: the body; missing variables take their baseline.
        formats: file endings, from ``.step`` and ``.stl``.
        time_limit: wall-clock limit for one file [s].

    Returns:
        The files: ``box.step``, ``box.stl``, ...

    Raises:
        DesignError: for a malformed design.
        InfeasibleDesign: if the body cannot exist or a part cannot be drawn.
        ValueError: for another robot or format.
    """
    return [
        write_drawing(drawing, Path(folder) / f"{name}{ending}", time_limit=time_limit)
        for name, drawing in mould_parts(robot, design).items()
        for ending in formats
    ]


def draw_cast(body: Drawing, part: str) -> None:
    """Draw a part of the mould of any body with gmsh, in the unit of its own drawing.

    Args:
        body: drawing of the body.
        part: ``"low"`` or ``"high"``, half of a block without the body, or ``"core_NAME"``, the chamber of an actuator.
    """
    import gmsh
    import numpy as np

    occ = gmsh.model.occ
    function, parameters = body
    function(**parameters)
    occ.synchronize()
    ((_, volume),) = gmsh.model.getEntities(3)
    tags = [tag for _, tag in gmsh.model.getPhysicalGroups(2)]
    groups = {gmsh.model.getPhysicalName(2, tag): gmsh.model.getEntitiesForPhysicalGroup(2, tag) for tag in tags}
    bounds = np.array(gmsh.model.getBoundingBox(3, volume)).reshape(2, 3)
    clamped = [np.array(gmsh.model.getBoundingBox(2, face)).reshape(2, 3) for face in groups.get(FIXED, ())]
    loops, surfaces = occ.getSurfaceLoops(volume)
    if part.startswith("core_"):
        name = part.removeprefix("core_")
        if name not in groups:
            raise InfeasibleDesign(f"the drawing names no faces '{name}', so its chamber has no core")
        chosen = [loop for loop, found in zip(loops, surfaces, strict=True) if groups[name][0] in found]
    else:
        chosen = [max(zip(loops, surfaces, strict=True), key=lambda pair: _diagonal(gmsh, pair[1]))[0]]
    solid = occ.addVolume(chosen)
    occ.remove([(3, volume)])
    gmsh.model.removePhysicalGroups()
    if part.startswith("core_"):
        return
    wall = WALL * (1e-3 if gmsh.option.getString("Geometry.OCCTargetUnit") == "M" else 1.0)
    slack = 1e-3 * wall
    low, high = bounds[0] - wall, bounds[1] + wall
    for box in clamped:  # open where the body is clamped, if that is an end of it
        for axis in range(3):
            if box[1, axis] - box[0, axis] < slack:
                if abs(box[0, axis] - bounds[0, axis]) < slack:
                    low[axis] = box[0, axis]
                elif abs(box[1, axis] - bounds[1, axis]) < slack:
                    high[axis] = box[1, axis]
    thin = int(np.argmin(bounds[1] - bounds[0]))
    middle = 0.5 * (bounds[0, thin] + bounds[1, thin])
    (high if part == "low" else low)[thin] = middle
    occ.cut([(3, occ.addBox(*low, *(high - low)))], [(3, solid)])


def _diagonal(gmsh: Any, faces: Sequence[int]) -> float:
    """Return the size of the box around faces, in the unit of the drawing."""
    import numpy as np

    boxes = np.array([gmsh.model.getBoundingBox(2, face) for face in faces])
    return float(np.linalg.norm(boxes[:, 3:].max(axis=0) - boxes[:, :3].min(axis=0)))


# -- drawings ----------------------------------------------------------------------------------------------------------


def _outside(lengths: Mapping[str, float]) -> tuple[float, float, float, float, float, float]:
    """Corner and size of the box on its outside [mm]."""
    half = max(THICKNESS / 2 + FLANGE, lengths["outer_radius"]) + WALL
    return (
        -half,
        0.0,
        -3.0 * lengths["length"] - WALL,
        2.0 * half,
        lengths["height"] + FLANGE + WALL,
        3.0 * lengths["length"] + 2.0 * WALL,
    )


def _draw_finger(lengths: Mapping[str, float], part: str) -> list:
    """Draw a part of the finger; returns its volumes as (dimension, tag) pairs."""
    import gmsh

    before = set(gmsh.model.occ.getEntities(3))
    draw_finger(**lengths, part=part)
    return sorted(set(gmsh.model.occ.getEntities(3)) - before)


def _draw_plugs(lengths: Mapping[str, float], low: float) -> tuple[list, list]:
    """Draw the cavities, and under each of them a prism from its bottom down to the height ``low`` [mm].

    Returns:
        The volumes of the cavities and those of the prisms, as (dimension, tag) pairs.
    """
    import gmsh

    occ = gmsh.model.occ
    cavities = _draw_finger(lengths, "cavities")
    occ.synchronize()
    cork, plugs = lengths["cork_thickness"], []
    for face in gmsh.model.getBoundary(cavities, combined=False, oriented=False):
        _, bottom, _, _, top, _ = occ.getBoundingBox(*face)
        if max(abs(bottom - cork), abs(top - cork)) < 1e-4:
            plugs += [e for e in occ.extrude([face], 0, low - cork, 0) if e[0] == 3]
    return cavities, plugs


def draw_box(lengths: Mapping[str, float], wires: Sequence[Sequence[float]]) -> None:
    """Draw the box with gmsh.

    Args:
        lengths: parameters of `draw_finger` [mm, rad].
        wires: x and y of the cables [mm], shape (n, 2).
    """
    import gmsh

    occ = gmsh.model.occ
    finger = _draw_finger(lengths, "filled")
    x, y, z, dx, dy, dz = _outside(lengths)
    block = (3, occ.addBox(x, y, z, dx, dy, dz))
    bores = [(3, occ.addCylinder(u, v, z, 0, 0, dz, WIRE_RADIUS)) for u, v in wires]
    occ.cut([block], finger + bores)


def draw_lid(lengths: Mapping[str, float]) -> None:
    """Draw the lid with the cores with gmsh; ``lengths`` [mm, rad] are the parameters of `draw_finger`."""
    import gmsh

    occ = gmsh.model.occ
    x, _, z, dx, _, dz = _outside(lengths)
    gap = WALL + TOLERANCE
    plate = (3, occ.addBox(x - gap, -WALL, z - gap, dx + 2 * gap, WALL + RIM, dz + 2 * gap))
    # The cores reach into the plate, because solids that only touch might not be fused.
    inside = (3, occ.addBox(x - TOLERANCE, 0, z - TOLERANCE, dx + 2 * TOLERANCE, RIM, dz + 2 * TOLERANCE))
    window, length = WINDOW * lengths["length"], lengths["length"]
    windows = [
        (3, occ.addBox(-THICKNESS / 2 + 1, -WALL, -(k + 0.5) * length - window / 2, THICKNESS - 2, WALL, window))
        for k in range(3)
    ]
    plate_parts, _ = occ.cut([plate], [inside, *windows])
    cavities, plugs = _draw_plugs(lengths, -WALL / 2)
    occ.fuse(plate_parts, cavities + plugs)


def draw_cork(lengths: Mapping[str, float]) -> None:
    """Draw the tray for the plugs with gmsh; ``lengths`` [mm, rad] are the parameters of `draw_finger`."""
    import gmsh

    occ = gmsh.model.occ
    cavities, plugs = _draw_plugs(lengths, 0.0)
    occ.remove(cavities, recursive=True)
    # Move the plugs of the second joint close to those of the first.
    step = lengths["bellow_height"] + WALL
    for plug in plugs:
        _, _, low, _, _, high = occ.getBoundingBox(*plug)
        joint = round(-(low + high) / (2.0 * lengths["length"]))
        occ.translate([plug], 0, 0, joint * (lengths["length"] - step))
    half = lengths["outer_radius"] + WALL
    margin = lengths["bellow_height"] / 2 + WALL
    tray = (
        3,
        occ.addBox(-half, -WALL, -2 * step - margin, 2 * half, WALL + lengths["cork_thickness"], step + 2 * margin),
    )
    occ.cut([tray], plugs)


def draw_clamp(height: float) -> None:
    """Draw the clamp of the flange with gmsh; ``height`` [mm] is that of the segments."""
    import gmsh

    occ = gmsh.model.occ
    ear = 4 * SCREW_RADIUS + WALL
    half, top, depth = THICKNESS / 2 + FLANGE, height + FLANGE, FLANGE + WALL
    yoke = (3, occ.addBox(-half - ear, 0, -depth, 2 * (half + ear), top + WALL, depth))
    pocket = (
        3,
        occ.addBox(-half - TOLERANCE, -1, -FLANGE - TOLERANCE, 2 * (half + TOLERANCE), 1 + top + TOLERANCE, depth),
    )
    slot = THICKNESS / 2 + TOLERANCE
    channel = (3, occ.addBox(-slot, -1, -depth - 1, 2 * slot, 1 + height + TOLERANCE, depth + 2))
    screws = [
        (3, occ.addCylinder(side * (half + ear / 2), height / 2, -depth - 1, 0, 0, depth + 2, SCREW_RADIUS))
        for side in (-1, 1)
    ]
    occ.cut([yoke], [pocket, channel, *screws])
