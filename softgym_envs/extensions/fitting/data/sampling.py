"""Sampling of FEM states: designs and commands are drawn together, and the states of one design are solved as a path.

The condensed model is a smooth function of the *reached* actuator displacements, whether cables pull or push. A slack
cable reaches more than its command. So commands are first solved with real cables; then part of the slack states are
solved again with the slack cables moved towards their commands by up to ``margin``, as if they could push. The network
thus learns states on the boundary of slackness and a little beyond it, where the search for slack cables also evaluates
it.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from softgym_envs.designs import Design
from softgym_envs.errors import ConvergenceError, DesignError, InfeasibleDesign, unknown_name
from softgym_envs.mechanics.solvers.equilibrium import Equilibrium
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.quantities import numbers
from softgym_envs.robots.base import Robot
from softgym_envs.robots.gmsh_robot import GmshRobot
from softgym_envs.surrogate.features import learned_variables

SEQUENCES = ("halton", "sobol", "latin", "random", "vertices")
"""Kinds of points: scrambled Halton and Sobol sequences, a Latin hypercube, independent draws, and for the designs the
vertices of their box with independent draws of the commands."""

SLIGHT = 1e-9
"""By how much solved coordinates may leave their ranges."""

APART = 0.01
"""By how much of its range at least one coordinate of a part must change between two states on its path."""

SOFTEST = 0.01
"""Smallest mean stiffness between two joined equilibria, relative to that at the first (see `may_be_joined`)."""


@dataclass(frozen=True)
class SamplingPlan:
    """A reproducible set of states, in groups that share a design.

    Args:
        groups: number of designs.
        states: commanded states per design, in addition to the state at rest; 0 for the latter only.
        sequence: one of `SEQUENCES`. Use ``"random"`` for validation and test.
        seed: seed of the sequence.
        margin: how far slack cables are moved back [fraction of the actuator range]; 1 samples cables that push.
        vary: design variables that are drawn, an empty tuple for none; default all that the surrogate learns.
        design: values of other variables; default their baseline.
        bounds: narrower bounds of drawn variables.
        alike: drawn variables with the same bounds that lie close together in some groups: each group moves them
            towards the first of them by a part that it draws, from not at all to altogether.
        boundary: share of the groups whose designs and commands lie on faces, edges and vertices of their boxes, where
            optimisers end; commands at a vertex leave cables slack (see `pushed`).
        share: part of the ranges of the commands, from their lower ends, that is drawn from.
        loads: groups in a row that share a body and differ in what acts on it (`Learning.loads`): a mesh costs
            more than the states under one more load.
        one_mesh: leave out bodies to which the mesh of the baseline does not move well: their own meshes have errors of
            their own, which no smooth function of the design describes.
        within: robot with parts of which the learned one is a part. Designs and commands are that robot's, and states
            those of the part on its paths (`HasParts`): a fraction of its own range, at a fraction of the time.
    """

    groups: int
    states: int
    sequence: str = "halton"
    seed: int = 0
    margin: float = 0.1
    vary: tuple[str, ...] | None = None
    design: Mapping[str, float] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    alike: tuple[str, ...] = ()
    boundary: float = 0.0
    share: float = 1.0
    loads: int = 1
    one_mesh: bool = False
    within: str = ""

    def __post_init__(self) -> None:
        if self.sequence not in SEQUENCES:
            raise ValueError(f"sequence = {self.sequence!r} is unknown; allowed: {', '.join(map(repr, SEQUENCES))}")
        for name, least in (("groups", 1), ("states", 0), ("seed", 0), ("loads", 1)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
                raise ValueError(f"{name} = {value!r} must be an integer of at least {least}")
        if self.vary is not None and len(set(self.vary)) < len(self.vary):
            raise ValueError(f"vary = {list(self.vary)} names a variable twice")
        for name, pair in self.bounds.items():
            if numbers(pair, f"bounds of '{name}'").size != 2:
                raise ValueError(f"bounds of '{name}' = {pair!r} must be two numbers, the lower and the upper one")
        for name in ("margin", "boundary", "share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} = {getattr(self, name)} is out of bounds; allowed: [0, 1]")

    def unit_points(self, dimension: int, first: int, count: int, total: int, stream: int) -> np.ndarray:
        """Points ``first .. first + count`` of ``total`` in [0, 1], shape (count, dimension)."""
        if dimension == 0 or count == 0:
            return np.zeros((count, dimension))
        if self.sequence == "vertices" and stream == 0:
            return vertices(dimension, total, np.random.default_rng([self.seed, stream]))[first : first + count]
        if self.sequence in ("random", "vertices"):
            rows = range(first, first + count)
            return np.stack([np.random.default_rng([self.seed, stream, row]).random(dimension) for row in rows])
        from scipy.stats import qmc

        rng = np.random.default_rng([self.seed, stream])
        if self.sequence == "halton":
            halton = qmc.Halton(dimension, scramble=True, rng=rng)
            halton.fast_forward(first)
            return halton.random(count)
        if self.sequence == "sobol":
            sobol = qmc.Sobol(dimension, scramble=True, rng=rng)
            # The number of points of a Sobol sequence is a power of two; some of them are used here.
            return sobol.random_base2(int(np.ceil(np.log2(max(total, 2)))))[first : first + count]
        return qmc.LatinHypercube(dimension, rng=rng).random(total)[first : first + count]

    def designs(self, robot: Robot, first: int, count: int) -> list[Design]:
        """Return the complete designs of groups ``first .. first + count``.

        Raises:
            DesignError: for variables that the robot does not have, bounds outside the robot's, bounds of a variable
                that is not drawn, and a fixed value of one that is.
        """
        space = robot.design_space
        names = learned_variables(robot) if self.vary is None else self.vary
        for name in (*names, *self.bounds):
            if name not in space.names:
                raise DesignError(unknown_name("design variable", name, space.names))
        for name in self.bounds.keys() - set(names):
            raise DesignError(f"'{name}' has bounds but is not drawn; drawn: {', '.join(names) or 'none'}")
        for name in self.design.keys() & set(names):
            raise DesignError(f"'{name}' is drawn and has a fixed value; remove it from `design` or from `vary`")
        box = []
        for name in names:
            low, high = self.bounds.get(name, (space[name].low, space[name].high))
            if not space[name].low <= low <= high <= space[name].high:
                own = f"[{space[name].low:g}, {space[name].high:g}]"
                raise DesignError(f"bounds of '{name}' = [{low:g}, {high:g}] must be inside {own}")
            box.append((low, high))
        for name in self.alike:
            if name not in names:
                raise DesignError(f"'{name}' is in `alike` but is not drawn; drawn: {', '.join(names) or 'none'}")
        ends = np.array(box).reshape(-1, 2)
        points = self.unit_points(len(names) + bool(self.alike), first, count, self.groups, 0)
        if self.loads > 1:
            body = [k for k, name in enumerate(names) if name not in robot.learning.loads]
            for row in range(count):
                shared = self.unit_points(points.shape[1], (first + row) // self.loads, 1, self.groups, 0)
                points[row, body] = shared[0, body]
        if self.alike:
            points, part = points[:, :-1], points[:, -1:]
            group = [names.index(name) for name in self.alike]
            points[:, group] += part * (points[:, group[:1]] - points[:, group])
        for row in range(count):
            if self._on_boundary(first + row):
                points[row] = pushed(points[row : row + 1], np.random.default_rng([self.seed, 4, first + row]))[0]
        values = ends[:, 0] + points * (ends[:, 1] - ends[:, 0])
        return [space.complete({**self.design, **dict(zip(names, map(float, row), strict=True))}) for row in values]

    def commands(self, robot: Robot, group: int) -> np.ndarray:
        """Return the commands of a group, shape (states, n_a)."""
        points = self.unit_points(len(robot.actuators), group * self.states, self.states, self.groups * self.states, 1)
        if self._on_boundary(group):
            points = pushed(points, np.random.default_rng([self.seed, 5, group]))
        return robot.displacements(self.share * points)

    def _on_boundary(self, group: int) -> bool:
        return self.boundary > 0.0 and np.random.default_rng([self.seed, 3, group]).random() < self.boundary


def pushed(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Move coordinates of points (N, d) in the unit box to its nearest faces.

    Each point draws the share of its coordinates that move, so that faces, edges and vertices are equally frequent.
    """
    share = rng.random((len(points), 1))
    return np.where(rng.random(points.shape) < share, np.round(points), points)


