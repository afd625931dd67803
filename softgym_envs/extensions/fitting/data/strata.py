"""Stratified FEM test states for surrogates: equilibria under given commands.

Environments and optimisers meet a model at commands, and optimisers end at the boundary of the design box. A test set
of random bodies has hardly any of the states that matter to them, so each kind is drawn on its own.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from softgym_envs.errors import ConvergenceError, DataError, InfeasibleDesign
from softgym_envs.executors import parallel_map
from softgym_envs.extensions.fitting.data.sampling import solve_path, vertices
from softgym_envs.mechanics.solvers.equilibrium import Equilibrium
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import Robot
from softgym_envs.storage import atomic_write, read_npz
from softgym_envs.surrogate.features import learned_variables

DRAWN = ("inside", "faces", "corners", "slack corners", "near buckling")
"""Strata by how they are drawn:

* ``inside``: bodies and commands anywhere in their boxes;
* ``faces``: one design variable at its bound;
* ``corners``: bodies at vertices of the design box, any commands; what a variable chooses is drawn, since a choice has
  no bounds;
* ``slack corners``: bodies at vertices, commands at vertices at which some actuators pull all the way and others not at
  all; only for robots whose actuators cannot push;
* ``near buckling``: bodies and commands from any of these whose actuators are expected to be softest; only for robots
  that can buckle.
