"""Pressure boards: messages, and a pneumatic trunk that an environment drives through one."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from softgym_envs.agents.baselines import make_baseline
from softgym_envs.envs.plant import Plant
from softgym_envs.extensions.hardware import HardwareBackend, HardwareError
from softgym_envs.extensions.hardware.emulation import Losses
from softgym_envs.extensions.hardware.pressure_board import content_of, framed
from softgym_envs.robots.registry import make_robot

NAMES = [actuator.name for actuator in make_robot("trunk").actuators]
TRUNK = {
    "robot": "trunk",
    "device": "pressure_board",
    "pressure_board": {
        "port": "/dev/null",
        "channels": {name: k for k, name in enumerate(NAMES)},
        "max_pressure": 4e5,
        "rise": 1e7,
    },
}


def test_messages_have_the_check_sums_of_nmea():
    # The example sentence of NMEA 0183 that is in every manual.
    text = "GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"
    assert framed(text) == f"${text}*47\n".encode()
    assert content_of(framed("P,1,5,0")) == ["P", "1", "5", "0"]
    for damaged in (b"$P,1,5,0*00\n", b"P,1,5,0*28\n", b"$P,1\xff,5*28\n", b"", b"*"):
        assert content_of(damaged) is None


def test_a_trunk_is_driven_by_the_pressures_of_its_model(make_bench):
    moved = make_bench(TRUNK, losses=Losses(lost=0.01, damaged=0.01, seed=3))
    env = gymnasium.make("SoftGym/TrunkReach-v0", backend="hardware", backend_options={"bench": moved.bench})
    agent = make_baseline("qp_pi")
    seen, _ = env.reset(seed=2)
    for _ in range(60):
        seen, _, _, _, info = env.step(agent(seen, env.unwrapped))
    assert info["is_success"], info["distance"]
    assert moved.emulated.pressure.max() > 1e3
    measured = env.unwrapped.state.effort
    assert np.abs(measured - moved.emulated.pressure[: len(NAMES)]).max() < 0.05 * moved.emulated.pressure.max()


def test_a_silent_line_vents(make_bench):
    moved = make_bench(TRUNK, plant=Plant(stiffness=1.1))
    backend = HardwareBackend(moved.bench.robot, bench=moved.bench)
    backend.reset()
    backend.step(np.full(len(NAMES), 5e3), "effort")
    moved.emulated.move(moved.clock.now())
    assert moved.emulated.pressure.max() == pytest.approx(5e3)
    died, moved.losses.dead = moved.clock.now(), True
    with pytest.raises(HardwareError, match="has not answered"):
        for _ in range(20):
            backend.step(np.full(len(NAMES), 5e3), "effort")
    assert moved.clock.now() - died < 0.1
    moved.emulated.move(died + 0.1)
    assert moved.emulated.pressure.max() == 0.0


def test_what_the_board_refuses_is_said(make_bench):
    moved = make_bench(TRUNK)
    with pytest.raises(HardwareError, match="pressures .* are beyond max_pressure = 400000 Pa"):
        moved.device.send(np.full(len(NAMES), 5e5))
    moved.device.connect()
    moved.device.send(np.zeros(len(NAMES)))
    with pytest.raises(HardwareError, match="refuses: vented: send A first"):
        moved.device.read(moved.clock.now() + 0.01)
    moved.emulated._max = 1e5
    with pytest.raises(HardwareError, match="max_pressure = 400000 Pa is beyond the 100000 Pa of board 'emulated'"):
        moved.device.connect()
