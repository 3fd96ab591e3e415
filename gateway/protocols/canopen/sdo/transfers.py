"""The SDO client's transfers, expedited and segmented (CiA 301, 7.2.4.3.1 to 7.2.4.3.8 and 7.2.4.3.17).

A transfer does no I/O: `start` returns the request, `feed` takes a received frame and returns the next step,
`expire` ends the transfer when its time is over. The caller owns the bus and the clock; `late_replies`
decides which replies may belong to an *earlier* transfer. Block transfers are in `block`.

A frame is not accepted as a reply if it has fewer than 8 bytes (`tolerate_short` pads it: CO-026), a different COB-ID or a
different multiplexor (index and subindex), or if it is a remote or extended frame. Such strays are counted, do not prolong the
transfer, and end it if there are too many. Segments carry no multiplexor, so during them any protocol violation aborts the
transfer.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import Bug, Desync, FieldtwinError, ReplyTimeout, SdoAborted, UsageError
from fieldtwin.gateway.protocols.canopen import cob_id
from fieldtwin.gateway.protocols.canopen.sdo import abort_codes

MAX_BYTES = 1 << 20
"""The largest object, in bytes, that the gateway reads. This limit also ends the transfer of a node that never stops sending
segments.
"""

WHOLE_TIMEOUTS = 10
WHOLE_NS_PER_BYTE = 50_000_000
"""Limit of a whole transfer: `WHOLE_TIMEOUTS` of its timeouts, plus `WHOLE_NS_PER_BYTE` for each transferred byte. Without
this limit a node that sends one byte just before each timeout would occupy the client for days. A segment of 7 bytes
takes 26 ms at 10 kbit/s.
"""

WHOLE_S = 600.0
"""The longest whole transfer in seconds, if no other limit is stated. `MAX_BYTES` at the slowest rate above would take
14.5 hours.
"""

KNOWN_MAX_BYTES = 64
"""The limit in bytes if the caller knows the object's size: a longer reply is read up to this limit, so that the error can
report its length.
"""

MAX_STRAYS = 64
"""The number of stray frames on the SDO channel after which a transfer is given up (CO-025)."""

_DOWNLOAD_SEGMENT_REPLY, _UPLOAD_SEGMENT_REPLY = 1, 0
_UPLOAD_REPLY, _DOWNLOAD_REPLY = 2, 3

ABORT = 0x80
"""The whole first byte of an abort: its other bits are always 0 (7.2.4.3.17). 81h and above are last segments of blocks."""


@dataclass(frozen=True, slots=True)
class SendFrame:
    """The step "send this frame"; the transfer continues.

    With `more`, `SdoTransfer.more` returns another frame to send immediately.
    """

    frame: CanFrame
    more: bool = False


@dataclass(frozen=True, slots=True)
class WaitForFrame:
    """The step "wait": the frame advanced the transfer, and there is nothing to send yet."""


@dataclass(frozen=True, slots=True)
class Done:
    """The transfer succeeded. `data` is the object's value (upload) or empty (download). The caller still has to send `last`,
    unless it is None.
    """

    data: bytes
    last: CanFrame | None = None


@dataclass(frozen=True, slots=True)
class Failed:
    """The transfer failed. The caller has to send `abort` first, unless the node itself aborted."""

    error: FieldtwinError
    abort: CanFrame | None


@dataclass(frozen=True, slots=True)
class Stray:
    """The frame does not belong to this transfer."""

    why: str


Step = SendFrame | WaitForFrame | Done | Failed | Stray


class TransferTooLong(ReplyTimeout):
    """The whole transfer reached its time limit. The node does answer, so a repetition would take just as long."""


class SdoTransfer(ABC):
    """One transfer of one object with one node. After its end, every frame is a stray.

    `timeout_ns` is the timeout of each reply; it starts again with every reply that advances the transfer (CO-022). The time for
    the whole transfer is limited by `whole_ns`, and by `WHOLE_TIMEOUTS` and `WHOLE_NS_PER_BYTE`, whichever is shorter. `answered`
    says whether the node has replied to the initiate request (or aborted).
    """

    whole_ns = int(WHOLE_S * NS_PER_S)
    """The longest time for the whole transfer, in nanoseconds; if it is less than one timeout, one timeout."""

    tolerate_short = False
    """Whether a reply of fewer than 8 bytes is accepted and padded with zeros, because old PLCs omit them (CO-026)."""

    _reply: ClassVar[int]
    _segment_reply: ClassVar[int]

    def __init__(self, node: int, index: int, subindex: int, timeout_ns: int) -> None:
        if not 0 <= index <= 0xFFFF or not 0 <= subindex <= 0xFF:
            raise UsageError(
                "no such object", expected="index 0 to FFFFh, subindex 0 to FFh", got=f"{index}:{subindex}"
            )
        self.node = cob_id.check_node(node)
        self.index = index
        self.subindex = subindex
        self.timeout_ns = timeout_ns
        self.deadline_ns = 0
        self._started_ns = 0
        self.started = False
        self.answered = False
        self.over = False
        self.strays = 0
        self._toggle = 0
        self._multiplexor = index.to_bytes(2, "little") + bytes([subindex])

    @property
    def name(self) -> str:
        """Return the object's name for messages, such as ``SDO 1018h:01``."""
        return f"SDO {self.index:04X}h:{self.subindex:02X}"

    def start(self, now_ns: int) -> CanFrame:
        """Return the initiate request."""
        self.deadline_ns = now_ns + self.timeout_ns
        self._started_ns = now_ns
        self.started = True
        return self._frame(self._request())

    def feed(self, frame: CanFrame, now_ns: int) -> Step:
        """Handle a frame that arrived at `now_ns`, and return the next step."""
        if frame.can_id != cob_id.SDO_RESPONSE_BASE + self.node or frame.extended or frame.remote or frame.error:
            return self._stray("another identifier or kind of frame")
        data = frame.data.ljust(8, b"\0") if self.tolerate_short and frame.data else frame.data
        if len(data) != 8:
            return self._stray("an SDO has 8 bytes")
        if self.over:
            return self._stray("the transfer is over")
        ours = data[1:4] == self._multiplexor
        if self._is_abort(data):
            return self._aborted(data) if ours else self._stray("an abort of another object")
        if not self.answered:
            if not (ours and self._is_reply(data)):
                return self._stray("a reply to another request")
            self.answered = True
            return self._go_on(self._on_reply(data), now_ns)
        return self._go_on(self._on_next(data), now_ns)

    def more(self, now_ns: int) -> SendFrame | None:
        """Return the next frame to send without waiting for a reply, if the last `SendFrame` announced more."""
        return None

    @property
    def unmarked(self) -> bool:
        """Return whether the node may now send segments that look like replies with a multiplexor."""
        return False

    @property
    def to_abort(self) -> bool:
        """Return whether the node needs an abort if this transfer is abandoned. Without the abort, the node could take the next
        request for a segment of this transfer.
        """
        return self.answered and not self.over

    def expire(self, now_ns: int) -> SendFrame | Failed | None:
        """Return the next step, usually the end of the transfer, if the reply is overdue at `now_ns`; otherwise None."""
        if self.over or now_ns < self.deadline_ns:
            return None
        if now_ns >= self._limit_ns:
            return self._timed_out()
        return self._recover(now_ns) or self._timed_out()

    def _recover(self, now_ns: int) -> SendFrame | None:
        """Return a frame that may restart a stalled transfer, or None if there is no such frame."""
        return None

    def _timed_out(self) -> Failed:
        self.over = True
        return Failed(self._why_timed_out(), self.abort_frame(abort_codes.TIMED_OUT))

    def _why_timed_out(self) -> ReplyTimeout:
        if self.answered and self.deadline_ns >= self._limit_ns:
            took = f"{(self.deadline_ns - self._started_ns) / 1e9:g} s and {self._moved} bytes"
            return TransferTooLong(
                f"{self.name}: not complete after {took}",
                hint="the node is too slow; `sdo_transfer_ms` in the system file limits a whole transfer",
            )
        what = "between segments" if self.answered else "to the request"
        return ReplyTimeout(f"{self.name}: no reply {what} within {self.timeout_ns / 1e9:g} s")

    def abort_frame(self, code: int) -> CanFrame:
        """Return the frame by which this client aborts the transfer."""
        return self._frame(b"\x80" + self._multiplexor + code.to_bytes(4, "little"))

    @abstractmethod
    def _request(self) -> bytes: ...

    @abstractmethod
    def _on_reply(self, data: bytes) -> Step: ...

    @abstractmethod
    def _on_segment_reply(self, data: bytes) -> Step: ...

    def _is_abort(self, data: bytes) -> bool:
        return data[0] == ABORT

    def _is_reply(self, data: bytes) -> bool:
        """Return whether `data`, whose multiplexor matches, has the command specifier of the reply to the initiate request."""
        return data[0] >> 5 == self._reply

    def _on_next(self, data: bytes) -> Step:
        """Handle a frame after the reply to the initiate request."""
        specifier = data[0] >> 5
        if specifier == self._segment_reply:
            return self._on_segment_reply(data)
        marked = specifier in (_UPLOAD_REPLY, _DOWNLOAD_REPLY) and data[1:4] == self._multiplexor
        if marked or specifier in (_UPLOAD_SEGMENT_REPLY, _DOWNLOAD_SEGMENT_REPLY):
            return self._break(abort_codes.UNKNOWN_SPECIFIER, "a reply of another kind amid the segments", data)
        return self._stray("a reply to another request")

    def _patience_ns(self) -> int:
        """Return the time limit for the next frame in ns."""
        return self.timeout_ns

    @property
    def _limit_ns(self) -> int:
        """Return the time (ns) at which the whole transfer is given up."""
        slowest_ns = WHOLE_TIMEOUTS * self.timeout_ns + self._moved * WHOLE_NS_PER_BYTE
        return self._started_ns + min(max(self.whole_ns, self.timeout_ns), slowest_ns)

    @property
    @abstractmethod
    def _moved(self) -> int:
        """Return the number of bytes of the object that were transferred so far."""

    def _frame(self, data: bytes) -> CanFrame:
        return CanFrame(cob_id.SDO_REQUEST_BASE + self.node, data.ljust(8, b"\0"))

    def _go_on(self, step: Step, now_ns: int) -> Step:
        if isinstance(step, SendFrame | WaitForFrame):
            self.deadline_ns = min(now_ns + self._patience_ns(), self._limit_ns)
        elif not isinstance(step, Stray):
            self.over = True
        return step

    def _stray(self, why: str) -> Step:
        self.strays += 1
        if self.over or self.strays <= MAX_STRAYS:
            return Stray(why)
        return self._break(abort_codes.UNKNOWN_SPECIFIER, f"{self.strays} frames that are not a reply", b"")

    def _aborted(self, data: bytes) -> Failed:
        self.answered = self.over = True
        code = int.from_bytes(data[4:8], "little")
        return Failed(SdoAborted(self.index, self.subindex, code, abort_codes.meaning(code)), None)

    def _break(self, code: int, why: str, data: bytes) -> Failed:
        """Give up because the node violated the protocol; the abort frame carries the reason."""
        self.over = True
        error = Desync(f"{self.name}: {why}; {abort_codes.meaning(code)}", got=data.hex(" "))
        return Failed(error, self.abort_frame(code))

    def _toggled(self, data: bytes) -> bool:
        """Return whether the toggle bit is as expected (7.2.4.3.3, CO-001); if so, expect the inverted bit next."""
        if (data[0] >> 4) & 1 != self._toggle:
            return False
        self._toggle ^= 1
        return True


