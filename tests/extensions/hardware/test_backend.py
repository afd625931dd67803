"""A robot on a bench is a backend: it is driven in time, watched, and stopped."""

from __future__ import annotations

import csv

import gymnasium
import numpy as np
import pytest

import softgym_envs
from softgym_envs.agents import EnvironmentConfig
from softgym_envs.agents.baselines import make_baseline
from softgym_envs.agents.policy import Policy
from softgym_envs.backends import make_backend
from softgym_envs.control import InverseQP, PICorrection
from softgym_envs.envs.plant import Plant
from softgym_envs.extensions.deployment import EmbeddedLoop
from softgym_envs.extensions.deployment.embedded import follow
from softgym_envs.extensions.hardware import HardwareBackend, HardwareError
from softgym_envs.extensions.hardware.dynamixel import Dynamixel, DynamixelConfig, ServoConfig
from softgym_envs.extensions.hardware.emulation import Losses
from tests.extensions.hardware.conftest import FINGER

PERIOD = 0.02


def make_env(moved, **options):
    return gymnasium.make(
        "SoftGym/FingerReach-v0", backend="hardware", backend_options={"bench": moved.bench, **options}
    )


def test_an_environment_on_the_bench_is_that_on_the_model(make_bench):
    """Without losses and noise, episodes differ from those on the surrogate by the steps of the encoders only."""
    moved = make_bench()
    real, model = make_env(moved), gymnasium.make("SoftGym/FingerReach-v0")
    policy = Policy("finger_reach")
    (seen, info), (_, expected) = real.reset(seed=3), model.reset(seed=3)
    assert np.allclose(info["goal"], expected["goal"])
    for _ in range(30):
        action = policy(seen)
        seen, _, _, _, info = real.step(action)
        *_, expected = model.step(action)
        assert np.abs(info["effector"] - expected["effector"]).max() < 1e-4
        assert np.abs(info["effort"] - expected["effort"]).max() < 0.3  # a step of the current is 0.48 N
    state = real.unwrapped.state
    assert np.allclose(state.condensed.delta.e, state.effector.ravel())
    timing = real.unwrapped.backend.timing
    assert timing.steps >= 31 and timing.lost == timing.missed == 0


@pytest.mark.parametrize("agent", ["qp", "qp_pi", "finger_reach"])
def test_agents_reach_goals_on_a_robot_with_another_gain(make_bench, agent):
    moved = make_bench(plant=Plant(gain=1.05))
    env = make_env(moved)
    act = make_baseline(agent) if agent.startswith("qp") else lambda seen, _: Policy(agent)(seen)
    seen, info = env.reset(seed=1)
    for _ in range(60):
        seen, _, _, _, info = env.step(act(seen, env.unwrapped))
    assert info["is_success"], info["distance"]


def test_the_embedded_loop_drives_the_bench(make_bench):
    moved = make_bench(plant=Plant(gain=0.9))
    robot = moved.bench.robot
    plant = HardwareBackend(robot, bench=moved.bench)
    goal = plant.probe(np.array([0.006, 0.004])).effector[0]
    plant.reset()
    loop = EmbeddedLoop(make_backend("surrogate", robot), InverseQP.for_robot(robot), PICorrection(0.1, 0.3))
    states = follow(loop, plant, [goal] * 80)
    assert np.linalg.norm(states[-1].effector[0] - goal) < 5e-4


def test_losses_and_jitter_are_counted(make_bench):
    """At 50 Hz with a clock that wakes late, lost and damaged packets; nothing waits for the time of the machine."""
    moved = make_bench(losses=Losses(lost=0.02, damaged=0.02, seed=1), late=2e-4)
    env = make_env(moved)
    policy = Policy("finger_reach")
    seen, _ = env.reset(seed=0)
    begin = moved.clock.now()
    for _ in range(100):
        seen, *_ = env.step(policy(seen))
    timing = env.unwrapped.backend.timing
    assert moved.clock.now() - begin == pytest.approx(100 * PERIOD, abs=1.5 * PERIOD)
    assert 2 <= timing.lost <= moved.losses.count
    assert timing.missed == 0
    assert timing.jitter["median"] == pytest.approx(2e-4 * np.log(2.0), rel=0.5)
    assert "lost readings" in timing.text()


