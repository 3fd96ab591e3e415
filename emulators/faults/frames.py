"""Whole frames out of what a medium delivers, so that a fault can aim at one: RTU, ASCII, MBAP; else chunks as they come.

Lenient on purpose: what makes no frame is passed on after `FLUSH_S`, unchanged. The emulators' own receivers judge.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from emulators.modbus.rtu_shapes import crc16

FLUSH_S = 0.05
"""How long bytes that make no frame wait for more."""
LONGEST = 1024
_MBAP_HEADER = 7
_ADDRESSED = frozenset((1, 2, 3, 4, 5, 6, 15, 16, 22, 23, 24))


class Framing(Enum):
    """What the bytes on a wire are. RAW: nobody knows."""

    RTU = "rtu"
    ASCII = "ascii"
    MBAP = "mbap"
    RAW = "raw"


class Way(Enum):
    """Which way a frame goes: a request to the device, or its reply."""

    REQUEST = "request"
    REPLY = "reply"


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame. `pdu` is empty, `unit` and `function` are -1 where it is not understood. `address`: of the request."""

    way: Way
    framing: Framing
    data: bytes
    unit: int = -1
    pdu: bytes = b""
    address: int = -1

    @property
    def function(self) -> int:
        """Without the bit of an exception."""
        return self.pdu[0] & 0x7F if self.pdu else -1


class Assembler:
    """One direction of one connection. `feed` gives what is whole; `flush` the rest, as it is."""

    def __init__(self, way: Way, framing: Framing) -> None:
        self.way = way
        self.framing = framing
        self._buffer = bytearray()

    @property
    def pending(self) -> int:
        """Bytes that wait for more."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Frame]:
        self._buffer += data
        frames = []
        while self._buffer:
            length = self._whole()
            if not length and len(self._buffer) <= LONGEST:
                break
            frames.append(self._take(length or len(self._buffer)))
        return frames

    def flush(self) -> list[Frame]:
        """What is left, as a frame that nobody understands."""
        return [self._take(len(self._buffer))] if self._buffer else []

    def _whole(self) -> int:
        """The length of the frame at the front; 0: not whole."""
        buffer = self._buffer
        if self.framing is Framing.RAW:
            return len(buffer)
        if self.framing is Framing.MBAP:
            if len(buffer) < _MBAP_HEADER:
                return 0
            length = 6 + int.from_bytes(buffer[4:6])
            return length if len(buffer) >= length else 0
        if self.framing is Framing.ASCII:
            end = buffer.find(b"\r\n")
            return end + 2 if end >= 0 else 0
        return len(buffer) if len(buffer) >= 4 and crc16(bytes(buffer)) == 0 else 0

    def _take(self, length: int) -> Frame:
        data = bytes(self._buffer[:length])
        del self._buffer[:length]
        return understood(self.way, self.framing, data)


def understood(way: Way, framing: Framing, data: bytes) -> Frame:
    """`data` as a frame, with unit and PDU where they can be told."""
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
        return Frame(way, framing, data)
    unit, pdu = adu[0], adu[1:]
    address = -1
    if way is Way.REQUEST and pdu[0] in _ADDRESSED and len(pdu) >= 3:
        address = int.from_bytes(pdu[1:3])
    return Frame(way, framing, data, unit, pdu, address)
