"""Robots driven by Dynamixel servos of the series X and MX: cables on pulleys, or joints on horns."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np
from pydantic import Field, model_validator

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
from softgym_envs.extensions.hardware.protocol2 import (
    ALERT,
    BROADCAST,
    ERRORS,
    Instruction,
    Packet,
    Stream,
    split_fast_status,
)
from softgym_envs.robots.base import Robot

# Registers (address, size) of the series X and of MX with protocol 2.0.
OPERATING_MODE, TORQUE = (11, 1), (64, 1)
HARDWARE_ERROR, BUS_WATCHDOG, GOAL_CURRENT = (70, 1), (98, 1), (102, 2)
PROFILE_VELOCITY, GOAL_POSITION, PRESENT_POSITION = (112, 4), (116, 4), (132, 4)
PRESENT = (126, 10)
"""Present current (2 bytes), velocity (4) and position (4) in one read."""

TICK = 2.0 * math.pi / 4096
"""Angle of one step of the encoder [rad]."""
VELOCITY = 0.229 * 2.0 * math.pi / 60
"""Unit of velocities [rad/s]."""
CURRENT = 2.69e-3
"""Unit of currents of the XM and XH [A]."""
WATCHDOG = 0.020
"""Unit of the bus watchdog [s]."""
MULTI_TURN, CURRENT_AND_POSITION = 4, 5
"""Operating modes: positions over several turns, without and with a limit of the current."""

FAULTS = {0: "input voltage", 2: "overheating", 3: "encoder", 4: "electrical shock", 5: "overload"}
"""Bits of the hardware error status."""
PATIENCE = 1.0
"""Time that a servo has to answer while nothing has power [s]; later half of the watchdog's."""


class ServoConfig(Config):
    """One servo.

    Attributes:
        id: number on the bus.
        radius: of its pulley [m]; 1 for a joint, whose displacement is an angle.
        zero: position of the encoder where the displacement is zero.
        reverse: whether the displacement falls where the position rises.
        max_current: largest current [A], for servos that measure it; None for those that do not.
        torque_constant: torque per current [N m/A]; with it efforts are measured.
    """

    id: int = Field(ge=0, le=252)
    radius: float = Field(default=1.0, gt=0.0)
    zero: int = 2048
    reverse: bool = False
    max_current: float | None = Field(default=None, gt=0.0, le=5.5)
    torque_constant: float | None = Field(default=None, gt=0.0)

    @property
    def per_tick(self) -> float:
        """Displacement per step of the encoder [m, rad]."""
        return (-1.0 if self.reverse else 1.0) * TICK * self.radius


class DynamixelConfig(Config):
    """Servos on one bus.

    Attributes:
        port: serial port of the adapter.
        baud: bits per second.
        servos: by name of the actuator.
        fast: whether the servos know the fast sync read: firmware from 2020 on.
    """

    port: str
    baud: int = Field(default=1_000_000, gt=0)
    servos: dict[str, ServoConfig] = Field(min_length=1)
    fast: bool = True

    @model_validator(mode="after")
    def _different(self) -> DynamixelConfig:
        ids = [servo.id for servo in self.servos.values()]
        if len(set(ids)) < len(ids):
            raise ValueError(f"servos have the ids {ids}, which must differ")
        return self


