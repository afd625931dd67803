"""Examination of a robot before any work is spent on it: can its bodies be built, held, learned and trusted?"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from softgym_envs.errors import ConvergenceError, InfeasibleDesign, MissingLibrary
from softgym_envs.extras import require
from softgym_envs.mechanics.condensation import effort_unit
from softgym_envs.mechanics.elements.tetrahedra import SolidBlock, boundary_triangles
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solids import SOLIDS
from softgym_envs.mechanics.solvers.equilibrium import Equilibrium
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import Robot
from softgym_envs.robots.gmsh_robot import GmshRobot
from softgym_envs.surrogate.pretrained import ships_weights
from softgym_envs.wording import counted

Verdict = Literal["good", "note", "fault"]

LOOSE = 100.0
"""Ranges by which the typical effort moves an actuator that counts as held by nothing."""
STIFF = 1e-3
"""Part of its range by which the typical effort moves an actuator that hardly moves."""
STRAINED = 10.0
"""Typical efforts beyond which random commands count as fighting each other."""
NOISY = 0.02
"""Scatter of the compliance between neighbouring designs that counts as noise, relative to its change in range."""
OFF_REST = 0.05
"""Distance from ``effector_rest`` that counts as wrong, in sizes of the robot."""
LAYERS: Mapping[str, int] = {"quadratic": 1, "averaged": 3, "linear": 4}
"""Fewest layers of elements in a wall that bends, by element."""
NEAR = 0.05
"""Reach of contact that does not matter, in thicknesses of the thinnest wall."""
SURVEYED = 200
"""Boundary triangles from which the thickness of walls is measured."""


@dataclass(frozen=True)
class Finding:
    """One line of an examination.

    Attributes:
        subject: what was examined.
        verdict: ``"good"``; ``"note"``, worth a look; or ``"fault"``, which will stop or mislead later work.
        text: what was measured.
        remedy: what to do about it; empty where all is good.
    """

    subject: str
    verdict: Verdict
    text: str
    remedy: str = ""


def check_robot(
    robot: Robot,
    *,
    bodies: int = 16,
    commands: int = 24,
    seed: int = 0,
    progress: Callable[[str], object] = lambda subject: None,
) -> Iterator[Finding]:
    """Examine a robot, yielding one finding after the other.

    Args:
        robot: the robot.
        bodies: corners of the design box to build, and bodies inside it, besides the baseline and the bounds of each
            variable.
        commands: random commands of the baseline body to solve for.
        seed: of corners and commands.
        progress: called with the name of each examination before it begins.

    Raises:
        ValueError: for fewer than one body or command.
        Exception: any error of the robot's own code, with a note that names the design.
    """
    for label, count in (("bodies", bodies), ("commands", commands)):
        if count < 1:
            raise ValueError(f"{label} = {count} must be 1 or more")
    rng = np.random.default_rng(seed)
    progress("baseline")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = robot.build()
    yield from (
        Finding("baseline", "note", str(warning.message), "see the message")
        for warning in {str(each.message): each for each in caught}.values()
    )
    statics = Statics(model)
    try:
        rest = _rest(robot, statics)
    except ConvergenceError as error:
        yield Finding("baseline", "fault", f"no equilibrium at rest: {error}", "look at clamps, loads and contacts")
        return
    yield Finding("baseline", "good", f"{counted(model.equations, 'equation')}, mass {1e3 * model.mass:.3g} g")
    yield _effector(robot, rest)
    progress("walls")
    yield from _walls(model)
    progress("refinement")
    yield from _refinement(robot, rest)
    yield from _compliance(robot, rest)
    progress("commands")
    yield from _commands(robot, statics, rest, rng, commands)
    progress("design box")
    rests: dict[tuple[str, float], Equilibrium] = {}
    yield from _box(robot, rng, bodies, rests)
    for variable in robot.design_space:
        progress(f"variable {variable.name}")
        yield from _variable(robot, variable.name, rest, rests)
    yield _learning(robot, model)
    progress("files")
    yield from _files(robot)


def _rest(robot: Robot, statics: Statics) -> Equilibrium:
    return statics.solve(np.zeros(len(robot.actuators)), robot.command_modes)


def _effector(robot: Robot, rest: Equilibrium) -> Finding:
    place = rest.condensed.delta.e[:3]
    off = float(np.linalg.norm(robot.goal_axes * (place - robot.effector_rest)))
    text = f"'{robot.effectors[0]}' rests {1e3 * off:.3g} mm from effector_rest"
    if off <= OFF_REST * robot.size:
        return Finding("effector", "good", text)
    return Finding("effector", "note", text, f"goals lie around effector_rest: set it to {place.round(4).tolist()} m")


# -- mesh ---------------------------------------------------------------------------------------------------------


def _walls(model: MechanicalModel) -> Iterator[Finding]:
    """Compare the thinnest walls of each solid with the size of its elements, and with the reach of contact."""
    thinnest = np.inf
    for number, block in enumerate(model.solids):
        kind = next(name for name, solid in SOLIDS.items() if type(block) is solid)
        needed = LAYERS[kind]
        thickness, layers = wall_layers(model.nodes, block)
        thinnest = min(thinnest, thickness)
        name = f"walls of solid {number}" if len(model.solids) > 1 else "walls"
        text = f"thinnest {1e3 * thickness:.3g} mm, {layers:.1f} layers of {kind} elements across it"
        if layers > needed - 0.01:
            yield Finding(name, "good", text)
        else:
            yield Finding(
                name, "note", text, f"at least {needed} where the wall bends: smaller elements, or element='quadratic'"
            )
    if model.contact is not None and np.isfinite(thinnest):
        reach = model.contact.distance
        text = f"acts up to {1e3 * reach:.3g} mm outside of the body, {reach / thinnest:.0%} of its thinnest wall"
        if reach <= NEAR * thinnest:
            yield Finding("contact", "good", text)
        else:
            remedy = (
                f"where this counts, contact_distance = {NEAR * thinnest:.2g} m or less; smaller ones take more steps"
            )
            yield Finding("contact", "note", text, remedy)


def wall_layers(nodes: np.ndarray, block: SolidBlock) -> tuple[float, float]:
    """Return the thickness of the thinnest walls [m] and the layers of elements across them.

    Rays go inwards from the centres of boundary triangles, element by element. The thinnest walls are the thinnest
    twentieth of the rays. A layer is as thick as a cube made of six such elements.
    """
    tetrahedra = block.corners
    triangles = boundary_triangles(tetrahedra)
    chosen = triangles[np.linspace(0, len(triangles) - 1, min(SURVEYED, len(triangles))).astype(int)]
    owners: dict[tuple[int, ...], list[int]] = {}
    for element, corners in enumerate(tetrahedra):
        for face in itertools.combinations(sorted(corners.tolist()), 3):
            owners.setdefault(face, []).append(element)
    edges = np.cbrt(6.0 * block.volumes)
    lengths, layers = [], []
    for triangle in chosen:
        face = tuple(sorted(triangle.tolist()))
        a, b, c = nodes[list(face)]
        start, normal = (a + b + c) / 3.0, np.cross(b - a, c - a)
        element = owners[face][0]
        inwards = nodes[tetrahedra[element]].mean(axis=0) - start
        normal *= np.sign(normal @ inwards) / np.linalg.norm(normal)
        length, mean_edge = _through(nodes, tetrahedra, owners, edges, element, face, start, normal)
        if length > 0.0:
            lengths.append(length)
            layers.append(max(1.0, length / mean_edge))  # flat elements are one layer, too
    order = np.argsort(lengths)[: max(1, len(lengths) // 20)]
    return float(np.mean(np.array(lengths)[order])), float(np.mean(np.array(layers)[order]))


def _through(
    nodes: np.ndarray,
    tetrahedra: np.ndarray,
    owners: Mapping[tuple[int, ...], list[int]],
    edges: np.ndarray,
    element: int,
    face: tuple[int, ...],
    start: np.ndarray,
    direction: np.ndarray,
) -> tuple[float, float]:
    """Follow a ray through the mesh until it leaves the body; return its length and the mean layer on its way [m]."""
    distance, passed = 0.0, []
    for _ in range(len(tetrahedra)):
        passed.append(edges[element])
        exits = []
        for other in itertools.combinations(sorted(tetrahedra[element].tolist()), 3):
            if other == face:
                continue
            a, b, c = nodes[list(other)]
            normal = np.cross(b - a, c - a)
            apex = nodes[next(node for node in tetrahedra[element] if node not in other)]
            normal *= np.sign(normal @ (a - apex))
            speed = float(normal @ direction)
            if speed > 0.0:
                exits.append((float(normal @ (a - start)) / speed, other))
        if not exits:
            break
        distance, face = min(exits)
        beyond = [neighbour for neighbour in owners[face] if neighbour != element]
        if not beyond:
            break
        element = beyond[0]
    return distance, float(np.mean(passed))


def _refinement(robot: Robot, rest: Equilibrium) -> Iterator[Finding]:
    """Compare the compliance at rest with that of a finer mesh, where the robot meshes itself."""
    if not isinstance(robot, GmshRobot):
        return
    finer = type(robot)(**{**robot._options, "mesh_size": 0.7 * robot.mesh_size})  # type: ignore[arg-type]
    try:
        fine = _rest(finer, Statics(finer.build()))
    except (ConvergenceError, InfeasibleDesign) as error:
        yield Finding("refinement", "note", f"the mesh of 0.7 times the size: {error}", "try another mesh_size")
        return
    change = _distance(fine.condensed.W.ea, rest.condensed.W.ea)
    text = f"elements smaller by 0.7 change the effector's compliance by {100 * change:.2g} %"
    if change < 0.02:
        yield Finding("refinement", "good", text)
    else:
        yield Finding("refinement", "note", text, "a smaller mesh_size or element='quadratic' before you quote results")


# -- actuators ----------------------------------------------------------------------------------------------------


def _compliance(robot: Robot, rest: Equilibrium) -> Iterator[Finding]:
    """Compare what typical efforts do at rest with the ranges of the actuators."""
    ranges = robot.upper - robot.lower
    moved = np.diag(rest.condensed.W.aa) * robot.effort_scale / ranges
    for actuator, ratio, typical in zip(robot.actuators, moved, robot.effort_scale, strict=True):
        effort = f"{typical:g} {effort_unit(actuator.unit)} (effort_scale)"
        does = f"{effort} move '{actuator.name}' by {ratio:.2g} of its range"
        if ratio > LOOSE:
            yield Finding("actuators", "fault", does, "nothing holds it: give it a stiffness")
        elif ratio < STIFF:
            yield Finding("actuators", "note", does, "a larger effort_scale or a smaller range")
    scale = np.sqrt(robot.effort_scale / ranges)
    values = np.linalg.eigvalsh(scale[:, None] * rest.condensed.W.aa * scale)
    text = f"compliance of the actuators at rest: eigenvalues {values[0]:.2g} to {values[-1]:.2g} (scaled)"
    if values[0] < 1e-6 * values[-1]:
        yield Finding("actuators", "fault", text, "two actuators do the same, or one of them does nothing")
    else:
        yield Finding("actuators", "good", text)


def _commands(
    robot: Robot, statics: Statics, rest: Equilibrium, rng: np.random.Generator, count: int
) -> Iterator[Finding]:
    """Solve for random commands as a fit samples them, each from rest."""
    targets = robot.displacements(rng.random((count, len(robot.actuators))))
    solved: list[Equilibrium] = []
    for target in targets:
        statics.restore(rest.x, rest.effort, memory=rest.memory)
        try:
            solved.append(statics.solve(target))
        except ConvergenceError:
            continue
    text = f"{len(solved)} of {count} random commands have an equilibrium"
    if solved:
        stable = sum(state.stable or bool(state.slack.all()) for state in solved)
        text += f", {stable} of them stable under efforts"
    if len(solved) < count:
        verdict: Verdict = "fault" if len(solved) < 0.5 * count else "note"
        yield Finding("commands", verdict, text, "smaller ranges, or `displacements` that leave out what cannot occur")
    else:
        yield Finding("commands", "good", text)
    if not solved:
        return
    efforts = np.array([state.effort[: len(robot.actuators)] for state in solved])
    for actuator, values, typical in zip(robot.actuators, efforts.T, robot.effort_scale, strict=True):
        unit = effort_unit(actuator.unit)
        text = f"'{actuator.name}' needs {values.min():.3g} to {values.max():.3g} {unit}"
        if np.abs(values).max() > STRAINED * typical:
            remedy = f"do they fight each other? name `antagonists`; or effort_scale ({typical:g}) is too small"
            yield Finding("efforts", "note", text, remedy)
        elif (beyond := int((np.abs(values) > actuator.max_effort).sum())) > 0:
            remedy = f"{counted(beyond, 'command')} beyond max_effort = {actuator.max_effort:g} {unit}: a smaller range"
            yield Finding("efforts", "note", text, remedy)
        else:
            yield Finding("efforts", "good", text)


# -- designs ------------------------------------------------------------------------------------------------------


def _box(
    robot: Robot, rng: np.random.Generator, bodies: int, rests: dict[tuple[str, float], Equilibrium]
) -> Iterator[Finding]:
    """Build the bounds of each variable, random corners and bodies inside; keep the states at rest of the bounds."""
    space = robot.design_space
    names = [variable.name for variable in space]
    tried: list[dict[str, float]] = [{v.name: bound} for v in space for bound in (v.low, v.high)]
    corners = rng.integers(0, 2, (bodies, len(names)))
    for corner in np.unique(corners, axis=0):
        tried.append({v.name: (v.low, v.high)[side] for v, side in zip(space, corner, strict=True)})
    yield _built(robot, "bodies at the bounds and corners", tried, rests)
    inside = rng.uniform(-1.0, 1.0, (bodies, len(names)))
    drawn = [{v.name: float(v.from_unit(unit)) for v, unit in zip(space, row, strict=True)} for row in inside]
    yield _built(robot, "bodies drawn inside the box", drawn, {})


def _built(
    robot: Robot, which: str, tried: Sequence[dict[str, float]], rests: dict[tuple[str, float], Equilibrium]
) -> Finding:
    """Build bodies, and keep the states at rest of those of one variable."""
    failed: list[tuple[dict[str, float], str]] = []
    for design in tried:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                rest = _rest(robot, Statics(robot.build(design)))
        except (InfeasibleDesign, ConvergenceError) as error:
            failed.append((design, str(error)))
            continue
        if len(design) == 1:
            rests[next(iter(design.items()))] = rest
    text = f"{len(tried) - len(failed)} of {len(tried)} {which} can be built and held"
    if not failed:
        return Finding("design box", "good", text)
    design, reason = min(failed, key=lambda pair: len(pair[0]))
    where = ", ".join(f"{name} = {value:g}" for name, value in design.items())
    verdict: Verdict = "fault" if len(failed) > 0.25 * len(tried) else "note"
    return Finding("design box", verdict, f"{text}; {where}: {reason}", "narrower bounds, or a shape that they allow")


def _variable(
    robot: Robot, name: str, rest: Equilibrium, rests: Mapping[tuple[str, float], Equilibrium]
) -> Iterator[Finding]:
    """Measure what a design variable changes, and how smoothly."""
    variable = robot.design_space[name]
    ends = [rests[name, bound] for bound in (variable.low, variable.high) if (name, bound) in rests]
    if not ends:
        return
    change = max(_distance(end.condensed.W.array, rest.condensed.W.array) for end in ends)
    moved = max(float(np.abs(end.condensed.delta.array - rest.condensed.delta.array).max()) for end in ends)
    subject = f"variable '{name}'"
    if change == 0.0 and moved == 0.0:
        yield Finding(subject, "fault", "its bounds have exactly the same body", "`assemble` does not read it")
        return
    text = f"W changes by up to {100 * change:.3g} % from the baseline to its bounds"
    if variable.choices:
        yield Finding(subject, "good", text)
        return
    centre, steps = float(variable.to_unit(robot.design_space.baseline[name])), np.linspace(-0.03, 0.03, 7)
    units = np.clip(centre, -0.97, 0.97) + steps
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            near = [_rest(robot, Statics(robot.build({name: float(variable.from_unit(unit))}))) for unit in units]
    except (InfeasibleDesign, ConvergenceError) as error:
        yield Finding(subject, "note", f"{text}; near the baseline: {error}", "another baseline or narrower bounds")
        return
    values = np.array([each.condensed.W.array.ravel() for each in near])
    fit = np.polynomial.polynomial.polyfit(steps, values, 2)
    residual = values - np.polynomial.polynomial.polyval(steps, fit).T
    noise = float(np.sqrt((residual**2).sum(axis=1).mean()) / np.linalg.norm(rest.condensed.W.array))
    text += f", with scatter of {100 * noise:.2g} % between neighbours"
    if noise > NOISY * max(change, 1e-3):
        yield Finding(subject, "note", text, "meshes differ from body to body: move one mesh (GmshRobot)")
    else:
        yield Finding(subject, "good", text)


def _distance(one: np.ndarray, other: np.ndarray) -> float:
    """Return the distance of two matrices relative to the second."""
    return float(np.linalg.norm(one - other) / np.linalg.norm(other))


def _files(robot: Robot) -> Iterator[Finding]:
    """Say which files of a body can be written, and whether it can be filmed."""
    from softgym_envs.extensions.deployment.moulds import mould_parts

    try:
        robot.printable().drawing(robot.design_space.complete(None))
    except ValueError as error:
        yield Finding("STEP", "note", str(error), "`softgym export` writes STL")
    else:
        yield Finding("STEP", "good", "`softgym export` writes it")
    try:
        parts = mould_parts(robot)
    except ValueError as error:
        yield Finding("moulds", "note", str(error), "only what is cast in one piece needs them")
    else:
        yield Finding("moulds", "good", f"`softgym export --moulds` writes {', '.join(parts)}")
    try:
        for extra in ("viewer", "video"):
            require(extra)
    except MissingLibrary as error:
        yield Finding("film", "note", str(error), "install it")
    else:
        yield Finding("film", "good", "`softgym rollout --video` draws it")


def _learning(robot: Robot, model: MechanicalModel) -> Finding:
    if limited := robot.effort_limited:
        text = f"no surrogate: a learned model drives {', '.join(limited)} beyond max_effort"
        return Finding("surrogate", "note", text, "backend='fem', or leave max_effort out and check efforts afterwards")
    if robot.obstacles:
        return Finding("surrogate", "note", "no surrogate: obstacles are never part of one", "backend='fem'")
    if stretching := [drive.name for drive in model.constraints["a"] if drive.compliance]:
        text = f"no surrogate: the drives of {', '.join(stretching)} stretch"
        return Finding("surrogate", "note", text, "backend='fem'")
    ships = "weights ship" if ships_weights(robot) else "no weights ship; `softgym fit` learns them"
    return Finding("surrogate", "good", ships)
