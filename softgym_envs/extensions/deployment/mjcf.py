"""A body as a chain of rigid links for MuJoCo (MJCF): soft parts on rigid arms, in a simulator that has no solids.

The links are slices of the body along its axis. The joint between two slices has the rotational compliance that finite
elements give the body there: a pure moment at the tip is the same in every section, so what one section turns against
the one before it, for unit moments about three axes, is the joint's 3 x 3 compliance, exactly in the linear range.
Each joint stands for an equal part of the compliance. Its three hinges pass through the centres of these rotations,
which in a notch lie far from the axis of the body; a slide along the axis gives what a force stretches besides. Shear
is left out. Cables become spatial tendons through sites on the links, each with a motor that pulls.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from softgym_envs.mechanics.constraints.cable import Cable
from softgym_envs.mechanics.elements.tetrahedra import boundary_triangles
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import Robot
from softgym_envs.storage import atomic_write
from softgym_envs.wording import counted

SLICES = 40
"""Thin slices from which the compliance along the axis is measured."""
SECTION = 24
"""Nodes nearest to the end of a slice, by whose motion its rotation is measured."""
ROTATION = 1e-4
"""Rotation of the tip [rad] by the moments with which the compliance is measured."""

SKIN = '"0.96 0.85 0.75 1"'
"""Colour of the links."""


@dataclass(frozen=True)
class Joint:
    """A joint of the chain.

    Attributes:
        place: on the axis of the body at rest [m], shape (3,).
        axes: unit vectors of its three hinges, as rows, shape (3, 3).
        centres: points of the hinges [m], as rows, shape (3, 3).
        stiffness: about them [N m/rad], shape (3,).
        axial: stiffness of the slide [N/m].
    """

    place: np.ndarray
    axes: np.ndarray
    centres: np.ndarray
    stiffness: np.ndarray
    axial: float


@dataclass(frozen=True)
class Link:
    """A rigid slice of the body.

    Attributes:
        mass: [kg].
        centre: of mass at rest [m], shape (3,).
        inertia: about the centre [kg m2], shape (3, 3).
        points: of its visible surface [m], shape (n, 3).
        triangles: of its visible surface, shape (t, 3).
    """

    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    points: np.ndarray
    triangles: np.ndarray


@dataclass(frozen=True)
class Chain:
    """A body as rigid links: the first is clamped, and a joint leads to each of the others.

    Attributes:
        name: of the robot.
        links: from the clamped one to the tip.
        joints: before each link but the first.
        axis: of the body, from its base to its tip, unit vector (3,).
        cables: by name, the points [m] (p, 3) from the pull point to the anchor, and the link of each (0: the base).
        effectors: by name, the point [m] (3,) and its link.
    """

    name: str
    links: Sequence[Link]
    joints: Sequence[Joint]
    axis: np.ndarray
    cables: Mapping[str, tuple[np.ndarray, np.ndarray]]
    effectors: Mapping[str, tuple[np.ndarray, int]]


def chain_of(robot: Robot, design: Mapping[str, float] | None = None, *, joints: int = 9) -> Chain:
    """Return a body as a chain of rigid links.

    Args:
        robot: the robot: one solid, clamped at one end and moved by cables.
        design: the body; missing variables take their baseline.
        joints: number of joints, from 1 to `SLICES`.

    Raises:
        ValueError: for a robot of another kind, or another number of joints.
        DesignError: for a malformed design.
        InfeasibleDesign: if the geometry cannot exist.
    """
    if not 1 <= joints <= SLICES:
        raise ValueError(f"joints = {joints} is out of bounds; allowed: 1 to {SLICES}")
    model = robot.build(design)
    _check(robot, model)
    block = model.solids[0]
    used = block.nodes_used
    nodes = model.nodes[used]
    fixed = model.fixed[used].all(axis=1) if model.fixed.ndim > 1 else model.fixed[used]
    base = nodes[fixed].mean(axis=0)
    tip = model.constraints["e"][0].value(model.nodes)[:3]
    axis = (tip - base) / np.linalg.norm(tip - base)
    along = (nodes - base) @ axis
    start = float(along[fixed].max())
    edges = np.linspace(start, float(along.max()), SLICES + 1)
    sections = _sections(model, used, along, edges, axis)
    middles = 0.5 * (edges[:-1] + edges[1:])

    # Each joint stands for an equal part of the compliance.
    weight = np.trace(np.diff(sections.turned[:, :, :3], axis=0, prepend=0.0), axis1=1, axis2=2).clip(min=0.0)
    total = np.cumsum(weight)
    group = np.minimum((total - 0.5 * weight) / total[-1] * joints, joints - 1e-9).astype(int)
    places, found, before = [], [], -1
    for number in np.unique(group):
        members = np.flatnonzero((group == number) & (weight > 0.0))
        if not len(members):
            continue
        places.append(np.average(middles[members], weights=weight[members]))
        found.append(_joint(sections, before, members[-1], base + places[-1] * axis, axis))
        before = members[-1]
    links = [_link(model, base, axis, places, k) for k in range(len(found) + 1)]

    def link_at(points: np.ndarray) -> np.ndarray:
        return np.searchsorted(places, (points - base) @ axis, side="right")

    cables = {}
    for cable in model.constraints["a"]:
        assert isinstance(cable, Cable)
        path = cable.path(model.nodes)
        number = link_at(path)
        number[0] = 0  # the pull point stands still
        cables[cable.name] = (path, number)
    effectors = {}
    for effector in model.constraints["e"]:
        point = effector.value(model.nodes)[:3]
        effectors[effector.name] = (point, int(link_at(point)))
    return Chain(robot.name, links, found, axis, cables, effectors)


def _check(robot: Robot, model: MechanicalModel) -> None:
    if len(model.blocks) != 1 or len(model.solids) != 1:
        raise ValueError(
            f"robot '{robot.name}' is made of {counted(len(model.blocks), 'part')}, of which {len(model.solids)} are "
            "solids; a chain of links is made of one solid"
        )
    others = [constraint.name for constraint in model.constraints["a"] if not isinstance(constraint, Cable)]
    if others:
        raise ValueError(f"robot '{robot.name}': a chain of links is moved by cables, and {', '.join(others)} are none")


@dataclass(frozen=True)
class _Sections:
    """Motion of the sections at the ends of the slices under unit loads at the tip: three moments and an axial force.

    Attributes:
        turned: rotations [rad/(N m), rad/N], shape (SLICES, 3, 4); the last index is the load.
        moved: displacements of their centres [m/(N m), m/N], shape (SLICES, 3, 4).
        centres: at rest [m], shape (SLICES, 3).
    """

    turned: np.ndarray
    moved: np.ndarray
    centres: np.ndarray

    def motion(self, number: int, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rotations and the displacements of a point [m] (3,) fixed to a section; -1 is the clamped one."""
        if number < 0:
            return np.zeros((3, 4)), np.zeros((3, 4))
        turned = self.turned[number]
        return turned, self.moved[number] + np.cross(turned, (place - self.centres[number])[:, None], axis=0)


