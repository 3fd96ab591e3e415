"""Divide the bytes of a medium into whole frames, so that a fault can aim at single frames.

The parser supports RTU, ASCII and MBAP frames, datagrams of a digital thread and MQTT packets; other bytes are passed on in the
chunks in which they arrive.

It is lenient on purpose: bytes that form no frame are passed on unchanged after `FLUSH_S`, and the emulators'
own receivers decide about them. In a stream whose frames carry their length (`Framing.streams`) it waits for the rest
of a frame, because passing half of it on would break the stream.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from fieldtwin.emulators.modbus.rtu.shapes import crc16
from fieldtwin.gateway.core.endpoint import Endpoint

FLUSH_S = 0.05
"""The time in seconds for which bytes that form no frame wait for more bytes."""
LONGEST = 1024
LONGEST_IN_STREAM = 256 * 1024
_MBAP_HEADER = 7
_MQTT_TYPE, _MQTT_PUBLISH, _MQTT_QOS = 0xF0, 0x30, 0x06
"""Bits of a packet's first byte (MQTT 2.1.2, 3.3.1.2)."""
_ADDRESSED = frozenset((1, 2, 3, 4, 5, 6, 15, 16, 22, 23, 24))
_SINGLE = frozenset((5, 6, 22, 24))
"""Functions that access one register, coil or queue, so that the request has no count."""


class Framing(Enum):
    """The frame format of the bytes on a link. RAW: the format is unknown."""

    RTU = "rtu"
    ASCII = "ascii"
    MBAP = "mbap"
    THREAD = "thread"
    """The datagrams of a digital thread over TCP. Two bytes before each datagram hold its length."""
    MQTT = "mqtt"
    """MQTT packets. A fault changes only a PUBLISH with QoS 0, because all other packets belong to the session with the
    broker.
    """
    RAW = "raw"

    @property
    def streams(self) -> bool:
        """Return whether frames are part of a TCP stream with arbitrary segments, and carry their own length."""
        return self in (Framing.THREAD, Framing.MQTT)


EVERY_FRAMING = frozenset(Framing)
MODBUS = frozenset({Framing.RTU, Framing.ASCII, Framing.MBAP})
"""The framings whose frames carry a unit ID and a PDU."""


def framing_of(plant: Endpoint) -> Framing:
    """Return the framing of the bus whose endpoint in the system file is `plant`."""
    if plant.is_can:
        return Framing.RAW
    if plant.scheme == "ascii":
        return Framing.ASCII
    return Framing.RTU if plant.is_serial or plant.scheme == "rtu+tcp" else Framing.MBAP


class FrameDirection(Enum):
    """The direction of a frame: a request to the device, or its reply."""

    REQUEST = "request"
    REPLY = "reply"


@dataclass(frozen=True, slots=True)
class FaultFrame:
    """One frame. If it cannot be parsed, `pdu` is empty, and `unit` and `function` are -1.

    `address` (the first register or bit) and `count` are those of the request, also in the frame of its reply; -1: none.
    """

    way: FrameDirection
    framing: Framing
    data: bytes
    unit: int = -1
    pdu: bytes = b""
    address: int = -1
    count: int = -1

    @property
    def spared(self) -> bool:
        """Return whether faults must leave the frame unchanged."""
        return (
            self.framing is Framing.MQTT
            and self.data != b""
            and self.data[0] & (_MQTT_TYPE | _MQTT_QOS) != _MQTT_PUBLISH
        )

    @property
    def function(self) -> int:
        """Return the function code without the exception bit."""
        return self.pdu[0] & 0x7F if self.pdu else -1


class Assembler:
    """The parser of one direction of a connection.

    `feed` returns the whole frames; `flush` returns the remaining bytes unchanged.
    """

    def __init__(self, way: FrameDirection, framing: Framing) -> None:
        self.way = way
        self.framing = framing
        self.pending = bytearray()
        """The received bytes that do not form a whole frame yet."""

    def feed(self, data: bytes) -> list[FaultFrame]:
        self.pending += data
        frames = []
        while self.pending:
            length = self._whole()
            if not length and len(self.pending) <= (LONGEST_IN_STREAM if self.framing.streams else LONGEST):
                break
            frames.append(self._take(length or len(self.pending)))
        return frames

    def flush(self) -> list[FaultFrame]:
        """Return the remaining bytes as one frame of unknown content."""
        return [self._take(len(self.pending))] if self.pending else []

    def _whole(self) -> int:
        """Return the length of the frame at the front, or 0 if it is incomplete."""
        buffer = self.pending
        if self.framing is Framing.RAW:
            return len(buffer)
        if self.framing is Framing.MBAP:
            if len(buffer) < _MBAP_HEADER:
                return 0
            length = 6 + int.from_bytes(buffer[4:6])
            return length if len(buffer) >= length else 0
        if self.framing.streams:
            length = _mqtt_length(buffer) if self.framing is Framing.MQTT else 2 + int.from_bytes(buffer[:2])
            return length if len(buffer) >= max(2, length) else 0
        if self.framing is Framing.ASCII:
            end = buffer.find(b"\r\n")
            return end + 2 if end >= 0 else 0
        return len(buffer) if len(buffer) >= 4 and crc16(bytes(buffer)) == 0 else 0

    def _take(self, length: int) -> FaultFrame:
        data = bytes(self.pending[:length])
        del self.pending[:length]
        return understood(self.way, self.framing, data)


def _mqtt_length(buffer: bytearray) -> int:
    """Return the length of the MQTT packet at the front with its header (MQTT 1.5.5), or 0 if more bytes are needed."""
    rest = 0
    for at, byte in enumerate(buffer[1:5]):
        rest |= (byte & 0x7F) << 7 * at
        if byte < 0x80:
            return 2 + at + rest
    return 0 if len(buffer) < 5 else len(buffer)


def understood(way: FrameDirection, framing: Framing, data: bytes) -> FaultFrame:
    """Return `data` as a frame, with unit ID and PDU if they can be determined."""
    adu = b""
    if framing is Framing.MBAP and len(data) > _MBAP_HEADER and len(data) == 6 + int.from_bytes(data[4:6]):
        adu = data[6:]
    elif framing is Framing.RTU and len(data) >= 4 and crc16(data) == 0:
        adu = data[:-2]
    elif framing is Framing.ASCII and data[:1] == b":" and data.endswith(b"\r\n"):
        try:
            adu = bytes.fromhex(data[1:-2].decode("ascii"))[:-1]
        except ValueError:
            adu = b""
    if len(adu) < 2:
        return FaultFrame(way, framing, data)
    unit, pdu = adu[0], adu[1:]
    address = count = -1
    if way is FrameDirection.REQUEST and pdu[0] in _ADDRESSED and len(pdu) >= 3:
        address = int.from_bytes(pdu[1:3])
        count = 1 if pdu[0] in _SINGLE else int.from_bytes(pdu[3:5]) if len(pdu) >= 5 else -1
    return FaultFrame(way, framing, data, unit, pdu, address, count)
