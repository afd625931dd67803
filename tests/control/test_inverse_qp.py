"""Inverse control: on linear models of known answer, and on the finite elements of the finger."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.backends.fem import FEMBackend
from softgym_envs.control import InverseQP
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.complementarity import solve_complementarity
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.robots import make_robot


class LinearRobot:
    """A body of constant W: what the controller assumes, so its answers can be checked exactly.

    Three cables on an effector in space, with the compliance and strokes of a real finger (SI).
    """

    lower, upper, rates = np.zeros(3), np.full(3, 0.02), np.full(3, 0.002)
    unilateral = np.ones(3, dtype=bool)
    rest = np.array([0.0, 0.01, -0.12])

    def __init__(self, rng):
        half = rng.standard_normal((6, 8))
        self.W = 1e-3 * (half @ half.T / 8 + 0.1 * np.eye(6))
        # Cables that pull in different directions, as antagonists do: some goals need two of them, none all three.
        self.W[3:, :3] = 1e-3 * np.array([[2.0, -1.0, -1.0], [0.0, 1.7, -1.7], [0.5, 0.6, 0.4]])
        self.W[:3, 3:] = self.W[3:, :3].T
        self.W[3:, 3:] += 2e-2 * np.eye(3)
        assert np.linalg.eigvalsh(self.W)[0] > 0
        self.go(np.zeros(3))

    def go(self, command):
        """Move to a command; cables that would have to push hang slack."""
        effort = solve_complementarity(self.W[None, :3, :3], -command[None], self.unilateral)[0]
        self.command, self.slack = command, effort <= 0.0
        effort = np.concatenate([effort, np.zeros(3)])
        self.model = CondensedModel(self.W, np.concatenate([np.zeros(3), self.rest]), effort, (("a", 3), ("e", 3)))
        self.effector = self.model.delta.e
        return self.effector

    def controller(self, **options):
        return InverseQP(self.lower, self.upper, self.rates, self.unilateral, **options)

    def follow(self, controller, goal, steps=60):
        """Close the loop; checks bounds and rates on the way, and returns the distances."""
        distances = []
        for _ in range(steps):
            command = controller.solve(self.model, goal, self.command, self.slack)
            assert (command >= self.lower - 1e-12).all()
            assert (command <= self.upper + 1e-12).all()
            assert (np.abs(command - self.command) <= self.rates * (1 + 1e-9)).all()
            distances.append(np.linalg.norm(self.go(command) - goal))
        return np.array(distances)


@pytest.fixture
def linear(rng):
    return LinearRobot(rng)


def test_reaches_reachable_goals(linear, rng):
    for _ in range(5):
        goal = linear.go(rng.uniform(0.002, 0.018, 3)).copy()
        linear.go(np.zeros(3))
        start = np.linalg.norm(linear.effector - goal)
        distances = linear.follow(linear.controller(effort_weight=0.0), goal)
        # With no weight on the effort there is no steady error; the step weight only slows the end.
        assert start > 1e-3
        assert distances[-1] < 1e-6
        assert (np.diff(distances) < 1e-7).all()


def test_one_step_is_the_least_squares_answer_where_no_bound_is_active(linear):
    """Against the normal equations, with W_ea, W_aa and the two weights written out."""
    linear.go(np.array([0.010, 0.006, 0.005]))
    goal = linear.effector + np.array([2e-4, -1e-4, 1e-4])
    controller = linear.controller(effort_weight=1e-2, step_weight=3e-2)
    command = controller.solve(linear.model, goal, linear.command)
    Waa, Wea, effort = linear.W[:3, :3], linear.W[3:, :3], linear.model.lambda_.a
    epsilon = np.linalg.norm(Wea.T @ Wea) / np.linalg.norm(Waa)
    normal = Wea.T @ Wea + (1e-2 + 3e-2) * epsilon * Waa
    change = np.linalg.solve(normal, Wea.T @ (goal - linear.effector) - 1e-2 * epsilon * Waa @ effort)
    step = Waa @ change
    assert (np.abs(step) < linear.rates).all()
    assert (effort + change > 0).all()
    np.testing.assert_allclose(command, linear.command + step, rtol=0, atol=1e-9)


def test_steps_are_limited_by_the_rates(linear):
    command = linear.controller().solve(linear.model, linear.rest + [0.05, 0.05, 0.05], np.zeros(3))
    assert np.abs(command).max() == pytest.approx(0.002, rel=1e-6)


def test_goals_out_of_reach_end_at_the_nearest_point_in_the_box(linear, rng):
    """The closed loop ends where a search over the box of commands ends."""
    goal = linear.rest + np.array([0.05, 0.01, 0.02])
    distances = linear.follow(linear.controller(effort_weight=0.0, step_weight=1e-6), goal)
    best = linear.command
    size = 0.01
    reached = np.linalg.norm(linear.go(best) - goal)
    for _ in range(400):
        trial = np.clip(best + size * rng.standard_normal(3), linear.lower, linear.upper)
        found = np.linalg.norm(linear.go(trial) - goal)
        if found < reached:
            best, reached = trial, found
        else:
            size *= 0.98
    assert distances[-1] > 5e-3
    assert distances[-1] < reached + 1e-5


def test_cables_never_push(linear):
    """A goal that only a pushing cable could meet: efforts stay at or above zero, and bilateral ones go below."""
    goal = linear.rest - 3.0 * (linear.W[3:, :3] @ [1.0, 1.0, 1.0])
    for _ in range(30):
        command = linear.controller().solve(linear.model, goal, linear.command, linear.slack)
        predicted = np.linalg.solve(linear.W[:3, :3], command)
        assert (predicted > -1e-5).all()
        linear.go(command)
    assert np.abs(linear.command).max() < 1e-4
    free = InverseQP(np.full(3, -0.02), linear.upper, linear.rates, np.zeros(3, dtype=bool))
    command = free.solve(linear.model, goal, np.zeros(3))
    assert np.linalg.solve(linear.W[:3, :3], command).min() < -0.1


def test_efforts_stay_below_their_bound(linear):
    goal = linear.rest + 40.0 * linear.W[3:, 0]
    limit = np.array([3.0, 2.0, 2.0])
    linear.follow(linear.controller(max_effort=limit), goal)
    assert (linear.model.lambda_.a <= limit + 1e-5).all()
    assert linear.model.lambda_.a[0] == pytest.approx(3.0, abs=1e-3)


def test_the_effort_weight_chooses_between_redundant_cables(rng):
    """Two equal cables, one coordinate of interest: the effort is shared."""
    W = np.array([[1.0, 0.2, 0.5], [0.2, 1.0, 0.5], [0.5, 0.5, 3.0]]) * 1e-3
    command = np.array([0.004, 0.0])
    controller = InverseQP(np.zeros(2), np.full(2, 0.02), np.full(2, 0.001), np.ones(2, dtype=bool), effort_weight=1e-3)
    free = np.zeros(3)
    for _ in range(300):
        effort = np.append(np.maximum(np.linalg.solve(W[:2, :2], command), 0.0), 0.0)
        model = CondensedModel(W, free, effort, (("a", 2), ("e", 1)))
        command = controller.solve(model, np.array([0.002]), command)
    assert command[0] == pytest.approx(command[1], rel=1e-2)
    assert model.delta.e[0] == pytest.approx(0.002, rel=5e-3)


def test_stands_still_at_its_goal(linear):
    linear.go(np.array([0.01, 0.008, 0.006]))
    command = linear.controller(effort_weight=0.0).solve(linear.model, linear.effector, linear.command)
    np.testing.assert_allclose(command, linear.command, rtol=0, atol=1e-9)


def test_the_answer_does_not_depend_on_units(linear):
    """In millimetres and millinewtons instead of SI: the problem is scaled to order one inside."""
    goal = linear.rest + [0.004, 0.002, 0.003]
    metres = linear.controller().solve(linear.model, goal, linear.command)
    kilo = CondensedModel(linear.W, 1e3 * linear.model.free, 1e3 * linear.model.effort, linear.model.roles)
    controller = InverseQP(1e3 * linear.lower, 1e3 * linear.upper, 1e3 * linear.rates, linear.unilateral)
    np.testing.assert_allclose(controller.solve(kilo, 1e3 * goal, 1e3 * linear.command), 1e3 * metres, atol=1e-6)


@pytest.mark.parametrize(
    "goal",
    [[np.nan, 0.0, 0.0], [0.0, 0.0, np.inf], [0.0, 0.0], [[0.0] * 3] * 2, 0.0],
    ids=["NaN", "inf", "two", "two effectors", "scalar"],
)
def test_malformed_goals_are_refused(linear, goal):
    controller = linear.controller()
    with pytest.raises(ValueError, match="goal must be 3 finite coordinates"):
        controller.solve(linear.model, goal, linear.command)
    # And the controller still works.
    assert np.isfinite(controller.solve(linear.model, linear.rest + 1e-3, linear.command)).all()


def test_a_broken_model_is_an_error_not_a_command(linear):
    free = linear.model.free.copy()
    free[4] = np.nan
    broken = CondensedModel(linear.W, free, linear.model.effort, linear.model.roles)
    controller = linear.controller()
    with pytest.raises((ConvergenceError, ValueError)):
        controller.solve(broken, linear.rest, linear.command)
    assert np.isfinite(controller.solve(linear.model, linear.rest + 1e-3, linear.command)).all()


@pytest.mark.parametrize("rates", [[0.0, 0.1, 0.1], [-1.0, 0.1, 0.1], [np.nan, 0.1, 0.1]], ids=str)
def test_rates_must_be_positive(rates):
    with pytest.raises(ValueError, match="rates must be positive"):
        InverseQP(np.zeros(3), np.ones(3), np.array(rates), np.ones(3, dtype=bool))


# -- on the finite elements -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cables", "target"),
    [(1, [0.0137]), (2, [0.013, 0.011]), (2, [0.004, 0.017])],
    ids=["one cable", "two cables", "one of two cables slack"],
)
def test_finger_reaches_a_reachable_goal(cables, target):
    """Within 0.01 mm (measured: 0.001 mm), linearising anew at each step; the goal is that of other displacements."""
    robot = make_robot("finger", cables=cables)
    backend = FEMBackend(robot)
    there = backend.step(np.array(target))
    goal = there.effector[0]
    state = backend.reset()
    controller = InverseQP(robot.lower, robot.upper, robot.rates, np.ones(cables, dtype=bool))
    for _ in range(40):
        command = controller.solve(state.condensed, goal, state.command, state.slack)
        assert (np.abs(command - state.command) <= robot.rates * (1 + 1e-9)).all()
        assert ((command >= robot.lower) & (command <= robot.upper)).all()
        state = backend.step(command)
        assert (state.effort >= 0.0).all()
    distance = np.linalg.norm(state.effector[0] - goal)
    print(f"{cables} cables: {distance * 1e3:.1e} mm")
    assert distance < 1e-5
    np.testing.assert_allclose(state.displacement, there.displacement, atol=2e-5)
