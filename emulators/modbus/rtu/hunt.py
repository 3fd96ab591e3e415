"""Search for the next RTU frame in the bytes of a line when the start of a frame is not known.

Every byte may begin a frame, and only a correct checksum confirms it. Of several candidates, the one that is complete
first is taken. The result therefore does not depend on how the bytes were divided, and each byte is examined a bounded
number of times, because the candidates are kept between calls. No I/O.
"""

from __future__ import annotations

import re
from heapq import heappop, heappush

from fieldtwin.emulators.modbus.rtu.shapes import (
    CRC_TABLE,
    KNOWN_REQUESTS,
    LAST_UNIT,
    MAX_FRAME,
    MIN_FRAME,
    Declared,
    crc16,
    response_shape,
)

LOST_AFTER = 4 * MAX_FRAME
"""The number of bytes without a frame after which the search only considers frames to the units served here, with functions
whose length is known. In garbage of this length, frames of other units do not help to resynchronise, and a check of every
byte costs too much.
"""

IDLE_NOISE = 4
"""The largest number of noise bytes that a line may produce while it changes direction (conformance case MB-008)."""

_REQUEST, _RESPONSE = 0, 1


class Hunt:
    """One search, starting at a byte that turned out not to begin a frame.

    `own` are the unit IDs served here, `declared` the request lengths that their units declare.
    """

    def __init__(self, own: frozenset[int], declared: Declared) -> None:
        self._own = own
        self._declared = declared
        self._ours = _pattern(own)
        self._base = 0  # bytes dropped by the owner; positions count from the first byte of the hunt
        self._next = 0  # the first position that has not been tried
        self._due: list[tuple[int, int, int]] = []  # heap of (end position, start position, request or response)
        self._searches: list[list[int]] = []  # [start, position reached, CRC up to there] of frames of unknown length

    def dropped(self, count: int) -> None:
        """Record that the owner removed `count` bytes from the front of the buffer; candidates that began there are
        dropped.
        """
        self._base += count

    @property
    def has_dropped(self) -> bool:
        """Return whether bytes of this search have already been removed from the buffer."""
        return self._base > 0

    def search(self, buffer: bytearray) -> tuple[int, int] | None:
        """Return start and end of the first complete frame in `buffer`, or None; then call again with more data."""
        size = self._base + len(buffer)
        while True:
            horizon = min(self._due[0][0], size) if self._due else size
            if self._next + MIN_FRAME <= horizon:
                self._try(self._candidate(buffer, horizon), buffer)
                continue
            found = self._advance(buffer, horizon)
            if found is not None:
                return found[0] - self._base, found[1] - self._base
            if not self._due or self._due[0][0] > size:
                return None
            end, start, kind = heappop(self._due)
            if start >= self._base and self._is_whole(buffer, start, end, kind):
                return start - self._base, end - self._base

    def _candidate(self, buffer: bytearray, horizon: int) -> int | None:
        """Return the next position to try. Bytes that cannot begin a possible frame are skipped."""
        place = self._next
        if place < LOST_AFTER:
            self._next += 1
            return place
        match = self._ours.search(buffer, place - self._base, horizon - self._base - MIN_FRAME + 2)
        if match is None:
            self._next = horizon - MIN_FRAME + 1
            return None
        self._next = self._base + match.start() + 1
        return self._next - 1

    def _try(self, place: int | None, buffer: bytearray) -> None:
        if place is None:
            return
        at = place - self._base
        head = buffer[at : at + MIN_FRAME]
        if head[0] > LAST_UNIT:
            return
        ours = head[0] in self._own
        kinds = (_REQUEST,) if ours or head[0] == 0 else (_REQUEST, _RESPONSE)
        unknown = False
        for kind in kinds:
            shape = self._declared.request_shape(head) if kind == _REQUEST else response_shape(head)
            if shape is None:
                unknown = True
            elif MIN_FRAME <= shape.length <= MAX_FRAME:
                heappush(self._due, (place + shape.length, place, kind))
        # The CRC alone decides for a frame that may begin where the last one ended, and for one to our units after a
        # byte or two of idle noise. Elsewhere it would find frames in garbage, once in 65536 tries.
        if unknown and (place == 0 or (ours and place < IDLE_NOISE)):
            self._searches.append([place, place, 0xFFFF])

    def _is_whole(self, buffer: bytearray, start: int, end: int, kind: int) -> bool:
        frame = buffer[start - self._base : end - self._base]
        shape = self._declared.request_shape(frame) if kind == _REQUEST else response_shape(frame)
        if shape is None or shape.length > MAX_FRAME or shape.length < MIN_FRAME:
            return False
        if shape.length > len(frame):
            heappush(self._due, (start + shape.length, start, kind))
            return False
        return shape.length == len(frame) and crc16(frame) == 0

    def _advance(self, buffer: bytearray, horizon: int) -> tuple[int, int] | None:
        """Advance the searches that use only the CRC up to `horizon`. Return the frame that ends first, if any."""
        best: tuple[int, int] | None = None
        kept = []
        for search in self._searches:
            start, place, crc = search
            stop = min(horizon, start + MAX_FRAME, best[1] if best else horizon)
            for byte in buffer[place - self._base : stop - self._base]:
                crc = crc >> 8 ^ CRC_TABLE[(crc ^ byte) & 0xFF]
                place += 1
                if crc == 0 and place - start >= MIN_FRAME:
                    best = (start, place) if best is None or place < best[1] else best
                    break
            search[1:] = place, crc
            if place - start < MAX_FRAME:
                kept.append(search)
        self._searches = kept
        return best


def _pattern(own: frozenset[int]) -> re.Pattern[bytes]:
    units = b"".join(b"\\x%02x" % unit for unit in sorted(own)) or b"\\xff"
    functions = b"".join(b"\\x%02x" % function for function in sorted(KNOWN_REQUESTS))
    return re.compile(b"[" + units + b"](?=[" + functions + b"])", re.DOTALL)
