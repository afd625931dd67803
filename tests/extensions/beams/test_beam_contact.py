"""Compiled bodies of beams that touch obstacles: against the general solver, and against what is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.beams.prism import RoundedPrism
from softgym_envs.extensions.beams.solver.batch import BeamBatch, BeamStates
from softgym_envs.extensions.beams.solver.contact import FEW
from softgym_envs.extensions.beams.solver.equations import Step, assemble, point_strains
from softgym_envs.extensions.beams.solver.frames import move
from softgym_envs.extensions.beams.solver.motion import anchors_of
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.contact.contact import ContactSettings
from softgym_envs.mechanics.contact.obstacles import Cylinder, MeshObstacle, Plane, Sphere
from softgym_envs.mechanics.solvers.dynamics import Dynamics
from softgym_envs.mechanics.solvers.statics import Statics
from tests.verification.walkers import H, compared_walk, dynamics, ground, mover, remaining, trot, walker


def tilted(angle):
    """Rotation about the y axis."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


@pytest.fixture(scope="module")
def standing():
    """A walker on a plane, at rest."""
    solver = dynamics(walker([ground()]))
    assert solver.not_compiled is None
    for _ in range(12):
        assert solver.advance_compiled(np.zeros((5, 8)))[0] == 5
    return solver


def start_again(standing, **options):
    """The same body in the same state, with another solver."""
    solver = dynamics(standing.model, **options)
    solver.restore(standing.x, standing.effort, standing.velocity, memory=standing.memory)
    return solver


def compare_steps(solver, commands, *, every):
    """Take steps, some of them from the same states with the general solver; return counts of touching and sliding."""
    general = dynamics(solver.model, compiled=False)
    touching = sliding = 0
    for k, command in enumerate(commands):
        start = solver.x, solver.effort, solver.velocity, solver.memory
        taken, found = solver.advance_compiled(command[None])
        assert taken == 1
        if k % every:
            continue
        general.restore(*start[:3], memory=start[3])
        expected = general.advance(command)
        assert found.substeps == expected.substeps == 1
        one, other = found.equilibrium, expected.equilibrium
        assert np.abs(one.x - other.x).max() < 2e-8
        W, exact = one.condensed.compliance, other.condensed.compliance
        size = np.sqrt(np.diag(exact))
        assert (np.abs(W - exact) < 1e-6 * np.outer(size, size)).all()
        assert one.contacts.count == other.contacts.count
        assert one.contacts.sliding.sum() == other.contacts.sliding.sum()
        assert one.contacts.total == pytest.approx(other.contacts.total, abs=2e-5)
        assert one.contacts.smallest_gap == pytest.approx(other.contacts.smallest_gap, rel=1e-5)
        for mine, theirs in zip(one.memory.anchors, other.memory.anchors, strict=True):
            assert (mine is None) == (theirs is None)
            assert mine is None or np.abs(mine - theirs).max() < 2e-8
        assert found.energy == pytest.approx(expected.energy, rel=1e-7, abs=1e-9)
        touching += one.contacts.count
        sliding += int(one.contacts.sliding.sum())
    return touching, sliding


def test_a_body_stands_still(standing):
    taken, motion = start_again(standing).advance_compiled(np.zeros((50, 8)))
    assert taken == 50
    assert np.abs(motion.velocity).max() < 1e-9
    weight = standing.model.mass * 9.81
    assert motion.equilibrium.contacts.total == pytest.approx(np.array([[0.0, 0.0, weight]]), abs=1e-6 * weight)


def test_steps_of_a_walk_are_those_of_the_general_solver(standing):
    commands = [trot(H * (k + 1)) for k in range(45)]
    touching, sliding = compare_steps(start_again(standing), commands, every=4)
    assert touching > 20
    assert sliding > 5


@pytest.mark.parametrize("seed", [0, 4, 6, 14, 17])
def test_random_walks_take_whole_steps_that_solve_the_general_equations(seed):
    """Of twenty random bodies and gaits, these pass most often between sticking and sliding; 14 does so in step 11."""
    found = compared_walk(seed)
    assert (found.steps, found.divided, found.compared) == (200, 0, 20)
    assert found.correction < 1e-9
    assert found.compliance < 1e-6
    assert found.touching > 20
    assert found.sliding > 5