def vertices(dimension: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return vertices of the unit cube (count, dimension): if possible all before any twice."""
    if dimension > 16:
        return rng.integers(2, size=(count, dimension)).astype(float)
    all_of_them = [rng.permutation(2**dimension) for _ in range(-(-count // 2**dimension))]
    numbers = np.concatenate(all_of_them)[:count]
    return (numbers[:, None] >> np.arange(dimension) & 1).astype(float)


def path_order(points: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return an order of points (n, d) in which each is the nearest remaining one, beginning near ``start`` (d,)."""
    left = np.ones(len(points), dtype=bool)
    order = np.empty(len(points), dtype=np.int64)
    present = start
    for k in range(len(points)):
        distance = np.where(left, ((points - present) ** 2).sum(axis=1), np.inf)
        order[k] = distance.argmin()
        left[order[k]] = False
        present = points[order[k]]
    return order


def solve_path(
    robot: Robot, statics: Statics, rest: Equilibrium, commands: np.ndarray
) -> Iterator[tuple[int, Equilibrium | None]]:
    """Solve commands (n, n_a) of one body, each starting from the nearest one before, or else from rest.

    Newton's method may pass from an equilibrium that ends to one far away, such as that of a gripper turned inside
    out. Such a command is approached once more as slowly as the actuators move (`Actuator.rate`), and has no
    equilibrium if that one ends on this way, too.

    Yields:
        The number of a command, and its equilibrium or None if there is none, in the order of the path.
    """
    span = robot.upper - robot.lower
    rates = np.array([actuator.rate for actuator in robot.actuators])
    at_rest = True  # where the next solve starts
    start, begun = rest, np.zeros(len(span))  # and the equilibrium and the command there

    def solve(command: np.ndarray) -> Equilibrium | None:
        try:
            found = statics.solve(command)
            if not robot.learning.convex or may_be_joined(start, found):
                return found
            statics.restore(start.x, start.effort)
            steps, before = int(np.ceil((np.abs(command - begun) / rates).max())), start
            for step in range(1, steps + 1):
                found = statics.solve(begun + step / steps * (command - begun))
                if not may_be_joined(before, found):
                    return None
                before = found
            return found
        except ConvergenceError:
            return None

    lost: set[bytes] = set()  # repeated commands without an equilibrium: each takes seconds
    for k in path_order((commands - robot.lower) / span, -robot.lower / span):
        if commands[k].tobytes() in lost:
            yield int(k), None
            continue
        found = solve(commands[k])
        if found is None and not at_rest:
            statics.restore(rest.x, rest.effort)
            start, begun = rest, np.zeros(len(span))
            found = solve(commands[k])
        if found is None:
            lost.add(commands[k].tobytes())
            statics.restore(rest.x, rest.effort)
        start, begun = (rest, np.zeros(len(span))) if found is None else (found, commands[k])
        at_rest = found is None or not commands[k].any()
        yield int(k), found


def may_be_joined(first: Equilibrium, second: Equilibrium) -> bool:
    """Return whether stable equilibria of a body, along which efforts grow with displacements, may join two others.

    Along them, displacements change by the integral of ``W d lambda`` with positive definite ``W``, so efforts and
    displacements change in the same direction. If this takes a mean stiffness of less than `SOFTEST` of that of the
    first equilibrium, the two do not count as joined. Nothing is known if the first is unstable.
    """
    moved = second.condensed.delta.a - first.condensed.delta.a
    try:
        half = np.linalg.solve(np.linalg.cholesky(first.condensed.W.aa), moved)
    except np.linalg.LinAlgError:
        return True
    work = moved @ (second.condensed.lambda_.a - first.condensed.lambda_.a)
    return bool(work >= SOFTEST * (half @ half) - 1e-12)


@runtime_checkable
class HasParts(Protocol):
    """A robot of equal parts, one of which can be learned."""

    def one_part(self) -> Robot:
        """Return the part as a robot, whose actuators are its coordinates."""

    def part_states(self, design: Design, commands: np.ndarray) -> tuple[list[list[Equilibrium]], int]:
        """Return states of each part on a path of commands, the first at rest, and the number of commands lost."""


@dataclass(frozen=True)
class Lost:
    """What was left out of a dataset.

    Attributes:
        bodies: that cannot be built, or have no equilibrium at rest.
        commands: without an equilibrium.
        states: of parts that are outside the ranges of their actuators.
    """

    bodies: int = 0
    commands: int = 0
    states: int = 0

    def __add__(self, other: Lost) -> Lost:
        return Lost(self.bodies + other.bodies, self.commands + other.commands, self.states + other.states)


def sample_group(robot: Robot, plan: SamplingPlan, group: int) -> tuple[dict[str, np.ndarray] | None, Lost]:
    """Solve all states of one design, each starting from the previous one.

    Args:
        robot: the robot that is learned, or with `SamplingPlan.within` that of which it is a part.
        plan: what to sample.
        group: number of the design.

    Returns:
        Arrays with one row per solved state: ``design`` (all variables), ``displacement``, ``effort``, ``effector``,
        ``compliance`` (upper triangle of W, row by row) and ``rest`` (1 for the state at rest), or None for a design
        that is infeasible, has a mesh that the plan leaves out, or has no equilibrium at rest; and what was left out.
        Sensor rows are the last columns of ``effector``.
    """
    try:
        design = plan.designs(robot, group, 1)[0]
        if plan.one_mesh and isinstance(robot, GmshRobot) and robot.body(design).origin != "morphed":
            return None, Lost(1, plan.states)
        learned, rows, lost = (_part_rows if plan.within else _rows)(robot, plan, group, design)
    except (InfeasibleDesign, ConvergenceError):
        return None, Lost(1, plan.states)
    upper = np.triu_indices(len(rows[0].condensed.effort))
    own = [design[name] for name in learned.design_space.names]
    return {
        "design": np.tile(own, (len(rows), 1)),
        "displacement": np.stack([r.condensed.delta.a for r in rows]),
        "effort": np.stack([r.condensed.lambda_.a for r in rows]),
        "effector": np.stack([np.concatenate([r.condensed.delta.e, _sensors(r)]) for r in rows]),
        "compliance": np.stack([r.condensed.compliance[upper] for r in rows]),
        "rest": np.arange(len(rows)) == 0,
    }, lost


def _rows(robot: Robot, plan: SamplingPlan, group: int, design: Design) -> tuple[Robot, list[Equilibrium], Lost]:
    """Return the states of a design, the first at rest."""
    count = len(robot.actuators)
    statics = Statics(robot.build(design))
    rest = statics.solve(np.zeros(count))
    rows: list[Equilibrium] = [rest]
    span = robot.upper - robot.lower
    commands = plan.commands(robot, group)
    rng = np.random.default_rng([plan.seed, 2, group])
    failed = 0
    for k, equilibrium in solve_path(robot, statics, rest, commands):
        if equilibrium is None:
            failed += 1
            continue
        command = commands[k]
        if equilibrium.slack.any() and rng.random() < 0.5:
            beyond = np.maximum(equilibrium.delta[:count] - command, 0.0) * equilibrium.slack
            push = np.minimum(rng.uniform(0.0, plan.margin, count) * span, beyond)
            kept = statics.unilateral
            statics.unilateral = np.zeros_like(kept)
            try:
                equilibrium = statics.solve(equilibrium.delta[:count] - push)
            except ConvergenceError:
                statics.restore(equilibrium.x, equilibrium.effort)
            finally:
                statics.unilateral = kept
        rows.append(equilibrium)
    return robot, rows, Lost(0, failed)


def _part_rows(robot: Robot, plan: SamplingPlan, group: int, design: Design) -> tuple[Robot, list[Equilibrium], Lost]:
    """Return states of the parts of a design, the first at rest, that differ by `APART` along each path."""
    assert isinstance(robot, HasParts)
    part, span = robot.one_part(), robot.upper - robot.lower
    commands = plan.commands(robot, group)
    order = path_order((commands - robot.lower) / span, -robot.lower / span)
    paths, failed = robot.part_states(design, commands[order])
    rows, outside = [paths[0][0]], 0
    for path in paths:
        last = path[0].condensed.delta.a
        for state in path[1:]:
            y = state.condensed.delta.a
            if (np.abs(y - last) < APART * (part.upper - part.lower)).all():
                continue
            last = y
            if ((y >= part.lower - SLIGHT) & (y <= part.upper + SLIGHT)).all():
                rows.append(state)
            else:
                outside += 1
    return part, rows, Lost(0, failed, outside)


def _sensors(state: Equilibrium) -> np.ndarray:
    return state.condensed.delta.s if "s" in state.condensed.slices else np.zeros(0)


def select_states(data: Mapping[str, np.ndarray], count: int, seed: int = 0) -> np.ndarray:
    """Choose states that represent a dataset: those nearest to k-means centres (thesis, sec. 5.3).

    Clusters are formed from the normalised entries of ``W`` and ``delta_free``: chosen states are close together where
    the condensed model changes, and far apart where it does not.

    Returns:
        Row numbers, ascending, shape (count,).

    Raises:
        ValueError: if ``count`` is not between 1 and the number of rows.
    """
    from scipy.cluster.vq import kmeans2

    rows = len(data["effort"])
    if not isinstance(count, int | np.integer) or not 1 <= count <= rows:
        raise ValueError(f"count = {count} states cannot be chosen from {rows}; allowed: 1 to {rows}")
    actuators, effectors = data["effort"].shape[1], data["effector"].shape[1]
    n = int(np.sqrt(2 * data["compliance"].shape[1]))  # more than actuators + effectors if there are contacts
    W = np.zeros((rows, n, n))
    W[:, *np.triu_indices(n)] = data["compliance"]
    W += np.triu(W, 1).swapaxes(1, 2)
    free = np.concatenate([data["displacement"], data["effector"]], axis=1)
    free = free - np.einsum("bij,bj->bi", W[:, : actuators + effectors, :actuators], data["effort"])
    entries = np.concatenate([data["compliance"], free], axis=1)
    spread = entries.std(axis=0)
    spread[spread <= 1e-12 * np.abs(entries).max(axis=0)] = np.inf
    entries = (entries - entries.mean(axis=0)) / spread
    distinct, first = np.unique(entries, axis=0, return_index=True)
    if len(distinct) <= count:  # k-means needs at least as many points as centres: take all points, and copies of some
        chosen, distance = first.tolist(), np.zeros(rows)
    else:
        with warnings.catch_warnings(action="ignore", category=UserWarning):  # empty clusters are handled below
            centres, labels = kmeans2(entries, count, minit="++", rng=np.random.default_rng(seed))
        distance = np.linalg.norm(entries - centres[labels], axis=1)
        chosen = [g[distance[g].argmin()] for k in range(count) if len(g := np.flatnonzero(labels == k))]
    if len(chosen) < count:  # replace empty clusters by the states farthest from their centres
        left = np.setdiff1d(np.argsort(-distance, kind="stable"), chosen, assume_unique=True)
        chosen += left[np.argsort(-distance[left], kind="stable")][: count - len(chosen)].tolist()
    return np.sort(np.array(chosen))
