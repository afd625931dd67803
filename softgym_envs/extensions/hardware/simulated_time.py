"""An emulated bench in simulated time, which goes on only where somebody waits: no busy machine delays anything."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from softgym_envs.envs.plant import Plant
from softgym_envs.errors import ConfigError
from softgym_envs.extensions.hardware.bench import Bench, BenchConfig
from softgym_envs.extensions.hardware.device import DEVICES, Clock
from softgym_envs.extensions.hardware.dynamixel import DynamixelConfig
from softgym_envs.extensions.hardware.emulation import (
    Emulated,
    EmulatedPressureBoard,
    EmulatedServoBus,
    Losses,
    SimulatedBody,
)
from softgym_envs.extensions.hardware.pressure_board import PressureBoardConfig

BYTE = 10 / 1_000_000
"""Time of a byte at 1 Mbaud [s]."""


class SimulatedClock(Clock):
    """A clock that stands still until somebody waits, and wakes late by exponentially distributed times.

    Args:
        late: mean of these times [s].
        seed: of them.
    """

    def __init__(self, late: float = 0.0, seed: int = 0) -> None:
        self.time, self.late, self._random = 100.0, late, np.random.default_rng(seed)

    def now(self) -> float:
        return self.time

    def wait(self, until: float) -> None:
        self.time = max(self.time, until) + (self._random.exponential(self.late) if self.late else 0.0)


class EmulatedLine:
    """A line to an emulated device, which takes its time for each byte."""

    def __init__(self, device: Emulated, clock: SimulatedClock) -> None:
        self._device, self._clock, self._arrived = device, clock, b""

    def write(self, data: bytes) -> None:
        self._clock.time += BYTE * len(data)
        self._arrived += self._device.feed(self._clock.now(), data)

    def read(self, until: float) -> bytes:
        data, self._arrived = self._arrived, b""
        self._clock.time = self._clock.time + BYTE * len(data) if data else max(self._clock.time, until)
        return data

    def close(self) -> None:
        pass


class SeenBody:
    """A tracker that sees a simulated body."""

    def __init__(self, body: SimulatedBody, clock: Clock) -> None:
        self._body, self._clock = body, clock

    def __call__(self) -> np.ndarray:
        return self._body.seen(self._clock.now())

    def close(self) -> None:
        pass


def make_emulated(config: BenchConfig, body: SimulatedBody, losses: Losses | None = None) -> Any:
    """Return the emulated device of a bench, which moves a body.

    Raises:
        ConfigError: for a device of which there is no emulation.
    """
    settings = config.settings
    if isinstance(settings, DynamixelConfig):
        return EmulatedServoBus(body, settings, losses)
    if isinstance(settings, PressureBoardConfig):
        channels = [settings.channels[actuator.name] for actuator in body.robot.actuators]
        return EmulatedPressureBoard(body, channels, max(channels) + 1, settings.max_pressure, losses)
    raise ConfigError(f"device '{config.device}' has no emulation; allowed: dynamixel, pressure_board")


def emulated_bench(
    config: BenchConfig,
    *,
    backend: str = "surrogate",
    plant: Mapping[str, Any] | None = None,
    losses: Mapping[str, Any] | None = None,
    latency: float = 0.0,
    late: float = 0.0,
) -> Bench:
    """Return a bench whose device is emulated, byte by byte, in simulated time; its ports are not opened.

    Args:
        config: the bench that is emulated.
        backend: physics of the body.
        plant: how it differs from its model, arguments of `Plant`.
        losses: what the line does, arguments of `Losses`.
        latency: age of the positions that the tracker sends [s].
        late: mean time by which the loop wakes late [s].

    Raises:
        ConfigError: for a device of which there is no emulation.
    """
    robot, clock = config.make_robot(), SimulatedClock(late)
    body = SimulatedBody(robot, config.design, backend=backend, plant=Plant(**(plant or {})), latency=latency)
    line = EmulatedLine(make_emulated(config, body, Losses(**(losses or {}))), clock)
    device = DEVICES.find(config.device)(config.settings, robot, clock, line)
    tracker = None if config.tracker is None else SeenBody(body, clock)
    return Bench(robot, config.design, device, tracker, clock, config.rate, config.watchdog, config.slow)