@pytest.mark.parametrize("how", ["dead", "unplugged"])
def test_everything_stops_within_100_ms_when_the_line_dies(make_bench, how):
    moved = make_bench()
    env = make_env(moved)
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.array([1.0, 1.0]))
    died = moved.clock.now()
    moved.losses.dead, moved.line.unplugged = how == "dead", how == "unplugged"
    with pytest.raises(HardwareError, match="has not answered|is lost"):
        for _ in range(20):
            env.step(np.array([1.0, 1.0]))
    assert moved.clock.now() - died < 0.1  # the computer gives up
    servo = moved.emulated.servos[1]
    moved.emulated.move(died + 0.1)
    assert servo.stopped  # and so do the servos, by themselves
    where = servo.position
    moved.emulated.move(died + 1.0)
    assert servo.position == where
    with pytest.raises(HardwareError, match="the robot was stopped: "):
        env.step(np.zeros(2))


def test_a_stop_takes_the_power(make_bench):
    moved = make_bench()
    env = make_env(moved)
    env.reset(seed=0)
    assert all(servo.powered for servo in moved.emulated.servos.values())
    env.unwrapped.backend.stop("a person is too near")
    assert not any(servo.powered for servo in moved.emulated.servos.values())
    for act in (lambda: env.step(np.zeros(2)), lambda: env.reset()):
        with pytest.raises(HardwareError, match="the robot was stopped: a person is too near"):
            act()


def test_closing_the_environment_takes_the_power(make_bench):
    moved = make_bench()
    env = make_env(moved)
    env.reset(seed=0)
    env.close()
    assert not any(servo.powered for servo in moved.emulated.servos.values())
    env.close()


def test_a_fault_of_a_servo_stops_all(make_bench):
    moved = make_bench()
    env = make_env(moved)
    env.reset(seed=0)
    moved.emulated.servos[2].set((70, 1), 1 << 5 | 1 << 2)
    with pytest.raises(HardwareError, match=r"servo 2 \(cable_2\) reports overheating, overload"):
        env.step(np.ones(2))
    assert not any(servo.powered for servo in moved.emulated.servos.values())
    with pytest.raises(HardwareError, match="reports overheating, overload; remove the cause"):
        HardwareBackend(moved.bench.robot, bench=moved.bench)


def test_the_first_motion_is_slow_and_begins_where_the_robot_stands(make_bench):
    moved = make_bench()
    servo = moved.emulated.servos[1]
    servo.position = 2048 + 0.006 / servo_travel(moved)  # somebody pulled 6 mm
    backend = HardwareBackend(moved.bench.robot, bench=moved.bench)
    assert not servo.powered  # connecting moves nothing
    places = []

    def see(now, move=servo.move):
        move(now)
        places.append((now, servo.position))

    servo.move = see
    backend.reset()
    times, positions = np.array(places).T
    steps = np.flatnonzero(np.diff(times) > 0.0)
    speed = np.abs(np.diff(positions))[steps].sum() * servo_travel(moved) / (times[-1] - times[0])
    rate = moved.bench.robot.rates[0] / PERIOD
    assert speed < 1.05 * moved.bench.slow * rate
    assert servo.position == pytest.approx(2048, abs=1.0)
    assert np.abs(np.diff(positions)).max() * servo_travel(moved) < 1.1 * moved.bench.slow * moved.bench.robot.rates[0]


def servo_travel(moved):
    return moved.config.settings.servos["cable_1"].per_tick


def test_servos_cannot_run_faster_than_the_rates(make_bench):
    """Whatever is sent: the servos' own limit holds."""
    moved = make_bench()
    HardwareBackend(moved.bench.robot, bench=moved.bench).reset()
    servo, start = moved.emulated.servos[1], moved.clock.now()
    moved.device.send(np.array([0.02, 0.0]))
    moved.emulated.move(start + 0.06)  # before the watchdog
    fastest = moved.bench.robot.rates[0] / PERIOD * 1.15
    assert 0.0 < (servo.position - 2048) * servo_travel(moved) <= fastest * 0.061


