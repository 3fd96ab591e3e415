"""Finding the next RTU frame in a line's bytes when it is not known where one begins.

Every byte may begin a frame, of which only a correct check sum tells. Of several the one that is whole first is taken, so
that it does not matter in which pieces the bytes came, and each byte is looked at a bounded number of times however
they come: what is under trial is kept between calls. Pure.
"""

from __future__ import annotations

import re
from heapq import heappop, heappush

from fieldtwin.emulators.modbus.rtu_shapes import (
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
"""Bytes without a frame after which only frames to the units here are looked for, of functions whose length is known: in
that much garbage others' frames do not help to find one's place any more, and trying every byte for one costs too much."""

IDLE_NOISE = 4
"""Bytes that a line may make up while it changes direction (row MB-008)."""

_REQUEST, _RESPONSE = 0, 1


class Hunt:
    """One search, from the byte that proved to begin no frame on. `own`: the unit ids served here, `declared` what they
    say of their requests."""

    def __init__(self, own: frozenset[int], declared: Declared) -> None:
        self._own = own
        self._declared = declared
        self._ours = _pattern(own)
        self._base = 0  # bytes that the owner dropped: places are counted from the hunt's first byte
        self._next = 0  # the first place that is not under trial
        self._due: list[
            tuple[int, int, int]
        ] = []  # heap of (place of the end, place of the start, request or response)
        self._searches: list[list[int]] = []  # [start, place reached, CRC up to there] of frames of unknown length

    def dropped(self, count: int) -> None:
        """The owner took `count` bytes off the front of the buffer; trials that began there are over."""
        self._base += count

    @property
    def has_dropped(self) -> bool:
        """Whether bytes of the hunt are gone from the buffer."""
        return self._base > 0

    def search(self, buffer: bytearray) -> tuple[int, int] | None:
        """Start and end of the frame in `buffer` that is whole first, or None: then call again when there is more."""
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
        """The next place to try, passing over what cannot begin a frame that is looked for."""
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
        # By CRC alone: the frame that may begin where the last one ended, and one to us behind a byte or two of idle noise.
        # Elsewhere it would find frames in garbage, one in 65536 tries.
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
        """Take the searches by CRC alone up to `horizon`; of several that end there, the one that ends first."""
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