class SdoUpload(SdoTransfer):
    """An upload: the client reads an object. `length` is its size if the caller knows it.

    An expedited reply may omit the size (CO-029); without `length`, all its 4 bytes then are the value.
    """

    _reply = _UPLOAD_REPLY
    _segment_reply = _UPLOAD_SEGMENT_REPLY

    def __init__(
        self,
        node: int,
        index: int,
        subindex: int,
        timeout_ns: int,
        *,
        length: int | None = None,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        super().__init__(node, index, subindex, timeout_ns)
        self._length = length
        self._max_bytes = max_bytes if length is None else min(max_bytes, max(length, KNOWN_MAX_BYTES))
        self._indicated: int | None = None
        self._received = bytearray()

    @property
    def _moved(self) -> int:
        return len(self._received)

    def _request(self) -> bytes:
        return b"\x40" + self._multiplexor

    def _on_reply(self, data: bytes) -> Step:
        expedited, sized = data[0] & 0x02, data[0] & 0x01
        if expedited:
            length = 4 - ((data[0] >> 2) & 3) if sized else min(4, 4 if self._length is None else self._length)
            return Done(data[4 : 4 + length])
        self._indicated = int.from_bytes(data[4:8], "little") if sized else None
        if self._indicated is not None and self._indicated > self._max_bytes:
            return self._break(abort_codes.OUT_OF_MEMORY, f"{self._indicated} bytes announced", data)
        return SendFrame(self._frame(b"\x60"))

    def _on_segment_reply(self, data: bytes) -> Step:
        if not self._toggled(data):
            return self._break(abort_codes.TOGGLE_NOT_ALTERNATED, "a repeated or out-of-order segment", data)
        last = data[0] & 0x01
        segment = data[1 : 8 - ((data[0] >> 1) & 7)]
        if not segment and not last:  # the transfer would never end
            return self._break(abort_codes.UNKNOWN_SPECIFIER, "a segment without data that is not the last", data)
        self._received += segment
        total, indicated = len(self._received), self._indicated
        if total > self._max_bytes:
            return self._break(abort_codes.OUT_OF_MEMORY, f"more than {self._max_bytes} bytes", data)
        if indicated is not None and total > indicated:
            return self._break(abort_codes.LENGTH_TOO_HIGH, f"{indicated} bytes announced, {total} sent", data)
        if not last:
            return SendFrame(self._frame(bytes([0x60 | self._toggle << 4])))
        if indicated is not None and total < indicated:
            return self._break(abort_codes.LENGTH_TOO_LOW, f"{indicated} bytes announced, {total} sent", data)
        return Done(bytes(self._received))


class SdoDownload(SdoTransfer):
    """A download: the client writes an object.

    A value of 1 to 4 bytes is sent expedited. A longer value is sent in segments, and an empty value as one empty segment
    (CO-030).
    """

    _reply = _DOWNLOAD_REPLY
    _segment_reply = _DOWNLOAD_SEGMENT_REPLY

    def __init__(self, node: int, index: int, subindex: int, timeout_ns: int, data: bytes) -> None:
        super().__init__(node, index, subindex, timeout_ns)
        if len(data) > MAX_BYTES:
            raise UsageError(
                f"{self.name}: too much to write", expected=f"at most {MAX_BYTES} bytes", got=str(len(data))
            )
        self._data = bytes(data)
        self._sent = 0
        self._last_sent = False

    @property
    def _moved(self) -> int:
        return self._sent

    @property
    def _expedited(self) -> bool:
        return 1 <= len(self._data) <= 4

    def _request(self) -> bytes:
        size = len(self._data)
        if self._expedited:
            return bytes([0x23 | (4 - size) << 2]) + self._multiplexor + self._data
        return b"\x21" + self._multiplexor + size.to_bytes(4, "little")

    def _on_reply(self, data: bytes) -> Step:
        return Done(b"") if self._expedited else self._next_segment()

    def _on_segment_reply(self, data: bytes) -> Step:
        if not self._toggled(data):
            return self._break(abort_codes.TOGGLE_NOT_ALTERNATED, "a repeated or out-of-order acknowledgement", data)
        return Done(b"") if self._last_sent else self._next_segment()

    def _next_segment(self) -> Step:
        if self._last_sent:
            raise Bug("a segment after the last", where=self.name)
        segment = self._data[self._sent : self._sent + 7]
        self._sent += len(segment)
        self._last_sent = self._sent == len(self._data)
        command = self._toggle << 4 | (7 - len(segment)) << 1 | self._last_sent
        return SendFrame(self._frame(bytes([command]) + segment))
