"""Meshes of fingers: of one element size, or of a half with small elements at the joints, where a finger bends.

Re-entrant edges at the joints may be rounded by a fillet, and elements may be small where loads act. The half is
mirrored, so the whole finger is symmetric.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from softgym_envs.robots.geometry.finger_shape import draw_finger, finger_features
from softgym_envs.robots.geometry.meshing import BodyMesh, mesh_geometry
from softgym_envs.robots.geometry.morphing import Feature, Plane
from softgym_envs.robots.geometry.symmetry import mirrored

if TYPE_CHECKING:
    from softgym_envs.robots.mesh_tiers import MeshTier

GRADING = 1.0  # growth of the edge length per distance from where it is smallest
MARGIN = 2.0  # edges are rounded up to this distance from the bellows along z [mm]
PROBES = 36  # directions in which an edge is probed for material
PROBE_DISTANCE = 0.05  # [mm]
LEAST_ANGLE = 190.0  # of material around an edge that is rounded [degrees]


def mesh_finger(lengths: dict[str, float], tier: MeshTier, balls: Sequence[Sequence[float]] = ()) -> BodyMesh:
    """Mesh the finger of `draw_finger`, or its half x >= 0 if the mesh is graded or has fillets.

    Args:
        lengths: parameters of `draw_finger` [mm, rad].
        tier: sizes and fillet.
        balls: middle and radius (4,) [m] of each part of the half in which elements have the tier's ``guide_size``.
    """
    if not is_half(tier):
        return mesh_geometry(draw_finger, lengths, mesh_size=tier.size)
    sizes = {"size": tier.size, "feature_size": tier.feature_size or tier.size, "fillet": tier.fillet}
    draw: Callable[..., None] = draw_half_finger
    uses: tuple[Callable[..., Any], ...] = (draw_finger, round_joints, angle_of_material)
    if tier.guide_size is not None:
        draw, uses = draw_graded_balls, (draw_half_finger, *uses)
        sizes |= {"ball_size": tier.guide_size}
        sizes |= {f"{letter}{k}": x for k, ball in enumerate(balls) for letter, x in zip("xyzr", ball, strict=True)}
        lengths = lengths | {"count": float(len(balls))}
    return mesh_geometry(
        draw,
        lengths | {name: round(1e3 * float(value), 9) for name, value in sizes.items()},
        mesh_size=tier.size,
        uses=uses,
        time_limit=300.0,
    )


def is_half(tier: MeshTier) -> bool:
    """Whether `mesh_finger` meshes half a finger."""
    return tier.feature_size is not None or tier.fillet > 0.0


def whole_finger(part: BodyMesh, tier: MeshTier) -> BodyMesh:
    """Return the whole finger from a mesh of `mesh_finger`."""
    return mirrored(part, (1.0, 0.0, 0.0)) if is_half(tier) else part


def graded_features(lengths: Mapping[str, float], tier: MeshTier) -> dict[str, Feature]:
    """Return the surfaces of a mesh of `mesh_finger` with sharp edges; see `finger_features`."""
    features = finger_features(lengths)
    return features | {"middle": Plane((0, 0, 0), (1.0, 0.0, 0.0))} if is_half(tier) else features


def draw_rounded_finger(*, fillet: float, **lengths: Any) -> None:
    """Draw a finger whose re-entrant edges at the joints have fillets, with gmsh.

    Args:
        fillet: their radius [mm].
        **lengths: parameters of `draw_finger` [mm, rad].
    """
    draw_finger(**lengths)
    round_joints(lengths, fillet)


def draw_half_finger(*, size: float, feature_size: float, fillet: float, **lengths: Any) -> None:
    """Draw the half x >= 0 of a finger with gmsh and set the sizes of its elements.

    Args:
        size: edge length away from the joints [mm].
        feature_size: edge length at the joints [mm]; half of it at fillets.
        fillet: radius of the re-entrant edges at the joints [mm]; 0 for sharp edges.
        **lengths: parameters of `draw_finger` [mm, rad].
    """
    import gmsh

    occ, length = gmsh.model.occ, lengths["length"]
    draw_finger(**lengths)
    occ.intersect(occ.getEntities(3), [(3, occ.addBox(0.0, -50.0, -4.0 * length, 100.0, 150.0, 5.0 * length))])
    curves = round_joints(lengths, fillet) if fillet else []
    occ.synchronize()
    field = gmsh.model.mesh.field
    # Elements have their smallest size along the bellows.
    away = f"max(0, min(fabs(z + {length}), fabs(z + {2.0 * length})) - {0.5 * lengths['bellow_height']})"
    sizes = [field.add("MathEval")]
    field.setString(sizes[0], "F", f"min({size}, {feature_size} + {GRADING} * {away})")
    if curves:
        distance = field.add("Distance")
        field.setNumbers(distance, "CurvesList", curves)
        field.setNumber(distance, "Sampling", 40)
        sizes.append(field.add("MathEval"))
        field.setString(sizes[1], "F", f"{0.5 * feature_size} + {GRADING} * F{distance}")
    smallest = field.add("Min")
    field.setNumbers(smallest, "FieldsList", sizes)
    field.setAsBackgroundMesh(smallest)
    gmsh.option.setNumber("Mesh.MeshSizeMin", 0.0)
    gmsh.option.setNumber("Mesh.MeshSizeMax", 1e22)


def draw_graded_balls(*, ball_size: float, count: float, **options: float) -> None:
    """Draw half a finger with gmsh, as `draw_half_finger`, with small elements in balls.

    Args:
        ball_size: largest edge length in the balls [mm]; it grows away from them.
        count: number of balls.
        **options: middles ``x0``, ``y0``, ``z0``, ``x1``, ... and radii ``r0``, ``r1``, ... of the balls [mm]; and
            those of `draw_half_finger`.
    """
    import gmsh

    balls = [[options.pop(f"{letter}{k}") for letter in "xyzr"] for k in range(int(count))]
    draw_half_finger(**options)
    field = gmsh.model.mesh.field
    sizes = [int(max(field.list()))]  # the sizes that were set already
    for x, y, z, radius in balls:
        sizes.append(field.add("MathEval"))
        away = f"max(0, sqrt((x - ({x}))^2 + (y - ({y}))^2 + (z - ({z}))^2) - {radius})"
        field.setString(sizes[-1], "F", f"{ball_size} + {GRADING} * {away}")
    smallest = field.add("Min")
    field.setNumbers(smallest, "FieldsList", sizes)
    field.setAsBackgroundMesh(smallest)


def round_joints(lengths: Mapping[str, float], fillet: float) -> list[int]:
    """Round the re-entrant edges at the joints of the one volume that is drawn in gmsh.

    Args:
        lengths: parameters of `draw_finger` [mm, rad].
        fillet: radius [mm].

    Returns:
        The edges of the faces that were added.
    """
    import gmsh

    occ = gmsh.model.occ
    occ.synchronize()
    ((_, body),) = gmsh.model.getEntities(3)
    near = []
    for _, edge in gmsh.model.getEntities(1):
        _, _, low, _, _, high = gmsh.model.getBoundingBox(1, edge)
        distance = min(abs(0.5 * (low + high) + joint * lengths["length"]) for joint in (1, 2))
        if distance < 0.5 * lengths["bellow_height"] + MARGIN:
            near.append(edge)
    edges = [edge for edge in near if angle_of_material(body, edge) > LEAST_ANGLE]
    occ.fillet([body], edges, [fillet])
    occ.synchronize()
    curves: set[int] = set()
    for face in gmsh.model.getEntities(2):
        low, high = gmsh.model.getParametrizationBounds(*face)
        middle = [0.5 * (a + b) for a, b in zip(low, high, strict=True)]
        largest = gmsh.model.getPrincipalCurvatures(face[1], middle)[0]
        if abs(largest[0]) > 0.6 / fillet:
            curves |= {tag for _, tag in gmsh.model.getBoundary([face], oriented=False)}
    return sorted(curves)


def angle_of_material(body: int, edge: int) -> float:
    """Return the angle around an edge that a volume fills in gmsh [degrees]: 90 at the edges of a cuboid."""
    import gmsh
    import numpy as np

    low, high = gmsh.model.getParametrizationBounds(1, edge)
    parameter = [low[0] + 0.4 * (high[0] - low[0])]
    place = np.array(gmsh.model.getValue(1, edge, parameter))
    tangent = np.array(gmsh.model.getDerivative(1, edge, parameter))
    first = np.cross(tangent, np.eye(3)[np.argmin(np.abs(tangent))])
    second = np.cross(tangent, first)
    turn = 2.0 * np.pi * (np.arange(PROBES) + 0.5) / PROBES
    circle = np.outer(np.cos(turn), first / np.linalg.norm(first))
    circle += np.outer(np.sin(turn), second / np.linalg.norm(second))
    inside = gmsh.model.isInside(3, body, (place + PROBE_DISTANCE * circle).ravel())
    return 360.0 * inside / PROBES
