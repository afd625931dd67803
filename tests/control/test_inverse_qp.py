"""Inverse control: on linear models with known answers, and on the finite elements of the finger."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.control import InverseQP, PICorrection
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.beams import Section, add_rod
from softgym_envs.extensions.deployment import EmbeddedLoop
from softgym_envs.extensions.grasping import ContactQP
from softgym_envs.mechanics import ModelBuilder, Statics
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.solvers.complementarity import solve_complementarity


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
        # With no weight on the effort, there is no steady error; the step weight only slows the end.
        assert start > 1e-3
        assert distances[-1] < 1e-6
        assert (np.diff(distances) < 1e-7).all()


def test_the_controller_of_a_robot_does_not_command_more_than_its_actuators_give():
    robot = make_robot("modular_arm", max_effort=0.05)
    backend, command = FEMBackend(robot), np.zeros(2)
    state = backend.state
    goal = state.effector[0] + [0.03, 0.01, -0.005]  # out of reach
    controller = InverseQP.for_robot(robot)
    for _ in range(15):
        command = controller.solve(state.condensed, goal, command)
        assert np.abs(controller.effort).max() < 0.05 + 1e-9
        state = backend.step(command)
    np.testing.assert_allclose(state.effort, 0.05, rtol=1e-6)
    np.testing.assert_allclose(command, state.displacement, rtol=1e-3)  # commands do not run ahead


def test_steps_within_the_largest_efforts_are_feasible():
    """Scaled steps of an arm from rest: ProxQP takes them for infeasible by default, although zero is allowed."""
    one, largest = np.ones(2), np.array([0.991556, 36.682888])
    hessian = np.array([[0.530067917348048, -0.054871839491015886], [-0.054871839491015886, 0.46993208265195197]])
    rows = np.array([[0.9972379615535633, -0.002762038446436761], [-0.10218235056025814, 0.897817649439742]])
    controller = InverseQP(-one, one, one, np.zeros(2, dtype=bool))
    for gradient, expected in (
        ([-3.386269, 6.899382], [0.991533, -1.0]),
        ([-1.789015, -7.444005], [0.997072, 1.0]),
    ):
        program = (hessian, np.array(gradient), None, None, rows, -largest, largest, -one, one)
        _, step = controller._solved(None, program)
        np.testing.assert_allclose(step, expected, atol=1e-6)


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


# -- efforts, weights and other units -------------------------------------------------------------------------------


def test_commands_in_effort_follow_the_normal_equations(linear):
    """The same answer as in displacement, given as efforts."""
    linear.go(np.array([0.010, 0.006, 0.005]))
    goal = linear.effector + np.array([2e-4, -1e-4, 1e-4])
    displacement = linear.controller(effort_weight=1e-2).solve(linear.model, goal, linear.command)
    controller = linear.controller(effort_weight=1e-2, mode="effort")
    effort = controller.solve(linear.model, goal, linear.model.lambda_.a)
    Waa = linear.W[:3, :3]
    np.testing.assert_allclose(Waa @ effort, displacement, rtol=1e-9)
    np.testing.assert_allclose(controller.effort, effort, rtol=1e-12)
    np.testing.assert_allclose(controller.displacement, Waa @ effort, rtol=1e-9)


def test_efforts_respect_bounds_and_rates_in_both_modes(linear):
    goal = linear.rest + 40.0 * linear.W[3:, 0]
    low, high, rates = np.array([0.2, 0.1, 0.0]), np.array([3.0, 2.0, 2.0]), np.array([0.25, 0.5, 0.1])
    options = {"min_effort": low, "max_effort": high, "effort_rates": rates}
    by_effort = InverseQP(linear.lower, linear.upper, linear.rates, linear.unilateral, mode="effort", **options)
    by_displacement = linear.controller(**options)
    for controller in (by_effort, by_displacement):
        linear.go(linear.W[:3, :3] @ low)
        for _ in range(40):
            before = linear.model.lambda_.a
            command = before if controller is by_effort else linear.command
            answer = controller.solve(linear.model, goal, command)
            linear.go(linear.W[:3, :3] @ answer if controller is by_effort else answer)
            after = linear.model.lambda_.a
            assert (np.abs(after - before) <= rates + 1e-5).all()
            assert ((after >= low - 1e-5) & (after <= high + 1e-5)).all()
        assert after[0] == pytest.approx(3.0, abs=1e-3)


def test_a_command_outside_its_bounds_is_brought_back(linear):
    controller = InverseQP(
        linear.lower,
        linear.upper,
        np.full(3, np.inf),
        linear.unilateral,
        max_effort=[2.0] * 3,
        effort_rates=[0.5] * 3,
        mode="effort",
    )
    linear.go(linear.W[:3, :3] @ [4.0, 1.0, 1.0])
    assert controller.solve(linear.model, linear.effector, linear.model.lambda_.a)[0] == pytest.approx(2.0)


def test_modes_may_differ_between_actuators(linear):
    """The first cable in displacement, the others in effort."""
    linear.go(np.array([0.010, 0.006, 0.005]))
    goal = linear.effector + np.array([2e-4, -1e-4, 1e-4])
    controller = InverseQP(
        linear.lower,
        linear.upper,
        linear.rates,
        linear.unilateral,
        effort_rates=[5.0] * 3,
        mode=["displacement", "effort", "effort"],
    )
    effort = linear.model.lambda_.a
    answer = controller.solve(linear.model, goal, np.array([linear.command[0], effort[1], effort[2]]))
    np.testing.assert_allclose(answer, [controller.displacement[0], *controller.effort[1:]], rtol=1e-9)
    np.testing.assert_allclose(linear.W[:3, :3] @ controller.effort, controller.displacement, atol=1e-10)


def test_goal_weights_choose_the_coordinates(linear):
    """With only y weighted, the other goals do not matter; of two conflicting goals, the heavier wins."""
    controllers = [linear.controller(goal_weights=[0.0, 1.0, 0.0]) for _ in range(2)]
    goal = linear.rest + [0.0, 0.003, 0.0]
    answers = [
        controller.solve(linear.model, goal + far, linear.command)
        for controller, far in zip(controllers, (np.zeros(3), np.array([5.0, 0.0, -7.0])), strict=True)
    ]
    np.testing.assert_array_equal(*answers)
    linear.follow(controllers[0], goal)
    assert linear.effector[1] == pytest.approx(goal[1], abs=1e-6)
    # A point that no command reaches: the error moves to the light coordinates.
    goal = linear.rest + np.array([0.05, 0.01, 0.02])
    errors = []
    for weights in (None, [1.0, 1.0, 100.0]):
        linear.go(np.zeros(3))
        linear.follow(linear.controller(goal_weights=weights), goal)
        errors.append(abs(linear.effector[2] - goal[2]))
    assert errors[1] < 0.2 * errors[0]


def rescaled(model, length, actuator):
    """The model with effectors in ``length`` units and each actuator's displacement in its own; energy is kept."""
    unit = np.concatenate([actuator, np.full(model.free.size - len(actuator), length)])
    return CondensedModel(unit[:, None] * model.compliance * unit, unit * model.free, model.effort / unit, model.roles)


