"""Modbus ASCII, server side: ``:``, unit ID and PDU in hexadecimal, LRC, CR LF (SL 2.5.2). No I/O.

A colon always begins a frame, so a second colon restarts the frame (conformance case MB-070). A pause of more than one second
inside a frame ends it. Function 08/03 can replace LF with a different character (AP 6.8).
"""

from __future__ import annotations

from collections.abc import Mapping

from fieldtwin.emulators.modbus.line import LineServer, ServedFrame
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.clock import NS_PER_S

CHARACTER_GAP_NS = NS_PER_S
"""The longest pause between two characters of a frame (SL 2.5.2.1)."""
MAX_CHARACTERS = 513
"""The number of characters of the longest frame: colon, 2 for each byte of unit ID, 253 bytes of PDU and LRC, CR and LF (SL
2.5.2.1).
"""
MIN_BYTES = 3
"""The number of bytes of the shortest frame: unit ID, function code and LRC."""
_COLON, _RETURN = b":", b"\r"


def lrc(frame: bytes) -> int:
    """Return the checksum of SL 2.5.2.2: the two's complement of the sum of all bytes."""
    return (0x100 - sum(frame) % 0x100) % 0x100


class AsciiReceiver:
    """The receiver of frames in the characters of a serial line. It returns frames in binary, LRC included.

    `crc_errors` counts damaged frames: the LRC or a character is wrong, a colon or a pause cut the frame off, or it is
    too long. `noise_bytes` counts the characters of damaged frames and all characters outside of frames.
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
        """Return the number of characters of an incomplete frame, at most `MAX_CHARACTERS`."""
        return len(self._buffer)

    def feed(self, data: bytes, now_ns: int) -> list[bytes]:
        """Return the frames that are now complete, oldest first. Never raises, whatever `data` contains."""
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
        """Discard everything before the last colon in front of `end`: each earlier colon began a damaged frame."""
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


class AsciiServer(LineServer):
    """The server for the units of one ASCII line.

    `units` maps a unit ID (1 to 247) to its unit; `gap_ns` is the longest pause in a frame.
    """

    check_bytes = 1

    def __init__(self, units: Mapping[int, ModbusUnit], gap_ns: int = CHARACTER_GAP_NS) -> None:
        self._ascii = AsciiReceiver(gap_ns)
        super().__init__(units, self._ascii)

    def encode(self, frame: bytes) -> bytes:
        text = (frame + bytes((lrc(frame),))).hex().upper().encode("ascii")
        return _COLON + text + _RETURN + self._ascii.delimiter

    def as_heard(self, frame: bytes) -> bytes:
        return _COLON + frame.hex().upper().encode("ascii") + _RETURN + self._ascii.delimiter

    def _exchange(self, frame: bytes, now_ns: int) -> ServedFrame:
        exchange = super()._exchange(frame, now_ns)  # the reply still ends with the old delimiter
        unit = self.units.get(frame[0])
        if unit is not None:
            self._ascii.delimiter = bytes((unit.diagnostics.delimiter,))
        return exchange


def _decoded(text: bytes) -> bytes | None:
    """Return the bytes of a frame, LRC included, or None if the frame is invalid or its LRC is wrong.

    Only the digits 0 to 9 and A to F are valid.
    """
    if not text.endswith(_RETURN) or text != text.upper() or b" " in text:
        return None
    try:
        frame = bytes.fromhex(text[:-1].decode("ascii"))
    except ValueError:
        return None
    return frame if len(frame) >= MIN_BYTES and sum(frame) % 0x100 == 0 else None