class Dynamixel(Device):
    """Servos that are commanded in position; all move at the same time, and all are read in one answer.

    Args:
        config: the servos.
        robot: the robot that they drive.
        clock: the time of the bench.
        line: the bus; default: the configured port.

    Raises:
        ValueError: unless there is one servo for each actuator.
    """

    Config = DynamixelConfig

    def __init__(self, config: DynamixelConfig, robot: Robot, clock: Clock, line: Line | None = None) -> None:
        check_names("servos", list(config.servos), robot)
        self.config, self._clock = config, clock
        self._servos = {actuator.name: config.servos[actuator.name] for actuator in robot.actuators}
        servos = list(self._servos.values())
        self._ids = [servo.id for servo in servos]
        self._per_tick = np.array([servo.per_tick for servo in servos])
        self._zero = np.array([servo.zero for servo in servos])
        # Nan where the torque constant is unknown. The current has the sign of the position.
        self._per_current = np.array([CURRENT * (servo.torque_constant or np.nan) / servo.radius for servo in servos])
        self._per_current *= np.sign(self._per_tick)
        self._line = line or SerialLine(config.port, config.baud, clock)
        self._stream, self._patience = Stream(), PATIENCE

    # -- instructions -----------------------------------------------------------------------------------------------

    def _send(self, packet: Packet) -> None:
        self._line.write(packet.encode())

    def _clear(self) -> None:
        """Forget what answers to earlier questions may have left."""
        while self._line.read(self._clock.now()):
            pass
        self._stream.clear()

    def _answers(self, count: int, until: float) -> list[Packet]:
        """Return the next answers until a time, at most ``count``."""
        found: list[Packet] = []
        while len(found) < count and (data := self._line.read(until)):
            found += [packet for packet in self._stream.feed(data) if packet.instruction == Instruction.STATUS]
        return found

    def _ask(self, name: str, instruction: Instruction, data: bytes = b"") -> bytes:
        """Return the data of one servo's answer."""
        servo = self._servos[name]
        for _ in range(3):  # a single packet may be lost
            self._clear()
            self._send(Packet(servo.id, instruction, data))
            until = self._clock.now() + self._patience
            answer = next((p for p in self._answers(1, until) if p.servo == servo.id), None)
            if answer is not None:
                break
        else:
            raise HardwareError(
                f"servo {servo.id} ({name}) on '{self.config.port}' does not answer; check its power, id and "
                f"baud = {self.config.baud}"
            )
        if answer.error & ALERT and instruction not in (Instruction.READ, Instruction.REBOOT):
            raise self._fault(name)
        if number := answer.error & ~ALERT:
            asked = f"{instruction.name} {data.hex(' ')}".strip()
            raise HardwareError(f"servo {servo.id} ({name}): {ERRORS.get(number, f'error {number}')} ({asked})")
        return answer.data

    def _get(self, name: str, register: tuple[int, int], *, signed: bool = False) -> int:
        address, size = register
        data = self._ask(name, Instruction.READ, address.to_bytes(2, "little") + size.to_bytes(2, "little"))
        return int.from_bytes(data, "little", signed=signed)

    def _set(self, name: str, register: tuple[int, int], value: int) -> None:
        address, size = register
        self._ask(name, Instruction.WRITE, address.to_bytes(2, "little") + value.to_bytes(size, "little", signed=True))

    def _set_all(self, register: tuple[int, int], values: Mapping[int, int]) -> None:
        """Set a register of several servos, by their ids, in one packet that none answers."""
        address, size = register
        data = address.to_bytes(2, "little") + size.to_bytes(2, "little")
        for id, value in values.items():
            data += bytes([id]) + value.to_bytes(size, "little", signed=True)
        self._send(Packet(BROADCAST, Instruction.SYNC_WRITE, data))

    def _fault(self, name: str) -> HardwareError:
        """Return the error for a servo that reports a fault."""
        bits = self._get(name, HARDWARE_ERROR)
        what = ", ".join(text for bit, text in FAULTS.items() if bits >> bit & 1) or f"fault {bits}"
        return HardwareError(
            f"servo {self._servos[name].id} ({name}) reports {what}; remove the cause and switch it off and on"
        )

    # -- the device -------------------------------------------------------------------------------------------------

    def connect(self) -> Reading:
        for name in self._servos:
            self._ask(name, Instruction.PING)
            if self._get(name, HARDWARE_ERROR):
                raise self._fault(name)
        found = self.read(self._clock.now() + PATIENCE)
        if found is None:
            raise HardwareError(
                f"the servos on '{self.config.port}' do not answer together; set fast: false for old firmware"
            )
        return found

    def start(self, watchdog: float, speed: np.ndarray) -> None:
        self._patience = 0.5 * watchdog
        for k, (name, servo) in enumerate(self._servos.items()):
            self._set(name, BUS_WATCHDOG, 0)  # ends an earlier stop
            mode = MULTI_TURN if servo.max_current is None else CURRENT_AND_POSITION
            if self._get(name, OPERATING_MODE) != mode:
                self._set(name, TORQUE, 0)  # it can be set only without power
                self._set(name, OPERATING_MODE, mode)
            if servo.max_current is not None:
                self._set(name, GOAL_CURRENT, int(servo.max_current / CURRENT))
            self._set(name, PROFILE_VELOCITY, max(1, math.ceil(speed[k] / servo.radius / VELOCITY)))
            # Power on where it stands: the goal is where the servo is.
            self._set(name, GOAL_POSITION, self._get(name, PRESENT_POSITION, signed=True))
            self._set(name, TORQUE, 1)
        for name in self._servos:  # last, since the others take their time
            self._set(name, BUS_WATCHDOG, max(1, math.floor(watchdog / WATCHDOG)))

    def send(self, command: np.ndarray) -> None:
        ticks = self._zero + np.rint(command / self._per_tick).astype(int)
        self._set_all(GOAL_POSITION, dict(zip(self._ids, ticks.tolist(), strict=True)))

    def read(self, until: float) -> Reading | None:
        found = self._present(until)
        if found is None:
            self.lost += 1
            return None
        for name, id in zip(self._servos, self._ids, strict=True):
            if found[id][0] & ALERT:
                raise self._fault(name)
        raw = [found[id][1] for id in self._ids]
        current = np.array([int.from_bytes(data[:2], "little", signed=True) for data in raw])
        position = np.array([int.from_bytes(data[6:10], "little", signed=True) for data in raw])
        return Reading((position - self._zero) * self._per_tick + 0.0, current * self._per_current + 0.0)

    def _present(self, until: float) -> dict[int, tuple[int, bytes]] | None:
        """Return error and present values of all servos, by id; None if one is missing."""
        self._clear()
        address, size = PRESENT
        asked = address.to_bytes(2, "little") + size.to_bytes(2, "little") + bytes(self._ids)
        fast = self.config.fast
        kind = Instruction.FAST_SYNC_READ if fast else Instruction.SYNC_READ
        self._send(Packet(BROADCAST, kind, asked))
        answers = self._answers(1 if fast else len(self._ids), until)
        found = {p.servo: (p.error, p.data) for p in answers if len(p.data) == size}
        if fast and answers:
            found = split_fast_status(answers[0], size)
        return found if self._has_all(found) else None

    def _has_all(self, found: Iterable[int]) -> bool:
        return set(self._ids) <= set(found)

    def stop(self) -> None:
        try:
            for _ in range(3):  # none answers, and one packet may be lost
                self._set_all(TORQUE, dict.fromkeys(self._ids, 0))
        except HardwareError:  # the line is lost: the watchdog of the servos stops them
            pass

    def close(self) -> None:
        self._line.close()