@pytest.mark.parametrize(
    "units",
    [[1.0, 1.0, 1.0], [1e3, 1e3, 1e3], [3e-6, 3e-6, 3e-6], [1.0, 3e-6, 1e9], [3e-6, 1.0, 1e3]],
    ids=["SI", "mm", "chambers in m3 and Pa", "cable, chamber and mm3", "chamber, cable and mm"],
)
@pytest.mark.parametrize("mode", ["displacement", "effort"])
@pytest.mark.parametrize("length", [1.0, 1e3])
def test_mixed_units_give_the_same_answer(linear, units, mode, length):
    """delta from 1e-8 m3 with efforts of 1e5 Pa to mm: every bound and rate active somewhere on the way."""
    units = np.array(units)
    linear.go(np.array([0.010, 0.006, 0.005]))
    present = linear.command if mode == "displacement" else linear.model.lambda_.a
    to_command = np.ones(3) if mode == "displacement" else None
    rates = np.array([0.002, 0.001, 0.003])
    for step in ([2e-4, -1e-4, 1e-4], [0.004, 0.002, 0.003], [-0.02, 0.01, 0.0]):
        answers = []
        for k, e in ((np.ones(3), 1.0), (units, length)):
            controller = InverseQP(
                k * linear.lower,
                k * linear.upper,
                k * rates,
                linear.unilateral,
                max_effort=np.array([9.0, 7.0, 8.0]) / k,
                effort_rates=np.array([2.0, 2.5, 3.0]) / k,
                mode=mode,
            )
            scale = k if to_command is not None else 1.0 / k
            model = rescaled(linear.model, e, k)
            answers.append(controller.solve(model, e * (linear.effector + step), scale * present) / scale)
        np.testing.assert_allclose(answers[1], answers[0], rtol=1e-6)


