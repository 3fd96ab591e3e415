"""Modbus RTU: a reply is recognised by its expected length and its check sum, never by silence alone.

The framer parses received bytes from the front of its buffer. A frame of another device is skipped *as a whole*, so that nothing
inside it can be mistaken for the awaited reply. A frame of the requested unit that answers a different request is an error. Any
other byte is noise and dropped. The framer waits for the rest of an incomplete foreign frame until the line has been silent for
`gap_ns`: silence decides only if length and check sum cannot.

This module does no I/O. `char_time_ns` is used only for the two silences of SL 2.5.1.1.
"""

from __future__ import annotations

from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import CrcError, Desync, ReplyTimeout, WireError, WrongSize
from fieldtwin.gateway.protocols.modbus.frames.crc import crc16, is_whole, with_crc
from fieldtwin.gateway.protocols.modbus.frames.framing import Framer
from fieldtwin.gateway.protocols.modbus.frames.shapes import MAX_FRAME, MIN_FRAME, frame_lengths
from fieldtwin.gateway.protocols.modbus.requests.request import IMPOSSIBLE, NEED_MORE, Request, counted_bytes, short_hex

USB_LATENCY_NS = 20 * NS_PER_MS
"""USB adapters delay bytes by up to 16 ms (case MB-006), so a shorter pause says nothing about the line."""

_IDLE_NOISE = (0x00, 0xFF)
"""Bytes that are received from a line that is being switched on, idle or not biased (case MB-008)."""

MOST_HUNTED = 8192
"""The number of bytes of noise after which an exchange stops looking for its reply, because the line carries continuous noise."""

_EXCEPTION_FRAME = 5
_LAST_UNIT = 247


