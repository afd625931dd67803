"""A body that walks: a trunk on four legs of beams, for tests of contact in motion."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.chamber import Chamber
from softgym_envs.extensions.beams.skins import box_skin, tube_skin
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.contact.contact import ContactSettings
from softgym_envs.mechanics.contact.obstacles import Plane
from softgym_envs.mechanics.elements.rigid import box_inertia
from softgym_envs.mechanics.solvers.dynamics import Dynamics
from softgym_envs.mechanics.solvers.schemes import ImplicitEuler

H = 0.01
HALF = np.array([0.05, 0.03, 0.008])
DOWN = np.column_stack([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
RADIUS = 0.008


def walker(obstacles, *, elements=2, length=0.05, modulus=6e5, clearance=4e-4, rotation=None, mass=0.05):
    """A trunk on four legs with two chambers each, which begin at frames that are mounted on the trunk."""
    rotation = np.eye(3) if rotation is None else rotation
    builder = ModelBuilder(gravity=(0.0, 0.0, -9.81), floating=True)
    centre = rotation @ [0.0, 0.0, length + HALF[2] + clearance]
    trunk = builder.add_frame(centre, rotation)
    builder.add_mass(trunk, mass, box_inertia(mass, HALF))
    inertia = math.pi * RADIUS**4 / 4.0
    section = Section(math.pi * RADIUS**2, (inertia, inertia), 2.0 * inertia, (0.9, 0.9))
    for x, y in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
        root = np.array([0.042 * x, 0.025 * y, -HALF[2]])
        rows = []
        for k in range(2 * elements + 1):
            place = centre + rotation @ (root - [0.0, 0.0, length * k / (2 * elements)])
            rows.append(builder.add_frame(place, rotation @ DOWN, on=trunk if k == 0 else None))
        builder.add_element(Beam, rows, section=section, young_modulus=modulus, poisson_ratio=0.45, density=1070.0)
    model = builder.build()
    angle = 2.0 * np.pi * np.arange(8) / 8
    outline = RADIUS * np.column_stack([np.cos(angle), np.sin(angle)])
    for beam in [block for block in model.blocks if isinstance(block, Beam)]:
        for side in (1.0, -1.0):
            name = f"chamber {len(model.constraints['a']) + 1}"
            line = beam.line(range(elements), (0.0045 * side, 0.0), model.nodes)
            model.add("a", Chamber(name, [line], math.pi * 0.003**2)).unilateral = False
        model.skins.append(tube_skin(beam, model.nodes, outline))
    model.skins.append(box_skin(trunk, HALF, model.nodes))
    model.add("e", Point("trunk", EmbeddedPoints.in_frame(trunk, np.zeros(3), model.nodes)))
    model.set_contact(obstacles=obstacles, settings=ContactSettings())
    return model


def ground(friction=0.8, normal=(0.0, 0.0, 1.0)):
    return Plane((0.0, 0.0, 0.0), normal, friction=friction, name="ground")


def dynamics(model, **options):
    return Dynamics(model, **{"step": H, "stiffness_damping": 0.01, "tolerance": 1e-10, **options})


def trot(time):
    """Volumes of the chambers [m3] at a time [s]."""
    volumes, size = np.empty(8), 3e-8 * min(1.0, time / 0.1)
    for leg, sign in enumerate((1.0, -1.0, -1.0, 1.0)):
        swing, lift = math.sin(12.0 * time) * sign, 0.5 * (1.0 + math.cos(12.0 * time) * sign)
        volumes[2 * leg : 2 * leg + 2] = size * (lift + swing), size * (lift - swing)
    return volumes


def random_walk(seed):
    """A quadruped with a random body, and a random gait: its backend and the commands of 200 time steps (200, 8)."""
    rng, robot = np.random.default_rng(seed), make_robot("quadruped")
    space = robot.design_space
    design = {name: float(space[name].from_unit(rng.uniform(-1.0, 1.0))) for name in space.names}
    backend = FEMBackend(robot, design, dynamics=True)
    size, phase, middle = rng.uniform(0.9e-8, 3e-8, 8), rng.uniform(0.0, 2.0 * np.pi, 8), rng.uniform(0.0, 2e-8, 8)
    k = np.arange(1, 41)[:, None]
    volumes = (middle + size * np.sin(2.0 * np.pi * k / 10 + phase)) * np.minimum(1.0, k / 5)
    volumes = volumes.clip(robot.lower, robot.upper)
    before = np.vstack([np.zeros(8), volumes[:-1]])
    return backend, np.concatenate([backend.steps.ramp(a, b) for a, b in zip(before, volumes, strict=True)])


def mover(backend, **options):
    """Dynamics of the present body of a backend, at rest."""
    solver, rest = Dynamics(backend.model, **{**backend.step_options, **options}), backend.rest
    solver.restore(rest.nodes, rest.row_effort, memory=rest.memory)
    return solver


def remaining(general, start, x, effort, command):
    """What the general solver would still correct at the end of a time step [m], and its ``W``.

    Args:
        general: a solver that is not compiled.
        start: rows, efforts, velocities and memory at the start.
        x: rows at the end, shape (n, 3).
        effort: efforts there, shape (size,).
        command: values of the actuators there, shape (n_a,).
    """
    rows, efforts, velocity, memory = start
    general.restore(rows, efforts, velocity, memory=memory)
    inertia, goal = ImplicitEuler(rows, velocity, general.step, general._body), np.zeros(len(effort))
    goal[: len(command)] = command
    general.x, general.effort = x, effort
    with general._inertia_added(inertia):
        assert general.linearisation.update(x, effort, exact=True)
        step, _ = general._correction(None, general.linearisation.delta, effort, goal, np.arange(len(command)))
        return general._norm(step), general.linearisation.W.copy()


@dataclass(frozen=True)
class Walk:
    """A walk of one body against the equations of the general solver, which is not asked for a walk of its own.

    Args:
        seed: of `random_walk`.
        steps: time steps that compiled code took.
        divided: those of them that it had to divide, which are not compared.
        compared: states that were.
        correction: largest motion by which the general solver would correct one of these states [m].
        compliance: largest error of ``W``, relative to its diagonal.
        touching: points that touched, over all these states.
        sliding: those that slid.
    """

    seed: int
    steps: int
    divided: int
    compared: int
    correction: float
    compliance: float
    touching: int
    sliding: int


def compared_walk(seed, *, every=10):
    """Take the steps of `random_walk` and compare the end of every few of them with the general equations."""
    backend, commands = random_walk(seed)
    solver, general = mover(backend), mover(backend, compiled=False)
    steps = divided = compared = touching = sliding = 0
    correction = error = 0.0
    for k, command in enumerate(commands):
        start = solver.x, solver.effort, solver.velocity, solver.memory
        taken, found = solver.advance_compiled(command[None])
        if not taken:
            break
        steps += 1
        divided += found.substeps > 1
        if k % every or found.substeps > 1:
            continue
        state = found.equilibrium
        left, exact = remaining(general, start, state.x, state.effort, command)
        size = np.sqrt(np.abs(np.diag(exact)))
        error = max(error, float((np.abs(state.condensed.compliance - exact) / np.outer(size, size)).max()))
        correction, compared = max(correction, left), compared + 1
        touching += state.contacts.count
        sliding += int(state.contacts.sliding.sum())
    return Walk(seed, steps, divided, compared, correction, error, touching, sliding)


def walkers(count=100):
    """Compare the walks of many random bodies and gaits, 40 control steps each, with the general equations."""
    return [asdict(compared_walk(seed)) for seed in range(count)]
