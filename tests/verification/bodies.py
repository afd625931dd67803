"""Bodies, meshes and loads of the validation cases."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.cavity import Cavity
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.elements.quadratic import add_midside_nodes, quadratic_triangles, split_triangles
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solids import SOLIDS
from softgym_envs.mechanics.solvers.linearisation import Linearisation

Mapping = Callable[[np.ndarray], np.ndarray]


def shell_octant(count: int, layers: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return nodes (n, 3), tetrahedra (m, 4) and inner triangles of the octant of 1 <= |x| + |y| + |z| <= 2."""
    ids, face = {}, []
    for i in range(count + 1):
        for j in range(count + 1 - i):
            ids[i, j] = len(face)
            face.append([i, j, count - i - j])
    triangles = [[ids[i, j], ids[i + 1, j], ids[i, j + 1]] for i, j in ids if i + j < count]
    triangles += [[ids[i + 1, j], ids[i + 1, j + 1], ids[i, j + 1]] for i, j in ids if i + j < count - 1]
    surface = np.sort(np.array(triangles), axis=1)
    points = np.array(face) / count
    nodes = np.concatenate([points * (1.0 + layer / layers) for layer in range(layers + 1)])
    tetrahedra = []
    for layer in range(layers):
        low, high = surface + layer * len(points), surface + (layer + 1) * len(points)
        # Cut the sides of each prism from its lowest-numbered lower node, so that neighbours match.
        for k in range(3):
            tetrahedra.append(np.column_stack([low[:, : k + 1], high[:, k:]]))
    return nodes, np.concatenate(tetrahedra), np.array(triangles)


def to_sphere(points: np.ndarray) -> np.ndarray:
    """Move points (n, 3) along their rays so that their distance from the origin becomes |x| + |y| + |z|."""
    lengths = np.linalg.norm(points, axis=1)
    return points * (np.abs(points).sum(axis=1) / lengths)[:, None]


def solid(
    mesh: tuple[np.ndarray, np.ndarray],
    element: str,
    fixed: Callable[[np.ndarray], np.ndarray],
    mapping: Mapping,
    **options,
) -> MechanicalModel:
    """Return a body of one element kind on a mapped mesh; midside nodes are mapped too, so edges may be curved.

    Args:
        mesh: nodes (n, 3) and tetrahedra (m, 4) before the mapping.
        element: a name of `SOLIDS`.
        fixed: mask (n,) or (n, 3) of clamped nodes, from the nodes before the mapping.
        mapping: function from the nodes before to the final nodes [m].
        **options: of the element block.
    """
    nodes, tetrahedra = mesh
    if element == "quadratic":
        nodes, tetrahedra = add_midside_nodes(nodes, tetrahedra)
    mapped = mapping(nodes)
    return MechanicalModel(mapped, [SOLIDS[element](mapped, tetrahedra, **options)], fixed=fixed(nodes))


def traction(model: MechanicalModel, selected: Callable[[np.ndarray], np.ndarray], force: np.ndarray) -> np.ndarray:
    """Return nodal loads (n, 3) of a uniform traction, in total ``force`` [N], on the outer faces of selected nodes."""
    connectivity = model.solids[0].connectivity
    corners = connectivity[:, :4]
    faces = corners[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
    _, first, counts = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer = faces[first[counts == 1]]
    outer = outer[selected(model.nodes)[outer].all(axis=1)]
    x = model.nodes[outer]
    areas = 0.5 * np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1)
    if connectivity.shape[1] == 10:  # a uniform traction loads only the midside nodes, a third each
        outer = quadratic_triangles(outer, connectivity)[:, 3:]
    loads = np.zeros_like(model.nodes)
    np.add.at(loads, outer, areas[:, None, None] / (3.0 * areas.sum()) * force)
    return loads


def linear_response(model: MechanicalModel, loads: np.ndarray) -> np.ndarray:
    """Return displacements [m] (n, 3) under small loads [N] (n, 3): one solve with the tangent at rest."""
    tangent = Linearisation(model)
    assert tangent.update(model.nodes, np.zeros(model.assembly.size))
    free = model.kinematics.free_dofs
    moved = np.zeros(model.nodes.size)
    moved[free] = tangent.solve(loads.ravel()[free])
    return moved.reshape(-1, 3)