def test_a_body_that_lies_on_many_points_solves_the_general_equations():
    """A crawler that is put down on its belly, and lifts itself: more points touch than have a dense compliance."""
    backend = FEMBackend(make_robot("crawler"), dynamics=True)
    solver, general = mover(backend), mover(backend, compiled=False)
    goal = 0.2 * np.asarray(backend.robot.upper)
    counts, sliding = [], 0
    for k in range(30):
        start = solver.x, solver.effort, solver.velocity, solver.memory
        command = min(1.0, k / 20) * goal
        taken, found = solver.advance_compiled(command[None])
        assert (taken, found.substeps) == (1, 1)
        counts.append(found.equilibrium.contacts.count)
        sliding += int(found.equilibrium.contacts.sliding.sum())
        if k % 5 == 0:
            assert remaining(general, start, found.equilibrium.x, found.equilibrium.effort, command)[0] < 1e-9
    assert max(counts) > 4 * FEW
    assert min(counts) <= FEW
    assert sliding > 0


def test_steps_between_other_obstacles_are_those_of_the_general_solver():
    """A fall onto a ball, a bar and the edge of a box."""
    obstacles = [
        Sphere((0.042, 0.027, -0.02), 0.02, friction=0.3, name="ball"),
        Cylinder((0.04, -0.025, -0.01), (1.0, 0.2, 0.0), 0.01, name="smooth bar"),
        RoundedPrism.box((0.03, 0.06, 0.02), 0.003, centre=(-0.05, 0.0, -0.02), friction=0.6, name="step"),
    ]
    solver = dynamics(walker(obstacles, clearance=0.003))
    touching, sliding = compare_steps(solver, np.zeros((24, 8)), every=2)
    assert touching > 10
    assert sliding > 0


def test_the_tangent_is_the_derivative_of_the_forces(standing):
    """With points that slide: its symmetric part, and the term of low rank."""
    solver = start_again(standing)
    solver.advance_compiled(np.array([trot(H * (k + 1)) for k in range(12)]))
    beams = solver.compiled_solver()
    body, equations = beams.body, beams.equations
    strains = np.zeros((len(body.elements.frames), 2, 6))
    point_strains(body.elements, solver.x, strains)
    anchors = anchors_of(body.contact, solver.memory)
    anchors += 1e-5 * np.random.default_rng(0).normal(size=anchors.shape)
    step = Step(solver.x, solver.velocity, strains, solver.model.loads, H, 0.3, 0.01, anchors)
    assemble(body, solver.x, solver.effort, step, equations, True)
    slides, pattern = equations.slides, body.pattern
    assert 0 < slides.number[0] < 20
    motion = np.random.default_rng(1).normal(size=body.components.free.shape)
    product = np.zeros_like(motion)
    for i in range(pattern.size):
        product[i] += equations.tangent[i] @ motion[i]
        for p in range(pattern.pointers[i], pattern.pointers[i + 1]):
            block, other = equations.tangent[pattern.size + p], pattern.columns[p]
            product[i] += block @ motion[other]
            product[other] += block.T @ motion[i]
    for s in range(slides.number[0]):
        product += slides.direction[s] * (slides.loading[s] * motion).sum()
    residuals = []
    for size in (1e-8, -1e-8):
        x = solver.x.copy()
        move(body.frames, x, size * motion, np.zeros((3, 3)))
        assemble(body, x, solver.effort, step, equations, False)
        residuals.append(equations.residual.copy())
    # Along the motion, the moments of frames turn too: compare only products that do not see this.
    difference = (residuals[0] - residuals[1]) / 2e-8
    assert difference[:, :3] == pytest.approx(product[:, :3], abs=1e-5 * np.abs(product).max())
    assert (difference * motion).sum() == pytest.approx((product * motion).sum(), rel=1e-5)


@pytest.mark.parametrize("share", [0.95, 1.05])
def test_a_slope_below_and_above_the_coefficient_of_friction(share):
    friction = 0.5
    angle = math.atan(share * friction)
    rotation = tilted(angle)
    model = walker([ground(friction, rotation[:, 2])], length=0.02, modulus=5e6, rotation=rotation, clearance=3e-4)
    solver = dynamics(model)
    for _ in range(20):
        assert solver.advance_compiled(np.zeros((5, 8)))[0] == 5
    start, down = solver.x[0].copy(), rotation[:, 0]
    speed = solver.velocity[0] @ down
    _, motion = solver.advance_compiled(np.zeros((20, 8)))
    if share < 1.0:
        assert np.abs(motion.velocity).max() < 1e-6  # 1 mm/s is asked for
        assert np.abs(solver.x[0] - start).max() < 1e-7
    else:
        expected = 9.81 * (math.sin(angle) - friction * math.cos(angle))
        assert (motion.velocity[0] @ down - speed) / 0.2 == pytest.approx(expected, rel=0.01)
        assert motion.equilibrium.contacts.sliding.all()