def test_commands_beyond_limits_are_not_sent(make_bench):
    moved = make_bench()
    backend = HardwareBackend(moved.bench.robot, bench=moved.bench)
    with pytest.raises(HardwareError, match="call reset first"):
        backend.step(np.zeros(2))
    backend.reset()
    sent = moved.line.written
    rate = moved.bench.robot.rates[0]
    for command, message in (
        ([-0.001, 0.0], "'cable_1' is out of its range; allowed: 0 to 0.02 m"),
        ([0.0, 3 * rate], "'cable_2' changes by .* in a step; allowed"),
        ([np.nan, 0.0], "must be 2 finite numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            backend.step(np.array(command))
    assert moved.line.written == sent and not backend.stopped


def test_a_pause_of_the_caller_ends_in_a_slow_start_not_in_a_jump(make_bench):
    """After a silence the servos have stopped; they get power where they stand, and go on."""
    moved = make_bench()
    env = make_env(moved)
    env.reset(seed=0)
    env.step(np.ones(2))
    moved.clock.time += 3.0
    moved.emulated.move(moved.clock.now())
    assert moved.emulated.servos[1].stopped
    before = moved.emulated.servos[1].position
    env.step(np.ones(2))
    servo = moved.emulated.servos[1]
    assert servo.powered and not servo.stopped
    assert 0.0 < (servo.position - before) * servo_travel(moved) < 1.05 * moved.bench.robot.rates[0]


def test_what_a_bench_cannot_be_asked_is_refused(make_bench):
    moved = make_bench()
    backend = HardwareBackend(moved.bench.robot, bench=moved.bench)
    state = backend.reset()
    with pytest.raises(HardwareError, match="cannot be put back"):
        backend.restore(state)
    with pytest.raises(ValueError, match="is not the body on the bench"):
        backend.reset({"length": 0.041})
    with pytest.raises(ValueError, match="the robot on the bench is 'finger', not 'diamond'"):
        HardwareBackend(softgym_envs.make_robot("diamond"), bench=moved.bench)
    before = moved.line.written
    assert backend.probe(np.array([0.004, 0.004])).effector[0, 1] > 0.01  # the model answers
    assert moved.line.written == before


def test_configurations_are_checked(make_bench):
    bad = {**FINGER, "dynamixel": {"port": "x", "servos": {"cable_1": {"id": 1}, "cable_2": {"id": 1}}}}
    with pytest.raises(ValueError, match=r"dynamixel: .*ids \[1, 1\], which must differ"):
        make_bench(bad)
    moved = make_bench()
    bad = DynamixelConfig(port="x", servos={"cable_1": ServoConfig(id=1), "cable_3": ServoConfig(id=2)})
    with pytest.raises(ValueError, match="must name the actuators of robot 'finger': cable_1, cable_2"):
        Dynamixel(bad, moved.bench.robot, moved.clock, moved.line)
    with pytest.raises(ValueError, match="watchdog = 0.08 s must be at least two steps of rate = 10 per second"):
        make_bench({**FINGER, "rate": 10.0})
    with pytest.raises(ValueError, match="unknown device 'dynamixels'"):
        make_bench({**FINGER, "device": "dynamixels"})
    EnvironmentConfig(id="SoftGym/FingerReach-v0", backend="hardware", backend_options={"bench": "bench.yaml"})


def test_the_log_has_what_calibrate_reads(make_bench, tmp_path):
    from softgym_envs.extensions.design.measurements import read_measurements

    moved = make_bench()
    log = tmp_path / "log.csv"
    env = make_env(moved, log=str(log), trial="a")
    env.reset(seed=0)
    for _ in range(4):
        env.step(np.array([1.0, 0.2]))
    env.unwrapped.backend.close()
    data = read_measurements(log, moved.bench.robot)
    assert data.driven == "displacement" and set(data.trial) == {"a"} and len(data) == 5
    assert np.isfinite(data.effort).all() and np.isfinite(data.effector).all()
    with open(log) as stream:
        assert next(csv.reader(stream))[:3] == ["trial", "cable_1_displacement", "cable_2_displacement"]