def _sections(
    model: MechanicalModel, used: np.ndarray, along: np.ndarray, edges: np.ndarray, axis: np.ndarray
) -> _Sections:
    """Measure how the ends of the slices move under unit loads at the tip.

    Args:
        model: the body.
        used: its nodes, shape (n,).
        along: their places along the axis [m], shape (n,).
        edges: ends of the slices along the axis [m], shape (SLICES + 1,).
        axis: unit vector (3,).
    """
    nodes = model.nodes[used]
    near = np.argsort(np.abs(along - edges[1:, None]), axis=1)[:, :SECTION]
    last = near[-1]
    arms = nodes[last] - nodes[last].mean(axis=0)
    turned, moved = np.zeros((2, SLICES, 3, 4))
    # Forces of a rigid rotation's form add up to a pure moment.
    loads = [np.cross(np.linalg.solve(_inertia(arms), direction), arms) for direction in np.eye(3)]
    for column, load in enumerate([*loads, np.tile(axis / len(last), (len(last), 1))]):
        forces = np.zeros_like(model.nodes)
        forces[used[last]] = load
        scale = 1e-6  # first a guess, then ROTATION at the tip
        for _ in range(2):
            change = (_solve(model, scale * forces) - _solve(model, -scale * forces))[used] / (2.0 * scale)
            turned[:, :, column] = [_rotation(nodes[section], change[section]) for section in near]
            scale = ROTATION / float(np.abs(turned[:, :, column]).max())
        moved[:, :, column] = [change[section].mean(axis=0) for section in near]
    return _Sections(turned, moved, nodes[near].mean(axis=1))