def test_a_state_that_is_stable_only_while_held_can_be_left(linear):
    """W_aa indefinite: the regularisation stays convex and the goal is reached."""
    Waa = np.array([[1e-3, 0.0, 0.0], [0.0, -2e-3, 0.0], [0.0, 0.0, 1e-3]])
    Wea = np.array([[2e-3, 1e-3, 0.0], [0.0, 2e-3, 1e-3], [1e-3, 0.0, 2e-3]])
    W = np.block([[Waa, Wea.T], [Wea, 1e-2 * np.eye(3)]])
    model = CondensedModel(W, np.zeros(6), np.append(np.ones(3), np.zeros(3)), linear.model.roles)
    bound = np.full(3, 0.1)
    controller = InverseQP(-bound, bound, 0.02 * bound, np.zeros(3, dtype=bool), effort_weight=0.0, step_weight=1e-6)
    step = Waa @ [0.3, -0.2, 0.4]
    goal = model.delta.e + Wea @ [0.3, -0.2, 0.4]
    np.testing.assert_allclose(controller.solve(model, goal, model.delta.a), model.delta.a + step, atol=1e-7)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"mode": "pressure"}, "mode must be"),
        ({"mode": ["effort"]}, "mode must be"),
        ({"effort_rates": [1.0, 0.0, 1.0]}, "effort_rates must be positive"),
        ({"goal_weights": [1.0, -1.0, 0.0]}, "goal_weights must be finite and not negative"),
        ({"max_effort": [-1.0, 1.0, 1.0]}, "bounds of effort must be 3 pairs"),
        ({"max_effort": [1.0, 1.0]}, "bounds of effort must be 3 pairs"),
        ({"min_effort": [np.nan, 1.0, 1.0]}, "bounds of effort must be 3 pairs"),
    ],
    ids=str,
)
def test_malformed_options_are_rejected(linear, options, expected):
    with pytest.raises(ValueError, match=expected):
        linear.controller(**options)


def test_other_malformed_input_is_rejected(linear):
    unlimited = np.full(3, np.inf)
    for mode in ("displacement", "effort"):
        with pytest.raises(ValueError, match="needs a finite rate"):
            InverseQP(linear.lower, linear.upper, unlimited, linear.unilateral, mode=mode)
    with pytest.raises(ValueError, match="goal_weights must be 3 numbers"):
        linear.controller(goal_weights=[1.0]).solve(linear.model, linear.rest, linear.command)
    for command in ([0.0, np.nan, 0.0], [0.0]):
        with pytest.raises(ValueError, match="command must be 3 finite numbers"):
            linear.controller().solve(linear.model, linear.rest, np.array(command))
    W = linear.W.copy()
    W[:2] = W[0]
    W[:, :2] = W[:, :1]
    same = CondensedModel(W, linear.model.free, linear.model.effort, linear.model.roles)
    with pytest.raises(ValueError, match="two actuators have the same effect"):
        linear.controller().solve(same, linear.rest, linear.command)


@pytest.mark.parametrize(
    "goal",
    [[np.nan, 0.0, 0.0], [0.0, 0.0, np.inf], [0.0, 0.0], [[0.0] * 3] * 2, 0.0],
    ids=["NaN", "inf", "two", "two effectors", "scalar"],
)
def test_malformed_goals_are_rejected(linear, goal):
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


@pytest.mark.parametrize("kind", [InverseQP, ContactQP])
def test_a_goal_in_millimetres_is_refused_by_the_controller_of_a_robot(kind):
    robot = make_robot("finger")
    state = FEMBackend(robot).reset()
    controller = kind.for_robot(robot)
    goal = state.effector[0] + [0.0, 0.0, 0.005]
    assert controller.solve(state.condensed, goal, state.command).any()
    with pytest.raises(ValueError, match=r"m away from the effector of robot 'finger', .* did you mean metres\?"):
        controller.solve(state.condensed, 1e3 * goal, state.command)
    loop = EmbeddedLoop(lambda displacement: state.condensed, controller)
    with pytest.raises(ValueError, match="did you mean metres"):
        loop.step(1e3 * goal)
    with pytest.raises(ValueError, match=r"command = 5 m of actuator 'cable_1' is far beyond its range .* its unit"):
        controller.solve(state.condensed, goal, [5.0, 0.0])
    closed = EmbeddedLoop(lambda displacement: state.condensed, controller, PICorrection())
    with pytest.raises(ValueError, match=r"measured effector = .* did you mean metres"):
        closed.step(goal, 1e3 * goal)
    if kind is InverseQP:
        with pytest.raises(ValueError, match=r"slack must have shape \(2,\), got \(3,\)"):
            controller.solve(state.condensed, goal, state.command, [True] * 3)
    # A coordinate without a weight is free.
    kind.for_robot(robot, goal_weights=[1.0, 0.0, 1.0]).solve(state.condensed, goal + [0.0, 9.0, 0.0], state.command)


