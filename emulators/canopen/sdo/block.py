"""Block transfers of the SDO server, one object per transfer (CiA 301 v4.2, 7.2.4.3.9 to 7.2.4.3.16).

The classes take and return the 8 data bytes of frames and do no I/O. They must not depend on objects, timers or the bus, which
the module `server` handles.

A sub-block has up to 127 segments, numbered from 1, which are acknowledged together. If a segment is missing, only the
segments before it count; the client sends the rest again, numbered from 1.
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
    """A transfer to the server. `announced` is the size that the client stated, `limit` the largest permitted, in bytes."""

    index: int
    subindex: int
    announced: int | None
    limit: int
    crc: bool
    overflow: Abort = Abort.TOO_LONG
    """The abort code for more than `limit` bytes."""
    block: int = MAX_BLOCK
    """The number of segments of a sub-block."""
    receiving: bool = True
    """False after the last segment, while only the end request is missing."""
    data: bytearray = field(default_factory=bytearray)
    good: int = 0
    """The number of the last segment of this sub-block that arrived in sequence."""

    def segment(self, data: bytes) -> bytes | None:
        """Process one segment; return the acknowledgement if it ends a sub-block. Raises `SdoAborted`."""
        number = data[0] & 0x7F
        if not 1 <= number <= self.block:
            raise abort(self.index, self.subindex, Abort.SEQUENCE)
        last = bool(data[0] & _LAST)
        if number == self.good + 1:
            self.good = number
            self.data += data[1:8]
            self.receiving = not last
            room = max(-(-self.limit // SEGMENT_BYTES), 1) * SEGMENT_BYTES  # an empty value also takes one segment
            if len(self.data) > room:
                raise abort(self.index, self.subindex, self.overflow)
        return self.acknowledge() if last or number == self.block else None

    def acknowledge(self) -> bytes:
        """Return the acknowledgement of the segments received in sequence, and begin the next sub-block."""
        reply = bytes([0xA2, self.good, self.block]) + bytes(5)
        self.good = 0
        return reply

    def end(self, data: bytes) -> bytes:
        """Process the client's end request and return the value. Raises `SdoAborted` if size or CRC do not match."""
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
    """A transfer to the client. `block` is the number of segments that the client accepts in one sub-block."""

    index: int
    subindex: int
    data: bytes
    block: int
    crc: bool
    offset: int = 0
    """The position in bytes at which the present sub-block begins."""
    sent: int = 0
    """The number of segments of the present sub-block; 0 before the client's start."""
    ending: bool = False

    def segments(self) -> list[bytes]:
        """Return the sub-block from `offset` on."""
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
        """Process the client's start. Raises `SdoAborted` if the transfer has already started."""
        if self.sent or self.ending:
            raise self._abort(Abort.COMMAND)
        return self.segments()

    def acknowledged(self, data: bytes) -> list[bytes]:
        """Return the frames to send after the client's acknowledgement, which may be early. Raises `SdoAborted`."""
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
