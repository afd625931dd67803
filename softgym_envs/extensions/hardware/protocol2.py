"""Packets of Dynamixel's protocol 2.0: written, found in a stream of bytes, and checked.

The layout is that of ROBOTIS' manual (emanual.robotis.com/docs/en/dxl/protocol2): ``FF FF FD 00``, the servo, the
length of what follows, the instruction, its parameters and a CRC, all numbers with the low byte first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
MAX_LENGTH = 1024
"""A longer packet is taken for noise that looks like a header."""

ALERT = 0x80
"""Bit of a status' error: the servo has a fault, which its hardware error status names."""


class Instruction(IntEnum):
    """What a packet asks for; `STATUS` is an answer."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A


ERRORS = {
    1: "the instruction failed",
    2: "unknown instruction",
    3: "the packet was damaged on its way",
    4: "value out of range",
    5: "wrong number of bytes",
    6: "value beyond the limits of the servo",
    7: "register cannot be written now",
}
"""What the numbers of errors in a status mean."""


def _table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
        table.append(crc)
    return table


_CRC = _table()


def crc16(data: bytes) -> int:
    """Return the CRC-16 of bytes (polynomial 0x8005, from 0, high bit first)."""
    crc = 0
    for byte in data:
        crc = ((crc << 8) ^ _CRC[(crc >> 8) ^ byte]) & 0xFFFF
    return crc


@dataclass(frozen=True)
class Packet:
    """An instruction, or the status that answers it.

    Attributes:
        servo: number of the servo, or `BROADCAST`.
        instruction: see `Instruction`.
        data: parameters; those of a status begin after its error.
        error: of a status: a number of `ERRORS`, with the bit `ALERT`.
    """

    servo: int
    instruction: int
    data: bytes = b""
    error: int = 0

    def encode(self) -> bytes:
        """Return the bytes of the packet."""
        content = bytes([self.instruction])
        if self.instruction == Instruction.STATUS:
            content += bytes([self.error])
        # An inner header gets a further FD, so that nobody takes it for the start of a packet.
        content = (content + self.data).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        return _framed(self.servo, content)


def _framed(servo: int, content: bytes) -> bytes:
    body = HEADER + bytes([servo]) + (len(content) + 2).to_bytes(2, "little") + content
    return body + crc16(body).to_bytes(2, "little")


def fast_status(errors: Sequence[int], servos: Sequence[int], data: Sequence[bytes]) -> bytes:
    """Return the one status by which several servos answer a fast sync read.

    Each servo adds its error, number, data and the CRC of all bytes so far; none of these are stuffed.
    """
    length = 1 + sum(len(part) + 4 for part in data)
    out = HEADER + bytes([BROADCAST]) + length.to_bytes(2, "little") + bytes([Instruction.STATUS])
    for error, servo, part in zip(errors, servos, data, strict=True):
        out += bytes([error, servo]) + part
        out += crc16(out).to_bytes(2, "little")
    return out


def split_fast_status(status: Packet, size: int) -> dict[int, tuple[int, bytes]]:
    """Return error and data of each servo in a status by which several answered; ``size`` bytes of data each."""
    # The CRC of the last servo is that of the packet.
    block, raw = size + 4, bytes([status.error]) + status.data + b"\0\0"
    return {raw[k + 1]: (raw[k], raw[k + 2 : k + 2 + size]) for k in range(0, len(raw), block) if k + block <= len(raw)}


class Stream:
    """Finds packets in bytes as they arrive.

    Attributes:
        damaged: number of packets whose CRC was wrong.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self.damaged = 0

    def clear(self) -> None:
        """Forget bytes of an unfinished packet."""
        self._buffer = b""

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Take bytes and yield the packets that they complete; damaged ones are counted and skipped."""
        self._buffer += data
        while (start := self._buffer.find(HEADER)) >= 0:
            self._buffer = self._buffer[start:]
            if len(self._buffer) < 7:
                return
            length = int.from_bytes(self._buffer[5:7], "little")
            if not 3 <= length <= MAX_LENGTH:
                self._buffer = self._buffer[len(HEADER) :]
                continue
            if len(self._buffer) < 7 + length:
                return
            body, crc = self._buffer[: 5 + length], self._buffer[5 + length : 7 + length]
            if crc16(body) != int.from_bytes(crc, "little"):
                self.damaged += 1
                self._buffer = self._buffer[len(HEADER) :]
                continue
            self._buffer = self._buffer[7 + length :]
            yield _packet(body)
        self._buffer = self._buffer[-len(HEADER) + 1 :]


def _packet(body: bytes) -> Packet:
    servo, content = body[4], body[7:]
    if not (servo == BROADCAST and content[0] == Instruction.STATUS):  # several answers at once are not stuffed
        content = content.replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
    if content[0] != Instruction.STATUS:
        return Packet(servo, content[0], content[1:])
    return Packet(servo, content[0], content[2:], content[1] if len(content) > 1 else 0)
