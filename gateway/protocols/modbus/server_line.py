"""Modbus RTU requests, heard by a slave on a line that it may share: bytes and times in, requests out.

A frame is told by length and check sum; other slaves' requests and replies are stepped over as wholes. What is neither is
dropped byte by byte, at the latest when the line has been silent for `gap_ns` (cases MB-004, MB-030, MB-034). Nothing here
knows ports, or which units are ours.
"""

from __future__ import annotations

from dataclasses import dataclass

from gateway.core.clock import NS_PER_MS
from gateway.protocols.modbus.crc import crc16, with_crc
from gateway.protocols.modbus.frame_shapes import MAX_FRAME, MIN_FRAME, frame_lengths

_LAST_UNIT = 247
_USB_LATENCY_NS = 20 * NS_PER_MS  # adapters hold bytes back for up to 16 ms (case MB-006)


@dataclass(frozen=True, slots=True)
class LineRequest:
    """A frame with a right check sum: a request, or the reply of another slave, which looks the same."""

    unit: int
    pdu: bytes

    def reply(self, pdu: bytes) -> bytes:
        """The frame that answers with `pdu`."""
        return with_crc(bytes([self.unit]) + pdu)


class RtuRequests:
    """The frames on a line whose characters take `char_time_ns`. Never keeps more than `MAX_FRAME` bytes for long."""

    def __init__(self, char_time_ns: int) -> None:
        # SL 2.5.1.1: fixed above 19200 bit/s, where 3.5 characters of 11 bits would be shorter.
        self.t35_ns = max(char_time_ns * 7 // 2, 1_750_000)
        self.gap_ns = max(self.t35_ns, _USB_LATENCY_NS)
        self.frames = 0
        self.noise_bytes = 0
        self._buffer = bytearray()

    @property
    def pending(self) -> bool:
        """Whether an unfinished frame waits for more bytes, or for a silence of `gap_ns`."""
        return bool(self._buffer)

    def feed(self, data: bytes) -> list[LineRequest]:
        """Take what arrived; the whole frames in it, in order."""
        self._buffer += data
        return self._scan(silent=False)

    def silence(self) -> list[LineRequest]:
        """The line was silent for `gap_ns`: what is incomplete stays so. As `feed`."""
        return self._scan(silent=True)

    def _scan(self, silent: bool) -> list[LineRequest]:
        found: list[LineRequest] = []
        buffer = self._buffer
        while buffer:
            lengths, more = frame_lengths(buffer) if len(buffer) > 1 else ([], True)
            size = self._whole(lengths) or self._unknown(lengths, more, silent)
            if size:
                found.append(LineRequest(buffer[0], bytes(buffer[1 : size - 2])))
                self.frames += 1
                del buffer[:size]
            elif self._may_grow(lengths, more) and not silent:
                return found
            else:
                self.noise_bytes += 1
                del buffer[:1]
        return found

    def _whole(self, lengths: list[int]) -> int:
        for size in lengths:
            if MIN_FRAME <= size <= min(len(self._buffer), MAX_FRAME) and crc16(self._buffer[:size]) == 0:
                return size
        return 0

    def _unknown(self, lengths: list[int], more: bool, silent: bool) -> int:
        """A function that nobody knows has no length: at a silence, or at the longest that a frame can be, it is all there."""
        size = len(self._buffer)
        if lengths or more or not MIN_FRAME <= size <= MAX_FRAME or not (silent or size == MAX_FRAME):
            return 0
        return size if crc16(self._buffer) == 0 else 0

    def _may_grow(self, lengths: list[int], more: bool) -> bool:
        size = len(self._buffer)
        if self._buffer[0] > _LAST_UNIT or size >= MAX_FRAME:
            return False
        return more or not lengths or any(n > size for n in lengths)