def _joint(sections: _Sections, before: int, after: int, place: np.ndarray, axis: np.ndarray) -> Joint:
    """Return the joint with the relative motion of two sections."""
    (turned_0, moved_0), (turned_1, moved_1) = (sections.motion(number, place) for number in (before, after))
    turned, slid = turned_1 - turned_0, moved_1 - moved_0
    values, vectors = np.linalg.eigh(0.5 * (turned[:, :3] + turned[:, :3].T))
    vectors *= np.sign(np.linalg.det(vectors))
    # A body that turns by v d about a hinge through c moves the point p by v d x (p - c).
    axes = vectors.T
    centres = place + np.cross(axes, (slid[:, :3] @ vectors).T) / values[:, None]
    by_hinges = (axes @ turned[:, 3]) @ np.cross(axes, place - centres)
    return Joint(place, axes, centres, 1.0 / values, 1.0 / float(axis @ (slid[:, 3] - by_hinges)))


def _solve(model: MechanicalModel, forces: np.ndarray) -> np.ndarray:
    """Return the rows [m] of the equilibrium under dead forces [N] on the rows, with slack cables."""
    model.nodal_loads += forces
    try:
        return Statics(model).solve(np.zeros(model.roles[0][1]), "effort").x
    finally:
        model.nodal_loads -= forces