def test_a_goal_in_millimetres_is_refused_in_a_batch():
    robot = make_robot("finger")
    state = FEMBackend(robot).reset()
    parts = (np.stack([getattr(state.condensed, name)] * 2) for name in ("compliance", "free", "effort"))
    batch, goals = CondensedModel(*parts, state.condensed.roles), np.stack([state.effector[0]] * 2)
    controller, commands = InverseQP.for_robot(robot), np.stack([state.command] * 2)
    assert controller.solve_batch(batch, goals, commands).shape == commands.shape
    with pytest.raises(ValueError, match="did you mean metres"):
        controller.solve_batch(batch, goals * [[1.0], [1e3]], commands)


# -- on the finite elements -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cables", "target"),
    [(1, [0.0137]), (2, [0.013, 0.011]), (2, [0.004, 0.017])],
    ids=["one cable", "two cables", "one of two cables slack"],
)
def test_finger_reaches_a_reachable_goal(cables, target):
    """Within 0.01 mm (measured: 0.001 mm), relinearising at each step; the goal is the tip at other displacements."""
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


def test_plants_in_a_batch_get_the_commands_that_they_get_alone(rng):
    robots = [LinearRobot(rng) for _ in range(4)]
    robots[1].go(np.array([0.004, 0.001, 0.0]))
    robots[3].W[0, 0] -= 2.5e-3  # stable only while its actuators are held
    robots[3].model = CondensedModel(robots[3].W, robots[3].model.free, robots[3].model.effort, (("a", 3), ("e", 3)))
    assert np.linalg.eigvalsh(robots[3].W[:3, :3])[0] < 0.0
    goals = LinearRobot.rest + rng.uniform(-0.01, 0.01, (4, 3))
    models = CondensedModel(
        *(np.stack([getattr(r.model, name) for r in robots]) for name in ("compliance", "free", "effort")),
        (("a", 3), ("e", 3)),
    )
    commands, slack = np.stack([r.command for r in robots]), np.stack([r.slack for r in robots])
    together = robots[0].controller().solve_batch(models, goals, commands, slack)
    alone = [r.controller().solve(r.model, goal, r.command, r.slack) for r, goal in zip(robots, goals, strict=True)]
    assert np.ptp(together, axis=0).min() > 1e-6  # the plants differ
    np.testing.assert_allclose(together, alone, atol=1e-9 * 0.02)


@pytest.fixture
def stretching_rod():
    """A rod with two tendons, of which one stretches by about as much as it moves the rod, and the other less."""
    discs = np.linspace(0.0, 0.2, 11)
    builder = ModelBuilder()
    path = [[0, 0, 0], [0, 0, 0.2]]
    rod = add_rod(builder, path, section=Section.circle(0.5e-3), elements=discs, young_modulus=6e10, density=6450)
    model = builder.build()
    for name, side, compliance in (("left", -1.0, 1e-3), ("right", 1.0, 2e-4)):
        rod.add_tendon(model, name, discs[1:], [side * 0.0045, 0.0], compliance=compliance)
    model.add_effector("tip", rod.points(0.2, (0.0, 0.0), model.nodes))
    return Statics(model)


def test_the_model_at_the_drives_is_the_derivative_by_the_commands(stretching_rod):
    command, step = np.array([0.003, 0.0005]), 1e-6
    condensed = stretching_rod.solve(command).condensed
    drives = condensed.at_drives
    np.testing.assert_allclose(drives.delta.a, command, atol=1e-12)
    np.testing.assert_array_equal(drives.delta.e, condensed.delta.e)
    slopes = []
    for k in range(2):
        ends = [stretching_rod.solve(command + side * step * np.eye(2)[k]).condensed.delta.e for side in (1, -1)]
        slopes.append((ends[0] - ends[1]) / (2.0 * step))
    expected = drives.W.ea @ np.linalg.inv(drives.W.aa)
    np.testing.assert_allclose(np.array(slopes).T, expected, atol=1e-5 * np.abs(expected).max())


def test_it_knows_how_drives_stretch(stretching_rod):
    goal = stretching_rod.solve([0.006, 0.0015]).condensed.delta.e
    sideways = np.array([1.0, 0.0, 0.0])
    limits = np.full(2, -0.01), np.full(2, 0.01), np.full(2, 0.001)
    controller = InverseQP(*limits, np.ones(2, dtype=bool), goal_weights=sideways)
    command = np.zeros(2)
    for _ in range(20):
        state = stretching_rod.solve(command)
        command = controller.solve(state.condensed, goal, command, state.slack)
    assert abs(goal[0]) > 3e-3
    assert abs(stretching_rod.solve(command).condensed.delta.e - goal)[0] < 1e-6