def clamped_beam(
    curve: Callable[[float], tuple[np.ndarray, np.ndarray]], elements: int, order: int, section: Section, **options
) -> MechanicalModel:
    """Return a beam along a curve on [0, 1] (position, rotation), clamped at 0, with an effector at 1."""
    body = ModelBuilder()
    places = np.linspace(0.0, 1.0, order * elements + 1)
    frames = [body.add_frame(*curve(t), fixed=t == 0.0, fixed_spin=t == 0.0) for t in places]
    body.add_element(Beam, frames, section=section, order=order, **options)
    model = body.build()
    model.add("e", Point("tip", EmbeddedPoints.in_frame(frames[-1], np.zeros(3), model.nodes)))
    return model


def straight(length: float) -> Callable[[float], tuple[np.ndarray, np.ndarray]]:
    """Return a line along x, for `clamped_beam`."""
    return lambda t: (np.array([length * t, 0.0, 0.0]), np.eye(3))


def sphere_octant(count: int, element: str, *, split: bool = False, **options) -> MechanicalModel:
    """Return an octant of a thick sphere (radii 1 and 2) on its planes of symmetry.

    Actuator: the pressure in the cavity, closed by flat triangles between the inner edge and the centre.

    Args:
        count: cells along an edge, and through the wall.
        element: a name of `SOLIDS`.
        split: close the cavity of quadratic elements with split instead of quadratic triangles.
        **options: of the element block.
    """
    nodes, tetrahedra, inner = shell_octant(count, count)
    if element == "quadratic":
        nodes, tetrahedra = add_midside_nodes(nodes, tetrahedra)
        inner = split_triangles(inner, tetrahedra) if split else quadratic_triangles(inner, tetrahedra)
    nodes = to_sphere(nodes)
    quadratic = inner.shape[1] == 6
    inward = np.linalg.det(nodes[inner[:, :3]]) < 0.0
    inner[inward] = inner[inward][:, [0, 2, 1, 5, 4, 3] if quadratic else [0, 2, 1]]
    # Edges of one triangle only, from corner to corner, with the midside node.
    sides = (
        [inner[:, [0, 1, 3]], inner[:, [1, 2, 4]], inner[:, [2, 0, 5]]]
        if quadratic
        else [inner, inner[:, [1, 2, 0]], inner[:, [2, 0, 1]]]
    )
    edges = {(a, b): middle for a, b, middle in np.concatenate(sides).tolist()}
    rim = {edge: middle for edge, middle in edges.items() if edge[::-1] not in edges}
    # The centre and the middles of its spokes belong to no element and are therefore held.
    centre, corners = len(nodes), sorted({a for a, _ in rim})
    spoke = {a: centre + 1 + k for k, a in enumerate(corners)}
    nodes = np.vstack([nodes, np.zeros((1, 3)), 0.5 * nodes[corners]])
    closing = [[b, a, centre, middle, spoke[a], spoke[b]] for (a, b), middle in rim.items()]
    block = SOLIDS[element](nodes, tetrahedra, **options)
    model = MechanicalModel(nodes, [block], fixed=np.isclose(nodes, 0.0, atol=1e-12))
    surface = np.vstack([inner, np.array(closing)[:, : inner.shape[1]]])
    model.add("a", Cavity("cavity", surface, nodes))
    return model


def halved(nodes: np.ndarray, tetrahedra: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut every tetrahedron into eight at the middles of its edges; new nodes are marked where both ends are."""
    finer, ten = add_midside_nodes(nodes, tetrahedra)
    marked = np.append(mask, np.zeros(len(finer) - len(nodes), dtype=bool))
    for slot, (a, b) in enumerate([(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]):
        marked[ten[:, 4 + slot]] = mask[ten[:, a]] & mask[ten[:, b]]
    corners = [(0, 4, 6, 7), (4, 1, 5, 8), (6, 5, 2, 9), (7, 8, 9, 3)]
    middle = [(6, 8, 4, 5), (6, 8, 5, 9), (6, 8, 9, 7), (6, 8, 7, 4)]
    return finer, ten[:, corners + middle].reshape(-1, 4), marked
