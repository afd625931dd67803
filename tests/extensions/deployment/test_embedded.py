"""Algorithm 2: effort-commanded loops on an analytic chamber robot, and on the finite elements of the finger."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.control import InverseQP, PICorrection
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.deployment import EmbeddedLoop
from softgym_envs.extensions.deployment.embedded import follow, settle
from softgym_envs.mechanics.condensation import CondensedModel

VOLUME, PRESSURE = 3e-8, 1e5  # typical of the chambers of a small trunk [m3, Pa]


class ChamberRobot:
    """Three chambers that bend and stretch a tip; pressure stiffens with volume and the tip moves on a curve.

    With ``v`` in units of VOLUME: pressure = stiffness PRESSURE (v + 0.3 v^3 + 0.1 (sum - v)).
    """

    angles = 2.0 * np.pi / 3 * np.arange(3)
    A = 0.03 * np.array([np.cos(angles), np.sin(angles), np.full(3, 0.2)])
    rest = np.array([0.0, 0.0, 0.11])

    def __init__(self, stiffness=1.0):
        self.stiffness = stiffness
        self.reset()

    def pressure(self, v):
        return self.stiffness * PRESSURE * (v + 0.3 * v**3 + 0.1 * (v.sum() - v))

    def tip(self, v):
        flat = self.A @ v
        return self.rest + flat - np.array([0.0, 0.0, 8.0]) * (flat[:2] @ flat[:2])

    def __call__(self, displacement):
        v = displacement / VOLUME
        dp = self.stiffness * PRESSURE * (np.diag(1.0 + 0.9 * v**2) + 0.1 * (1.0 - np.eye(3)))
        flat = self.A @ v
        jacobian = self.A - np.outer([0.0, 0.0, 16.0], flat[:2] @ self.A[:2])
        Waa = np.linalg.inv(dp) * VOLUME
        Wea = jacobian @ np.linalg.inv(dp)
        W = np.block([[Waa, Wea.T], [Wea, 1e-2 * np.eye(3)]])
        delta = np.concatenate([displacement, self.tip(v)])
        effort = np.append(self.pressure(v), np.zeros(3))
        return CondensedModel(W, delta - W @ effort, effort, (("a", 3), ("e", 3)))

    # -- as a plant
    def reset(self):
        self.v = np.zeros(3)
        return self._state()

    def step(self, command, mode):
        assert mode == "effort"
        for _ in range(50):
            step = self(self.v * VOLUME).W.aa @ (command - self.pressure(self.v)) / VOLUME
            self.v = self.v + step
            if np.abs(step).max() < 1e-13:
                break
        return self._state()

    def _state(self):
        self.state = SimpleNamespace(displacement=self.v * VOLUME, effector=self.tip(self.v)[None])
        return self.state


def controller(**options):
    unbounded = np.full(3, np.inf)
    return InverseQP(
        -unbounded,
        unbounded,
        unbounded,
        np.ones(3, dtype=bool),
        max_effort=np.full(3, 2.0 * PRESSURE),
        effort_rates=np.full(3, 0.05 * PRESSURE),
        mode="effort",
        **options,
    )


def circle(count, radius=0.012, height=0.006):
    angle = np.linspace(0.0, 2.0 * np.pi, count)
    robot = ChamberRobot()
    start = robot.rest + [0.0, 0.0, height]
    ring = start + np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0.0 * angle])
    return np.concatenate([np.linspace(robot.rest, ring[0], count // 2), ring])


def test_W_of_the_toy_is_its_derivative():
    robot = ChamberRobot()
    model = robot(VOLUME * np.array([0.4, 0.1, 0.7]))
    assert np.allclose(model.compliance, model.compliance.T)
    ends = [robot.step(model.lambda_.a + [s, 0.0, 0.0], "effort").effector[0] for s in (50.0, -50.0)]
    np.testing.assert_allclose((ends[0] - ends[1]) / 100.0, model.W.ea[:, 0], rtol=1e-5)


def test_finer_goals_improve_the_predicted_state():
    """Open loop: the error falls with the square of the spacing of the goals, with or without encoders."""
    largest = {}
    for count, encoders in ((100, False), (400, False), (400, True)):
        loop = EmbeddedLoop(ChamberRobot(), controller(effort_weight=0.0))
        goals = circle(count)
        states = follow(loop, ChamberRobot(), goals, feedback=False, encoders=encoders)
        errors = np.linalg.norm(np.array([s.effector[0] for s in states]) - goals, axis=1)
        largest[count, encoders] = errors[count // 2 :].max()
        # Efforts respect their rate and bounds.
        assert (np.abs(loop.effort) <= 2.0 * PRESSURE).all()
    print({key: f"{1e3 * value:.4f} mm" for key, value in largest.items()})
    assert largest[400, False] < 0.1 * largest[100, False]
    assert largest[400, True] < 1.1 * largest[400, False]
    assert largest[400, False] < 1e-6


def test_the_displacement_is_predicted_by_the_last_model():
    loop = EmbeddedLoop(ChamberRobot(), controller())
    first = ChamberRobot()(np.zeros(3))
    effort = loop.step(ChamberRobot.rest + [0.002, 0.0, 0.001])
    assert (effort <= 0.05 * PRESSURE * (1 + 1e-9)).all()
    np.testing.assert_allclose(loop.displacement, first.W.aa @ effort + first.delta_free.a, rtol=1e-10)
    np.testing.assert_allclose(loop.predicted, first.W.ea @ effort + first.delta_free.e, rtol=1e-10)
    # A measurement replaces it.
    seen = VOLUME * np.array([0.2, 0.1, 0.0])
    loop.step(ChamberRobot.rest, displacement=seen)
    model = ChamberRobot()(seen)
    np.testing.assert_allclose(loop.displacement, model.W.aa @ loop.effort + model.delta_free.a, rtol=1e-10)
    loop.reset()
    assert not loop.effort.any()
    np.testing.assert_array_equal(loop.displacement, 0.0)


@pytest.mark.parametrize(("gains", "calls"), [((0.01, 0.002), 4000), ((0.1, 0.05), 250)], ids=["thesis", "faster"])
def test_a_plant_of_the_wrong_stiffness_is_corrected(gains, calls):
    """20 % stiffer than the model: millimetres off in open loop, nothing in closed loop."""
    goal = ChamberRobot.rest + [0.008, 0.006, 0.005]
    open_ = follow(EmbeddedLoop(ChamberRobot(), controller()), ChamberRobot(1.2), [goal] * 60)[-1]
    before = np.linalg.norm(open_.effector[0] - goal)
    loop = EmbeddedLoop(ChamberRobot(), controller(), PICorrection(*gains))
    after = np.linalg.norm(follow(loop, ChamberRobot(1.2), [goal] * calls)[-1].effector[0] - goal)
    print(f"open loop {1e3 * before:.3f} mm, closed {1e3 * after:.5f} mm after {calls} calls")
    assert before > 1e-3
    assert after < 5e-6


def test_the_integral_does_not_wind_up():
    """A goal out of reach for a long time, then one in reach: the loop recovers without delay."""
    far, near = ChamberRobot.rest + [0.3, 0.0, 0.0], ChamberRobot.rest + [0.008, 0.0, 0.004]
    calls = {}
    for wait in (60, 1000):
        correction = PICorrection(0.05, 0.05)
        loop, plant = EmbeddedLoop(ChamberRobot(), controller(), correction), ChamberRobot(1.2)
        follow(loop, plant, [far] * wait)
        along = correction.correction[0]
        assert np.linalg.norm(correction.correction) <= correction.limit * (1 + 1e-12)
        assert along < 1e-3
        errors = [np.linalg.norm(s.effector[0] - near) for s in follow(loop, plant, [near] * 300)]
        calls[wait] = int(np.flatnonzero(np.array(errors) > 1e-4)[-1])
        assert errors[-1] < 1e-5
    print(f"calls until the error stays below 0.1 mm, by time out of reach: {calls}")
    assert calls[1000] <= calls[60] + 20


def test_an_error_without_a_solution_is_not_integrated(monkeypatch):
    correction = PICorrection(0.05, 0.05)
    loop, goal = EmbeddedLoop(ChamberRobot(), controller(), correction), ChamberRobot.rest + [0.008, 0.0, 0.004]
    loop.step(goal, ChamberRobot.rest)
    before, effort = correction.correction.copy(), loop.effort.copy()

    def fail(*arguments):
        raise ConvergenceError("no answer")

    monkeypatch.setattr(loop.controller, "solve", fail)
    for _ in range(10):
        with pytest.raises(ConvergenceError):
            loop.step(goal, ChamberRobot.rest)
    np.testing.assert_array_equal(correction.correction, before)
    np.testing.assert_array_equal(loop.effort, effort)


def test_bad_measurements_are_rejected():
    loop = EmbeddedLoop(ChamberRobot(), controller(), PICorrection())
    goal = ChamberRobot.rest
    loop.step(goal, goal)
    kept = loop.effort.copy()
    for options in (
        {"measured": np.full(3, np.nan)},
        {"measured": np.zeros(2)},
        {"displacement": np.full(3, np.inf)},
        {"displacement": np.zeros(2)},
    ):
        with pytest.raises(ValueError, match="must be . finite"):
            loop.step(goal, **options)
        np.testing.assert_array_equal(loop.effort, kept)
    with pytest.raises(ValueError, match="goal must be 3 finite"):
        loop.step(np.full(3, np.nan))
    mixed = ["effort", "displacement", "effort"]
    with pytest.raises(ValueError, match="mixes two"):
        bounds = np.zeros(3), np.ones(3), np.ones(3), np.ones(3, dtype=bool)
        EmbeddedLoop(ChamberRobot(), InverseQP(*bounds, mode=mixed))
    for arguments in ((np.nan, 0.0), (0.1, -1.0)):
        with pytest.raises(ValueError, match="finite and not negative"):
            PICorrection(*arguments)
    assert np.isfinite(loop.step(goal, goal)).all()


def test_a_finger_of_the_wrong_stiffness_is_corrected():
    """Finite elements on both sides: the plant is 20 % stiffer than the model, driven in tension."""
    robot = make_robot("finger")
    model, plant = FEMBackend(robot), FEMBackend(robot, {"young_modulus": 3.6e6})
    goal = plant.probe(np.array([0.010, 0.008])).effector[0]
    qp = InverseQP(robot.lower, robot.upper, np.full(2, np.inf), [True, True], effort_rates=[1.0, 1.0], mode="effort")
    open_ = follow(EmbeddedLoop(model, qp), plant, [goal] * 15, feedback=False)[-1]
    plant.reset()
    loop = EmbeddedLoop(model, qp, PICorrection(0.1, 0.2))
    states = follow(loop, plant, [goal] * 50)
    before, after = (np.linalg.norm(s.effector[0] - goal) for s in (open_, states[-1]))
    print(f"open loop {1e3 * before:.3f} mm, closed {1e3 * after:.5f} mm, tensions {np.round(loop.effort, 3)} N")
    assert before > 2e-3
    assert after < 1e-5


def test_a_goal_that_is_not_finite_leaves_no_trace():
    """The integral of a NaN would be NaN for ever."""
    loops = [EmbeddedLoop(ChamberRobot(), controller(), PICorrection(0.1, 0.05)) for _ in range(2)]
    goal, measured = ChamberRobot.rest + [0.005, 0.0, 0.0], ChamberRobot.rest
    for loop in loops:
        loop.step(goal, measured)
    with pytest.raises(ValueError, match="goal must be finite"):
        loops[0].step(np.array([np.nan, 0.0, 0.1]), measured)
    np.testing.assert_array_equal(*(loop.step(goal, measured) for loop in loops))


def test_an_unstable_model_is_no_singular_matrix():
    def unstable(displacement):
        pushing = np.array([-1.0, 0.0, 0.0, 0.0])
        return CondensedModel(-np.eye(4), np.zeros(4), pushing, (("a", 1), ("e", 3)))

    controller = InverseQP(np.zeros(1), np.ones(1), np.ones(1), np.ones(1, dtype=bool))
    with pytest.raises(ConvergenceError, match="unstable"):
        settle(unstable, controller, np.array([0.5]), np.zeros(1))
