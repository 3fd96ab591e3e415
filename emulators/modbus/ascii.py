"""Modbus ASCII, server side: ``:``, unit and PDU in hexadecimal, LRC, CR LF (SL 2.5.2). Pure.

A colon begins a frame wherever it stands, so a second one restarts (row MB-070); a pause of over a second inside a frame
ends it. Which character stands for LF can be changed by function 08/03 (AP 6.8).
"""

from __future__ import annotations

from collections.abc import Mapping

from fieldtwin.emulators.modbus.line import Exchange, LineSlave
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.clock import NS_PER_S

CHARACTER_GAP_NS = NS_PER_S
"""The longest pause between two characters of a frame (SL 2.5.2.1)."""
MAX_CHARACTERS = 513
"""Of a frame: colon, 2 for each of unit, 253 bytes of PDU and LRC, CR and LF (SL 2.5.2.1)."""
MIN_BYTES = 3
"""Unit, function, LRC."""
_COLON, _RETURN = b":", b"\r"


def lrc(frame: bytes) -> int:
    """The check sum of SL 2.5.2.2: two's complement of the sum of all bytes."""
    return (0x100 - sum(frame) % 0x100) % 0x100


class AsciiReceiver:
    """Cuts frames out of a line; they come out in binary, LRC included.

    `crc_errors` counts frames that began and were none: a bad LRC or character, cut off by a colon or a pause, too long.
    `noise_bytes` counts the characters of those, and all outside of frames.
    """

    def __init__(self, gap_ns: int = CHARACTER_GAP_NS) -> None:
        self.gap_ns = gap_ns
        self.delimiter = b"\n"
        self.frames = 0
        self.crc_errors = 0
        self.noise_bytes = 0
        self._buffer = bytearray()
        self._last_ns = 0

    @property
    def pending(self) -> int:
        """Characters of a frame that is not whole, at most `MAX_CHARACTERS`."""
        return len(self._buffer)

    def feed(self, data: bytes, now_ns: int) -> list[bytes]:
        """Frames that are whole now, oldest first. Never raises, whatever comes."""
        if self._buffer and now_ns - self._last_ns > self.gap_ns:
            self._damaged(len(self._buffer))
        if not data:
            return []
        self._last_ns = now_ns
        self._buffer += data
        frames: list[bytes] = []
        while (end := self._buffer.find(self.delimiter)) >= 0:
            self._restart_at_last_colon(end)
            end = self._buffer.find(self.delimiter)
            if not self._buffer.startswith(_COLON):
                self._skip(end + 1)
                continue
            frame = _decoded(bytes(self._buffer[1:end])) if end < MAX_CHARACTERS else None
            if frame is None:
                self._damaged(end + 1)
            else:
                del self._buffer[: end + 1]
                frames.append(frame)
        self._restart_at_last_colon(len(self._buffer))
        if not self._buffer.startswith(_COLON):
            self._skip(len(self._buffer))
        elif len(self._buffer) >= MAX_CHARACTERS:
            self._damaged(len(self._buffer))
        self.frames += len(frames)
        return frames

    def _restart_at_last_colon(self, end: int) -> None:
        """Every colon before `end` but the last began a frame that is none."""
        last = self._buffer.rfind(_COLON, 0, end)
        if last > 0:
            self.crc_errors += self._buffer.count(_COLON, 0, last)
            self._skip(last)

    def _damaged(self, count: int) -> None:
        self.crc_errors += 1
        self._skip(count)

    def _skip(self, count: int) -> None:
        self.noise_bytes += count
        del self._buffer[:count]


class AsciiSlave(LineSlave):
    """The units of one ASCII line. `units`: unit id (1 to 247) -> unit; `gap_ns`: the longest pause inside a frame."""

    check_bytes = 1

    def __init__(self, units: Mapping[int, ModbusUnit], gap_ns: int = CHARACTER_GAP_NS) -> None:
        self._ascii = AsciiReceiver(gap_ns)
        super().__init__(units, self._ascii)

    def encode(self, frame: bytes) -> bytes:
        text = (frame + bytes((lrc(frame),))).hex().upper().encode("ascii")
        return _COLON + text + _RETURN + self._ascii.delimiter

    def as_heard(self, frame: bytes) -> bytes:
        return _COLON + frame.hex().upper().encode("ascii") + _RETURN + self._ascii.delimiter

    def _exchange(self, frame: bytes, now_ns: int) -> Exchange:
        exchange = super()._exchange(frame, now_ns)  # its reply still ends as its request did
        unit = self.units.get(frame[0])
        if unit is not None:
            self._ascii.delimiter = bytes((unit.diagnostics.delimiter,))
        return exchange


def _decoded(text: bytes) -> bytes | None:
    """The bytes of a frame, LRC included and found right; None where it is none. Digits are 0 to 9 and A to F only."""
    if not text.endswith(_RETURN) or text != text.upper() or b" " in text:
        return None
    try:
        frame = bytes.fromhex(text[:-1].decode("ascii"))
    except ValueError:
        return None
    return frame if len(frame) >= MIN_BYTES and sum(frame) % 0x100 == 0 else None
