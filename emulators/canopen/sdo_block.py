"""Block transfers of the SDO server, one object for each transfer (CiA 301 v4.2, 7.2.4.3.9 to 7.2.4.3.16).

Pure: 8 bytes in, 8 bytes out. It must never know objects, timers or the bus; `sdo_server` has those.

A sub-block is up to 127 segments, numbered from 1, acknowledged together. Of a sub-block with a hole only what came before
the hole counts; the client sends the rest again, numbered from 1.
"""

from __future__ import annotations

from binascii import crc_hqx
from dataclasses import dataclass, field

from fieldtwin.emulators.canopen.aborts import Abort, abort
from fieldtwin.gateway.core.errors import SdoAborted

MAX_BLOCK = 127
SEGMENT_BYTES = 7
_LAST = 0x80


@dataclass(slots=True)
class BlockDownload:
    """Towards the server. `announced` is the size that the client said, `limit` what may come at most, in bytes."""

    index: int
    subindex: int
    announced: int | None
    limit: int
    crc: bool
    overflow: Abort = Abort.TOO_LONG
    """What more than `limit` is refused with."""
    block: int = MAX_BLOCK
    """Segments of a sub-block."""
    receiving: bool = True
    """False once the last segment is here and only the end is awaited."""
    data: bytearray = field(default_factory=bytearray)
    good: int = 0
    """Number of the last segment of this sub-block that came in its turn."""

    def segment(self, data: bytes) -> bytes | None:
        """One segment; returns the acknowledgement where it ends a sub-block. Raises `SdoAborted`."""
        number = data[0] & 0x7F
        if not 1 <= number <= self.block:
            raise abort(self.index, self.subindex, Abort.SEQUENCE)
        last = bool(data[0] & _LAST)
        if number == self.good + 1:
            self.good = number
            self.data += data[1:8]
            self.receiving = not last
            room = max(-(-self.limit // SEGMENT_BYTES), 1) * SEGMENT_BYTES  # nothing at all takes a segment too
            if len(self.data) > room:
                raise abort(self.index, self.subindex, self.overflow)
        return self.acknowledge() if last or number == self.block else None

    def acknowledge(self) -> bytes:
        """Says up to where the sub-block is good, and begins the next one."""
        reply = bytes([0xA2, self.good, self.block]) + bytes(5)
        self.good = 0
        return reply

    def end(self, data: bytes) -> bytes:
        """The client's end request: the value. Raises `SdoAborted` where size or CRC do not match."""
        unused = data[0] >> 2 & 0x07
        value = bytes(self.data[: len(self.data) - unused])
        if len(value) > self.limit:
            raise abort(self.index, self.subindex, self.overflow)
        if self.announced is not None and len(value) < self.announced:
            raise abort(self.index, self.subindex, Abort.TOO_SHORT)
        if self.crc and crc_hqx(value, 0) != int.from_bytes(data[1:3], "little"):
            raise abort(self.index, self.subindex, Abort.CRC)
        return value


@dataclass(slots=True)
class BlockUpload:
    """Towards the client. `block` is how many segments the client takes at once."""

    index: int
    subindex: int
    data: bytes
    block: int
    crc: bool
    offset: int = 0
    """Where the present sub-block begins."""
    sent: int = 0
    """Segments of the present sub-block; 0 before the client's start."""
    ending: bool = False

    def segments(self) -> list[bytes]:
        """The sub-block from `offset` on."""
        frames: list[bytes] = []
        position = self.offset
        while len(frames) < self.block:
            chunk = self.data[position : position + SEGMENT_BYTES]
            position += SEGMENT_BYTES
            last = position >= len(self.data)
            frames.append(bytes([len(frames) + 1 | (_LAST if last else 0)]) + chunk.ljust(SEGMENT_BYTES, b"\0"))
            if last:
                break
        self.sent = len(frames)
        return frames

    def start(self) -> list[bytes]:
        """The client is ready. Raises `SdoAborted` when it was already."""
        if self.sent or self.ending:
            raise self._abort(Abort.COMMAND)
        return self.segments()

    def acknowledged(self, data: bytes) -> list[bytes]:
        """What is sent after the client's acknowledgement, an early one included. Raises `SdoAborted`."""
        if not self.sent:
            raise self._abort(Abort.COMMAND)
        number, block = data[1], data[2]
        if number > self.sent:
            raise self._abort(Abort.SEQUENCE)
        if not 1 <= block <= MAX_BLOCK:
            raise self._abort(Abort.BLOCK_SIZE)
        self.block = block
        self.offset += number * SEGMENT_BYTES
        if number == self.sent and self.offset >= len(self.data):
            self.ending, self.sent = True, 0
            unused = self.offset - len(self.data)
            return [
                bytes([0xC1 | unused << 2])
                + (crc_hqx(self.data, 0) if self.crc else 0).to_bytes(2, "little")
                + bytes(5)
            ]
        return self.segments()

    def _abort(self, code: Abort) -> SdoAborted:
        return abort(self.index, self.subindex, code)
