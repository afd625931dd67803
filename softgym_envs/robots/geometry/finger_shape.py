"""The shape of the soft fingers: three segments, two notches with bellows, and cavities inside (thesis, sec. 3.3)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from softgym_envs.errors import InfeasibleDesign
from softgym_envs.robots.geometry.morphing import Cone, Cylinder, Feature, Plane

# Fixed dimensions [mm]. Where bellows end along z they are as wide as the segments: TEETH_RADIUS = THICKNESS / 2.
THICKNESS = 17.5
FLANGE = 3.0
TEETH_RADIUS = 8.75


def draw_finger(
    length: float,
    height: float,
    joint_height: float,
    slope: float,
    outer_radius: float,
    bellow_height: float,
    plateau_height: float,
    wall_thickness: float,
    cork_thickness: float,
    split: float = 0.0,
    part: str = "body",
) -> None:
    """Draw a finger of three segments and two bellows with gmsh: lengths in mm, slope of the notches in rad.

    Args:
        length: of one segment, along -z.
        height: of the segments, along y.
        joint_height: thickness left under the notches.
        slope: angle of the notch faces from the cross-section.
        outer_radius: of the bellows, at their plateau.
        bellow_height: of bellows and cavities along z, where they are widest in z.
        plateau_height: of their cylindrical part.
        wall_thickness: radius of the bellow minus radius of the cavity.
        cork_thickness: height of the slab under the cavities.
        split: half the thickness of a wall in the plane x = 0 through the cavities; 0 for none.
        part: ``"body"``, ``"filled"`` (the body without its cavities) or ``"cavities"`` (what was left out).
    """
    import gmsh

    check_finger(
        {
            "length": length,
            "height": height,
            "joint_height": joint_height,
            "slope": slope,
            "outer_radius": outer_radius,
            "bellow_height": bellow_height,
            "plateau_height": plateau_height,
            "wall_thickness": wall_thickness,
            "cork_thickness": cork_thickness,
            "split": split,
        }
    )
    occ = gmsh.model.occ
    run = (height - joint_height) * math.tan(slope)

    def half_turned(inner: float, outer: float, z: float) -> tuple[int, int]:
        """A trapezoid profile (full height up to ``inner``, plateau at ``outer``) turned by 180 degrees about z."""
        full, flat = bellow_height / 2, plateau_height / 2
        profile = [(0.0, -full), (inner, -full), (outer, -flat), (outer, flat), (inner, full), (0.0, full)]
        points = [occ.addPoint(r, 0, z + h) for r, h in profile]
        lines = [occ.addLine(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)]
        face = occ.addPlaneSurface([occ.addCurveLoop(lines)])
        return next(e for e in occ.revolve([(2, face)], 0, 0, 0, 0, 0, 1, math.pi) if e[0] == 3)

    hollows = []
    if part != "filled":
        cavities = [
            half_turned(TEETH_RADIUS - wall_thickness, outer_radius - wall_thickness, -j * length) for j in (1, 2)
        ]
        solid = []
        for joint in (1, 2):
            low = -joint * length - bellow_height
            solid.append(
                (3, occ.addBox(-outer_radius, -1, low, 2 * outer_radius, 1 + cork_thickness, 2 * bellow_height))
            )
            if split:
                solid.append((3, occ.addBox(-split, -1, low, 2 * split, 1 + outer_radius, 2 * bellow_height)))
        hollows, _ = occ.cut(cavities, solid)
    if part == "cavities":
        return

    # Side view (y, z): a bar with a notch at each joint; the base half of the first segment is filled.
    outline = [(0.0, 0.0), (0.0, -3.0 * length), (joint_height, -3.0 * length), (height, -3.0 * length + run)]
    for joint in (2, 1):
        z = -joint * length
        outline += [(height, z - run), (joint_height, z), (height, z + run)]
    outline.append((height, 0.0))
    points = [occ.addPoint(-THICKNESS / 2, y, z) for y, z in outline]
    lines = [occ.addLine(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)]
    face = occ.addPlaneSurface([occ.addCurveLoop(lines)])
    bar = [e for e in occ.extrude([(2, face)], THICKNESS, 0, 0) if e[0] == 3]
    flange = (3, occ.addBox(-THICKNESS / 2 - FLANGE, 0, -FLANGE, THICKNESS + 2 * FLANGE, height + FLANGE, FLANGE))
    bellows = [half_turned(TEETH_RADIUS, outer_radius, -joint * length) for joint in (1, 2)]
    body, _ = occ.fuse(bar, [flange, *bellows])
    if hollows:
        occ.cut(body, hollows)


def check_finger(lengths: Mapping[str, float]) -> None:
    """Check that the shape that `draw_finger` draws can exist.

    Args:
        lengths: its parameters [mm, rad].

    Raises:
        InfeasibleDesign: naming what does not fit.
    """
    length, height, joint_height = lengths["length"], lengths["height"], lengths["joint_height"]
    tangent = math.tan(lengths["slope"])
    outer, inner = lengths["outer_radius"] - lengths["wall_thickness"], TEETH_RADIUS - lengths["wall_thickness"]
    half, cork, split = lengths["bellow_height"] / 2, lengths["cork_thickness"], lengths.get("split", 0.0)
    run = (height - joint_height) * tangent
    if not run > 0.0:
        raise InfeasibleDesign(
            f"there is no notch: joint height {joint_height:.2f} mm, height {height:.2f} mm, tan(slope) {tangent:.3g}"
        )
    if 2.0 * run >= length:
        raise InfeasibleDesign(
            f"the notches meet: 2 x {run:.2f} mm does not fit in a segment of {length:.2f} mm; "
            "lower the slope or raise the joints"
        )
    if lengths["plateau_height"] >= 2.0 * half:
        raise InfeasibleDesign(f"a plateau of {lengths['plateau_height']:.2f} mm on a bellow of {2.0 * half:.2f} mm")
    if math.hypot(cork, split) >= outer:
        raise InfeasibleDesign(
            f"the cavity vanishes: the cork ends at {cork:.2f} mm, the cavity at a radius of {outer:.2f} mm"
        )
    # Where the cavity is widest along z, only the adjacent segment closes it.
    closed = joint_height + half / tangent
    if inner > cork and inner >= closed:
        raise InfeasibleDesign(
            f"the cavity opens into the notch: it is {inner:.2f} mm high at its ends, the adjacent segment "
            f"{closed:.2f} mm"
        )


def in_flange(nodes: np.ndarray) -> np.ndarray:
    """Return which nodes [m] (n, 3) belong to the flange, which is clamped, shape (n,)."""
    return nodes[:, 2] >= -(FLANGE + 1e-3) * 1e-3


def finger_features(lengths: Mapping[str, float]) -> dict[str, Feature]:
    """Return the planes of bar, flange and notches, and the cones and cylinders of bellows and cavities [m].

    Args:
        lengths: parameters of `draw_finger` [mm, rad].
    """
    metres = {name: 1e-3 * value for name, value in lengths.items() if name != "slope"}
    x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    side, flange, teeth = 1e-3 * THICKNESS / 2, 1e-3 * FLANGE, 1e-3 * TEETH_RADIUS
    length, height, joint = metres["length"], metres["height"], metres["joint_height"]
    outer, wall, full = metres["outer_radius"], metres["wall_thickness"], metres["bellow_height"] / 2
    tangent, split = math.tan(lengths["slope"]), metres.get("split", 0.0)
    features: dict[str, Feature] = {
        "left": Plane((-side, 0, 0), x),
        "right": Plane((side, 0, 0), x),
        "bottom": Plane((0, 0, 0), y),
        "top": Plane((0, height, 0), y),
        "base": Plane((0, 0, 0), z),
        "tip": Plane((0, 0, -3 * length), z),
        "flange left": Plane((-side - flange, 0, 0), x),
        "flange right": Plane((side + flange, 0, 0), x),
        "flange top": Plane((0, height + flange, 0), y),
        "flange face": Plane((0, 0, -flange), z),
        "bellow rim": Cylinder(outer),
        "cavity rim": Cylinder(outer - wall),
        "cork": Plane((0, metres["cork_thickness"], 0), y),
        "notch 3 base": Plane((0, joint, -3 * length), (0.0, -tangent, 1.0)),
    }
    if split:
        features["split left"] = Plane((-split, 0, 0), x)
        features["split right"] = Plane((split, 0, 0), x)
    # Radius lost per height between full height and plateau.
    taper = (outer - teeth) / (full - metres["plateau_height"] / 2)
    for k in (1, 2):
        centre = -k * length
        for word, sign in (("base", 1.0), ("tip", -1.0)):
            features[f"notch {k} {word}"] = Plane((0, joint, centre), (0.0, -sign * tangent, 1.0))
            features[f"flat {k} {word}"] = Plane((0, 0, centre + sign * full), z)
            for part, radius in (("bellow", teeth), ("cavity", teeth - wall)):
                features[f"{part} {k} {word}"] = Cone(radius, centre + sign * full, -sign * taper)
    return features
