"""Find Modbus RTU requests in the bytes that a server receives on a line that it may share with other servers.

A frame is recognised by length and check sum. Requests to other servers and their replies are skipped as a whole. Any other byte
is dropped, at the latest when the line has been silent for `gap_ns` (cases MB-004, MB-030, MB-034). In continuous noise, the
search is only for requests to the units of interest. This module does no I/O.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.protocols.modbus.frames.crc import crc16, with_crc
from fieldtwin.gateway.protocols.modbus.frames.shapes import KNOWN_FUNCTIONS, MAX_FRAME, MIN_FRAME, frame_lengths

_LAST_UNIT = 247
LOST_AFTER = 4 * MAX_FRAME
"""Bytes of noise in a row after which only requests to the units of interest, with functions of a known length, are
looked for.

This lasts until such a request is found or the line is silent. Noise is then dropped several times faster than it could
be parsed.
"""
_USB_LATENCY_NS = 20 * NS_PER_MS  # adapters delay bytes by up to 16 ms (case MB-006)


@dataclass(frozen=True, slots=True)
class LineRequest:
    """A frame with a right check sum: a request, or the reply of another server, which may look like a request."""

    unit: int
    pdu: bytes

    def reply(self, pdu: bytes) -> bytes:
        """Return the frame that answers with `pdu`."""
        return with_crc(bytes([self.unit]) + pdu)


class RtuRequests:
    """The receiver of frames on a line whose characters take `char_time_ns`. Its buffer is limited to about `MAX_FRAME` bytes.

    `units` are the unit IDs of interest: those for which the server answers. Other frames are also returned, except in continuous
    noise.
    """

    def __init__(self, char_time_ns: int, units: Collection[int] = range(_LAST_UNIT + 1)) -> None:
        # SL 2.5.1.1: fixed above 19200 bit/s, where 3.5 characters of 11 bits would be shorter.
        self.t35_ns = max(char_time_ns * 7 // 2, 1_750_000)
        self.gap_ns = max(self.t35_ns, _USB_LATENCY_NS)
        self.frames = 0
        self.noise_bytes = 0
        self._buffer = bytearray()
        self._noise_run = 0
        self._since_pause = bytearray()  # bytes dropped since the last frame or silence, at most MAX_FRAME
        self._units = frozenset(units)
        heads = b"".join(re.escape(bytes([unit])) for unit in sorted(units))
        functions = b"".join(re.escape(bytes([function])) for function in sorted(KNOWN_FUNCTIONS))
        self._ours = re.compile(b"[" + heads + b"][" + functions + b"]", re.DOTALL) if heads else None

    @property
    def pending(self) -> bool:
        """Return whether an unfinished frame waits for more bytes, or for a silence of `gap_ns`."""
        return bool(self._buffer) or bool(self._since_pause)

    def feed(self, data: bytes) -> list[LineRequest]:
        """Take the bytes that arrived; return the frames that are now complete, in order."""
        self._buffer += data
        return self._scan(silent=False)

    def silence(self) -> list[LineRequest]:
        """Note that the line was silent for `gap_ns`: an incomplete frame will not be completed. Return the frames, as `feed`
        does.

        All bytes since the last frame or silence are returned as one request of a wrong length if they are addressed to
        one of `units` and their check sum is right: the addressed device refuses it (AP 7, exception 03).
        """
        whole = bytes(self._since_pause + self._buffer)
        found = self._scan(silent=True)
        self._noise_run = 0
        self._since_pause.clear()
        if not found and self._is_whole_request(whole):
            self.noise_bytes -= len(whole)
            self.frames += 1
            return [LineRequest(whole[0], whole[1:-2])]
        return found

    def _is_whole_request(self, data: bytes) -> bool:
        if not MIN_FRAME <= len(data) <= MAX_FRAME or data[0] not in self._units or data[1] not in KNOWN_FUNCTIONS:
            return False
        return crc16(data) == 0

    def _scan(self, silent: bool) -> list[LineRequest]:
        found: list[LineRequest] = []
        buffer = self._buffer
        while buffer:
            if self._noise_run >= LOST_AFTER and not self._find_ours(silent):
                return found
            lengths, more = frame_lengths(buffer) if len(buffer) > 1 else ([], True)
            size = self._whole(lengths) or self._unknown(lengths, more, silent)
            if size:
                found.append(LineRequest(buffer[0], bytes(buffer[1 : size - 2])))
                self.frames += 1
                self._noise_run = 0
                self._since_pause.clear()
                del buffer[:size]
            elif self._may_grow(lengths, more) and not silent:
                return found
            else:
                self._drop(1)
        return found

    def _find_ours(self, silent: bool) -> bool:
        """Drop the bytes before the next position where a request of interest may begin; return False if there is none."""
        match = self._ours.search(self._buffer) if self._ours is not None else None
        if match is not None:
            self._drop(match.start())
            return True
        self._drop(len(self._buffer) - (not silent))  # the last byte may be a unit ID
        return False

    def _drop(self, count: int) -> None:
        self.noise_bytes += count
        self._noise_run += count
        self._since_pause += self._buffer[: min(count, MAX_FRAME + 1 - len(self._since_pause))]
        del self._buffer[:count]

    def _whole(self, lengths: list[int]) -> int:
        for size in lengths:
            if MIN_FRAME <= size <= min(len(self._buffer), MAX_FRAME) and crc16(self._buffer[:size]) == 0:
                return size
        return 0

    def _unknown(self, lengths: list[int], more: bool, silent: bool) -> int:
        """Return the length of a frame of an unknown function: it is complete at a silence, or at the maximum frame length."""
        size = len(self._buffer)
        if lengths or more or not MIN_FRAME <= size <= MAX_FRAME or not (silent or size == MAX_FRAME):
            return 0
        return size if crc16(self._buffer) == 0 else 0

    def _may_grow(self, lengths: list[int], more: bool) -> bool:
        size = len(self._buffer)
        if self._buffer[0] > _LAST_UNIT or size >= MAX_FRAME:
            return False
        return more or not lengths or any(n > size for n in lengths)