def _rotation(nodes: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return the small rotation (3,) that fits displacements [m] (n, 3) of nodes [m] (n, 3) best."""
    arms = nodes - nodes.mean(axis=0)
    return np.linalg.solve(_inertia(arms), np.cross(arms, moved).sum(axis=0))


def _inertia(arms: np.ndarray) -> np.ndarray:
    """Return the inertia (3, 3) of unit masses at arms (n, 3)."""
    return float((arms**2).sum()) * np.eye(3) - arms.T @ arms


def _link(model: MechanicalModel, base: np.ndarray, axis: np.ndarray, places: Sequence[float], number: int) -> Link:
    """Return the slice of the body between two joints as a rigid link: its elements, and its part of the surface."""
    block = model.solids[0]
    along = (model.nodes[block.corners].mean(axis=1) - base) @ axis
    mine = np.searchsorted(places, along, side="right") == number
    if not mine.any():
        raise ValueError(f"joints = {len(places)} is more than the mesh resolves: a link has no element")
    corners, masses = model.nodes[block.corners[mine]], block.density * block.volumes[mine]
    middles = corners.mean(axis=1)
    centre = masses @ middles / masses.sum()
    arms, middle = corners - centre, middles - centre
    # Second moment of a tetrahedron: m / 20 (sum of x x^T over its corners + 16 times that of its middle).
    moment = np.einsum("m,mki,mkj->ij", masses, arms, arms) + 16.0 * np.einsum("m,mi,mj->ij", masses, middle, middle)
    inertia = (np.trace(moment) * np.eye(3) - moment) / 20.0
    shown, triangles = np.unique(boundary_triangles(block.corners[mine]), return_inverse=True)
    return Link(float(masses.sum()), centre, inertia, model.nodes[shown], triangles.reshape(-1, 3))


def export_mjcf(
    robot: Robot,
    path: str | Path,
    design: Mapping[str, float] | None = None,
    *,
    joints: int = 9,
    damping: float = 0.01,
) -> Path:
    """Write a body as a chain of rigid links for MuJoCo, in metres; see `chain_of`.

    Its outermost ``<body>`` stands still and may be attached to any other. A motor ``NAME`` pulls each cable with the
    tension that it is given [N].

    Args:
        robot: the robot.
        path: ends with ``.xml``.
        design: the body; missing variables take their baseline.
        joints: number of joints.
        damping: of the joints over their stiffness [s].

    Raises:
        ValueError: for another ending, or as `chain_of` does.
    """
    path = Path(path)
    if path.suffix != ".xml":
        raise ValueError(f"'{path}' must end with .xml")
    text = _document(chain_of(robot, design, joints=joints), 10.0 * robot.effort_scale, damping)
    with atomic_write(path, "w") as stream:
        stream.write(text)
    return path


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.8g}" for value in np.asarray(values, dtype=float).ravel())


def _document(chain: Chain, largest: np.ndarray, damping: float) -> str:
    """Return the MJCF text of a chain whose cables are pulled by at most ``largest`` [N]."""
    name = chain.name
    origins = [np.zeros(3), *(joint.place for joint in chain.joints)]
    assets, bodies = [], []
    for number, (link, origin) in enumerate(zip(chain.links, origins, strict=True)):
        label = f"{name}_{number}"
        before = origins[number - 1] if number else np.zeros(3)
        bodies.append(f'<body name={quoteattr(label)} pos="{_numbers(origin - before)}">')
        inertia = link.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        pose = f'pos="{_numbers(link.centre - origin)}" mass="{link.mass:.8g}"'
        bodies.append(f'<inertial {pose} fullinertia="{_numbers(inertia)}"/>')
        if number:
            joint = chain.joints[number - 1]
            bodies.append(
                f'<joint name={quoteattr(f"{label}_slide")} type="slide" axis="{_numbers(chain.axis)}" '
                f'stiffness="{joint.axial:.8g}" damping="{damping * joint.axial:.8g}"/>'
            )
            hinges = zip(joint.axes, joint.centres - origin, joint.stiffness, strict=True)
            for axis, (direction, centre, stiffness) in enumerate(hinges):
                bodies.append(
                    f'<joint name={quoteattr(f"{label}_{axis}")} type="hinge" pos="{_numbers(centre)}" '
                    f'axis="{_numbers(direction)}" stiffness="{stiffness:.8g}" damping="{damping * stiffness:.8g}"/>'
                )
        faces = " ".join(map(str, link.triangles.ravel()))
        assets.append(f'<mesh name={quoteattr(label)} vertex="{_numbers(link.points - origin)}" face="{faces}"/>')
        # Links touch other objects, but not each other.
        bodies.append(f'<geom type="mesh" mesh={quoteattr(label)} rgba={SKIN} contype="0" conaffinity="1" mass="0"/>')
        for cable, (points, owners) in chain.cables.items():
            for index in np.flatnonzero(owners == number):
                site = f"{name}_{cable}_{index}"
                bodies.append(f'<site name={quoteattr(site)} pos="{_numbers(points[index] - origin)}" size="0.0005"/>')
        for effector, (point, owner) in chain.effectors.items():
            if owner == number:
                bodies.append(f'<site name={quoteattr(effector)} pos="{_numbers(point - origin)}" size="0.001"/>')
    bodies.extend("</body>" for _ in chain.links)
    tendons, motors = [], []
    for (cable, (points, _)), bound in zip(chain.cables.items(), largest, strict=True):
        sites = "".join(f"<site site={quoteattr(f'{name}_{cable}_{index}')}/>" for index in range(len(points)))
        tendons.append(f"<spatial name={quoteattr(cable)}>{sites}</spatial>")
        motors.append(
            f'<motor name={quoteattr(cable)} tendon={quoteattr(cable)} gear="-1" ctrlrange="0 {bound:.8g}" '
            'ctrllimited="true"/>'
        )

    def lines(rows: Sequence[str]) -> str:
        return "\n".join(f"    {row}" for row in rows)

    return f"""<mujoco model={quoteattr(name)}>
  <compiler angle="radian" inertiafromgeom="false"/>
  <asset>
{lines(assets)}
  </asset>
  <worldbody>
{lines(bodies)}
  </worldbody>
  <tendon>
{lines(tendons)}
  </tendon>
  <actuator>
{lines(motors)}
  </actuator>
</mujoco>
"""
