"""Friction of cables: the capstan law on a fixed arc, sticking and sliding, exact W."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.cable_friction import CableFriction
from softgym_envs.mechanics.solvers.dynamics import Dynamics
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.cable_trunk import octagonal_bar

MU, ANGLE, GUIDES = 0.85, 0.5 * np.pi, 7


def arc_and_spring(friction):
    """A cable over a quarter circle in a clamped block, with its anchor on the free end of a soft bar.

    The guides do not move. So a displacement of the cable stretches the bar alone, whose tension is that without
    friction, and the drive has to pull with ``exp(mu angle)`` times as much.
    """
    bar, tetrahedra = octagonal_bar(4, 1)
    bar = bar * [0.01, 0.01, 0.05]
    block = bar * [4.0, 4.0, 2.0] + [0.1, 0.0, 0.0]
    nodes = np.vstack([bar, block])
    fixed = (nodes[:, 2] == 0.0) | (np.arange(len(nodes)) >= len(bar))
    model = MechanicalModel.from_mesh(
        nodes,
        np.vstack([tetrahedra, tetrahedra + len(bar)]),
        fixed=fixed,
        young_modulus=1e5,
        poisson_ratio=0.3,
        element="linear",
    )
    # From the bar's end along +x, a quarter turn to +y, in the plane z = 0.05.
    turns = np.linspace(0.0, ANGLE, GUIDES + 1)
    middle = 0.5 * (turns[1:] + turns[:-1])
    radius = 0.03
    guides = np.column_stack([0.08 + radius * np.sin(middle), radius - radius * np.cos(middle), np.full(GUIDES, 0.05)])
    # Chords of equal angles: the first and the last segment are tangents of the circle.
    pull = guides[-1] + 0.05 * np.array([np.cos(ANGLE), np.sin(ANGLE), 0.0])
    start = np.array([0.0, guides[0, 1], 0.05])
    cable = model.add_cable("cable", np.vstack([guides[::-1], start]), pull)
    cable.friction = friction
    return model, cable


def turning(cable, x):
    edges = np.diff(cable.path(x), axis=0)
    along = edges / np.linalg.norm(edges, axis=1)[:, None]
    return float(np.arccos(np.clip((along[1:] * along[:-1]).sum(axis=1), -1.0, 1.0)).sum())


def test_the_capstan_law_on_a_fixed_arc():
    """Pulled, then let out: exp(mu angle) and exp(-mu angle) times the tension without friction."""
    (plain, _), (rough, cable) = arc_and_spring(0.0), arc_and_spring(MU)
    free, held = Statics(plain), Statics(rough)
    for pull, sign in ((0.001, 1.0), (0.003, 1.0), (0.0024, -1.0), (0.002, -1.0), (0.0025, 1.0)):
        expected, found = free.solve([pull]), held.solve([pull])
        np.testing.assert_allclose(found.x, expected.x, atol=1e-9)
        ratio = found.effort[0] / expected.effort[0]
        angle = turning(cable, found.x)
        print(f"{1e3 * pull:.1f} mm: ratio {ratio:.5f}, exp(+-mu angle) {np.exp(sign * MU * angle):.5f}")
        assert abs(angle - ANGLE) < 0.1
        assert abs(ratio / np.exp(sign * MU * angle) - 1.0) < 1e-4


def test_a_cable_sticks_before_it_slides_back():
    """Just after the direction turns, the tension lies between those of sliding, and the cable does not creep."""
    (plain, _), (rough, cable) = arc_and_spring(0.0), arc_and_spring(MU)
    free, held = Statics(plain), Statics(rough)
    held.solve([0.003])
    pull = 0.003 - 1e-3 * cable.rest_length
    first = held.solve([pull])
    ratio = first.effort[0] / free.solve([pull]).effort[0]
    assert np.exp(-MU * ANGLE) * 1.2 < ratio < np.exp(MU * ANGLE) / 1.2
    again = held.solve([pull])
    np.testing.assert_allclose(again.effort, first.effort, rtol=1e-9)
    # The state and its memory bring it back, also in another solver.
    other = Statics(rough)
    other.restore(first.x, first.effort, memory=first.memory)
    np.testing.assert_allclose(other.solve([0.0015]).effort, held.solve([0.0015]).effort, rtol=1e-7)


@pytest.mark.parametrize("name", ["finger", "cable_trunk"])
@pytest.mark.parametrize("back", [False, True], ids=["pulled", "let out and stuck"])
def test_W_is_the_derivative_with_friction(name, back):
    """By finite differences in the efforts of the taut cables, extrapolated to no step; W is not symmetric.

    Where guides slide, the equilibrium has a derivative but a jump in the second one, so errors are linear in the step.
    """
    robot = make_robot(name)
    model = robot.build()
    for cable in model.constraints["a"]:
        cable.friction = MU
    solver = Statics(model)
    pull = (np.array([0.30, 0.27]) if name == "finger" else 0.3 * np.array([1, 1, 0, 0, 1, 1, 0, 0])) * robot.upper
    for share in (0.5, 1.0):
        state = solver.solve(share * pull)
    if back:
        state = solver.solve(pull - 0.7e-3 * np.array([c.rest_length for c in model.constraints["a"]]) * (pull > 0.0))
    W, count = state.condensed.compliance, len(pull)
    effort = state.effort[:count]
    taut = np.flatnonzero(effort > 0.05 * effort.max())
    columns = []
    for k in taut:
        slopes = []
        for step in (2e-6 * effort.max(), 1e-6 * effort.max()):
            ends = []
            for change in (step, -step):
                solver.restore(state.x, state.effort, memory=state.memory)
                ends.append(solver.solve(np.maximum(effort + change * (np.arange(count) == k), 0.0), "effort").delta)
            slopes.append((ends[0] - ends[1]) / (2.0 * step))
        columns.append(2.0 * slopes[1] - slopes[0])
    largest = np.abs(W[:, taut]).max()
    difference = np.abs(np.array(columns).T - W[:, taut]).max() / largest
    asymmetry = np.abs(W[:count, :count] - W[:count, :count].T).max() / largest
    print(f"{len(taut)} taut: W against differences {difference:.1e}, asymmetry {asymmetry:.1e}")
    assert len(taut) > 1
    assert difference < 1e-6
    assert asymmetry > 1e-4


def test_the_finger_bends_less_at_its_tip_with_friction():
    """Friction takes tension from the distal joints; shares of tension fall from the pull point to the anchor."""
    robot = make_robot("finger")
    tips, tensions = [], []
    for friction in (0.0, MU):
        model = robot.build()
        for cable in model.constraints["a"]:
            cable.friction = friction
        solver = Statics(model)
        for pull in np.linspace(0.0, 0.012, 7)[1:]:
            state = solver.solve([pull, pull])
        tips.append(state.condensed.delta.e)
        tensions.append(state.effort[0])
    shares = CableFriction.shares(solver.linearisation.cable_friction, state.x)
    print(
        f"tips {np.round(1e3 * np.array(tips), 2).tolist()} mm, tensions {tensions} N, shares {np.round(shares[0], 3)}"
    )
    assert np.linalg.norm(tips[0] - tips[1]) > 5e-4
    assert tensions[1] > 1.05 * tensions[0]
    assert (np.diff(shares[0]) <= 1e-12).all() and shares[0][-1] < 0.9


def test_friction_is_refused_where_it_is_not_computed():
    model = make_robot("finger").build()
    model.constraints["a"][0].friction = 0.3
    with pytest.raises(ValueError, match="friction"):
        Dynamics(model, step=0.01)
    model = make_robot("finger", self_contact=True).build()
    model.constraints["a"][0].friction = 0.3
    with pytest.raises(ValueError, match="no frames and no contact"):
        Statics(model)
