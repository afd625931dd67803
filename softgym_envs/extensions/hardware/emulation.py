"""Benches without hardware: servos and boards that speak the real protocols, with a simulated body behind them.

They run behind pseudo-terminals (`softgym hardware emulate`), or in simulated time (`--emulate`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from softgym_envs.backends.registry import make_backend
from softgym_envs.envs.plant import Plant, play
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.hardware import dynamixel as registers
from softgym_envs.extensions.hardware.pressure_board import content_of, framed
from softgym_envs.extensions.hardware.protocol2 import ALERT, BROADCAST, Instruction, Packet, Stream, fast_status
from softgym_envs.robots.base import Robot


class SimulatedBody:
    """A body that drives move: a backend as the robot, with what its drives do and what is seen of it.

    Args:
        robot: the robot.
        design: its body.
        backend: ``"fem"``, ``"surrogate"``, ...
        plant: how the robot differs from its model: gain, offset, play, stiffness, noise of positions.
        latency: time after which positions are seen [s].
        seed: of the noise.
    """

    def __init__(
        self,
        robot: Robot,
        design: Mapping[str, float] | None = None,
        *,
        backend: str = "surrogate",
        plant: Plant | None = None,
        latency: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.robot, self.plant, self.latency = robot, plant or Plant(), latency
        self._backend = make_backend(backend, robot, design)
        self._at = np.zeros(len(robot.actuators))
        self._commanded = np.full(len(robot.actuators), np.nan)
        self._random = np.random.default_rng(seed)
        self._past: deque[tuple[float, np.ndarray]] = deque([(-math.inf, self._backend.state.effector)])

    @property
    def effort(self) -> np.ndarray:
        """Efforts of the drives [N, ...], shape (n_a,)."""
        return self.plant.stiffness * self._backend.state.effort

    @property
    def displacement(self) -> np.ndarray:
        """Displacements at the body [m, ...], shape (n_a,)."""
        return self._backend.state.displacement

    def drive(self, now: float, command: np.ndarray, mode: str = "displacement") -> None:
        """Take the body to where its drives are at a time."""
        if np.array_equal(command, self._commanded):
            return
        self._commanded = command.copy()
        if mode == "displacement":
            wanted = np.multiply(self.plant.gain, command) + self.plant.offset
            command = self._at = play(wanted, self._at, np.broadcast_to(self.plant.backlash, wanted.shape))
        else:
            command = command / self.plant.stiffness
        try:
            state = self._backend.step(command, mode)
        except ConvergenceError:  # it stays where it is
            return
        self._past.append((now, state.effector))

    def seen(self, now: float) -> np.ndarray:
        """Return the positions that are seen of the effectors at a time [m], shape (k, 3)."""
        while len(self._past) > 1 and self._past[1][0] <= now - self.latency:
            self._past.popleft()
        effector = self._past[0][1]
        return effector + self.plant.noise * self.robot.size * self._random.standard_normal(effector.shape)


@dataclass
class Losses:
    """What a line does to packets.

    Attributes:
        lost: share of messages that disappear, in either direction.
        damaged: share of messages in which a bit is turned.
        dead: nothing passes any more.
        seed: of which ones.
        count: number of messages that were lost or damaged.
    """

    lost: float = 0.0
    damaged: float = 0.0
    dead: bool = False
    seed: int = 0
    count: int = 0

    def __post_init__(self) -> None:
        self._random = np.random.default_rng(self.seed)

    def pass_on(self, message: bytes) -> bytes:
        """Return what arrives of a message."""
        if not message:
            return b""
        if self.dead or self._random.random() < self.lost:
            self.count += 1
            return b""
        if self._random.random() < self.damaged:
            self.count += 1
            k = int(self._random.integers(len(message)))
            return message[:k] + bytes([message[k] ^ 1 << int(self._random.integers(8))]) + message[k + 1 :]
        return message


class Emulated(Protocol):
    """A device that answers bytes with bytes."""

    def feed(self, now: float, data: bytes) -> bytes:
        """Take bytes at a time and return the answer."""

    def move(self, now: float) -> None:
        """Let the drives and the body move until a time."""


# -- servos -----------------------------------------------------------------------------------------------------------

XM430_W350 = 1020
"""Model number."""
PRESENT_CURRENT, PRESENT_VELOCITY, PRESENT_POSITION, MOVING = (126, 2), (128, 4), (132, 4), (122, 1)
MAX_VELOCITY = 460
"""Largest velocity of the servo [0.229 rev/min]: 46 rev/min for the XM430-W350 would be 200; cables are light."""
_WRITABLE = {  # address -> (size, lowest, highest); of the RAM, and of the EEPROM, which is locked with power on
    **{7: (1, 0, 252), 8: (1, 0, 7), 9: (1, 0, 254), 10: (1, 0, 13), 11: (1, 0, 16), 38: (2, 0, 1193)},
    **{44: (4, 0, 1023), 48: (4, 0, 4095), 52: (4, 0, 4095), 63: (1, 0, 255)},
    **{64: (1, 0, 1), 65: (1, 0, 1), 68: (1, 0, 2), 98: (1, -1, 127), 100: (2, -885, 885), 102: (2, -1193, 1193)},
    **{104: (4, -1023, 1023), 108: (4, 0, 32767), 112: (4, 0, 32767), 116: (4, -1048575, 1048575)},
}
_EEPROM = 64
"""First address of the RAM."""
_GOALS = (100, 102, 104, 116)
"""Registers that cannot be written after the bus watchdog has stopped the servo."""


class EmulatedServo:
    """The registers of one servo, and its motion.

    Attributes:
        position: of the encoder, as a real number.
        id: number on the bus.
    """

    def __init__(self, id: int, position: int = 2048) -> None:
        self.id, self.position = id, float(position)
        self._memory = bytearray(256)
        self._time, self._heard = 0.0, 0.0
        self._pending: tuple[int, bytes] | None = None
        for register, value in (((0, 2), XM430_W350), ((6, 1), 45), ((7, 1), id), ((11, 1), 3), ((38, 2), 1193)):
            self.set(register, value)
        self.set((48, 4), 4095)
        self.set(registers.GOAL_POSITION, position)
        self.set(PRESENT_POSITION, position)
        self.set((144, 2), 120)

    def get(self, register: tuple[int, int], *, signed: bool = True) -> int:
        """Return the number in a register."""
        address, size = register
        return int.from_bytes(self._memory[address : address + size], "little", signed=signed)

    def set(self, register: tuple[int, int], value: int) -> None:
        """Set a register."""
        address, size = register
        self._memory[address : address + size] = value.to_bytes(size, "little", signed=value < 0)

    @property
    def stopped(self) -> bool:
        """Whether its bus watchdog has stopped it."""
        return self.get(registers.BUS_WATCHDOG) == -1

    @property
    def powered(self) -> bool:
        """Whether its motor has power."""
        return bool(self.get(registers.TORQUE)) and not self.get(registers.HARDWARE_ERROR)

    def move(self, now: float) -> None:
        """Turn towards the goal until a time."""
        watchdog = self.get(registers.BUS_WATCHDOG) * registers.WATCHDOG
        stop = self._heard + watchdog if watchdog > 0.0 else math.inf
        until = min(now, stop)
        if self.powered and not self.stopped and until > self._time:
            fastest = self.get(registers.PROFILE_VELOCITY, signed=False) or MAX_VELOCITY
            reach = fastest * registers.VELOCITY / registers.TICK * (until - self._time)
            self.position += float(np.clip(self.get(registers.GOAL_POSITION) - self.position, -reach, reach))
        if now >= stop and not self.stopped:
            self.set(registers.BUS_WATCHDOG, -1)
            self.set(registers.GOAL_POSITION, round(self.position))
        self._time = max(now, self._time)
        self.set(PRESENT_POSITION, round(self.position))

    def draw(self, current: float) -> None:
        """Note what the motor draws [units of current]."""
        self.set(PRESENT_CURRENT, int(np.clip(round(current), -1193, 1193)) if self.powered else 0)

    def hear(self, now: float) -> None:
        """Note that an instruction was heard."""
        self._heard = now

    def read(self, address: int, size: int) -> tuple[int, bytes]:
        """Return the error and the bytes of registers."""
        if address + size > len(self._memory):
            return 7 | self.alert, b""
        return self.alert, bytes(self._memory[address : address + size])

    @property
    def alert(self) -> int:
        """Bit of errors: whether it has a fault."""
        return ALERT if self.get(registers.HARDWARE_ERROR) else 0

    def write(self, address: int, data: bytes) -> int:
        """Write registers and return the error."""
        at, rest = address, data
        values: list[tuple[int, int, int]] = []
        while rest:
            if at not in _WRITABLE:
                return 7 | self.alert
            size, low, high = _WRITABLE[at]
            if len(rest) < size:
                return 5 | self.alert
            value = int.from_bytes(rest[:size], "little", signed=True)
            if low >= 0 and value < 0:
                value = int.from_bytes(rest[:size], "little")
            if not low <= value <= high:
                return 4 | self.alert
            if at < _EEPROM and self.get(registers.TORQUE):
                return 7 | self.alert
            if at in _GOALS and self.stopped:
                return 7 | self.alert
            if at == 102 and abs(value) > self.get((38, 2)):
                return 6 | self.alert
            if at == 116 and self.get(registers.OPERATING_MODE) == 3 and not 0 <= value <= self.get((48, 4)):
                return 6 | self.alert
            values.append((at, size, value))
            at, rest = at + size, rest[size:]
        for at, size, value in values:
            self.set((at, size), value)
        return self.alert


class EmulatedServoBus:
    """Servos of the series X on one bus, which turn pulleys or horns of a simulated body.

    Args:
        body: what they move.
        config: the servos.
        losses: what the line does to packets.
    """

    def __init__(self, body: SimulatedBody, config: registers.DynamixelConfig, losses: Losses | None = None) -> None:
        self.body, self.losses = body, losses or Losses()
        self._configs = [config.servos[actuator.name] for actuator in body.robot.actuators]
        self.servos = {each.id: EmulatedServo(each.id, each.zero) for each in self._configs}
        self._stream = Stream()

    def move(self, now: float) -> None:
        """Turn all servos until a time, and take the body with them."""
        for servo in self.servos.values():
            servo.move(now)
        turned = [(self.servos[c.id].position - c.zero) * c.per_tick for c in self._configs]
        self.body.drive(now, np.array(turned))
        for config, effort in zip(self._configs, self.body.effort.tolist(), strict=True):
            sign = -1.0 if config.reverse else 1.0
            torque = sign * effort * config.radius
            self.servos[config.id].draw(torque / (config.torque_constant or 1.0) / registers.CURRENT)

    def feed(self, now: float, data: bytes) -> bytes:
        self.move(now)
        heard = self._stream.feed(self.losses.pass_on(data))  # a damaged packet is answered by none
        return b"".join(self.losses.pass_on(self._answer(now, packet)) for packet in heard)

    def _answer(self, now: float, packet: Packet) -> bytes:
        """Return what the servos answer to an instruction."""
        meant = self._meant(packet)
        for servo in meant:
            servo.hear(now)
        asked, data = packet.instruction, packet.data
        address = int.from_bytes(data[:2], "little")
        if asked == Instruction.SYNC_WRITE:
            size = int.from_bytes(data[2:4], "little")
            for k in range(4, len(data), size + 1):
                if data[k] in self.servos:
                    self.servos[data[k]].write(address, data[k + 1 : k + 1 + size])
            self.move(now)
            return b""
        if asked in (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ):
            found = [servo.read(address, int.from_bytes(data[2:4], "little")) for servo in meant]
            if asked == Instruction.FAST_SYNC_READ:
                return fast_status([e for e, _ in found], [s.id for s in meant], [d for _, d in found])
            return b"".join(_status(servo, *each) for servo, each in zip(meant, found, strict=True))
        out = b"".join(_status(servo, *self._single(servo, packet)) for servo in meant)
        return out if packet.servo != BROADCAST or asked == Instruction.PING else b""

    def _meant(self, packet: Packet) -> Sequence[EmulatedServo]:
        """Return the servos that a packet is for, in the order in which they answer."""
        if packet.instruction in (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ):
            return [self.servos[id] for id in packet.data[4:] if id in self.servos]
        if packet.servo == BROADCAST:
            return [self.servos[id] for id in sorted(self.servos)]
        return [self.servos[packet.servo]] if packet.servo in self.servos else []

    def _single(self, servo: EmulatedServo, packet: Packet) -> tuple[int, bytes]:
        """Return error and data of one servo's answer."""
        address, data = int.from_bytes(packet.data[:2], "little"), packet.data[2:]
        if packet.instruction == Instruction.PING:
            return servo.alert, bytes(servo.read(0, 2)[1] + servo.read(6, 1)[1])
        if packet.instruction == Instruction.READ:
            return servo.read(address, int.from_bytes(data, "little"))
        if packet.instruction == Instruction.WRITE:
            return servo.write(address, data), b""
        if packet.instruction == Instruction.REBOOT:
            position = round(servo.position)
            self.servos[servo.id] = EmulatedServo(servo.id, position)
            return 0, b""
        return 2 | servo.alert, b""


