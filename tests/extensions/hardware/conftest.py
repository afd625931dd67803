"""A bench whose time the tests move: real packets through a pseudo-terminal, and nothing that a busy machine delays."""

from __future__ import annotations

import os
import select

import pytest

from softgym_envs.extensions.hardware.bench import Bench, BenchConfig
from softgym_envs.extensions.hardware.device import DEVICES, HardwareError, SerialLine
from softgym_envs.extensions.hardware.emulation import Losses, SimulatedBody
from softgym_envs.extensions.hardware.serving import PseudoTerminal
from softgym_envs.extensions.hardware.simulated_time import BYTE, SeenBody, SimulatedClock, make_emulated

FINGER = {
    "robot": "finger",
    "device": "dynamixel",
    "dynamixel": {
        "port": "/dev/null",
        "servos": {
            "cable_1": {"id": 1, "radius": 0.01, "max_current": 1.0, "torque_constant": 1.78},
            "cable_2": {"id": 2, "radius": 0.01, "max_current": 1.0, "torque_constant": 1.78, "reverse": True},
        },
    },
}


class PumpedLine(SerialLine):
    """A serial line on a pseudo-terminal, whose other end answers when it is read."""

    def __init__(self, terminal, device, clock):
        super().__init__(terminal.path, 1_000_000, clock)
        self.terminal, self.device, self.written, self.heard, self.sent, self.received = terminal, device, 0, 0, 0, 0
        self.unplugged = False

    def write(self, data):
        if self.unplugged:
            raise HardwareError(f"port '{self.port}' is lost: unplugged")
        super().write(data)
        self.written += len(data)
        self.pump()

    def pump(self):
        """Let the device answer all that was written; terminals pass bytes on with a delay, so wait for all of them."""
        while self.heard < self.written:
            select.select([self.terminal.master], [], [])
            data = os.read(self.terminal.master, self.written - self.heard)
            self.heard += len(data)
            self._clock.time += BYTE * len(data)
            answer = self.device.feed(self._clock.now(), data)
            os.write(self.terminal.master, answer)
            self.sent += len(answer)

    def read(self, until):
        if self.sent == self.received:
            self._clock.time = max(self._clock.time, until)
            return b""
        self._serial.timeout = None
        data = self._serial.read(self.sent - self.received)
        self.received += len(data)
        self._clock.time += BYTE * len(data)
        return data


class MovedBench:
    """A bench with an emulated device, and what is behind it."""

    def __init__(self, config, *, backend="surrogate", plant=None, losses=None, late=0.0, latency=0.0, tracker=True):
        self.config = BenchConfig.model_validate(config)
        robot = self.config.make_robot()
        self.clock, self.losses = SimulatedClock(late), losses or Losses()
        self.body = SimulatedBody(robot, backend=backend, plant=plant, latency=latency)
        self.emulated = make_emulated(self.config, self.body, self.losses)
        self.terminal = PseudoTerminal()
        self.line = PumpedLine(self.terminal, self.emulated, self.clock)
        self.device = DEVICES.find(self.config.device)(self.config.settings, robot, self.clock, self.line)
        seen = SeenBody(self.body, self.clock) if tracker else None
        self.bench = Bench(robot, {}, self.device, seen, self.clock)

    def close(self):
        self.line.close()
        self.terminal.close()


@pytest.fixture
def make_bench():
    made = []

    def make(config=FINGER, **options):
        made.append(MovedBench(config, **options))
        return made[-1]

    yield make
    for each in made:
        each.close()
