"""Gradients of rollouts by the design of the body, against rollouts of other bodies."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.extensions.beams.neighbours import neighbours_of
from softgym_envs.extensions.beams.robots.tetrapod import Tetrapod
from softgym_envs.extensions.beams.rollout import roll_out
from softgym_envs.extensions.beams.solver.design import Neighbours
from softgym_envs.extensions.walkers.robots.quadruped import Quadruped
from softgym_envs.mechanics.solvers.dynamics import Dynamics
from tests.verification.walkers import H, trot

EXACT = 1e-4
"""Allowed error of a derivative, as a part of it: that of the differences."""


def dynamics(model, **options):
    return Dynamics(model, **{"step": H, "stiffness_damping": 0.01, "tolerance": 1e-12, **options})


def weighted(rollout, seed=0):
    """A scalar of rows, velocities and efforts of the trunk at all times, and its derivatives."""
    rng, count = np.random.default_rng(seed), len(rollout.x)
    by_x, by_velocity, by_effort = (np.zeros_like(a) for a in (rollout.x, rollout.velocity, rollout.effort))
    by_x[:, :4] = rng.normal(size=(count, 4, 3))
    by_velocity[:, :4] = 0.01 * rng.normal(size=(count, 4, 3))
    actuators = sum(c.size for c in rollout.dynamics.model.constraints["a"])
    by_effort[:, :actuators] = 1e-7 * rng.normal(size=(count, actuators))
    value = (by_x * rollout.x).sum() + (by_velocity * rollout.velocity).sum() + (by_effort * rollout.effort).sum()
    return float(value), {"by_x": by_x, "by_velocity": by_velocity, "by_effort": by_effort}


def check(build, values, sizes, roll, *, seed=0):
    """Compare derivatives by design variables of a whole rollout with differences of rollouts of other bodies."""
    neighbours = Neighbours.of(build, values, 1e-5 * sizes)
    rollout = roll(build(values))
    _, given = weighted(rollout, seed)
    gradient = rollout.gradient(**given, neighbours=neighbours).design
    for k, size in enumerate(sizes):
        ends = []
        for sign in (1.0, -1.0):
            other = values.copy()
            other[k] += sign * 1e-6 * size
            ends.append(weighted(roll(build(other)), seed)[0])
        assert gradient[k] == pytest.approx((ends[0] - ends[1]) / (2e-6 * size), rel=EXACT, abs=1e-7 / size)
    return rollout


@pytest.mark.parametrize(
    ("friction", "push", "steps", "size"), [(0.8, 0.0, 25, 0.4), (0.1, 0.3, 50, 1.0)], ids=["sticking", "sliding"]
)
def test_a_walk_from_the_undeformed_body(friction, push, steps, size):
    """All design variables of the quadruped: inertia, elasticity, chambers, contact, loads and the shape at the start.

    On slippery ground it is pushed, so that its feet slide all the time. No time step may be divided: where one of two
    bodies needs that, they have different equations, and differences tell nothing.
    """
    robot = Quadruped(elements=2, friction=friction)
    # At a lean of 0 the height of the feet has a kink.
    names, values = robot.design_space.names, robot.design_space.complete({"lean": 0.1}).array
    sizes = np.array([variable.high - variable.low for variable in robot.design_space])

    def build(values):
        model = robot.build(dict(zip(names, values, strict=True)))
        model.nodal_loads[0] += [push * 0.9, push * 0.3, 0.0]
        return model

    commands = np.concatenate([np.zeros((15, 8)), [size * trot(H * (k + 1)) for k in range(steps)]])
    rollout = check(build, values, sizes, lambda model: roll_out(dynamics(model, max_cuts=0), commands))
    feet = rollout.dynamics.linearisation.contact.contacts(rollout.x[-1])
    assert feet.count > 2
    if push:
        assert np.linalg.norm(rollout.x[-1, 0] - rollout.x[15, 0]) > 0.02


def test_a_motion_that_begins_elsewhere():
    """Frames begin where they are, whatever the body; servos of bodies that are held by the ground."""
    robot = Tetrapod(elements=2)
    names, baseline = robot.design_space.names, robot.design_space.baseline.array
    sizes = np.array([variable.high - variable.low for variable in robot.design_space])

    def build(values):
        return robot.build(dict(zip(names, values, strict=True)))

    start = dynamics(build(baseline))
    start.advance_compiled(np.full((5, 4), 0.05))
    commands = 0.05 + 0.01 * np.random.default_rng(2).normal(size=(20, 4)).cumsum(axis=0)
    elastic = np.array([name not in ("leg_length", "servo_radius") for name in names])

    def roll(model):
        solver = dynamics(model)
        solver.restore(start.x, start.effort, start.velocity)
        return roll_out(solver, commands)

    # Rows that follow a frame are where other bodies have them only if the arms are the same.
    def partial(values):
        full = baseline.copy()
        full[elastic] = values
        return build(full)

    check(partial, baseline[elastic], sizes[elastic], roll)


def test_a_function_of_torch():
    """One backward pass gives what the gradient gives, by commands and design together."""
    torch = pytest.importorskip("torch")
    from softgym_envs.extensions.beams.torch_rollout import torch_rollout

    robot = Quadruped(elements=2)
    names, values = robot.design_space.names, robot.design_space.complete({"lean": 0.1}).array

    def build(design):
        return robot.build(dict(zip(names, design, strict=True)))

    def near(design):
        return neighbours_of(robot, dict(zip(names, design, strict=True)))

    commands = np.array([trot(H * (k + 1)) for k in range(4)])
    rollout = roll_out(dynamics(build(values)), commands)
    _, given = weighted(rollout)
    expected = rollout.gradient(**given, neighbours=near(values))
    one, other = torch.tensor(commands, requires_grad=True), torch.tensor(values, requires_grad=True)
    found = torch_rollout(lambda design: dynamics(build(design)), one, other, near)
    sum((torch.tensor(by) * value).sum() for by, value in zip(given.values(), found, strict=True)).backward()
    np.testing.assert_allclose(one.grad.numpy(), expected.commands, rtol=1e-12)
    np.testing.assert_allclose(other.grad.numpy(), expected.design, rtol=1e-12)
    with pytest.raises(ValueError, match="gradients by the design need its neighbours"):
        torch_rollout(lambda design: dynamics(build(design)), one, other)


def test_bodies_that_have_no_derivative():
    robot = Quadruped(elements=2)
    names, baseline = robot.design_space.names, robot.design_space.baseline.array
    counts = iter((2, 3))

    def changing(values):
        return Quadruped(elements=next(counts)).build()

    with pytest.raises(ValueError, match="designs of different layouts have no derivative"):
        Neighbours.of(changing, baseline[:1], [1e-6])
    with pytest.raises(ValueError, match=r"must be as many, finite and positive"):
        Neighbours.of(changing, baseline[:1], [0.0])
    longer = Neighbours.of(lambda values: Quadruped(elements=3).build(), baseline[:1], [1e-6])
    rollout = roll_out(dynamics(robot.build(dict(zip(names, baseline, strict=True)))), np.zeros((2, 8)))
    with pytest.raises(ValueError, match="the neighbours have other frames"):
        rollout.gradient(neighbours=longer)