"""

SLACK = 1e-6
"""Actuators that end farther beyond their commands than this are slack [range]."""

CANDIDATES = 40
"""Candidates for each state near buckling."""


@dataclass(frozen=True)
class Commands:
    """Bodies and commands to be solved: G bodies with S commands each.

    Attributes:
        stratum: one of `DRAWN` per body, shape (G,).
        design: values in the order of the design space, shape (G, d).
        command: commanded displacements, shape (G, S, n_a).
    """

    stratum: np.ndarray
    design: np.ndarray
    command: np.ndarray


@dataclass(frozen=True)
class StratifiedStates:
    """Commands and the FEM equilibria they lead to, N states.

    Attributes:
        stratum: one of `DRAWN`, or ``adversarial`` (from `surrogate.calibration.adversarial_search`), shape (N,).
        body: number of the body, shape (N,).
        design: shape (N, d).
        command: commanded displacements, shape (N, n_a).
        displacement: reached displacements, shape (N, n_a).
        effort: shape (N, n_a).
        effector: [m], shape (N, n_e).
        slack: which actuators are slack, shape (N, n_a).
        touching: whether surfaces are in contact, shape (N,).
        growth: how many times softer the actuators are than at rest, in the softest direction; infinite for states that
            are stable only while their actuators are held, shape (N,).
        apart: distance of the effector from that of the equilibrium found from another start [m], shape (N,): more than
            round-off if the command has several equilibria. NaN without a second start.
        found: whether there is an equilibrium, shape (N,); other rows hold NaN. Equilibria with an indefinite ``W`` do
            not count for robots whose learned energy is convex, because it cannot have them.
    """

    stratum: np.ndarray
    body: np.ndarray
    design: np.ndarray
    command: np.ndarray
    displacement: np.ndarray
    effort: np.ndarray
    effector: np.ndarray
    slack: np.ndarray
    touching: np.ndarray
    growth: np.ndarray
    apart: np.ndarray
    found: np.ndarray

    def __len__(self) -> int:
        return len(self.found)

    def rows(self, index: np.ndarray) -> StratifiedStates:
        """Return some of the states."""
        return StratifiedStates(*(getattr(self, f.name)[index] for f in fields(self)))

    def save(self, path: str | Path) -> None:
        """Write the states to an npz file."""
        with atomic_write(path) as stream:
            np.savez_compressed(stream, allow_pickle=False, **{f.name: getattr(self, f.name) for f in fields(self)})

    @classmethod
    def load(cls, path: str | Path) -> StratifiedStates:
        """Read the states that `save` wrote.

        Raises:
            DataError: if the file is missing or damaged.
        """
        names = tuple(f.name for f in fields(cls))
        return cls(**read_npz(path, names))

    @classmethod
    def join(cls, parts: list[StratifiedStates]) -> StratifiedStates:
        """Return all states of several sets, with bodies numbered anew."""
        first = np.cumsum([0, *(part.body.max(initial=-1) + 1 for part in parts)])
        columns = {f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)}
        columns["body"] = np.concatenate([part.body + start for part, start in zip(parts, first, strict=False)])
        return cls(**columns)


def strata_of(robot: Robot, *, buckles: bool) -> tuple[str, ...]:
    """Return the strata that can be drawn for a robot.

    Args:
        robot: the robot.
        buckles: whether it can buckle.
    """
    missing = set()
    if robot.unilateral.sum() < 2 or not robot.learning.convex:
        missing.add("slack corners")
    if not buckles:
        missing.add("near buckling")
    return tuple(name for name in DRAWN if name not in missing)


def draw_commands(
    robot: Robot,
    stratum: str,
    groups: int,
    states: int,
    seed: int = 0,
    softness: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
) -> Commands:
    """Return random bodies and commands of one stratum.

    Args:
        robot: the robot.
        stratum: one of `DRAWN`.
        groups: number of bodies.
        states: commands of each body.
        seed: of the random numbers.
        softness: for ``near buckling``: returns the expected growth (N,) of bodies (N, d) under commands (N, n_a).
        bounds: narrower bounds of design variables; default those of the robot.

    Raises:
        ValueError: for an unknown stratum, or one that needs ``softness``.
    """
    if stratum not in DRAWN:
        raise ValueError(f"stratum = {stratum!r} is unknown; allowed: {', '.join(map(repr, DRAWN))}")
    rng = np.random.default_rng([seed, DRAWN.index(stratum)])
    space, count = robot.design_space.within(bounds or {}), len(robot.actuators)
    names = [name for name in learned_variables(robot) if not space[name].choices]
    if stratum == "near buckling":
        if softness is None:
            raise ValueError("states near buckling need an estimate of the softness")
        kinds = [k for k in strata_of(robot, buckles=False)]
        pool = [
            draw_commands(robot, kind, 2 * groups, CANDIDATES, int(rng.integers(2**31)), bounds=bounds)
            for kind in kinds
        ]
        design, command = (np.concatenate([getattr(p, f) for p in pool]) for f in ("design", "command"))
        growth = softness(np.repeat(design, CANDIDATES, axis=0), command.reshape(-1, count)).reshape(len(design), -1)
        # The softest states of a body first; bodies by how soft the last of its chosen states is.
        order = np.argsort(-growth, axis=1)[:, :states]
        least = np.take_along_axis(growth, order, axis=1)[:, -1]
        chosen = np.argsort(-least)[:groups]
        command = np.take_along_axis(command[chosen], order[chosen][:, :, None], axis=1)
        return Commands(np.full(groups, stratum), design[chosen], command)
    points = rng.random((groups, len(names)))
    if stratum == "faces" and names:
        which = rng.integers(len(names), size=groups)
        points[np.arange(groups), which] = np.round(points[np.arange(groups), which])
    elif stratum in ("corners", "slack corners"):
        points = vertices(len(names), groups, rng)
    fractions = rng.random((groups * states, count))
    if stratum == "slack corners":
        fractions = np.round(fractions)
        alike = (fractions == fractions[:, :1]).all(axis=1)
        fractions[alike, rng.integers(count, size=alike.sum())] = 1.0 - fractions[alike, 0]
    design = np.array([space.sample(rng).array for _ in range(groups)])
    for k, name in enumerate(names):
        variable = space[name]
        design[:, space.names.index(name)] = variable.low + points[:, k] * (variable.high - variable.low)
    command = robot.displacements(fractions).reshape(groups, states, count)
    return Commands(np.full(groups, stratum), design, command)


def solve_commands(
    robot: Robot,
    commands: Commands,
    *,
    second_start: bool = False,
    folder: str | Path | None = None,
    kept_only: bool = False,
    workers: int = 1,
) -> StratifiedStates:
    """Return the FEM equilibria under commands; bodies that are infeasible or have no state at rest are left out.

    Each state is reached from the nearest state before it, as an environment reaches it. With ``second_start`` it is
    reached from rest, at about twice the cost, and compared with the other one: they differ if there are several
    equilibria. Cables of a robot whose energy is not convex can push, as they can in its learned model.

    Args:
        robot: the robot.
        commands: bodies and their commands.
        second_start: also solve each command from rest.
        folder: where the states of each body are kept, so that an interrupted run continues with the next body.
        kept_only: leave out bodies whose states are not in the folder, instead of solving them.
        workers: number of processes that solve bodies.

    Raises:
        DataError: if no body is left then.
    """
    parts: dict[int, StratifiedStates] = {}
    missing = []
    for number in range(len(commands.design)):
        path = None if folder is None else Path(folder) / f"{_key(robot, commands, number, second_start)}.npz"
        if path is not None and path.exists():
            parts[number] = StratifiedStates.load(path)
        else:
            missing.append((robot, commands, number, second_start, path))
    if not kept_only:
        parts |= parallel_map(_solve_and_keep, missing, workers)
    if not parts:
        raise DataError(f"'{folder}' holds no states of the stratum '{commands.stratum[0]}' with these commands")
    return StratifiedStates.join([parts[number] for number in sorted(parts)])


def _solve_and_keep(
    robot: Robot, commands: Commands, number: int, second_start: bool, path: Path | None
) -> tuple[int, StratifiedStates]:
    """Return the number of a body and its states, and write them to a file."""
    part = _solve_body(robot, commands, number, second_start)
    if path is not None:
        part.save(path)
    return number, part


def _key(robot: Robot, commands: Commands, number: int, second_start: bool) -> str:
    """Return a name for the states of one body, by everything that they depend on."""
    text = json.dumps([robot.name, robot.mechanics_key, str(commands.stratum[number]), second_start], sort_keys=True)
    values = commands.design[number].tobytes() + commands.command[number].tobytes()
    return hashlib.sha256(text.encode() + values).hexdigest()[:16]


def _solve_body(robot: Robot, commands: Commands, number: int, second_start: bool) -> StratifiedStates:
    """Return the states of one body; no rows if it is infeasible or has no state at rest."""
    count, size, span = len(robot.actuators), 3 * len(robot.effectors), robot.upper - robot.lower
    design = dict(zip(robot.design_space.names, commands.design[number].tolist(), strict=True))
    wanted = commands.command[number]
    rows = len(wanted)
    part = StratifiedStates(
        stratum=np.full(rows, commands.stratum[number]),
        body=np.zeros(rows, dtype=np.int64),
        design=np.tile(commands.design[number], (rows, 1)),
        command=wanted,
        displacement=np.full((rows, count), np.nan),
        effort=np.full((rows, count), np.nan),
        effector=np.full((rows, size), np.nan),
        slack=np.zeros((rows, count), dtype=bool),
        touching=np.zeros(rows, dtype=bool),
        growth=np.full(rows, np.nan),
        apart=np.full(rows, np.nan),
        found=np.zeros(rows, dtype=bool),
    )
    try:
        statics = Statics(robot.build(design))
        if not robot.learning.convex:
            statics.unilateral = np.zeros(count, dtype=bool)
        rest = statics.solve(np.zeros(count))
    except (InfeasibleDesign, ConvergenceError):
        return part.rows(np.zeros(0, dtype=np.int64))
    source, image = _repeated(robot, wanted)
    own = np.unique(source)
    for row, found in solve_path(robot, statics, rest, wanted[own]):
        k = own[row]
        if found is None:
            continue
        other = found
        if second_start:
            found = _from_rest(statics, rest, wanted[k], found)
        growth = growth_of(rest, found)
        if robot.learning.convex and growth == np.inf:
            continue
        if second_start:
            part.apart[k] = np.abs(found.condensed.delta.e - other.condensed.delta.e).max()
        part.displacement[k], part.effort[k] = found.condensed.delta.a, found.condensed.lambda_.a
        part.effector[k], part.found[k] = found.condensed.delta.e, True
        part.slack[k] = statics.unilateral & (part.displacement[k] > wanted[k] + SLACK * span)
        part.touching[k] = found.contacts is not None and np.isfinite(found.contacts.smallest_gap)
        part.growth[k] = growth
    for name in ("displacement", "effort", "effector", "slack", "touching", "growth", "apart", "found"):
        getattr(part, name)[:] = getattr(part, name)[source]
    for k in np.flatnonzero(image >= 0):
        symmetry = robot.learning.symmetries[image[k]]
        for name in ("displacement", "effort", "slack"):
            getattr(part, name)[k] = getattr(part, name)[k][symmetry.order]
        part.effector[k] = symmetry.positions(part.effector[k])
    return part


def _repeated(robot: Robot, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which commands (n, n_a) need no solution of their own.

    Returns:
        For each command, the number of the first that is equal to it or has it as an image (`Learning.symmetries`), its
        own if there is none before; and the number of that symmetry, -1 for none.
    """
    source, image = np.arange(len(commands)), np.full(len(commands), -1)
    for k, command in enumerate(commands):
        for first in range(k):
            before = commands[first]
            alike = [before, *(before[symmetry.order] for symmetry in robot.learning.symmetries)]
            found = next((i for i, other in enumerate(alike) if np.array_equal(command, other)), None)
            if found is not None:
                source[k], image[k] = first, found - 1
                break
    return source, image


def _from_rest(statics: Statics, rest: Equilibrium, command: np.ndarray, known: Equilibrium) -> Equilibrium:
    """Return the equilibrium under a command that is reached from rest, or the known one, where solving goes on."""
    statics.restore(rest.x, rest.effort)
    try:
        found = statics.solve(command)
    except ConvergenceError:  # too far for one step
        found = known
    statics.restore(known.x, known.effort)
    return found


def growth_of(rest: Equilibrium, found: Equilibrium) -> float:
    """Return how many times softer the actuators of a state are than at rest; infinite if W is not positive there."""
    unmoved, W = rest.condensed.W.aa, found.condensed.W.aa
    try:
        half = np.linalg.cholesky(0.5 * (unmoved + unmoved.T))
        np.linalg.cholesky(0.5 * (W + W.T))
    except np.linalg.LinAlgError:
        return np.inf
    inner = np.linalg.solve(half, np.linalg.solve(half, W).T)
    return float(np.linalg.eigvalsh(0.5 * (inner + inner.T))[-1])
