"""Modbus ASCII (SL 2.5.2): ``:``, the frame in hexadecimal, LRC, CR LF.

A frame extends from a colon to LF, so its length is not needed to recognise it. A pause of more than a second inside
a frame also ends it (case MB-070). As in RTU, a reply does not say which request it answers. This module does no I/O.
"""

from __future__ import annotations

from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.core.errors import CrcError, Desync, ReplyTimeout, WireError
from fieldtwin.gateway.protocols.modbus.frames.framing import Framer
from fieldtwin.gateway.protocols.modbus.requests.request import MAX_PDU, Request, short_hex

CHARACTER_GAP_NS = NS_PER_S
"""The longest permitted pause between two characters of a frame (SL 2.5.2.1)."""

MAX_FRAME = 1 + 2 * (1 + MAX_PDU + 1) + 2
"""The number of characters of the longest frame (SL 2.5.2.1)."""

MOST_DAMAGED = 256
"""The number of damaged frames after which an exchange stops looking for its reply: the line carries continuous noise."""

_REST_NS = 20 * NS_PER_MS  # the delay with which a USB adapter may deliver the rest of a damaged frame
_START, _END = b":", b"\n"


def lrc(data: bytes | bytearray) -> int:
    """Return the check sum (LRC) of an ASCII frame (SL 6.2.1). With it, the bytes of the frame add up to 0 modulo 256."""
    return -sum(data) & 0xFF


