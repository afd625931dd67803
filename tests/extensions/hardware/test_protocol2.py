"""Packets agree with the examples of ROBOTIS' manual and with ROBOTIS' own library."""

from __future__ import annotations

import dynamixel_sdk as sdk
import numpy as np
import pytest

from softgym_envs.extensions.hardware.dynamixel import DynamixelConfig
from softgym_envs.extensions.hardware.emulation import EmulatedServoBus, SimulatedBody
from softgym_envs.extensions.hardware.protocol2 import Packet, Stream, crc16, fast_status, split_fast_status
from softgym_envs.robots.registry import make_robot
from tests.extensions.hardware.conftest import FINGER

MANUAL = {  # emanual.robotis.com/docs/en/dxl/protocol2, its examples
    "fffffd00010300 01 194e": Packet(1, 0x01),
    "fffffd00010700 55000604 26 655d": Packet(1, 0x55, bytes([6, 4, 0x26])),
    "fffffd00010700 0284000400 1d15": Packet(1, 0x02, bytes([0x84, 0, 4, 0])),
    "fffffd00010900 03740000020000 ca89": Packet(1, 0x03, bytes([0x74, 0, 0, 2, 0, 0])),
    "fffffd00fe0900 82840004000102 cefa": Packet(0xFE, 0x82, bytes([0x84, 0, 4, 0, 1, 2])),
    "fffffd00fe1100 83740004000196000000 02aa000000 8287": Packet(
        0xFE, 0x83, bytes([0x74, 0, 4, 0, 1, 0x96, 0, 0, 0, 2, 0xAA, 0, 0, 0])
    ),
}


@pytest.mark.parametrize("text", MANUAL)
def test_packets_of_the_manual(text):
    raw = bytes.fromhex(text)
    assert MANUAL[text].encode() == raw
    assert list(Stream().feed(raw)) == [MANUAL[text]]


def test_headers_inside_a_packet_are_stuffed():
    packet = Packet(3, 0x03, b"\x00\x00\xff\xff\xfd\x00\xff\xff\xfd")
    raw = packet.encode()
    assert raw.count(b"\xff\xff\xfd\xfd") == 2 and list(Stream().feed(raw)) == [packet]


def test_packets_are_found_in_pieces_and_noise():
    rng, packets = np.random.default_rng(0), list(MANUAL.values())
    raw = b"".join(rng.bytes(3) + packet.encode() for packet in packets)
    stream = Stream()
    found = [packet for k in range(len(raw)) for packet in stream.feed(raw[k : k + 1])]
    assert found == packets and stream.damaged == 0


def test_every_turned_bit_is_found():
    raw, stream = Packet(1, 0x03, bytes(range(12))).encode(), Stream()
    for bit in range(8 * 5, 8 * len(raw)):  # the header itself excepted
        damaged = bytearray(raw)
        damaged[bit // 8] ^= 1 << bit % 8
        stream.clear()
        assert list(stream.feed(bytes(damaged))) == []


def test_one_status_of_several_servos():
    raw = fast_status([0, 0x80], [1, 2], [b"\xff\xff\xfd\xfd", b"abcd"])
    (packet,) = Stream().feed(raw)
    assert split_fast_status(packet, 4) == {1: (0, b"\xff\xff\xfd\xfd"), 2: (0x80, b"abcd")}


# -- ROBOTIS' library on the emulated bus -----------------------------------------------------------------------------


class Port(sdk.PortHandler):
    """A port of ROBOTIS' library whose other end is the emulated bus; time does not pass."""

    def __init__(self, bus):
        super().__init__("emulated")
        self.bus, self.waiting, self.now = bus, b"", 0.0

    def clearPort(self):
        self.waiting = b""

    def writePort(self, packet):
        self.now += 0.001
        self.waiting += self.bus.feed(self.now, bytes(packet))
        return len(packet)

    def readPort(self, length):
        data, self.waiting = self.waiting[:length], self.waiting[length:]
        return data

    def setPacketTimeout(self, packet_length):
        pass

    def setPacketTimeoutMillis(self, msec):
        pass

    def isPacketTimeout(self):
        return not self.waiting


@pytest.fixture(scope="module")
def bus():
    config = DynamixelConfig.model_validate(FINGER["dynamixel"])
    return EmulatedServoBus(SimulatedBody(make_robot("finger")), config)


def test_the_library_of_the_maker_drives_the_emulated_servos(bus):
    port, packets = Port(bus), sdk.PacketHandler(2.0)
    assert packets.ping(port, 1) == (1020, sdk.COMM_SUCCESS, 0)
    found, result = packets.broadcastPing(port)
    assert result == sdk.COMM_SUCCESS and found == {1: [1020, 45], 2: [1020, 45]}
    for id in (1, 2):
        assert packets.write1ByteTxRx(port, id, 64, 1) == (sdk.COMM_SUCCESS, 0)
    goals = sdk.GroupSyncWrite(port, packets, 116, 4)
    for id, goal in ((1, 2100), (2, 2000)):
        goals.addParam(id, goal.to_bytes(4, "little"))
    assert goals.txPacket() == sdk.COMM_SUCCESS
    port.now += 1.0
    assert packets.read4ByteTxRx(port, 1, 132) == (2100, sdk.COMM_SUCCESS, 0)
    for name in ("txRxPacket", "fastSyncRead"):
        together = sdk.GroupSyncRead(port, packets, 126, 10)
        assert together.addParam(1) and together.addParam(2)
        assert getattr(together, name)() == sdk.COMM_SUCCESS
        assert [together.getData(id, 132, 4) for id in (1, 2)] == [2100, 2000]


def test_the_emulated_servos_refuse_as_real_ones(bus):
    port, packets = Port(bus), sdk.PacketHandler(2.0)
    packets.write1ByteTxRx(port, 1, 64, 1)
    assert packets.write1ByteTxRx(port, 1, 11, 4)[1] == 7  # the EEPROM is locked while the motor has power
    assert packets.write4ByteTxRx(port, 1, 132, 5)[1] == 7  # read only
    assert packets.write4ByteTxRx(port, 1, 116, 5000)[1] == 6  # beyond the limits of the position
    assert packets.write1ByteTxRx(port, 1, 65, 9)[1] == 4  # out of range
    assert packets.write1ByteTxRx(port, 1, 116, 9)[1] == 5  # half a number
    bus.servos[1].set((70, 1), 1 << 5)
    assert packets.read1ByteTxRx(port, 1, 70) == (32, sdk.COMM_SUCCESS, 0x80)
    assert packets.reboot(port, 1)[0] == sdk.COMM_SUCCESS
    assert packets.read1ByteTxRx(port, 1, 70) == (0, sdk.COMM_SUCCESS, 0)


def test_the_crc_is_that_of_the_maker():
    data = np.random.default_rng(1).bytes(40)
    assert crc16(data) == sdk.Protocol2PacketHandler().updateCRC(0, list(data), len(data))
