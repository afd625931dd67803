"""Contact of a model with obstacles, with itself, and between its parts."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, hstack

from softgym_envs.arguments import explained
from softgym_envs.mechanics.contact.obstacle_contact import ObstacleContact, Touch
from softgym_envs.mechanics.contact.obstacles import MeshObstacle, Obstacle
from softgym_envs.mechanics.contact.self_contact import SelfContact, SelfContactMemory
from softgym_envs.mechanics.contact.surface import Mapping, Surface, surface_set
from softgym_envs.mechanics.kinematics import Kinematics
from softgym_envs.quantities import check_quantity


@dataclass(frozen=True)
class Contacts:
    """Where a model touches at one state: one entry for each point of its surface that an obstacle presses on.

    Meshed obstacles have no entries, only a total force.

    Attributes:
        obstacles: names of the obstacles.
        obstacle: number of the obstacle, shape (k,).
        point: [m], shape (k, 3).
        gap: [m], shape (k,).
        force: on the model [N], shape (k, 3).
        pressing: normal forces [N], shape (k,).
        sliding: whether the friction force has reached its limit, shape (k,).
        self_force: sum of the normal forces between surfaces, of the model and of meshed obstacles [N].
        mesh_force: force of each meshed obstacle on the model [N], zero for others, shape (o, 3).
        smallest_gap: to any obstacle or between surfaces of the model [m]; inf beyond the distance of contact.
        number: of each point among those of the surface, shape (k,); None on learned chains.
    """

    obstacles: tuple[str, ...]
    obstacle: np.ndarray
    point: np.ndarray
    gap: np.ndarray
    force: np.ndarray
    pressing: np.ndarray
    sliding: np.ndarray
    self_force: float
    mesh_force: np.ndarray
    smallest_gap: float
    number: np.ndarray | None = None

    @property
    def count(self) -> int:
        """Number of points in contact with obstacles."""
        return len(self.gap)

    @property
    def total(self) -> np.ndarray:
        """Force of each obstacle on the model [N], shape (o, 3)."""
        out = self.mesh_force.copy()
        np.add.at(out, self.obstacle, self.force)
        return out


FAR = 5.0
"""Largest gap between a body and an obstacle, in lengths of the body; one that is farther away has another unit."""

SMALLEST_GAP = 1e-6
"""Smallest gap between surfaces at rest, over the distance of contact: less cannot be told from touching."""


class ContactMemory(NamedTuple):
    """What friction remembers.

    Attributes:
        anchors: of the friction springs for each obstacle [m], shape (p, 3), along the axes of its frame.
        surfaces: memory of the friction between surfaces of the model.
    """

    anchors: tuple[np.ndarray | None, ...]
    surfaces: SelfContactMemory | None


class ContactTerms(NamedTuple):
    """Contributions of contact to the equations, at one state.

    Attributes:
        gradient: derivative of the energy by the rows [N], shape (n, 3).
        tangent: its derivative by the equations, while limits of friction are held; shape (N, N), both halves.
        directions: derivatives of the stretch of sliding springs, shape (N, s).
        loading: derivatives of their limits, shape (N, s). The exact tangent adds ``directions loading^T``.
        limits: of the friction forces of the points of each obstacle [N], shape (p,); None without friction.
    """

    gradient: np.ndarray
    tangent: csr_matrix
    directions: csc_matrix
    loading: csc_matrix
    limits: tuple[np.ndarray | None, ...]


class ContactRow(NamedTuple):
    """The opening of the contact with one obstacle, as a row of a condensed model.

    Attributes:
        name: of the obstacle.
        opening: zero while the obstacle is pressed, else the smallest gap less the distance of contact [m].
        force: sum of the normal forces [N].
        gradient: derivative of the gap by the equations, shape (N,).
        compliance: of the barrier [m/N]; zero while open.
        coefficient: of friction.
        slips: derivatives of the motion along two directions of the surface, shape (N, 2).
        rubbing: friction forces on the body along them [N], shape (2,).
        yielding: compliance of the friction springs [m/N]; zero while open.
        free: whether the obstacle is an object that moves with a frame.
    """

    name: str
    opening: float
    force: float
    gradient: np.ndarray
    compliance: float
    coefficient: float
    slips: np.ndarray
    rubbing: np.ndarray
    yielding: float
    free: bool


@explained
@dataclass(frozen=True)
class ContactSettings:
    """Which surfaces of a body touch, and the law of contact.

    Attributes:
        self_contact: whether surfaces of the body touch each other.
        self_friction: coefficient of friction between them.
        distance: gap below which there are forces [m]. It must be smaller than the thinnest wall.
        stiffness: of the barrier [Pa], about the pressure at 0.8 of the distance. It is never adapted to the load.
            None: a tenth of the largest Young's modulus of the body.
        stick: stiffness of friction before sliding, per area [Pa/m]; None: 5 ``stiffness / distance``.

    Raises:
        ValueError: for a value that is not positive.
    """

    self_contact: bool = False
    self_friction: float = 0.0
    distance: float = 5e-4
    stiffness: float | None = None
    stick: float | None = None

    def __post_init__(self) -> None:
        for name, unit in (("distance", "m"), ("stiffness", "Pa"), ("stick", "Pa/m")):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} = {value} {unit} of contact must be positive and finite")
        check_quantity("contact_distance", self.distance, "distance of contact")
        if self.stiffness is not None:
            check_quantity("contact_stiffness", self.stiffness, "stiffness of contact")
        if not (np.isfinite(self.self_friction) and self.self_friction >= 0.0):
            raise ValueError(f"self_friction = {self.self_friction} must be finite and not negative")
        check_quantity("friction", self.self_friction, "self_friction")
        if self.self_friction and not self.self_contact:
            raise ValueError(f"self_friction = {self.self_friction} has no effect without self_contact=True")


class Contact:
    """What a model touches.

    Args:
        surface: of the model.
        obstacles: what the model touches, each with its coefficient of friction. With self-contact, an obstacle on a
            frame stands for the skin of that frame, which then touches no other surface.
        settings: self-contact and the law of contact, with a stiffness.

    Raises:
        ValueError: if the stiffness is missing, or if a skin has to touch a meshed obstacle itself, because an obstacle
            without a mesh stands for it in self-contact.
    """

    def __init__(
        self, surface: Surface, obstacles: Sequence[Obstacle | MeshObstacle], settings: ContactSettings
    ) -> None:
        if settings.stiffness is None:
            raise ValueError("contact needs a stiffness [Pa]")
        self.obstacles = tuple(obstacles)
        self.self_contact, self.self_friction = settings.self_contact, settings.self_friction
        self.distance, self.stiffness = settings.distance, settings.stiffness
        self.stick = 5.0 * self.stiffness / self.distance if settings.stick is None else settings.stick
        self.surface = surface
        frames = [each.frame for each in self.obstacles if each.frame is not None]
        self.surfaces = surface_set(surface, self.meshes, self.self_contact, frames)
        for each in self.obstacles if self.self_contact and self.meshes else ():
            if not isinstance(each, MeshObstacle) and not self.not_carried(each).all():
                raise ValueError(
                    f"obstacle '{each.name}' stands for the skin of its frame in self-contact and cannot touch meshed "
                    "obstacles: make it a MeshObstacle, or leave self-contact out"
                )

    def with_friction(self, friction: float) -> Contact:
        """Return this contact with another coefficient of friction of all obstacles."""
        made, own = copy.copy(self), self.surfaces
        made.obstacles = tuple(replace(each, friction=friction) for each in self.obstacles)
        made.surfaces = replace(own, friction=np.where(np.isnan(own.friction), np.nan, friction))
        return made

    @property
    def meshes(self) -> tuple[MeshObstacle, ...]:
        """The meshed obstacles."""
        return tuple(each for each in self.obstacles if isinstance(each, MeshObstacle))

    def check_near(self, nodes: np.ndarray) -> None:
        """Check the distances of contact and of obstacles against the size of the body, whose rest rows are (n, 3) [m].

        Raises:
            ValueError: for an obstacle far from the body, or a distance of contact that is large beside it.
        """
        points = self.surface.points[0] @ nodes
        if not len(points):
            return
        size = float(np.linalg.norm(np.ptp(points, axis=0)))
        example = f"a tenth of the body, which is {size:.3g} m long"
        check_quantity("contact_distance", self.distance, "distance of contact", high=0.1 * size, example=example)
        for obstacle in self.obstacles:
            if obstacle.frame is None:
                label = f"gap between the body and obstacle '{obstacle.name or obstacle.kind}'"
                gap = max(obstacle.distance_to(points), 0.0)
                check_quantity("length", gap, label, high=FAR * size, example=f"{FAR:g} times the body's length")

    def intersections(self, x: np.ndarray) -> str | None:
        """Return what crosses what at rows ``x`` (n, 3), or None."""
        for number, obstacle in enumerate(self.obstacles):
            if isinstance(obstacle, MeshObstacle):
                continue
            points = self.surface.points[0] @ x
            if obstacle.frame is not None:
                points = (points - x[obstacle.frame]) @ x[obstacle.frame + 1 : obstacle.frame + 4].T
            own = self.not_carried(obstacle)
            if not (obstacle.gap(points[own]) > 0.0).all():
                return f"the body is inside obstacle {obstacle.name or number + 1}"
        surfaces = self.between_surfaces(x)
        if surfaces is not None:
            places, other = self.surfaces.places(x), " or a meshed obstacle" if self.meshes else ""
            if surfaces.intersects(places):
                return f"surfaces of the body cross each other{other}"
            if (gap := surfaces.minimum_distance(places)) < SMALLEST_GAP * self.distance:
                return f"surfaces of the body touch each other{other} (gap {gap:.1g} m)"
        return None

    def not_carried(self, obstacle: Obstacle) -> np.ndarray:
        """Return which points of the surface can touch an obstacle: those that do not move with it, mask (p,)."""
        weights = self.surface.points[0]
        if obstacle.frame is None:
            return np.ones(weights.shape[0], dtype=bool)
        touches = weights[:, obstacle.frame : obstacle.frame + 4]
        return np.diff(touches.tocsr().indptr) == 0

    def between_surfaces(self, x: np.ndarray) -> SelfContact | None:
        """Return the contact between the surfaces of the model and meshed obstacles, or None if none touch.

        Args:
            x: rows (n, 3) at which meshed obstacles have their size, such as those at rest.
        """
        if not self.self_contact and not self.meshes:
            return None
        return SelfContact(
            self.surfaces.places(x),
            self.surfaces.triangles,
            distance=self.distance,
            stiffness=self.stiffness,
            friction=self.self_friction,
            groups=self.surfaces.groups,
            obstacle_friction=self.surfaces.friction,
        )


class ContactState:
    """Contact of one solver: forces, derivatives, and the memory of friction.

    Args:
        contact: what touches what.
        kinematics: degrees of freedom of the model.
        nodes: its rest rows [m], shape (n, 3).
    """

    def __init__(self, contact: Contact, kinematics: Kinematics, nodes: np.ndarray) -> None:
        self.contact = contact
        self._kinematics = kinematics
        self._shape = nodes.shape
        weights, area = contact.surface.points
        n = len(nodes)
        self.pairs = []
        for obstacle in contact.obstacles:
            if isinstance(obstacle, MeshObstacle):
                continue
            own = contact.not_carried(obstacle)
            frame = None
            if obstacle.frame is not None:
                rows = obstacle.frame + np.arange(4)
                frame = Mapping(csr_matrix((np.ones(4), (np.arange(4), rows)), shape=(4, n)), kinematics)
            self.pairs.append(
                ObstacleContact(
                    obstacle,
                    weights[own],
                    area[own],
                    Mapping(weights[own], kinematics),
                    frame,
                    distance=contact.distance,
                    stiffness=contact.stiffness,
                    stick=contact.stick,
                )
            )
        self._surfaces = contact.between_surfaces(nodes)
        self._vertices = Mapping(contact.surfaces.weights, kinematics)
        self._limits: tuple[np.ndarray | None, ...] = (None,) * len(self.pairs)
        self.begin(nodes)

    # -- memory -----------------------------------------------------------------------------------------------------

    @property
    def has_friction(self) -> bool:
        """Whether there is friction, so that forces depend on the path."""
        return any(each.friction > 0.0 for each in self.contact.obstacles) or self.contact.self_friction > 0.0

    def begin(self, x: np.ndarray) -> None:
        """Forget the past: all friction springs are relaxed at rows ``x`` (n, 3)."""
        self._anchors = list(self.relaxed(x))
        if self._surfaces is not None:
            self._surfaces.begin_increment(self._corners(x))

    def relaxed(self, x: np.ndarray) -> tuple[np.ndarray | None, ...]:
        """Return anchors of friction springs on obstacles without a stretch at rows ``x`` (n, 3)."""
        return tuple(pair.local(x) if pair.obstacle.friction > 0.0 else None for pair in self.pairs)

    @property
    def memory(self) -> ContactMemory:
        """What friction remembers; assign it to go back."""
        surfaces = self._surfaces.memory if self._surfaces is not None else None
        return ContactMemory(tuple(self._anchors), surfaces)

    @memory.setter
    def memory(self, kept: ContactMemory) -> None:
        self._anchors = list(kept.anchors)
        if self._surfaces is not None and kept.surfaces is not None:
            self._surfaces.memory = kept.surfaces

    def commit(self, x: np.ndarray) -> float:
        """Let springs that slid at the accepted rows ``x`` (n, 3) catch up; return the dissipated energy [J]."""
        dissipated = 0.0
        for number, pair in enumerate(self.pairs):
            anchors = self._anchors[number]
            if anchors is None:
                continue
            touch = pair.touch(x, anchors)
            new = pair.local(x)
            new[touch.points] -= touch.elastic
            slip = new[touch.points] - anchors[touch.points]
            dissipated -= float(np.vdot(touch.rubbing, slip))
            self._anchors[number] = new
        if self._surfaces is not None:
            self._surfaces.begin_increment(self._corners(x))
        return dissipated

    # -- energy and derivatives ---------------------------------------------------------------------------------------

    def _corners(self, x: np.ndarray) -> np.ndarray:
        return self.contact.surfaces.places(x)

    def energy(self, x: np.ndarray) -> float:
        """Return the potential [J] at rows ``x`` (n, 3), with the limits of friction that are held; see `hold`."""
        total = 0.0
        for pair, anchors, limits in zip(self.pairs, self._anchors, self._limits, strict=True):
            total += pair.energy(x, anchors, limits)
            if not np.isfinite(total):
                return np.inf
        return total if self._surfaces is None else total + self._surfaces.energy(self._corners(x))

    def hold(self, terms: ContactTerms) -> None:
        """Hold the limits of friction of a state in `energy`."""
        self._limits = terms.limits

    def stored_energy(self, x: np.ndarray) -> float:
        """Return the energy [J] stored in barriers and friction springs at accepted rows ``x`` (n, 3)."""
        total = 0.0
        for pair, anchors in zip(self.pairs, self._anchors, strict=True):
            touch = pair.touch(x, anchors)
            total += pair.energy(x, None, None) - 0.5 * float(np.vdot(touch.rubbing, touch.elastic))
        return total if self._surfaces is None else total + self._surfaces.energy(self._corners(x))

    def evaluate(self, x: np.ndarray, *, convex: bool = False) -> ContactTerms:
        """Return the terms of the equations at rows ``x`` (n, 3).

        Args:
            x: rows.
            convex: leave out what can make the tangent indefinite.
        """
        if self._kinematics.map is not None:
            self._kinematics.map.linearise(x)
        n = self._kinematics.equations
        gradient = np.zeros(self._shape)
        directions, loading = [csc_matrix((n, 0))], [csc_matrix((n, 0))]
        touches = [
            pair.touch(x, anchors, convex=convex) for pair, anchors in zip(self.pairs, self._anchors, strict=True)
        ]
        for pair, touch in zip(self.pairs, touches, strict=True):
            pair.add_to_rows(touch, gradient)
            if touch.sliding.any():
                directions.append(touch.columns(touch.direction, touch.sliding))
                loading.append(touch.columns(touch.loading, touch.sliding))
        return ContactTerms(
            gradient,
            self._tangent(x, touches, gradient, convex=convex),
            hstack(directions, format="csc"),
            hstack(loading, format="csc"),
            tuple(
                None if anchors is None else pair.limits(touch)
                for pair, anchors, touch in zip(self.pairs, self._anchors, touches, strict=True)
            ),
        )

    def forces_held(self, x: np.ndarray) -> csr_matrix:
        """Return the tangent (N, N) at rows ``x`` (n, 3) if the forces of obstacles did not change."""
        touches = [pair.touch(x, anchors, held=True) for pair, anchors in zip(self.pairs, self._anchors, strict=True)]
        return self._tangent(x, touches, np.zeros(self._shape))

    def _tangent(
        self, x: np.ndarray, touches: list[Touch], gradient: np.ndarray, *, convex: bool = False
    ) -> csr_matrix:
        """Return the tangent (N, N) of touched obstacles and surfaces; add the forces of the latter to ``gradient``."""
        n = self._kinematics.equations
        tangent = sum((touch.hessian() for touch in touches if len(touch.points)), start=csr_matrix((n, n)))
        if self._surfaces is not None:
            slope, curvature = self._surfaces.derivatives(self._corners(x), project=convex)
            if curvature.nnz:
                gradient += self.contact.surfaces.weights.T @ slope
                tangent = tangent + self._to_equations(curvature)
        return tangent.tocsr()

    def rows(
        self, x: np.ndarray, motions: np.ndarray, *, each_point: bool = False, friction: bool = False
    ) -> list[ContactRow]:
        """Return the openings: one for each obstacle, or for each point that presses.

        Args:
            x: rows (n, 3).
            motions: of the equations, shape (N, k); of an obstacle that nothing presses on, the point that they bring
                there first counts.
            each_point: see above.
            friction: an object that moves with a frame then has an opening for each point that presses on it, because
                together they hold it against turning.
        """
        found = []
        names = self._names()
        numbers = self._numbers(meshed=False)
        for name, pair, anchors in zip([names[k] for k in numbers], self.pairs, self._anchors, strict=True):
            touch = pair.touch(x, anchors)
            free = pair.obstacle.frame is not None
            several = each_point or (friction and free)
            loaded, opening = bool(touch.pressing.any()), 0.0
            if loaded and not several:
                shares = [touch.pressing / touch.pressing.sum()]
            elif loaded:
                shares = list(np.eye(len(touch.points))[touch.pressing > 0.0])
            elif not each_point:
                nearest, gap = pair.next_point(x, motions)
                touch = pair.touch(x, None, points=np.array([nearest]))
                opening, shares = gap - self.contact.distance, [np.ones(1)]
            else:
                shares = []
            moved = touch.jacobian @ motions if friction else motions[:0]
            for number, share in enumerate(shares):
                used = share > 0.0
                slips, rubbing = np.empty((touch.jacobian.shape[1], 0)), np.empty(0)
                if friction:
                    slips, rubbing = _along_surface(pair, x, touch, share, moved)
                found.append(
                    ContactRow(
                        f"{name} point {number + 1}" if several and loaded else name,
                        opening,
                        float(touch.pressing[used].sum()) if loaded else 0.0,
                        touch.jacobian.T @ (share[:, None] * touch.gaps).ravel(),
                        float((share[used] ** 2 / touch.stiffness[used]).sum()) if loaded else 0.0,
                        pair.obstacle.friction,
                        slips,
                        rubbing,
                        float((share[used] ** 2 / pair.stick[touch.points[used]]).sum()) if loaded else 0.0,
                        free,
                    )
                )
        return found

    def _names(self) -> tuple[str, ...]:
        return tuple(each.name or f"obstacle {k + 1}" for k, each in enumerate(self.contact.obstacles))

    def _numbers(self, meshed: bool) -> np.ndarray:
        """Numbers, among all obstacles, of those that are or are not meshed."""
        return np.flatnonzero([isinstance(each, MeshObstacle) == meshed for each in self.contact.obstacles])

    def _to_equations(self, curvature: csr_matrix) -> csr_matrix:
        """Return the tangent (N, N) of a tangent over the components of the vertices (3 v, 3 v)."""
        entries = coo_matrix(curvature)
        touched = np.zeros(curvature.shape[0] // 3, dtype=bool)
        touched[entries.row // 3] = touched[entries.col // 3] = True
        used = np.flatnonzero(touched)
        places = np.full(len(touched), -1)
        places[used] = np.arange(len(used))
        row, col = (3 * places[index // 3] + index % 3 for index in (entries.row, entries.col))
        small = csr_matrix((entries.data, (row, col)), shape=(3 * len(used), 3 * len(used)))
        jacobian = self._vertices.jacobian(used)
        return (jacobian.T @ (small @ jacobian)).tocsr()

    # -- motion -------------------------------------------------------------------------------------------------------

    def free_path(self, start: np.ndarray, end: np.ndarray) -> float:
        """Return the part, in (0, 1], of the straight way between rows (n, 3) on which nothing collides."""
        part = min((pair.free_path(start, end) for pair in self.pairs), default=1.0)
        if self._surfaces is not None:
            part = min(part, self._surfaces.max_step(self._corners(start), self._corners(end)))
        return part

    def contacts(self, x: np.ndarray) -> Contacts:
        """Return where the model touches at rows ``x`` (n, 3)."""
        touches = [pair.touch(x, anchors) for pair, anchors in zip(self.pairs, self._anchors, strict=True)]
        return self._record(x, touches)

    def _record(self, x: np.ndarray, touches: list[Touch]) -> Contacts:
        places = [pair.weights[touch.points] @ x for pair, touch in zip(self.pairs, touches, strict=True)]
        smallest = min((float(touch.gap.min(initial=np.inf)) for touch in touches), default=np.inf)
        self_force, mesh_force = 0.0, np.zeros((len(self.contact.obstacles), 3))
        if self._surfaces is not None:
            corners = self._corners(x)
            smallest = min(smallest, self._surfaces.minimum_distance(corners))
            forces, owner = self._surfaces.forces(corners), self.contact.surfaces.owner
            self_force = 0.5 * float(np.linalg.norm(forces, axis=1).sum())
            for mesh, number in enumerate(self._numbers(meshed=True)):
                mesh_force[number] = -forces[owner == mesh].sum(axis=0)

        def joined(parts: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
            return np.concatenate([np.empty((0, *shape)), *parts])

        return Contacts(
            obstacles=self._names(),
            obstacle=np.repeat(self._numbers(meshed=False), [len(touch.points) for touch in touches]),
            point=joined(places, (3,)),
            gap=joined([touch.gap for touch in touches], ()),
            force=joined([touch.force for touch in touches], (3,)),
            pressing=joined([touch.pressing for touch in touches], ()),
            sliding=joined([touch.sliding for touch in touches], ()).astype(bool),
            self_force=self_force,
            mesh_force=mesh_force,
            smallest_gap=smallest,
            number=joined([touch.points for touch in touches], ()).astype(np.int64),
        )


def _along_surface(
    pair: ObstacleContact, x: np.ndarray, touch: Touch, share: np.ndarray, moved: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the motion along two directions of the surface (N, 2), and the friction forces along them [N] (2,).

    The first is that of the friction force or, without any, that in which the actuators move the points most.

    Args:
        pair: model and obstacle.
        x: rows (n, 3).
        touch: points near it.
        share: of the points in the row, shape (k,).
        moved: motions of points and frame by the actuators, shape (m k, n_a).
    """
    used = np.flatnonzero(share > 0.0)
    force = touch.rubbing[used].sum(axis=0)
    if not force.any():
        frames = np.stack([pair.along(x, touch, np.tile(axis, (len(share), 1))) for axis in np.eye(3)])
        motions = np.einsum("k,aki,kin->an", share, frames, moved.reshape(*touch.gaps.shape, -1))
        mean = share @ touch.normal
        across = motions - np.outer(mean, mean @ motions) / (mean @ mean)
        vectors, sizes, _ = np.linalg.svd(across, full_matrices=False)
        force = vectors[:, 0] if len(sizes) and sizes[0] > 0.0 else np.zeros(3)
    # Where actuators move nothing along the surface, any direction serves.
    normal = touch.normal
    for start in (force, *np.eye(3)):
        first = start - (normal @ start)[:, None] * normal
        length = np.linalg.norm(first, axis=1)
        if (length[used] > 1e-3 * max(float(np.linalg.norm(start)), 1e-300)).all():
            break
    first = first / np.where(length > 0.0, length, 1.0)[:, None]
    slips, rubbing = [], []
    for axes in (first, np.cross(normal, first)):
        derivative = share[:, None] * pair.along(x, touch, axes)
        slips.append(touch.jacobian.T @ derivative.ravel())
        rubbing.append(float((touch.rubbing[used] * axes[used]).sum()))
    return np.column_stack(slips), np.array(rubbing)