class RtuFramer(Framer):
    """RTU framing of one serial line.

    `echo` says that the adapter returns the sent bytes first (two-wire adapters). They are removed; a damaged echo means a
    collision and raises `Desync`. `strict` discards the bytes before a pause of more than 1.5 characters, and a frame that
    follows a foreign frame after less than 3.5 characters (SL 2.5.1.1). Use it only if the time stamps of received bytes are
    accurate. Without `strict`, such frames are accepted.
    """

    has_broadcast = True

    def __init__(self, *, echo: bool = False, strict: bool = False, char_time_ns: int = 0) -> None:
        super().__init__()
        self._expect_echo = echo
        self._strict = strict
        self._char_ns = char_time_ns
        # SL 2.5.1.1: fixed above 19200 bit/s, where 3.5 characters of 11 bits would be shorter.
        self.t15_ns = max(char_time_ns * 3 // 2, 750_000) if char_time_ns else 0
        self.t35_ns = max(char_time_ns * 7 // 2, 1_750_000) if char_time_ns else 0
        self.gap_ns = self.rest_ns = max(self.t35_ns, USB_LATENCY_NS)
        self._buffer = bytearray()
        self._request: Request[Any] | None = None
        self._unit = 0
        self._sent = b""
        self._echo_due = False
        self._last_ns = 0
        self._after_foreign = False
        self._garbage = 0
        self._hunted = 0
        self._wrong_header = ""
        self._seen = ""
        self._late = bytearray()
        """Bytes that arrived while no reply was awaited, up to one frame."""

    def wire_length(self, pdu_length: int) -> int:
        return 1 + pdu_length + 2

    def begin(self, unit: int, request: Request[Any]) -> bytes:
        if self._buffer:
            self._skip(len(self._buffer))
        self._late.clear()
        self._request = request
        self._unit = unit
        self._sent = with_crc(bytes([unit]) + request.encode())
        self._echo_due = self._expect_echo
        self._after_foreign = False
        self._garbage = self._hunted = 0
        self._wrong_header = self._seen = ""
        return self._sent

    def feed(self, data: bytes, now_ns: int) -> bytes | None:
        if self._strict:
            self._apply_silences(data, now_ns)
        self._last_ns = now_ns
        if self._after_foreign:
            self.noise_bytes += len(data)
            return None
        if not self._buffer and self._is_our_reply(data):
            self._end(0)
            return data[1:-2]
        self._buffer += data
        return self._scan(settled=False)

    def settle(self) -> bytes | None:
        if self._request is not None:
            self._request.line_silent()
        return self._scan(settled=True)

    def drained(self, data: bytes) -> None:
        if self._echo_due and data.startswith(self._sent):  # the echo of a broadcast
            self._echo_due = False
            data = data[len(self._sent) :]
        self.late_bytes += len(data)
        self._late += data
        if MIN_FRAME <= len(self._late) <= MAX_FRAME and crc16(self._late) == 0:
            self._stray(self._late[0], self._late[1:], 0)
            self._late.clear()
        del self._late[MAX_FRAME + 1 :]

    def overdue(self, waited_s: float) -> WireError:
        if self._wrong_header:
            return Desync("a reply of the wrong size", expected=self._expectation(), got=self._wrong_header)
        if self._garbage >= self._shortest_reply():
            return CrcError(
                f"{self._garbage} bytes arrived, but no valid frame",
                expected=self._expectation(),
                hint="check baud rate, parity and wiring",
            )
        got = short_hex(self._buffer) if self._buffer else self._seen
        return ReplyTimeout(f"no reply within {waited_s:.3g} s", expected=self._expectation(), got=got)

    # -- reading from the front ----------------------------------------------------------------------------------

    def _is_our_reply(self, data: bytes) -> bool:
        """Return whether `data` is exactly the awaited reply, which is the usual case; `_scan` handles all other cases.

        This shortcut saves 22 % of the time of a read of 10 registers (benchmarks/modbus_codec.py).
        """
        request = self._request
        if request is None or self._echo_due or len(data) < _EXCEPTION_FRAME or data[0] != self._unit:
            return False
        return data[1] == request.function and request.reply_length(data[1:3]) + 3 == len(data) and is_whole(data)

    def _scan(self, settled: bool) -> bytes | None:
        if self._echo_due and not self._strip_echo():
            return None
        while self._buffer and (request := self._request) is not None:
            if self._hunted >= MOST_HUNTED:
                self._skip(len(self._buffer))
                return None
            if self._starts_our_reply(request):
                return self._take_reply(request)
            if not self._step_over(request, settled):
                return None
        return None

    def _starts_our_reply(self, request: Request[Any]) -> bool:
        """Return whether the buffer may start with the awaited reply.

        Unit ID and function have to match, and also the next bytes of a normal reply.
        """
        buffer = self._buffer
        if buffer[0] != self._unit:
            return False
        if len(buffer) == 1:
            return True
        if buffer[1] == request.function | 0x80:
            return True
        return buffer[1] == request.function and request.reply_length(bytes(buffer[1:])) != IMPOSSIBLE

    def _take_reply(self, request: Request[Any]) -> bytes | None:
        """Remove the reply from the front of the buffer and return its PDU; return None while it is incomplete.

        Raises `CrcError` if it is damaged, `Desync` if the bytes are a valid frame that answers a different request.
        """
        buffer = self._buffer
        if len(buffer) < 2:
            return None
        if buffer[1] == request.function | 0x80:
            size = _EXCEPTION_FRAME  # known immediately: no wait for the length of a normal reply (case MB-021)
        else:
            length = request.reply_length(bytes(buffer[1:]))
            if length == NEED_MORE:
                return None
            size = 1 + length + 2
        if len(buffer) < size:
            return None
        frame = bytes(buffer[:size])
        if crc16(frame) != 0:
            self._refuse_other_frame(request)
            self._end(size)
            raise CrcError(
                "the check sum of a reply is wrong",
                expected=crc16(frame[:-2]).to_bytes(2, "little").hex(" "),
                got=short_hex(frame, 32),
            )
        self._end(size)
        return frame[1:-2]

    def _step_over(self, request: Request[Any], settled: bool) -> bool:
        """Drop a foreign frame or a byte of noise from the front of the buffer; return False if more bytes are needed to decide.

        `settled` says that the line was silent for `gap_ns`, so that no more bytes are awaited.
        """
        buffer = self._buffer
        if len(buffer) >= 2:
            lengths, more = self._candidates(request)
            size = self._whole_frame(lengths)
            if size:
                if buffer[0] == self._unit:
                    self._refuse_other_frame(request)
                self._drop_foreign(size)
                return True
            possible = 1 <= buffer[0] <= _LAST_UNIT and (more or any(n > len(buffer) for n in lengths))
        else:
            possible = buffer[0] not in _IDLE_NOISE
        if possible and not settled:
            return False
        if len(buffer) >= 2 and (buffer[0], buffer[1]) == (self._unit, request.function):
            self._wrong_header = short_hex(buffer)
        if buffer[0] not in _IDLE_NOISE:
            self._garbage += 1
        self._hunted += 1
        self._skip(1)
        return True

    def _candidates(self, request: Request[Any]) -> tuple[list[int], bool]:
        """Return the possible lengths of the frame at the front of the buffer, and whether more bytes could add one.

        The lengths include that of the awaited reply if unit ID and function are as requested.
        """
        lengths, more = frame_lengths(self._buffer)
        nominal = request.nominal_length()
        if nominal and (self._buffer[0], self._buffer[1]) == (self._unit, request.function):
            lengths = sorted({*lengths, 1 + nominal + 2})
        return lengths, more

    def _whole_frame(self, lengths: list[int]) -> int:
        """Return the first of `lengths` for which the buffer starts with a frame of that length and a right check sum, else 0."""
        for size in lengths:
            if MIN_FRAME <= size <= min(len(self._buffer), MAX_FRAME) and crc16(self._buffer[:size]) == 0:
                return size
        return 0

    def _refuse_other_frame(self, request: Request[Any]) -> None:
        """Raise `Desync` if the buffer starts with a whole frame of the requested unit that is not the awaited reply."""
        size = self._whole_frame(self._candidates(request)[0])
        if not size:
            return
        frame = bytes(self._buffer[:size])
        expected = self._expectation()
        self._end(size)
        hint = "the line echoes sent bytes: set `echo: true` for its bus, or --echo" if frame == self._sent else ""
        other = "a reply to a different request"
        if frame[1] == request.function and (carried := counted_bytes(frame[1:-2])):
            raise WrongSize(other, expected=expected, got=short_hex(frame), hint=hint, got_bytes=carried)
        raise Desync(other, expected=expected, got=short_hex(frame), hint=hint)

    def _strip_echo(self) -> bool:
        """Remove the echo of the request from the front of the buffer; return False while it is incomplete. Raises `Desync`."""
        while self._buffer and self._buffer[0] in _IDLE_NOISE and not self._sent.startswith(self._buffer[:1]):
            self._skip(1)
        size = min(len(self._buffer), len(self._sent))
        if self._buffer[:size] != self._sent[:size]:
            got = short_hex(self._buffer)
            self._end(len(self._buffer))
            raise Desync(
                "the echo differs from what was sent", expected=short_hex(self._sent), got=got, hint="a collision"
            )
        if size < len(self._sent):
            return False
        del self._buffer[:size]
        self._echo_due = False
        return True

    # -- silences, counting ---------------------------------------------------------------------------------------

    def _apply_silences(self, data: bytes, now_ns: int) -> None:
        gap_ns = max(0, now_ns - self._last_ns - len(data) * self._char_ns)
        if self._buffer and gap_ns > self.t15_ns:
            self._seen = f"a pause of {gap_ns / 1e6:.3g} ms inside a frame"
            self._skip(len(self._buffer))
        if gap_ns >= self.t35_ns:
            self._after_foreign = False
        elif self._after_foreign:
            self._seen = "a frame too soon after another"

    def _drop_foreign(self, size: int) -> None:
        self._seen = f"a frame of unit {self._buffer[0]}"
        self._stray(self._buffer[0], self._buffer[1:size], self._last_ns)
        self.foreign_frames += 1
        self._skip(size)
        if self._strict:
            self._after_foreign = True
            self._skip(len(self._buffer))

    def _skip(self, count: int) -> None:
        self.noise_bytes += count
        del self._buffer[:count]

    def _end(self, size: int) -> None:
        """End the exchange with a frame of `size` bytes, and count and discard the bytes after it.

        These may be zeros (case MB-009) or a repeated reply (MB-014).
        """
        if self._buffer:
            del self._buffer[:size]
            rest = len(self._buffer.rstrip(b"\x00"))
            self.late_bytes += rest
            self.noise_bytes += len(self._buffer) - rest
            self._buffer.clear()
        self._request = None
        self._echo_due = False

    def _shortest_reply(self) -> int:
        nominal = self._request.nominal_length() if self._request else 0
        return 1 + nominal + 2 if nominal else _EXCEPTION_FRAME

    def _expectation(self) -> str:
        function = f"{self._request.function:02X}h" if self._request else "?"
        return f"unit {self._unit}, function {function}"
