"""What a robot on a bench must be able to do, and the time and lines that its parts share."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol

import numpy as np

from softgym_envs.config import Config
from softgym_envs.errors import SoftGymError
from softgym_envs.registry import Table
from softgym_envs.robots.base import Robot


class HardwareError(SoftGymError):
    """A device does not answer, reports a fault, or was stopped."""


class Clock:
    """The time of a bench [s], which tests replace by one that they move."""

    def now(self) -> float:
        """Return the time, which never goes back."""
        return time.monotonic()

    def wait(self, until: float) -> None:
        """Wait until a time; return at once if it has passed."""
        if (left := until - time.monotonic()) > 0.0:
            time.sleep(left)


class Line(Protocol):
    """Bytes to and from a device."""

    def write(self, data: bytes) -> None:
        """Send bytes."""

    def read(self, until: float) -> bytes:
        """Return what has arrived, waiting for it until a time of the clock; nothing if nothing comes."""

    def close(self) -> None:
        """Close the line."""


class SerialLine:
    """A serial port, or what pyserial opens by an address, such as ``socket://localhost:7777``.

    Args:
        port: ``/dev/ttyUSB0``, ``COM3``, or an address.
        baud: bits per second.
        clock: the time of the bench.

    Raises:
        HardwareError: if the port does not exist, or another process uses it.
    """

    def __init__(self, port: str, baud: int, clock: Clock) -> None:
        import serial

        self.port, self._clock = port, clock
        try:
            self._serial = serial.serial_for_url(port, baudrate=baud, timeout=0.0)
            if "://" not in port:
                self._serial.exclusive = True
        except (OSError, ValueError) as error:
            raise HardwareError(f"port '{port}' cannot be opened: {error}") from None

    def write(self, data: bytes) -> None:
        try:
            self._serial.write(data)
        except OSError as error:
            raise HardwareError(f"port '{self.port}' is lost: {error}") from None

    def read(self, until: float) -> bytes:
        try:
            if waiting := self._serial.in_waiting:
                return bytes(self._serial.read(waiting))
            left = until - self._clock.now()
            if left <= 0.0:
                return b""
            self._serial.timeout = left
            return bytes(self._serial.read(1))
        except OSError as error:
            raise HardwareError(f"port '{self.port}' is lost: {error}") from None

    def close(self) -> None:
        self._serial.close()


@dataclass(frozen=True)
class Reading:
    """What a device measured.

    Attributes:
        displacement: of its actuators [m, ...], shape (n_a,); NaN where nothing measures it.
        effort: of its actuators [N, ...], shape (n_a,); NaN where nothing measures it.
    """

    displacement: np.ndarray
    effort: np.ndarray


class Device(ABC):
    """The drives of a robot.

    A device has no power until `start`, which leaves the robot as it is; nothing moves before the first `send`. It
    stops by itself when it has heard nothing for the time of its watchdog.

    Attributes:
        takes: what its commands are, ``"displacement"`` or ``"effort"``.
        lost: number of readings that did not arrive, or arrived damaged.
    """

    takes: Literal["displacement", "effort"] = "displacement"
    lost: int = 0
    Config: ClassVar[type[Config]]

    @abstractmethod
    def connect(self) -> Reading:
        """Find all drives, without giving them power, and return what they measure.

        Raises:
            HardwareError: if one is missing, of another kind, or has a fault.
        """

    @abstractmethod
    def start(self, watchdog: float, speed: np.ndarray) -> None:
        """Give power to the drives where they stand.

        Args:
            watchdog: time after which they stop if they hear nothing [s].
            speed: largest change of their displacements per second, shape (n_a,).

        Raises:
            HardwareError: as `connect`.
        """

    @abstractmethod
    def send(self, command: np.ndarray) -> None:
        """Send a command (n_a,), without waiting."""

    @abstractmethod
    def read(self, until: float) -> Reading | None:
        """Return what the drives measure now; None if no answer comes until a time of the clock.

        Raises:
            HardwareError: if a drive reports a fault.
        """

    @abstractmethod
    def stop(self) -> None:
        """Take the power from all drives, or the pressure; never raises, and may be called again."""

    @abstractmethod
    def close(self) -> None:
        """Close the line; the drives have been stopped."""


DEVICES = Table(
    "device",
    {
        "dynamixel": "softgym_envs.extensions.hardware.dynamixel:Dynamixel",
        "pressure_board": "softgym_envs.extensions.hardware.pressure_board:PressureBoard",
    },
    group="softgym_envs.devices",
)
"""Classes of devices by name, made with ``(Config, robot, clock)``."""


def check_names(kind: str, given: Sequence[str], robot: Robot) -> None:
    """Check that a configuration names each actuator of a robot once.

    Raises:
        ValueError: with those that are missing or unknown.
    """
    names = [actuator.name for actuator in robot.actuators]
    if sorted(given) != sorted(names):
        raise ValueError(
            f"{kind} = {', '.join(given) or 'none'} must name the actuators of robot '{robot.name}': {', '.join(names)}"
        )


class Tracker(Protocol):
    """Where the effectors are seen, such as by cameras."""

    def __call__(self) -> np.ndarray | None:
        """Return the newest positions [m], shape (k, 3); None if none came since the last call."""

    def close(self) -> None:
        """Close what the tracker reads from."""


class LineTracker:
    """Positions as lines of text, ``x y z`` of each effector in metres, the newest of which counts.

    Args:
        line: where they come from.
        effectors: number of effectors.
        clock: the time of the bench.
    """

    def __init__(self, line: Line, effectors: int, clock: Clock) -> None:
        self._line, self._count, self._clock = line, effectors, clock
        self._rest = b""

    def __call__(self) -> np.ndarray | None:
        newest = None
        while arrived := self._line.read(self._clock.now()):
            *lines, self._rest = (self._rest + arrived).split(b"\n")
            for text in lines:
                numbers = _numbers(text)
                if len(numbers) == 3 * self._count:
                    newest = np.array(numbers).reshape(-1, 3)
        return newest

    def close(self) -> None:
        self._line.close()


def _numbers(text: bytes) -> list[float]:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:  # half a line, at the beginning
        return []
    return values if np.isfinite(values).all() else []
