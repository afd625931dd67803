"""Where to evaluate the FEM: designs and actuation drawn together, states of one design solved as a path.

The condensed model is smooth in the *reached* actuator displacement, taut or pushed. Cables that hang slack reach
more than they are told; so commands are first solved as real cables, and part of the slack states are then solved
again with the slack cables pulled back towards their commands by up to ``margin``, as if they could push. The network
thus knows the states on the slack boundary and a little beyond, where a solver that looks for the boundary has to go.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from softgym_envs.designs import Design
from softgym_envs.errors import ConvergenceError, DesignError, InfeasibleDesign, unknown_name
from softgym_envs.mechanics.solvers.statics import Equilibrium, Statics
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.features import learned_variables

SEQUENCES = ("halton", "sobol", "latin", "random")
"""How points are spread: scrambled Halton and Sobol sequences, a Latin hypercube, independent draws."""


@dataclass(frozen=True)
class SamplingPlan:
    """A reproducible set of states, made of groups that share a design.

    Args:
        groups: number of designs.
        states: commanded states per design, beside the rest state.
        sequence: one of `SEQUENCES`. Use ``"random"`` for validation and test.
        seed: seed of the sequence.
        margin: how far slack cables are pulled back [fraction of the actuator range]; 1 samples cables that push.
        vary: design variables that are drawn; default all that the surrogate learns. None of them: an empty tuple.
        design: values of the others, where they are not at their baseline.
        bounds: narrower bounds of drawn variables.
    """

    groups: int
    states: int
    sequence: str = "halton"
    seed: int = 0
    margin: float = 0.1
    vary: tuple[str, ...] | None = None
    design: Mapping[str, float] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.sequence not in SEQUENCES:
            raise ValueError(f"sequence = {self.sequence!r} is unknown; allowed: {', '.join(map(repr, SEQUENCES))}")
        for name, least in (("groups", 1), ("states", 1), ("seed", 0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
                raise ValueError(f"{name} = {value!r} must be a whole number of {least} or more")
        if self.vary is not None and len(set(self.vary)) < len(self.vary):
            raise ValueError(f"vary = {list(self.vary)} names a variable twice")
        if not 0.0 <= self.margin <= 1.0:
            raise ValueError(f"margin = {self.margin} is out of bounds; allowed: [0, 1]")

    def unit_points(self, dimension: int, first: int, count: int, total: int, stream: int) -> np.ndarray:
        """Points ``first .. first + count`` of ``total`` in [0, 1], shape (count, dimension)."""
        if dimension == 0:
            return np.zeros((count, 0))
        if self.sequence == "random":
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
            # Its points come in powers of two; of a part of them no balance is asked.
            return sobol.random_base2(int(np.ceil(np.log2(max(total, 2)))))[first : first + count]
        return qmc.LatinHypercube(dimension, rng=rng).random(total)[first : first + count]

    def designs(self, robot: Robot, first: int, count: int) -> list[Design]:
        """Complete designs of groups ``first .. first + count``.

        Raises:
            DesignError: for variables the robot does not have, bounds outside its own or of a variable that is not
                drawn, and a value for one that is.
        """
        space = robot.design_space
        names = learned_variables(robot) if self.vary is None else self.vary
        for name in (*names, *self.bounds):
            if name not in space.names:
                raise DesignError(unknown_name("design variable", name, space.names))
        for name in self.bounds.keys() - set(names):
            raise DesignError(f"bounds of '{name}', which is not drawn; drawn: {', '.join(names) or 'none'}")
        for name in self.design.keys() & set(names):
            raise DesignError(f"a value of '{name}', which is drawn; leave it out of `design` or of `vary`")
        box = []
        for name in names:
            low, high = self.bounds.get(name, (space[name].low, space[name].high))
            if not space[name].low <= low <= high <= space[name].high:
                own = f"[{space[name].low:g}, {space[name].high:g}]"
                raise DesignError(f"bounds of '{name}' = [{low:g}, {high:g}] leave its own, {own}")
            box.append((low, high))
        ends = np.array(box).reshape(-1, 2)
        points = self.unit_points(len(names), first, count, self.groups, 0)
        values = ends[:, 0] + points * (ends[:, 1] - ends[:, 0])
        return [space.complete({**self.design, **dict(zip(names, map(float, row), strict=True))}) for row in values]


def path_order(points: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Order points (n, d) so that each lies near the one before, beginning near ``start`` (d,): nearest first."""
    left = np.ones(len(points), dtype=bool)
    order = np.empty(len(points), dtype=np.int64)
    present = start
    for k in range(len(points)):
        distance = np.where(left, ((points - present) ** 2).sum(axis=1), np.inf)
        order[k] = distance.argmin()
        left[order[k]] = False
        present = points[order[k]]
    return order


