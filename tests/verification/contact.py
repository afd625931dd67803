"""Contact compared with exact solutions.

``python -m tests.verification contact`` computes all cases; studies/validation lists them. Every case is a function
that returns rows; the tests run them on coarse meshes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.skins import box_skin, tube_skin
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.contact.contact import Contacts, ContactSettings
from softgym_envs.mechanics.contact.obstacles import Cylinder, Plane, Sphere
from softgym_envs.mechanics.elements.rigid import box_inertia
from softgym_envs.mechanics.gmsh_process import set_options
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.complementarity import solve_complementarity
from softgym_envs.mechanics.solvers.dynamics import Dynamics
from softgym_envs.mechanics.solvers.statics import Statics
from tests.helpers import box_mesh
from tests.verification.rows import CheckedRow as Row
from tests.verification.rows import as_results

GRAVITY = 9.81
UP = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Rotation of a beam along z."""


# -- Hertz ------------------------------------------------------------------------------------------------------------


def graded_block(
    size: float, finest: float, growth: float, *, radius: float = 1.2, half: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh below z = 0 whose cells grow with the distance from the origin.

    Args:
        size: of the block; it reaches from x = 0 (``half``: ``-size``), y = 0 and z = ``-size``.
        finest: size of the cells within the radius.
        growth: of their size per distance beyond it.
        radius: where the growth begins.
        half: whether the block reaches to both sides of x = 0.
    """
    import gmsh

    gmsh.initialize(interruptible=False)
    try:
        set_options(gmsh, size)
        gmsh.option.setNumber("Mesh.MeshSizeMin", 0.0)
        gmsh.model.add("block")
        gmsh.model.occ.addBox(-size if half else 0.0, 0.0, -size, 2.0 * size if half else size, size, size)
        gmsh.model.occ.synchronize()
        gmsh.model.mesh.field.add("MathEval", 1)
        gmsh.model.mesh.field.setString(1, "F", f"{finest} + {growth} * Max(0, Sqrt(x*x + y*y + z*z) - {radius})")
        gmsh.model.mesh.field.setAsBackgroundMesh(1)
        gmsh.model.mesh.generate(3)
        tags, places, _ = gmsh.model.mesh.getNodes()
        corners = gmsh.model.mesh.getElementsByType(4)[1]
    finally:
        gmsh.finalize()
    rank = np.empty(int(tags.max()) + 1, dtype=np.int64)
    rank[tags.astype(np.int64)] = np.arange(len(tags))
    used, tetrahedra = np.unique(rank[corners.astype(np.int64)], return_inverse=True)
    return places.reshape(-1, 3)[used], tetrahedra.reshape(-1, 4)


class Indentation:
    """A rigid sphere of radius 1 pressed into an elastic half-space with E = 1.

    The sphere sits on a frame that a weak beam guides; it moves along z and, in half a block, along x. The half-space
    ends at 250 contact radii. The contact radius, a hundredth of the sphere's, keeps strains small.

    Args:
        element: kind of the solid elements.
        finest: size of the cells at the contact, relative to the contact radius.
        growth: see `graded_block`.
        poisson_ratio: of the half-space.
        friction: of the sphere.
        half: compute one half instead of one quarter, which allows tangential motion.
    """

    radius = 0.01
    depth = radius**2
    distance = 0.02 * depth

    def __init__(
        self,
        element: str,
        finest: float,
        growth: float = 0.25,
        *,
        poisson_ratio: float = 0.3,
        friction: float = 0.0,
        half: bool = False,
    ) -> None:
        size = 250.0
        nodes, tetrahedra = graded_block(size, finest, growth, half=half)
        far = np.isclose(np.abs(nodes), size).any(axis=1)
        plane = np.isclose(nodes[:, :2], 0.0, atol=1e-9)
        if half:
            plane[:, 0] = False
        fixed = np.column_stack([plane, np.zeros(len(nodes), dtype=bool)]) | far[:, None]
        builder = ModelBuilder()
        builder.add_solid(
            self.radius * nodes,
            tetrahedra,
            fixed=fixed,
            element=element,
            young_modulus=1.0,
            poisson_ratio=poisson_ratio,
        )
        self.height = 1.0 + self.distance
        frame = builder.add_frame((0, 0, self.height), UP, fixed=(not half, True, False), fixed_spin=True)
        end = builder.add_frame((0, 0, self.height + 0.5), UP, fixed=True, fixed_spin=True)
        builder.add_element(Beam, [frame, end], order=1, section=Section.circle(1e-4), young_modulus=1.0)
        self.model = builder.build()
        self.model.add("a", Point("sphere", EmbeddedPoints.in_frame(frame, np.zeros(3), self.model.nodes)))
        self.model.set_contact(
            obstacles=[Sphere((0.0, 0.0, 0.0), 1.0, frame=frame, friction=friction)],
            settings=ContactSettings(distance=self.distance, stiffness=0.01),
        )
        self.solver = Statics(self.model, tolerance=1e-9, max_iterations=60)
        self.share = 2.0 if half else 4.0

    def press(self, depth: float, slip: float | None = None) -> Contacts:
        """Move the sphere down to a depth, and sideways by a slip; without one no force acts sideways."""
        sideways = "effort" if slip is None else "displacement"
        target = [slip or 0.0, 0.0, self.height - depth]
        contacts = self.solver.solve(target, [sideways, "effort", "displacement"]).contacts
        assert contacts is not None
        return contacts

    @property
    def level(self) -> str:
        """The mesh in words."""
        return f"{len(self.model.nodes)} nodes"


def contact_radius(contacts: Contacts, forces: np.ndarray | None = None) -> float:
    """Radius of the Hertzian pressure with the same second moment as normal or other forces (k,) of the points.

    2/5 a^2 = sum(f r^2) / sum(f).
    """
    if forces is None:
        forces = contacts.pressing
    square = np.einsum("ki,ki->k", contacts.point[:, :2], contacts.point[:, :2])
    return float(np.sqrt(2.5 * (forces @ square) / forces.sum()))


HERTZ = (("linear", 0.15, 0.15), ("quadratic", 0.25, 0.25))


def hertz(meshes: Sequence[tuple[str, float, float]] = HERTZ) -> list[Row]:
    """Force and contact radius of a rigid sphere on a half-space: F = 4/3 E* sqrt(R) d^1.5, a^2 = R d."""
    rows = []
    for element, finest, growth in meshes:
        indentation = Indentation(element, finest, growth)
        depth = indentation.depth
        contacts = indentation.press(depth)
        force, exact = -indentation.share * contacts.total[0, 2], 4.0 / 3.0 / (1.0 - 0.3**2) * depth**1.5
        radius, exact_radius = contact_radius(contacts), indentation.radius
        setting = f"{element}, {indentation.level}"
        tolerance = 0.08 if element == "linear" else 0.02
        rows.append(Row("Hertz: force", setting, force, exact, force / exact - 1.0, tolerance))
        rows.append(Row("Hertz: contact radius", setting, radius, exact_radius, radius / exact_radius - 1.0, 0.05))
    return rows


def cattaneo_mindlin(
    finest: float = 0.25,
    growth: float = 0.35,
    loads: Sequence[float] = (0.2, 0.4, 0.6, 0.8),
    tolerances: tuple[float, float] = (0.03, 0.08),
) -> list[Row]:
    """A sphere pressed on a half-space and then moved sideways; friction 0.5.

    Displacement 3 mu P / (16 a G*) (1 - (1 - Q / (mu P))^(2/3)) with 1 / G* = (2 - nu) / G, and radius of the area that
    sticks c = a (1 - Q / (mu P))^(1/3) (Johnson, Contact Mechanics, sec. 7.2). The theory needs equal or incompressible
    bodies: nu is 0.49. Both are compared at the computed P and Q. Values: displacement over that at which the whole
    area slides, and c / a, by the second moment of what the friction is below its limit: that is Hertzian, too.

    Args:
        finest: see `Indentation`.
        growth: see `graded_block`.
        loads: steps, as parts of the force mu P.
        tolerances: of the displacement, relative, and of c / a, absolute.
    """
    friction, nu = 0.5, 0.49
    indentation = Indentation("quadratic", finest, growth, poisson_ratio=nu, friction=friction, half=True)
    contacts = indentation.press(indentation.depth)
    a = contact_radius(contacts)
    stiffness = 8.0 * a / (2.0 * (1.0 + nu) * (2.0 - nu))  # 8 a G*
    rows = []
    for load in loads:
        limit = -friction * indentation.share * contacts.total[0, 2]
        whole = 1.5 * limit / stiffness
        slip = whole * (1.0 - (1.0 - load) ** (2.0 / 3.0))
        contacts = indentation.press(indentation.depth, slip)
        limit = -friction * indentation.share * contacts.total[0, 2]
        part = indentation.share * contacts.total[0, 0] / limit
        exact = 1.0 - (1.0 - part) ** (2.0 / 3.0)
        value = slip / (1.5 * limit / stiffness)
        setting = f"quadratic, {indentation.level}, Q = {load:g} mu P"
        rows.append(Row("Cattaneo-Mindlin: displacement", setting, value, exact, value / exact - 1.0, tolerances[0]))
        held = friction * contacts.pressing - contacts.force[:, 0]
        radius = contact_radius(contacts, held) / a
        stick = (1.0 - part) ** (1.0 / 3.0)
        rows.append(Row("Cattaneo-Mindlin: c / a", setting, radius, stick, radius - stick, tolerances[1]))
    return rows


# -- patch test -------------------------------------------------------------------------------------------------------


def _strains(model: MechanicalModel, x: np.ndarray) -> np.ndarray:
    """Strains along z of all linear tetrahedra, shape (m,)."""
    corners = np.concatenate([block.corners for block in model.solids])
    rest, now = (np.diff(places[corners], axis=1) for places in (model.nodes, x))
    return (np.linalg.solve(rest, now) - np.eye(3))[:, 2, 2]


def patch(distances: Sequence[float] = (1e-4,), pressure: float = 1e4) -> list[Row]:
    """Strain of blocks under a uniform pressure that contact passes on, between unlike meshes and to a plane.

    Errors: root mean square and largest difference from ``pressure / E``, relative to it.
    """
    young, size = 1e6, (0.02, 0.02, 0.01)
    rows = []
    for distance in distances:
        for between in (True, False):
            builder = ModelBuilder(floating=True)
            height, start = 0.9 * distance, 0
            for cells, bottom in (((5, 5, 3), True), ((4, 4, 3), False))[0 if between else 1 :]:
                nodes, tetrahedra = box_mesh(size, cells)
                fixed = np.isclose(nodes, 0.0, atol=1e-9)
                fixed[:, 2] &= bottom
                nodes = nodes + [0.0, 0.0, size[2] + height if between and not bottom else 0.0 if between else height]
                start = builder.add_solid(
                    nodes, tetrahedra, fixed=fixed, young_modulus=young, poisson_ratio=0.3, element="linear"
                )
            model = builder.build()
            top = model.nodes[start:, 2].max()
            corners = model.solids[-1].corners
            faces = corners[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
            faces = faces[(model.nodes[faces, 2] > top - 1e-9).all(axis=1)]
            np.add.at(model.nodal_loads[:, 2], faces, -pressure * size[0] * size[1] / len(faces) / 3.0)
            obstacles = [] if between else [Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))]
            model.set_contact(
                obstacles=obstacles, settings=ContactSettings(self_contact=between, distance=distance, stiffness=young)
            )
            found = Statics(model, tolerance=1e-11, max_iterations=60).solve([])
            ratio = -_strains(model, found.x) * young / pressure
            case = f"patch test, {'two meshes' if between else 'plane'}"
            setting = f"distance {1e3 * distance:g} mm"
            spread, worst = float(np.sqrt(np.mean((ratio - 1.0) ** 2))), float(np.abs(ratio - 1.0).max())
            rows.append(Row(f"{case}: rms", setting, spread, 0.0, spread, 0.015))
            rows.append(Row(f"{case}: worst", setting, worst, 0.0, worst, 0.04))
    return rows


# -- limit of a hard contact ------------------------------------------------------------------------------------------

CANTILEVER = (0.06, 0.01, 0.01)
PLANE_BELOW = -0.003


def _cantilever(cells: tuple[int, int, int]) -> MechanicalModel:
    nodes, tetrahedra = box_mesh(CANTILEVER, cells)
    builder = ModelBuilder()
    builder.add_solid(
        nodes, tetrahedra, fixed=nodes[:, 0] == 0.0, young_modulus=1e5, poisson_ratio=0.3, element="linear"
    )
    model = builder.build()
    model.add_effector("tip", (CANTILEVER[0], 0.5 * CANTILEVER[1], CANTILEVER[2]))
    return model


def hard_contact_force(cells: tuple[int, int, int], load: float) -> float:
    """Force [N] of a hard plane on nodes, by complementarity on the condensed model until nothing changes."""
    model = _cantilever(cells)
    below = (model.nodes[:, 2] == 0.0) & (model.nodes[:, 0] > 0.6 * CANTILEVER[0])
    for node in np.flatnonzero(below):
        model.add("c", Point(f"node {node}", model.embed(model.nodes[node])))
    solver = Statics(model, tolerance=1e-11)
    force = np.zeros(int(below.sum()))
    for _ in range(30):
        loads = np.zeros((len(force), 3))
        loads[:, 2] = force
        found = solver.solve([], effector_force=[0.0, 0.0, load], contact=loads.ravel())
        W = found.condensed.W.cc[2::3, 2::3]
        gap = found.condensed.delta.c[2::3] - PLANE_BELOW
        new = solve_complementarity(W[None], (gap - W @ force)[None], np.ones(len(force), dtype=bool))[0]
        change = float(np.abs(new - force).max())
        force = new
        if change < 1e-9:
            return float(force.sum())
    raise ConvergenceError("the hard contact does not settle", fraction=0.0)


def signorini(
    distances: Sequence[float] = (2e-4, 1e-4, 5e-5), cells: tuple[int, int, int] = (12, 2, 2), load: float = -0.04
) -> list[Row]:
    """Force of a plane on a bent cantilever against a hard contact; the tolerance holds at 0.05 mm."""
    exact = hard_contact_force(cells, load)
    rows = []
    for distance in distances:
        model = _cantilever(cells)
        plane = Plane((0.0, 0.0, PLANE_BELOW), (0.0, 0.0, 1.0))
        model.set_contact(obstacles=[plane], settings=ContactSettings(distance=distance))
        found = Statics(model, max_iterations=60).solve([], effector_force=[0.0, 0.0, load])
        assert found.contacts is not None
        force = float(found.contacts.total[0, 2])
        setting = f"distance {1e3 * distance:g} mm"
        rows.append(
            Row("hard contact: force", setting, force, exact, force / exact - 1.0, 0.005 * max(1.0, distance / 5e-5))
        )
    return rows


# -- beam on a cylinder -----------------------------------------------------------------------------------------------


def beam_on_cylinder(loads: Sequence[float] = (0.02, 0.04), elements: int = 10, order: int = 2) -> list[Row]:
    """A cantilever whose tip is loaded and that rests on a cylinder at 0.6 of its length, after closing a gap.

    Small deflections (Euler-Bernoulli): the force R at s fulfils P s^2 (3 L - s) / 6 - R s^3 / 3 = E I times the gap.
    """
    length, width, young, at, clearance = 0.2, 4e-3, 1e9, 0.6, 5e-4
    section = Section.rectangle(width, width)
    rows = []
    for load in loads:
        builder = ModelBuilder()
        places = np.linspace(0.0, length, order * elements + 1)
        frames = [builder.add_frame((x, 0, 0), fixed=x == 0.0, fixed_spin=x == 0.0) for x in places]
        builder.add_element(Beam, frames, section=section, order=order, young_modulus=young, poisson_ratio=0.0)
        model = builder.build()
        outline = 0.5 * width * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        model.skins.append(tube_skin(model.blocks[0], model.nodes, outline))  # type: ignore[arg-type]
        model.add("e", Point("tip", EmbeddedPoints.in_frame(frames[-1], np.zeros(3), model.nodes)))
        radius = 0.02
        centre = (at * length, 0.0, -0.5 * width - clearance - radius)
        cylinder = Cylinder(centre, (0.0, 1.0, 0.0), radius)
        model.set_contact(obstacles=[cylinder], settings=ContactSettings(distance=1e-5, stiffness=1e6))
        found = Statics(model, max_iterations=60).solve([], effector_force=[0.0, 0.0, -load])
        assert found.contacts is not None
        force, s = float(found.contacts.total[0, 2]), at * length
        exact = 3.0 / s**3 * (load * s**2 * (3.0 * length - s) / 6.0 - young * section.inertia[0] * clearance)
        setting = f"{elements} elements of order {order}, P = {1e3 * load:g} mN"
        rows.append(Row("beam on a cylinder: force", setting, force, exact, force / exact - 1.0, 0.02))
    return rows


# -- blocks on an incline ---------------------------------------------------------------------------------------------


def block_on_incline(
    degrees: float,
    *,
    friction: float = 0.5,
    size: tuple[float, float, float] = (0.02, 0.02, 0.01),
    rigid: bool = True,
    cells: tuple[int, int, int] = (4, 4, 2),
    distance: float = 1e-4,
    stiffness: float = 1e5,
) -> MechanicalModel:
    """Return a block on a plane, whose axes are those of the plane; gravity is turned."""
    angle = np.radians(degrees)
    builder = ModelBuilder(floating=True, gravity=(GRAVITY * np.sin(angle), 0.0, -GRAVITY * np.cos(angle)))
    half = 0.5 * np.array(size)
    centre = half + [0.0, 0.0, 0.95 * distance]
    if rigid:
        frame = builder.add_frame(centre)
        builder.add_mass(frame, 0.0044, box_inertia(0.0044, half))
        model = builder.build()
        model.skins.append(box_skin(frame, half.tolist(), model.nodes))
        model.add("e", Point("centre", EmbeddedPoints.in_frame(frame, np.zeros(3), model.nodes)))
    else:
        nodes, tetrahedra = box_mesh(size, cells)
        nodes = nodes + [0.0, 0.0, 0.95 * distance]
        builder.add_solid(
            nodes, tetrahedra, fixed=np.zeros(len(nodes), bool), young_modulus=1e6, poisson_ratio=0.3, element="linear"
        )
        model = builder.build()
        model.add("e", Point("centre", model.embed(centre)))
    plane = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), friction=friction)
    model.set_contact(obstacles=[plane], settings=ContactSettings(distance=distance, stiffness=stiffness))
    return model


def _holds(degrees: float, **options) -> bool:
    try:
        Statics(block_on_incline(degrees, **options), max_iterations=40).solve([])
    except ConvergenceError:
        return False
    return True


INCLINES = {
    "slides, soft block": 0.5,
    "slides, rigid block": 0.5,
    "tips over, rigid block": 0.4,
}
"""Tangents of critical angles."""


def incline(width: float = 0.05, chosen: Sequence[str] = tuple(INCLINES)) -> list[Row]:
    """Angles at which blocks begin to slide, tan = mu, and tip over, tan = b / h.

    Args:
        width: of the interval [degrees] in which an angle is found by bisection.
        chosen: of `INCLINES`.
    """
    rows = []
    for case in chosen:
        options: dict[str, Any] = {"rigid": "rigid" in case}
        if "tips" in case:
            options |= {"size": (0.008, 0.02, 0.02), "friction": 0.8, "distance": 1e-5}
        tolerance = 0.01 if "tips" in case else 0.003
        exact = float(np.degrees(np.arctan(INCLINES[case])))
        low, high = exact - 0.6, exact + 0.6
        if not _holds(low, **options) or _holds(high, **options):
            rows.append(Row(f"incline: {case}", f"{low:g} to {high:g} degrees", np.nan, exact, np.nan, tolerance))
            continue
        while high - low > width:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if _holds(middle, **options) else (low, middle)
        value = 0.5 * (low + high)
        rows.append(Row(f"incline: {case}", f"within {width:g} degrees", value, exact, value / exact - 1.0, tolerance))
    return rows


# -- motion -----------------------------------------------------------------------------------------------------------


def sliding(step: float = 1e-3, steps: int = 60) -> list[Row]:
    """Acceleration of a block that slides down 35 degrees: g (sin - mu cos)."""
    degrees = 35.0
    solver = Dynamics(block_on_incline(degrees), step=step)
    speeds = []
    for _ in range(steps):
        solver.advance([])
        speeds.append(solver.effector_velocity()[0])
    value = float(speeds[-1] - speeds[steps // 2 - 1]) / (step * (steps - steps // 2))
    exact = GRAVITY * float(np.sin(np.radians(degrees)) - 0.5 * np.cos(np.radians(degrees)))
    return [Row("sliding block: acceleration", f"{1e3 * step:g} ms", value, exact, value / exact - 1.0, 1e-4)]


def bouncing(steps: Sequence[float] = (2e-4, 1e-4, 5e-5)) -> list[Row]:
    """Part of its energy that a block loses when it bounces without friction: of the order of the step."""
    rows = []
    for h in steps:
        model = block_on_incline(0.0, friction=0.0, distance=2e-3, stiffness=2e3)
        solver = Dynamics(model, step=h)
        velocity = np.zeros(model.equations)
        velocity[2] = -0.3
        solver.launch(velocity)
        start = sum(solver.energies())
        for _ in range(round(0.04 / h)):
            motion = solver.advance([])
        lost = float((start - motion.energy) / (0.5 * model.mass * 0.3**2))
        rows.append(Row("bouncing block: lost energy", f"{1e3 * h:g} ms", lost, 0.0, lost, 3e3 * h))
    return rows


def collision(step: float = 2e-4, steps: int = 60) -> list[Row]:
    """Two blocks that meet in free flight, off their centres: the momentum stays, to the tolerance of the solver.

    Values: change of the total momentum over that of one block; largest gain of energy in a step over the energy.
    """
    builder = ModelBuilder(floating=True)
    starts = []
    for shift in ((0.0, 0.0, 0.0), (0.0021, 0.0033, 0.0106)):
        nodes, tetrahedra = box_mesh((0.01, 0.01, 0.01), (2, 2, 2), jitter=0.1)
        fixed = np.zeros(len(nodes), dtype=bool)
        starts.append(
            builder.add_solid(
                nodes + shift, tetrahedra, fixed=fixed, young_modulus=1e5, poisson_ratio=0.3, element="linear"
            )
        )
    model = builder.build()
    model.set_contact(settings=ContactSettings(self_contact=True, distance=5e-4))
    solver = Dynamics(model, step=step)
    velocity = np.zeros_like(model.nodes)
    velocity[: starts[1], 2], velocity[starts[1] :, 2] = 0.3, -0.2
    solver.launch(velocity.ravel())
    mass = model.assembly.mass_matrix().rows
    first = mass @ velocity
    start, touched = sum(solver.energies()), 0.0
    energies = [start]
    for _ in range(steps):
        motion = solver.advance([])
        assert motion.equilibrium.contacts is not None
        touched = max(touched, motion.equilibrium.contacts.self_force)
        energies.append(motion.energy)
    if touched == 0.0:
        raise ConvergenceError("the blocks did not meet", fraction=0.0)
    scale = float(first[: starts[1], 2].sum())
    drift = float(np.abs((mass @ motion.velocity - first).sum(axis=0)).max()) / scale
    gained = float(max(0.0, np.diff(energies).max())) / start
    setting = f"{1e3 * step:g} ms"
    return [
        Row("collision of soft blocks: drift of momentum", setting, drift, 0.0, drift, 1e-8),
        Row("collision of soft blocks: energy gained in a step", setting, gained, 0.0, gained, 1e-8),
    ]


def creep(increments: int = 20, degrees: float = 15.0, friction: float = 0.5) -> list[Row]:
    """A block that sticks to another one on an incline creeps, because friction between surfaces has no memory.

    The force of the friction grows with the slip y in an increment as mu N (2 y / e - (y / e)^2), where e is the
    smoothing distance of 0.01 mm: so it creeps by e (1 - sqrt(1 - tan / mu)) in each increment. Value: creep [m] per
    increment.
    """
    smoothing = 1e-5
    angle = np.radians(degrees)
    builder = ModelBuilder(floating=True, gravity=(GRAVITY * np.sin(angle), 0.0, -GRAVITY * np.cos(angle)))
    for size, cells, shift in (
        ((0.02, 0.02, 0.005), (4, 4, 1), (0.0, 0.0, 0.0)),
        ((0.01, 0.01, 0.005), (3, 3, 2), (0.004, 0.0051, 0.005 + 2.5e-4)),
    ):
        nodes, tetrahedra = box_mesh(size, cells)
        fixed = (nodes[:, 2] < 1e-9) & (shift[2] == 0.0)
        builder.add_solid(
            nodes + shift, tetrahedra, fixed=fixed, young_modulus=1e6, poisson_ratio=0.3, element="linear"
        )
    model = builder.build()
    model.add("e", Point("top", model.embed(np.array([0.009, 0.01, 0.008]), block=1)))
    model.set_contact(settings=ContactSettings(self_contact=True, self_friction=friction, distance=3e-4, stiffness=1e4))
    solver = Statics(model, tolerance=1e-12, max_iterations=60)
    places = [float(solver.solve([]).delta[0]) for _ in range(increments)]
    value = (places[-1] - places[increments // 2]) / (increments - 1 - increments // 2)
    exact = smoothing * float(1.0 - np.sqrt(1.0 - np.tan(angle) / friction))
    setting = f"{degrees:g} degrees, mu {friction:g}"
    return [Row("friction between surfaces: creep", setting, value, exact, value / exact - 1.0, 0.05)]


# -- all cases --------------------------------------------------------------------------------------------------------

CASES: dict[str, Callable[[], list[Row]]] = {
    "hertz": hertz,
    "cattaneo_mindlin": cattaneo_mindlin,
    "patch": patch,
    "signorini": signorini,
    "beam_on_cylinder": beam_on_cylinder,
    "incline": incline,
    "sliding": sliding,
    "bouncing": bouncing,
    "collision": collision,
    "creep": creep,
}
"""Registry of cases."""


def contact() -> dict[str, object]:
    """Contact against exact solutions, with tolerances."""
    rows = [row for case in CASES.values() for row in case()]
    return as_results(rows, "case", "setting")