def _status(servo: EmulatedServo, error: int, data: bytes) -> bytes:
    return Packet(servo.id, Instruction.STATUS, data, error).encode()


# -- pressure board ---------------------------------------------------------------------------------------------------


class EmulatedPressureBoard:
    """A board that fills the chambers of a simulated body; see `softgym_envs.extensions.hardware.pressure_board`.

    Args:
        body: what it fills.
        channels: channel of each actuator.
        count: number of channels.
        max_pressure: largest pressure [Pa].
        losses: what the line does to messages.
    """

    def __init__(
        self,
        body: SimulatedBody,
        channels: Sequence[int],
        count: int,
        max_pressure: float,
        losses: Losses | None = None,
    ) -> None:
        self.body, self.losses = body, losses or Losses()
        self._channels, self._count, self._max = list(channels), count, max_pressure
        self.pressure, self._wanted = np.zeros(count), np.zeros(count)
        self._time, self._heard, self._watchdog, self._rise = 0.0, 0.0, math.inf, 0.0
        self.active, self._rest = False, b""

    def move(self, now: float) -> None:
        """Let pressures follow what is wanted until a time; vent if nobody was heard."""
        if self.active and now >= self._heard + self._watchdog:
            self.active = False
        if self.active:
            reach = self._rise * max(now - self._time, 0.0)
            self.pressure += np.clip(self._wanted - self.pressure, -reach, reach)
        else:
            self.pressure[:] = self._wanted[:] = 0.0
        self._time = max(now, self._time)
        self.body.drive(now, self.pressure[self._channels], "effort")

    def feed(self, now: float, data: bytes) -> bytes:
        self.move(now)
        *lines, self._rest = (self._rest + self.losses.pass_on(data)).split(b"\n")
        heard = [fields for line in lines if (fields := content_of(line)) is not None]
        return b"".join(self.losses.pass_on(framed(self._answer(now, fields))) for fields in heard)

    def _answer(self, now: float, fields: list[str]) -> str:
        self._heard = now
        if fields == ["?"]:
            return f"I,emulated,{self._count},{self._max:.0f}"
        if fields[0] == "A" and len(fields) == 3:
            self.active, self._watchdog, self._rise = True, int(fields[1]) / 1000, float(fields[2])
            return "A"
        if fields[0] == "S":
            self.active = False
            self.move(now)
            return "S"
        if fields[0] == "P" and not self.active:
            return "E,vented: send A first"
        if fields[0] == "P" and len(fields) == 2 + self._count:
            wanted = np.array([float(value) for value in fields[2:]])
            if (wanted < 0.0).any() or (wanted > self._max).any():
                return f"E,pressures must be from 0 to {self._max:.0f}"
            self._wanted = wanted
            return f"M,{fields[1]},{','.join(f'{value:.0f}' for value in self.pressure)}"
        return "E,unknown message"