def test_a_body_in_the_air_falls_freely():
    model = walker([ground()], clearance=0.2)
    solver = dynamics(model)
    start = solver.x.copy()
    _, motion = solver.advance_compiled(np.zeros((10, 8)))
    fallen = 9.81 * H**2 * 10 * 11 / 2
    origins = [0, *range(4, len(start), 4)]
    assert solver.x[origins] == pytest.approx(start[origins] - [0.0, 0.0, fallen], abs=1e-9)
    assert motion.equilibrium.contacts.count == 0


def test_a_landing_gains_no_energy():
    """What is lost beyond damping and friction is lost by implicit Euler, which never gains any."""
    solver = dynamics(walker([ground()], clearance=0.02), stiffness_damping=0.001)
    total, heights = [], []
    for _ in range(60):
        taken, motion = solver.advance_compiled(np.zeros((1, 8)))
        assert taken == 1
        total.append(motion.energy + motion.dissipated - motion.work)
        heights.append(motion.equilibrium.contacts.smallest_gap)
        assert heights[-1] > 0.0
    assert min(heights) < 5e-4  # it touches
    assert (np.diff(total) < 1e-9).all()


def test_batches_take_the_same_steps(standing):
    one, two = standing.model, walker([ground(0.3)], modulus=9e5)
    solvers = [start_again(standing), dynamics(two)]
    bodies = [solver.compiled_solver().body for solver in solvers]
    states = BeamStates.of(bodies[0], 11, 2, factors=True)
    assert states.anchors is not None
    for k, solver in enumerate(solvers):
        states.x[k], states.velocity[k], states.effort[k] = solver.x, solver.velocity, solver.effort
        states.anchors[k] = anchors_of(bodies[k].contact, solver.memory)
    targets = np.zeros((2, 10, 11))
    targets[:, :, :8] = [trot(H * (k + 1)) for k in range(10)]
    is_driven = np.arange(11) < 8
    options = {"limit": np.zeros(0), "step": H, "mass_damping": 0.0, "stiffness_damping": 0.01, "tolerance": 1e-10}
    batch = BeamBatch(bodies, [one.loads, two.loads])
    solved, _ = batch.march(np.arange(2), states, targets, is_driven, np.zeros(8, dtype=bool), **options, cuts=6)
    assert solved.all()
    for k, solver in enumerate(solvers):
        _, motion = solver.advance_compiled(targets[k, :, :8])
        assert np.abs(states.x[k] - solver.x).max() < 1e-10
        assert states.compliance[k] == pytest.approx(motion.equilibrium.condensed.compliance, rel=1e-6, abs=1e-12)
        assert np.abs(states.anchors[k] - anchors_of(bodies[k].contact, solver.memory)).max() < 1e-10


def test_bodies_that_need_the_general_solver_say_why():
    def reason(obstacles, **settings):
        model = walker([ground()])
        model.set_contact(obstacles=obstacles, settings=ContactSettings(**settings))
        return Dynamics(model, step=H).not_compiled

    mesh = MeshObstacle(((0, 0, -0.05), (0.1, 0, -0.05), (0, 0.1, -0.05)), ((0, 1, 2),), name="shell")
    assert reason([mesh]) == "obstacle 'shell' is a mesh"
    assert reason([Plane((0, 0, -0.05), (0, 0, 1), frame=0)]) == "obstacle 'plane' moves with a frame"
    assert reason([], self_contact=True) == "surfaces of the body touch each other"
    assert Statics(walker([ground()])).not_compiled == "it touches obstacles, at rest"
    builder = ModelBuilder(floating=True)
    frames = [builder.add_frame((0.01 * k, 0.0, 0.0)) for k in range(3)]
    builder.add_mass(frames[0], 1.0, np.eye(3))
    assert Dynamics(builder.build(), step=H).not_compiled == "it has no beams"
    options = {"young_modulus": 1e6, "poisson_ratio": 0.3, "density": 1e3, "order": 1}
    builder.add_element(Beam, frames[:2], section=Section.circle(0.001), **options)
    assert Dynamics(builder.build(), step=H).not_compiled == "a beam has linear elements"