class AsciiFramer(Framer):
    """ASCII framing of one serial line. `echo` says, as for `RtuFramer`, that the adapter returns the sent bytes first."""

    has_broadcast = True
    gap_ns = CHARACTER_GAP_NS
    rest_ns = _REST_NS

    def __init__(self, *, echo: bool = False) -> None:
        super().__init__()
        self._expect_echo = echo
        self._buffer = bytearray()
        self._request: Request[Any] | None = None
        self._unit = 0
        self._sent = b""
        self._echo_due = False
        self._last_ns = 0
        self._damaged = 0
        self._seen = ""
        self._late = bytearray()
        """Bytes that arrived while no reply was awaited, up to one frame."""

    def wire_length(self, pdu_length: int) -> int:
        return 1 + 2 * (1 + pdu_length + 1) + 2

    def begin(self, unit: int, request: Request[Any]) -> bytes:
        self._skip(len(self._buffer))
        self._late.clear()
        self._request = request
        self._unit = unit
        frame = bytes([unit]) + request.encode()
        self._sent = _START + (frame + bytes([lrc(frame)])).hex().upper().encode() + b"\r\n"
        self._echo_due = self._expect_echo
        self._damaged = 0
        self._seen = ""
        return self._sent

    def feed(self, data: bytes, now_ns: int) -> bytes | None:
        if self._buffer and now_ns - self._last_ns > CHARACTER_GAP_NS:
            self._give_up_frame()
        self._last_ns = now_ns
        self._buffer += data
        if self._echo_due and not self._strip_echo():
            return None
        while (request := self._request) is not None and (text := self._next_frame()) is not None:
            if self._damaged >= MOST_DAMAGED:
                self._skip(len(self._buffer))
                return None
            pdu = self._examine(text, request)
            if pdu is not None:
                return pdu
        return None

    def settle(self) -> bytes | None:
        self._give_up_frame()
        return None

    def drained(self, data: bytes) -> None:
        if self._echo_due and data.startswith(self._sent):  # the echo of a broadcast
            self._echo_due = False
            data = data[len(self._sent) :]
        self.late_bytes += len(data)
        self._late += data
        start, end = self._late.rfind(_START), self._late.rfind(_END)
        frame = _decoded(bytes(self._late[start : end + 1])) if 0 <= start < end else None
        if frame is not None:
            self._stray(frame[0], frame[1:], 0)
            self._late.clear()
        del self._late[:-MAX_FRAME]

    def overdue(self, waited_s: float) -> WireError:
        if self._damaged:
            return CrcError(
                f"{self._damaged} damaged frames arrived, but no valid one",
                expected=self._expectation(),
                hint="check baud rate, parity and wiring",
            )
        got = short_hex(self._buffer) if self._buffer else self._seen
        return ReplyTimeout(f"no reply within {waited_s:.3g} s", expected=self._expectation(), got=got)

    # -- reading from the front ----------------------------------------------------------------------------------

    def _next_frame(self) -> bytes | None:
        """Remove the next frame, from its colon to its LF, from the buffer and return it. Everything outside a frame is noise."""
        buffer = self._buffer
        start = buffer.find(_START)
        self._skip(start if start >= 0 else len(buffer))
        end = buffer.find(_END)
        # The last colon counts: a second colon means that the first frame was cut off.
        self._skip(max(0, buffer.rfind(_START, 0, end if end >= 0 else len(buffer))))
        if end < 0:
            if len(buffer) > MAX_FRAME:
                self._give_up_frame()
            return None
        end = buffer.find(_END) + 1
        text = bytes(buffer[:end])
        del buffer[:end]
        return text

    def _examine(self, text: bytes, request: Request[Any]) -> bytes | None:
        """Return the PDU of a frame with the requested unit ID and function, or None for other frames. Raises like `feed`."""
        frame = _decoded(text)
        ours = f":{self._unit:02X}{request.function:02X}".encode()
        if frame is None:
            self._damaged += 1
            self.noise_bytes += len(text)
            if text.upper().startswith((ours, f":{self._unit:02X}{request.function | 0x80:02X}".encode())):
                self._end()
                raise CrcError(
                    "a reply is damaged", expected="hexadecimal digits and a correct LRC", got=repr(text[:48])
                )
            return None
        if frame[0] != self._unit:
            self._seen = f"a frame of unit {frame[0]}"
            self.foreign_frames += 1
            self._stray(frame[0], frame[1:], self._last_ns)
            self.noise_bytes += len(text)
            return None
        self._end()
        pdu = frame[1:]
        echoed = text == self._sent and request.reply_length(pdu) != len(pdu)
        if echoed or pdu[0] & 0x7F != request.function:
            hint = "the line echoes sent bytes: set `echo: true` for its bus, or --echo" if echoed else ""
            raise Desync(
                "a reply to a different request", expected=self._expectation(), got=short_hex(frame), hint=hint
            )
        return pdu

    def _strip_echo(self) -> bool:
        """Remove the echo of the request from the buffer's start; return False while the echo is incomplete."""
        start = self._buffer.find(_START)
        self._skip(len(self._buffer) if start < 0 else start)
        size = min(len(self._buffer), len(self._sent))
        if self._buffer[:size] != self._sent[:size]:
            got = repr(bytes(self._buffer[:48]))
            self._end()
            expected = repr(self._sent[:48])
            raise Desync("the echo differs from what was sent", expected=expected, got=got, hint="a collision")
        if size < len(self._sent):
            return False
        del self._buffer[:size]
        self._echo_due = False
        return True

    # -- counting ------------------------------------------------------------------------------------------------

    def _give_up_frame(self) -> None:
        if self._buffer:
            self._seen = f"{len(self._buffer)} characters of a frame that never ended"
            self._skip(len(self._buffer))

    def _skip(self, count: int) -> None:
        self.noise_bytes += count
        del self._buffer[:count]

    def _end(self) -> None:
        """End the exchange. Bytes after its frame belong to no request."""
        self.late_bytes += len(self._buffer)
        self._buffer.clear()
        self._request = None
        self._echo_due = False

    def _expectation(self) -> str:
        function = f"{self._request.function:02X}h" if self._request else "?"
        return f"unit {self._unit}, function {function}"


def _decoded(text: bytes) -> bytes | None:
    """Return unit ID and PDU of the frame ``:...CR LF``, or None if a character is not a hexadecimal digit or the LRC
    is wrong.

    Lower-case digits are accepted because some devices send them, although SL 2.5.2 has capitals only.
    """
    digits = text[1:-2]
    if not text.endswith(b"\r\n") or len(digits) < 6 or len(digits) % 2 or not digits.isalnum():
        return None
    try:
        frame = bytes.fromhex(digits.decode("ascii"))
    except ValueError:  # includes UnicodeDecodeError
        return None
    return frame[:-1] if sum(frame) & 0xFF == 0 else None
