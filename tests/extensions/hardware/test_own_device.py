"""A device of one's own: a class, and the verb that drives it. Nothing fails if the machine is late."""

from __future__ import annotations

import json

import numpy as np
import pytest

from softgym_envs.config import Config
from softgym_envs.extensions.hardware import Device, HardwareError, Reading
from softgym_envs.extensions.hardware.device import DEVICES


class Springs(Device):
    """Drives that are always where they were sent."""

    class Config(Config):
        fails_after: int = 1_000_000

    made: list[Springs] = []  # noqa: RUF012

    def __init__(self, config, robot, clock):
        self.config, self.at, self.sent = config, np.zeros(len(robot.actuators)), 0
        self.powered = self.closed = False
        self.made.append(self)

    def connect(self):
        return Reading(self.at, np.full(len(self.at), np.nan))

    def start(self, watchdog, speed):
        self.powered = True

    def send(self, command):
        assert self.powered and not self.closed
        self.sent += 1
        if self.sent > self.config.fails_after:
            raise HardwareError("the springs broke")
        self.at = np.array(command)

    def read(self, until):
        return self.connect()

    def stop(self):
        self.powered = False

    def close(self):
        self.closed = True


@pytest.fixture
def bench(tmp_path, monkeypatch):
    monkeypatch.setitem(DEVICES._entries, "springs", Springs)
    monkeypatch.chdir(tmp_path)
    Springs.made.clear()
    path = tmp_path / "bench.yaml"
    path.write_text("robot: finger\ndevice: springs\nrate: 1000\nwatchdog: 2.5\nslow: 1.0\n")
    return path


def test_the_verb_drives_episodes_and_goes_home(softgym, bench):
    status, out, _ = softgym("hardware", "run", bench, "SoftGym/FingerReach-v0", "--agent", "qp", "--json")
    found, (device,) = json.loads(out), Springs.made
    assert status == 0 and found["episodes"][0]["success"] and found["steps"] > 50
    assert device.closed and not device.powered and not device.at.any()


def test_errors_end_without_power(softgym, bench):
    status, _, err = softgym(
        "hardware", "run", bench, "SoftGym/FingerReach-v0", "springs.fails_after=7", "--log", "log.csv"
    )
    assert status == 2 and err == "softgym: error: the springs broke\n"
    assert Springs.made[0].closed and not Springs.made[0].powered


def test_without_a_tracker_the_model_says_where_the_tip_is(softgym, bench):
    status, out, _ = softgym("hardware", "check", bench)
    assert status == 0 and "effectors: no tracker" in out and "cable_1: 0 m, effort not measured" in out
