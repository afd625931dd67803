"""A board with valves and pressure sensors on a serial line, with a wire format that is easy to write for.

All messages are lines of ASCII, ``$CONTENT*XX``, where XX is the exclusive or of the content's bytes in hexadecimal
digits (as in NMEA 0183). Pressures are integers in pascals above the ambient one.

| from the computer | to it | meaning |
|---|---|---|
| ``?`` | ``I,NAME,CHANNELS,MAX`` | who are you: number of channels, largest pressure [Pa] |
| ``A,WATCHDOG,RATE`` | ``A`` | take commands; vent all after WATCHDOG ms of silence; change by at most RATE Pa/s |
| ``P,N,P1,P2,...`` | ``M,N,M1,M2,...`` | set pressures, question N (0 to 255): measured pressures |
| ``S`` | ``S`` | vent all channels, and take no commands until the next ``A`` |
| anything else | ``E,TEXT`` | refused; also for ``P`` before ``A``, or after the watchdog has vented |
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from softgym_envs.config import Config
from softgym_envs.extensions.hardware.device import (
    Clock,
    Device,
    HardwareError,
    Line,
    Reading,
    SerialLine,
    check_names,
)
from softgym_envs.robots.base import Robot

PATIENCE = 0.1
"""Time that the board has to answer, besides the loop [s]."""


def framed(content: str) -> bytes:
    """Return a message with its content and check sum."""
    return f"${content}*{_check(content)}\n".encode("ascii")


def _check(content: str) -> str:
    found = 0
    for byte in content.encode("ascii"):
        found ^= byte
    return f"{found:02X}"


def content_of(message: bytes) -> list[str] | None:
    """Return the fields of a message's content; None for one that is damaged."""
    text = message.decode("ascii", errors="replace").strip()
    content, star, check = text[1:].rpartition("*")
    valid = text.startswith("$") and star and content.isascii() and _check(content) == check
    return content.split(",") if valid else None


class PressureBoardConfig(Config):
    """A pressure board.

    Attributes:
        port: serial port of the board.
        baud: bits per second.
        channels: of each actuator, by its name, from 0.
        max_pressure: largest pressure that is commanded [Pa].
        rise: largest change of a pressure per second [Pa/s].
    """

    port: str
    baud: int = Field(default=115_200, gt=0)
    channels: dict[str, int] = Field(min_length=1)
    max_pressure: float = Field(gt=0.0)
    rise: float = Field(gt=0.0)


class PressureBoard(Device):
    """Chambers that are commanded by pressures.

    Args:
        config: the board.
        robot: the robot whose chambers it fills.
        clock: the time of the bench.
        line: the line; default: the configured port.

    Raises:
        ValueError: unless there is one channel for each actuator.
    """

    Config = PressureBoardConfig
    takes = "effort"

    def __init__(self, config: PressureBoardConfig, robot: Robot, clock: Clock, line: Line | None = None) -> None:
        check_names("channels", list(config.channels), robot)
        self.config, self._clock = config, clock
        self._channels = [config.channels[actuator.name] for actuator in robot.actuators]
        if len(set(self._channels)) < len(self._channels):
            raise ValueError(f"channels {self._channels} must differ")
        self._line = line or SerialLine(config.port, config.baud, clock)
        self._rest, self._number, self._count = b"", 0, 0

    def _answer(self, until: float) -> list[str] | None:
        """Return the fields of the next message that is not damaged; None if none comes until a time."""
        while True:
            line, newline, rest = self._rest.partition(b"\n")
            if newline:
                self._rest = rest
                if (fields := content_of(line)) is not None:
                    return fields
            elif data := self._line.read(until):
                self._rest += data
            else:
                return None

    def _ask(self, content: str) -> list[str]:
        for _ in range(3):  # a single message may be lost
            self._line.write(framed(content))
            until = self._clock.now() + PATIENCE
            while (fields := self._answer(until)) is not None:
                if fields[0] == "E":
                    raise self._refused(fields)
                if fields[0] == {"?": "I"}.get(content, content[0]):
                    return fields
        raise HardwareError(
            f"the board on '{self.config.port}' does not answer; check its power and baud = {self.config.baud}"
        )

    def _refused(self, fields: list[str]) -> HardwareError:
        return HardwareError(f"the board on '{self.config.port}' refuses: {','.join(fields[1:])}")

    def connect(self) -> Reading:
        _, name, count, largest = self._ask("?")
        self._count = int(count)
        if max(self._channels) >= self._count:
            raise HardwareError(f"board '{name}' has {count} channels, but channel {max(self._channels)} is configured")
        if self.config.max_pressure > float(largest):
            raise HardwareError(
                f"max_pressure = {self.config.max_pressure:g} Pa is beyond the {largest} Pa of board '{name}'"
            )
        unknown = np.full(len(self._channels), np.nan)
        return Reading(unknown, unknown)

    def start(self, watchdog: float, speed: np.ndarray) -> None:
        self._ask(f"A,{1000 * watchdog:.0f},{self.config.rise:.0f}")

    def send(self, command: np.ndarray) -> None:
        if (command > self.config.max_pressure).any():
            raise HardwareError(
                f"pressures {command.tolist()} are beyond max_pressure = {self.config.max_pressure:g} Pa of the board"
            )
        pressures = np.zeros(self._count, dtype=int)
        pressures[self._channels] = np.rint(command).astype(int)
        self._number = (self._number + 1) % 256
        self._line.write(framed(f"P,{self._number},{','.join(map(str, pressures))}"))

    def read(self, until: float) -> Reading | None:
        while (fields := self._answer(until)) is not None:
            if fields[0] == "E":
                raise self._refused(fields)
            if fields[:2] == ["M", str(self._number)] and len(fields) == 2 + self._count:
                measured = np.array([float(value) for value in fields[2:]])[self._channels]
                return Reading(np.full(len(measured), np.nan), measured)
        self.lost += 1
        return None

    def stop(self) -> None:
        try:
            for _ in range(3):  # one message may be lost
                self._line.write(framed("S"))
        except HardwareError:  # the line is lost: the watchdog of the board vents
            pass

    def close(self) -> None:
        self._line.close()