def sample_group(robot: Robot, plan: SamplingPlan, group: int) -> tuple[dict[str, np.ndarray] | None, int]:
    """Solve all states of one design, each from its neighbour.

    Returns:
        Arrays with one row per solved state: ``design`` (all variables), ``displacement``, ``effort``, ``effector``,
        ``compliance`` (upper triangle of W, row by row), ``rest`` (1 for the rest state), and the number of states
        without an equilibrium, which are left out. None for a design that is infeasible or has no rest.
    """
    space = robot.design_space
    count = len(robot.actuators)
    zero = np.zeros(count)
    try:
        design = plan.designs(robot, group, 1)[0]
        model = robot.build(design)
        statics = Statics(model)
        rest = statics.solve(zero, robot.rest_mode)
        if robot.rest_mode == "effort" and model.loads.any():
            rest = statics.solve(zero)
    except (InfeasibleDesign, ConvergenceError):
        return None, plan.states
    rows: list[Equilibrium] = [rest]
    span = robot.upper - robot.lower
    points = plan.unit_points(count, group * plan.states, plan.states, plan.groups * plan.states, 1)
    commands = robot.displacements(points)
    order = path_order((commands - robot.lower) / span, -robot.lower / span)
    rng = np.random.default_rng([plan.seed, 2, group])
    failed = 0
    for command in commands[order]:
        try:
            equilibrium = statics.solve(command)
        except ConvergenceError:
            try:  # another way to it, from rest
                statics.restore(rest.x, rest.effort)
                equilibrium = statics.solve(command)
            except ConvergenceError:
                failed += 1
                statics.restore(rest.x, rest.effort)
                continue
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
    upper = np.triu_indices(len(rest.condensed.effort))
    return {
        "design": np.tile([design[name] for name in space.names], (len(rows), 1)),
        "displacement": np.stack([r.condensed.delta.a for r in rows]),
        "effort": np.stack([r.condensed.lambda_.a for r in rows]),
        "effector": np.stack([r.condensed.delta.e for r in rows]),
        "compliance": np.stack([r.condensed.compliance[upper] for r in rows]),
        "rest": np.arange(len(rows)) == 0,
    }, failed


def select_states(data: Mapping[str, np.ndarray], count: int, seed: int = 0) -> np.ndarray:
    """Choose the states that stand for a dataset: those nearest to k-means centres (thesis 5.3).

    Clusters are of the normalised entries of ``W`` and ``delta_free``, so that states lie close where the condensed
    model changes and far apart where it does not.

    Returns:
        Row numbers, ascending, shape (count,).

    Raises:
        ValueError: if ``count`` is no number of rows the data can give.
    """
    from scipy.cluster.vq import kmeans2

    rows = len(data["effort"])
    if not isinstance(count, int | np.integer) or not 1 <= count <= rows:
        raise ValueError(f"count = {count} states cannot be chosen from {rows}; allowed: 1 to {rows}")
    actuators, effectors = data["effort"].shape[1], data["effector"].shape[1]
    n = int(np.sqrt(2 * data["compliance"].shape[1]))  # more than these where there are contacts
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
    if len(distinct) <= count:  # all of them, and copies; more centres than points cannot be drawn
        chosen, distance = first.tolist(), np.zeros(rows)
    else:
        with warnings.catch_warnings(action="ignore", category=UserWarning):  # empty clusters are seen to below
            centres, labels = kmeans2(entries, count, minit="++", rng=np.random.default_rng(seed))
        distance = np.linalg.norm(entries - centres[labels], axis=1)
        chosen = [g[distance[g].argmin()] for k in range(count) if len(g := np.flatnonzero(labels == k))]
    if len(chosen) < count:  # clusters that came out empty: the states farthest from what is chosen
        left = np.setdiff1d(np.argsort(-distance, kind="stable"), chosen, assume_unique=True)
        chosen += left[np.argsort(-distance[left], kind="stable")][: count - len(chosen)].tolist()
    return np.sort(np.array(chosen))
