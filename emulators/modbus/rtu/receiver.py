"""Find the beginning and the end of RTU frames in the bytes of a line, as a server on a shared line receives them.

Frames are recognised by their length and checksum, never by silence alone: USB adapters, ptys and sockets do not
preserve the pauses of the line (SL 2.5.1.1 describes what a UART sees). A long pause only decides that an unfinished
frame is discarded. This module performs no I/O: it takes bytes and the present time and returns complete frames. It does not
depend on the units and builds no replies.

The line also carries requests to and responses from other units. To distinguish them, the receiver tries both lengths. It assumes
that the first byte of the buffer begins a frame, so later bytes may wait until that frame is complete. If the first byte proves
to be noise, the receiver tries every following byte (`hunt`), and only a correct checksum counts.
"""

from __future__ import annotations

from fieldtwin.emulators.modbus.rtu.hunt import Hunt
from fieldtwin.emulators.modbus.rtu.shapes import (
    FIXED_REQUESTS,
    KNOWN_REQUESTS,
    LAST_UNIT,
    MAX_FRAME,
    MIN_FRAME,
    Declared,
    Shape,
    crc16,
    is_whole,
    response_shape,
    with_crc,
)
from fieldtwin.gateway.core.clock import NS_PER_MS

__all__ = ["FRAME_GAP_NS", "MAX_FRAME", "MIN_FRAME", "RtuReceiver", "crc16", "with_crc"]

FRAME_GAP_NS = 50 * NS_PER_MS
"""A pause after which no sender continues a frame. It is much longer than t3.5 and than the 16 ms of a USB adapter's timer,
and much shorter than the response timeout of any client.
"""

_NOISE, _WAIT = 0, -1


class RtuReceiver:
    """The receiver of frames in the bytes of a line.

    `own` are the unit IDs served here; the line does not return their responses. `declared` gives the request lengths of their
    device-specific functions.

    `crc_errors` counts runs of at least `MIN_FRAME` bytes that belong to no frame, `noise_bytes` every such byte. Both
    are updated when the next frame is found or the line has paused for `gap_ns`; feed ``b""`` to report a pause.
    """

    def __init__(self, own: frozenset[int], gap_ns: int = FRAME_GAP_NS, declared: Declared | None = None) -> None:
        self.gap_ns = gap_ns
        self.frames = 0
        self.crc_errors = 0
        self.noise_bytes = 0
        self._own = own
        self._declared = declared or Declared()
        self._buffer = bytearray()
        self._hunt: Hunt | None = None
        self._run = 0
        self._last_ns = 0

    @property
    def pending(self) -> int:
        """Return the number of bytes that wait for more, at most `MAX_FRAME`."""
        return len(self._buffer)

    def feed(self, data: bytes, now_ns: int) -> list[bytes]:
        """Return the frames that are now complete, oldest first, each with unit ID and CRC.

        Never raises, whatever `data` is.
        """
        if not self._buffer and self._is_a_request(data):
            self._last_ns = now_ns
            self.frames += 1
            return [data]
        frames: list[bytes] = []
        if self._buffer and now_ns - self._last_ns >= self.gap_ns:
            if self._is_a_whole_request_of_a_wrong_length():
                frames.append(self._take(len(self._buffer)))
            while frame := self._next_frame(wait=False):
                frames.append(frame)
            self._drop(len(self._buffer))
            self._end_run()
        if data:
            self._last_ns = now_ns
            self._buffer += data
            while frame := self._next_frame(wait=True):
                frames.append(frame)
        self.frames += len(frames)
        return frames

    def _is_a_request(self, data: bytes) -> bool:
        """Return whether a chunk is exactly one request to the units served here, the usual case.

        `_next_frame` handles all other cases. This saves 13 % of the time of a read of 10 registers.
        """
        if len(data) < MIN_FRAME or data[0] not in self._own or self._hunt is not None:
            return False
        return FIXED_REQUESTS.get(data[1]) == len(data) and is_whole(data)

    def _is_a_whole_request_of_a_wrong_length(self) -> bool:
        """Return whether the bytes between two pauses are one request to a unit served here, with a length that its first bytes
        do not imply.

        The pauses and the checksum show that it is a complete frame (SL 2.5.1.1). It is therefore refused with
        exception 03 (AP 7: the implied length is incorrect) and not treated as noise.
        """
        if self._hunt is not None and self._hunt.has_dropped:
            return False
        buffer = self._buffer
        if not MIN_FRAME <= len(buffer) <= MAX_FRAME or buffer[0] not in self._own or buffer[1] not in KNOWN_REQUESTS:
            return False
        return self._at_front() <= 0 and crc16(buffer) == 0

    def _next_frame(self, wait: bool) -> bytes | None:
        if self._hunt is None:
            length = self._at_front()
            if length > 0:
                return self._take(length)
            if len(self._buffer) < MIN_FRAME or (length == _WAIT and wait):
                return None
            self._hunt = Hunt(self._own, self._declared)
        found = self._hunt.search(self._buffer)
        if found is not None:
            start, end = found
            self._drop(start)
            self._end_run()
            return self._take(end - start)
        self._drop(len(self._buffer) - MAX_FRAME + 1)  # a frame that began earlier would be complete by now
        return None

    def _at_front(self) -> int:
        """Return the length of the frame at the start of the buffer, `_WAIT` if a plausible frame is incomplete, or `_NOISE`."""
        if len(self._buffer) < MIN_FRAME:
            return _WAIT
        head = self._buffer[:MAX_FRAME]
        shapes = self._shapes(head)
        # Shortest first: a 00 after a complete frame leaves its checksum correct, and is the broadcast address of the
        # next frame.
        for length in sorted(s.length for s in shapes if MIN_FRAME <= s.length <= len(head)):
            if crc16(head[:length]) == 0:
                return length
        waiting = any(s.plausible and len(head) < s.length <= MAX_FRAME for s in shapes)
        return _WAIT if waiting else _NOISE

    def _shapes(self, head: bytearray) -> list[Shape]:
        if head[0] > LAST_UNIT:
            return []  # noise, or a frame that does not concern our units
        request = self._declared.request_shape(head)
        both = [request] if head[0] in self._own or head[0] == 0 else [request, response_shape(head)]
        return [shape for shape in both if shape is not None]

    def _take(self, length: int) -> bytes:
        frame = bytes(self._buffer[:length])
        del self._buffer[:length]
        self._hunt = None
        return frame

    def _drop(self, count: int) -> None:
        if count <= 0:
            return
        del self._buffer[:count]
        if self._hunt is not None:
            self._hunt.dropped(count)
        self._run += count
        self.noise_bytes += count

    def _end_run(self) -> None:
        self._hunt = None
        if self._run >= MIN_FRAME:
            self.crc_errors += 1
        self._run = 0
