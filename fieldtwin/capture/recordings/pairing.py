"""Combine observed requests and replies into exchanges: convert the content of a capture to the form of a recording.

A `Pairer` is fed the bytes of both directions of one connection or line, in the order of their capture, and returns
`RecordedExchange`s in the order of their requests. Bytes that form no frame, and frames without a counterpart, are given to
`on_bad` and counted; none is dropped silently. Sans-IO: it uses no files and no clocks; the caller gives the time of the
bytes. At most `MAX_OPEN` requests wait for an answer.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from fieldtwin.capture.decoding.modbus_frames import Expected, ModbusFrame, splitter
from fieldtwin.capture.decoding.modbus_pdu import parse_request
from fieldtwin.gateway.core.files.recording import ExchangeError, RecordedExchange
from fieldtwin.gateway.protocols.modbus.frames.crc import crc16
from fieldtwin.gateway.protocols.modbus.frames.shapes import MAX_FRAME, MIN_FRAME, frame_lengths

MAX_OPEN = 64
"""Maximum number of open requests on one connection; an older one counts as unanswered."""
MAX_ADU = 260
MAX_REMEMBERED = 4096
"""Maximum number of requests whose reply length is remembered."""
_LAST_UNIT = 247
_DIGITS = 6
"""Number of decimal places of times in seconds: microseconds."""


@dataclass(frozen=True, slots=True)
class Bad:
    """Bytes that do not belong to an exchange, and the reason. `sent` is true for bytes that went to the device."""

    t_ns: int
    sent: bool
    data: bytes
    why: str


@dataclass(slots=True)
class PairCounters:
    """The counts of frames. `malformed` counts runs of bytes that form no frame, `strays` frames that answer no request."""

    exchanges: int = 0
    unanswered: int = 0
    strays: int = 0
    malformed: int = 0

    def add(self, other: PairCounters) -> None:
        self.exchanges += other.exchanges
        self.unanswered += other.unanswered
        self.strays += other.strays
        self.malformed += other.malformed


OnBad = Callable[[Bad], None]


class Pairer(ABC):
    """The pairer of one connection or line. The times of exchanges are relative to `zero_ns`."""

    def __init__(self, zero_ns: int, on_bad: OnBad | None = None) -> None:
        self.counters = PairCounters()
        self._zero_ns = zero_ns
        self._on_bad = on_bad

    @abstractmethod
    def feed(self, sent: bool, data: bytes, t_ns: int) -> list[RecordedExchange]:
        """Add bytes that went to the device (`sent`) or came from it; return the exchanges that are now complete."""

    @abstractmethod
    def finish(self) -> list[RecordedExchange]:
        """End the connection; return the remaining exchanges: requests that are still open are unanswered."""

    def lost(self, sent: bool) -> None:  # noqa: B027 - only a stream can lose its place
        """Note that bytes of one direction are missing (a capture dropped packets): an open frame stays incomplete."""

    def _bad(self, t_ns: int, sent: bool, data: bytes, why: str, *, stray: bool = False) -> None:
        if stray:
            self.counters.strays += 1
        else:
            self.counters.malformed += 1
        if self._on_bad is not None:
            self._on_bad(Bad(t_ns, sent, data, why))

    def _exchange(
        self, t_ns: int, unit: int, request: bytes, reply: bytes | None, end_ns: int, error: ExchangeError | None
    ) -> RecordedExchange:
        self.counters.exchanges += 1
        self.counters.unanswered += reply is None
        latency_s = max(end_ns - t_ns, 0) / 1e9 if reply else 0.0
        t_s = max(t_ns - self._zero_ns, 0) / 1e9
        return RecordedExchange(round(t_s, _DIGITS), unit, request, reply, round(latency_s, _DIGITS), error)


class MbapPairer(Pairer):
    """The pairer for Modbus TCP: a reply belongs to the request with the same transaction ID, and replies may come in any
    order. `datagrams`: each chunk holds whole frames.
    """

    def __init__(self, zero_ns: int, on_bad: OnBad | None = None, *, datagrams: bool = False) -> None:
        super().__init__(zero_ns, on_bad)
        self._datagrams = datagrams
        self._rest = {True: b"", False: b""}
        self._open: dict[int, tuple[int, int, bytes]] = {}  # transaction id -> time, unit, request
        self._done: dict[int, RecordedExchange] = {}  # answered exchanges that wait for an older one

    def feed(self, sent: bool, data: bytes, t_ns: int) -> list[RecordedExchange]:
        rest = self._rest[sent]
        if rest:
            data = rest + data
        found: list[RecordedExchange] = []
        at, end = 0, len(data)
        while end - at >= 8:
            size = 6 + (data[at + 4] << 8 | data[at + 5])
            if data[at + 2] or data[at + 3] or not 8 <= size <= MAX_ADU:
                self._bad(t_ns, sent, data[at:], "no Modbus TCP header")
                at = end
                break
            if end - at < size:
                break
            transaction, unit, pdu = data[at] << 8 | data[at + 1], data[at + 6], data[at + 7 : at + size]
            if sent:
                self._request(transaction, unit, pdu, t_ns, found)
            else:
                self._reply(transaction, unit, pdu, t_ns, found)
            at += size
        left = data[at:] if at < end else b""
        if left and self._datagrams:
            self._bad(t_ns, sent, left, "a datagram that is cut off")
            left = b""
        self._rest[sent] = left
        return found

    def lost(self, sent: bool) -> None:
        rest, self._rest[sent] = self._rest[sent], b""
        if rest:
            self._bad(self._zero_ns, sent, rest, "a frame that is incomplete in the capture")

    def finish(self) -> list[RecordedExchange]:
        for sent, rest in self._rest.items():
            if rest:
                self._bad(self._zero_ns, sent, rest, "a frame that is cut off")
        self._rest = {True: b"", False: b""}
        found: list[RecordedExchange] = []
        while self._open:
            self._give_up(found)
        return found

    def _request(self, transaction: int, unit: int, pdu: bytes, t_ns: int, found: list[RecordedExchange]) -> None:
        while transaction in self._open or len(self._open) >= MAX_OPEN:
            self._give_up(found)  # the oldest first, which keeps the order
        self._open[transaction] = (t_ns, unit, pdu)

    def _give_up(self, found: list[RecordedExchange]) -> None:
        """Complete the oldest request, either without an answer or with an answer that was kept until all older requests were
        complete.
        """
        transaction = next(iter(self._open))
        t_ns, unit, request = self._open.pop(transaction)
        done = self._done.pop(transaction, None)
        found.append(done or self._exchange(t_ns, unit, request, None, t_ns, "timeout"))

    def _reply(self, transaction: int, unit: int, pdu: bytes, t_ns: int, found: list[RecordedExchange]) -> None:
        asked = self._open.get(transaction)
        if asked is None or transaction in self._done:
            self._bad(t_ns, False, pdu, f"has no request (transaction {transaction}, unit {unit})", stray=True)
            return
        asked_ns, asked_unit, request = asked
        fits = unit == asked_unit and (pdu[0] ^ request[0]) & 0x7F == 0
        if fits:
            exchange = self._exchange(asked_ns, unit, request, pdu, t_ns, None)
        else:
            self._bad(t_ns, False, pdu, f"of unit {unit}, answers another request", stray=True)
            exchange = self._exchange(asked_ns, asked_unit, request, None, t_ns, "desync")
        self._done[transaction] = exchange
        while self._open and (oldest := next(iter(self._open))) in self._done:
            del self._open[oldest]
            found.append(self._done.pop(oldest))


@dataclass(slots=True)
class _Asked:
    frame: ModbusFrame
    expected: Expected
    began_ns: int
    noise: ExchangeError = "timeout"


class SerialPairer(Pairer):
    """The pairer for a serial line, also one carried over TCP: there is one request at a time. `framing` is rtu or ascii.

    Both directions are known here; `HalfDuplexPairer` is for lines without known directions.
    """

    def __init__(self, framing: str, zero_ns: int, on_bad: OnBad | None = None) -> None:
        super().__init__(zero_ns, on_bad)
        self._requests, self._replies = splitter(framing), splitter(framing)
        self._rtu = framing == "rtu"
        self._reply_bytes: dict[bytes, int] = {}  # by request: saves 19 % of an import
        self._asked: _Asked | None = None

    def feed(self, sent: bool, data: bytes, t_ns: int) -> list[RecordedExchange]:
        found: list[RecordedExchange] = []
        if self._rtu and self._is_frame(sent, data):
            frame = ModbusFrame(t_ns, data[0], data[1:-2], data)
            (self._take_requests if sent else self._take_replies)([frame], found)
        elif sent:
            self._take_requests(self._requests.feed(data, t_ns), found)
        else:
            if self._requests.pending:
                self._take_requests(self._requests.flush(), found)
            self._take_replies(self._replies.feed(data, t_ns, self._expected), found)
        return found

    def finish(self) -> list[RecordedExchange]:
        found: list[RecordedExchange] = []
        self._take_requests(self._requests.flush(), found)
        self._settle(found)
        return found

    def _is_frame(self, sent: bool, data: bytes) -> bool:
        """Return whether a chunk is exactly one frame while no incomplete frame is waiting. This fast path saves 12 % of an
        import's time.
        """
        size = len(data)
        if self._requests.pending or self._replies.pending or not MIN_FRAME <= size <= MAX_FRAME or crc16(data):
            return False
        asked = self._asked
        if sent:
            return data[0] <= _LAST_UNIT and size in frame_lengths(data)[0]
        if asked is None or data[0] != asked.expected.unit:
            return False
        if data[1] == asked.expected.function:
            return size == asked.expected.pdu_bytes + 3
        return data[1] == asked.expected.function | 0x80 and size == 5

    @property
    def _expected(self) -> Expected | None:
        return self._asked.expected if self._asked else None

    def _take_requests(self, frames: list[ModbusFrame], found: list[RecordedExchange]) -> None:
        for frame in frames:
            if frame.bad or not frame.pdu:
                self._bad(frame.t_ns, True, frame.raw, frame.bad or "no frame")
                continue
            self._settle(found)
            self._ask(frame, found)

    def _ask(self, frame: ModbusFrame, found: list[RecordedExchange]) -> None:
        if frame.unit == 0:
            found.append(self._exchange(frame.t_ns, 0, frame.pdu, b"", frame.t_ns, None))
            return
        size = self._reply_bytes.get(frame.pdu)
        if size is None:
            if len(self._reply_bytes) >= MAX_REMEMBERED:
                self._reply_bytes.clear()
            size = self._reply_bytes[frame.pdu] = parse_request(frame.pdu).reply_bytes
        self._asked = _Asked(frame, Expected(frame.unit, frame.pdu[0], size), frame.t_ns)

    def _settle(self, found: list[RecordedExchange]) -> None:
        """End the exchange at the next request or at the end of the recording. The remaining bytes are either a complete
        reply or noise.
        """
        if self._replies.pending:
            self._take_replies(self._replies.flush(self._expected), found)
        if (asked := self._asked) is not None:
            self._asked = None
            found.append(self._exchange(asked.began_ns, asked.frame.unit, asked.frame.pdu, None, 0, asked.noise))

    def _take_replies(self, frames: list[ModbusFrame], found: list[RecordedExchange]) -> None:
        for frame in frames:
            asked = self._asked
            ours = asked is not None and frame.unit == asked.frame.unit and bool(frame.pdu)
            if asked is not None and ours and not frame.bad and (frame.pdu[0] ^ asked.frame.pdu[0]) & 0x7F == 0:
                self._asked = None
                found.append(self._exchange(asked.began_ns, frame.unit, asked.frame.pdu, frame.pdu, frame.t_ns, None))
                continue
            self._bad(frame.t_ns, False, frame.raw, frame.bad or "answers nothing", stray=not frame.bad)
            if asked is not None:
                asked.noise = "crc" if frame.bad else "desync"


class HalfDuplexPairer(SerialPairer):
    """Pairs requests and replies of a serial line whose recording does not say which side sent a byte. A frame that can be the
    reply to the last request is treated as that reply, and every other frame as a request.
    """

    def feed(self, sent: bool, data: bytes, t_ns: int) -> list[RecordedExchange]:
        found: list[RecordedExchange] = []
        for frame in self._replies.feed(data, t_ns):
            self._either(frame, found)
        return found

    def finish(self) -> list[RecordedExchange]:
        found: list[RecordedExchange] = []
        for frame in self._replies.flush():
            self._either(frame, found)
        self._settle(found)
        return found

    def _either(self, frame: ModbusFrame, found: list[RecordedExchange]) -> None:
        if frame.bad or self._may_answer(frame):
            self._take_replies([frame], found)
        else:
            self._take_requests([frame], found)

    def _may_answer(self, frame: ModbusFrame) -> bool:
        asked = self._asked
        if asked is None or frame.unit != asked.frame.unit or not frame.pdu:
            return False
        if frame.pdu[0] == asked.expected.function | 0x80:
            return len(frame.pdu) == 2
        if frame.pdu[0] != asked.expected.function:
            return False
        return not asked.expected.pdu_bytes or len(frame.pdu) == asked.expected.pdu_bytes


def pairer(framing: str, zero_ns: int, on_bad: OnBad | None = None) -> Pairer:
    """Return the pairer for a connection with that framing: rtu, ascii, mbap or udp."""
    if framing in ("mbap", "udp"):
        return MbapPairer(zero_ns, on_bad, datagrams=framing == "udp")
    return SerialPairer(framing, zero_ns, on_bad)
