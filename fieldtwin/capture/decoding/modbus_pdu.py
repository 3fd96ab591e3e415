"""Decode Modbus protocol data units into words: the content of a request, and that of its reply (AP 6).

PDUs are read by position alone; a PDU that is too short is malformed and never an error. The module knows neither framings
nor device profiles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

from fieldtwin.capture.decoding.exchange import TouchedSpan
from fieldtwin.gateway.core.errors import ModbusExceptionReply
from fieldtwin.gateway.core.files.profile import Table

SERVICES = {
    0x01: "read coils", 0x02: "read discrete inputs", 0x03: "read holding registers", 0x04: "read input registers",
    0x05: "write coil", 0x06: "write register", 0x07: "read exception status", 0x08: "diagnostics",
    0x0B: "get comm event counter", 0x0C: "get comm event log", 0x0F: "write coils", 0x10: "write registers",
    0x11: "report server id", 0x14: "read file records", 0x15: "write file records", 0x16: "mask write register",
    0x17: "read/write registers", 0x18: "read FIFO queue", 0x2B: "read device identification",
}  # fmt: skip

TABLES: dict[int, Table] = {
    0x01: "coil", 0x02: "discrete", 0x03: "holding", 0x04: "input", 0x05: "coil", 0x06: "holding", 0x0F: "coil",
    0x10: "holding", 0x16: "holding", 0x18: "holding",
}  # fmt: skip
BIT_TABLES = ("coil", "discrete")
assert set(TABLES.values()) <= set(get_args(Table))


@dataclass(frozen=True, slots=True)
class DecodedRequest:
    """A request. `written` is the data to write: register bytes, or a byte (0 or 1) for each bit.

    `reply_bytes` is the length of a normal reply PDU, 0 where the reply itself states it. `echoes` is the number of
    bytes of the request that its reply repeats.
    """

    function: int
    service: str
    spans: tuple[TouchedSpan, ...] = ()
    written: bytes = b""
    reply_bytes: int = 0
    echoes: int = 0
    problem: str = ""

    @property
    def read_span(self) -> TouchedSpan | None:
        return next((s for s in self.spans if s.access == "read"), None)

    @property
    def write_span(self) -> TouchedSpan | None:
        return next((s for s in self.spans if s.access == "write"), None)


@dataclass(frozen=True, slots=True)
class DecodedReply:
    """A reply, decoded with its request. `read` is the data that was read, in the form of `DecodedRequest.written`. `detail`
    describes the rest of the reply.
    """

    read: bytes = b""
    exception: int | None = None
    problem: str = ""
    detail: str = ""


def service_of(function: int) -> str:
    """Return the standard's name of a function, or its number."""
    return SERVICES.get(function, f"function {function:02X}h")


def exception_text(code: int) -> str:
    """Return a text such as ``02 illegal data address``."""
    return f"{code:02X} {ModbusExceptionReply.NAMES.get(code, 'vendor specific')}"


def parse_request(pdu: bytes) -> DecodedRequest:
    """Decode a request PDU (function code first)."""
    function = pdu[0] if pdu else 0
    malformed = DecodedRequest(function, service_of(function), problem="malformed")
    if function in (0x01, 0x02, 0x03, 0x04) and len(pdu) == 5:
        address, count = _words(pdu[1:5])
        size = (count + 7) // 8 if function < 3 else 2 * count
        return DecodedRequest(
            function,
            service_of(function),
            (TouchedSpan("read", TABLES[function], address, count),),
            reply_bytes=2 + size,
        )
    if function in (0x05, 0x06) and len(pdu) == 5:
        written = bytes([pdu[3] != 0]) if function == 0x05 else pdu[3:5]
        return _write(function, int.from_bytes(pdu[1:3]), 1, written, 5)
    if function in (0x0F, 0x10) and len(pdu) >= 6:
        address, count = _words(pdu[1:5])
        size = (count + 7) // 8 if function == 0x0F else 2 * count
        if pdu[5] != size or len(pdu) != 6 + size:
            return malformed
        return _write(function, address, count, bits(pdu[6:], count) if function == 0x0F else pdu[6:], 5)
    if function == 0x16 and len(pdu) == 7:
        return _write(function, int.from_bytes(pdu[1:3]), 1, b"", 7)
    if function == 0x17 and len(pdu) >= 10:
        at, count, to, many = _words(pdu[1:9])
        if pdu[9] != 2 * many or len(pdu) != 10 + 2 * many:
            return malformed
        spans = (TouchedSpan("read", "holding", at, count), TouchedSpan("write", "holding", to, many))
        return DecodedRequest(function, service_of(function), spans, pdu[10:], 2 + 2 * count)
    return malformed if (function in TABLES and function != 0x18) or function == 0x17 else _other(function, pdu)


def _write(function: int, address: int, count: int, written: bytes, echoes: int) -> DecodedRequest:
    span = TouchedSpan("write", TABLES[function], address, count)
    return DecodedRequest(function, service_of(function), (span,), written, echoes, echoes)


def _other(function: int, pdu: bytes) -> DecodedRequest:
    """Decode a request that addresses no register by number, or whose function is not in the standard."""
    spans: tuple[TouchedSpan, ...] = ()
    if function == 0x18 and len(pdu) == 3:
        spans = (TouchedSpan("read", "holding", int.from_bytes(pdu[1:3])),)
    if function in (0x14, 0x15):
        spans = tuple(_file_spans(pdu))
    fixed = {0x07: 2, 0x08: len(pdu), 0x0B: 5, 0x15: len(pdu)}
    service = service_of(function)
    if function == 0x08 and len(pdu) >= 3:
        service = f"diagnostics {int.from_bytes(pdu[1:3]):02X}"
    return DecodedRequest(function, service, spans, reply_bytes=fixed.get(function, 0))


def _file_spans(pdu: bytes) -> list[TouchedSpan]:
    """Return the records of functions 14h and 15h, each given by reference type, file, record and length (AP 6.14, 6.15)."""
    spans, at = [], 2
    while at + 7 <= len(pdu):
        file, record, count = _words(pdu[at + 1 : at + 7])
        access = "read" if pdu[0] == 0x14 else "write"
        spans.append(TouchedSpan("read" if access == "read" else "write", "file", record, count, file))
        at += 7 + (2 * count if access == "write" else 0)
    return spans


def parse_reply(asked: DecodedRequest, request: bytes, pdu: bytes) -> DecodedReply:
    """Decode the reply PDU `pdu` to a request. A reply with a different function code or an unexpected size is malformed."""
    if len(pdu) == 2 and pdu[0] == asked.function | 0x80:
        return DecodedReply(exception=pdu[1], problem="exception", detail=f"exception {exception_text(pdu[1])}")
    if not pdu or pdu[0] != asked.function or (asked.reply_bytes and len(pdu) != asked.reply_bytes):
        return DecodedReply(problem="malformed", detail=f"{len(pdu)} bytes that do not answer the request")
    if asked.echoes:
        if pdu == request[: asked.echoes]:
            return DecodedReply(detail="done")
        return DecodedReply(problem="malformed", detail=f"does not acknowledge the request: {pdu[1:].hex(' ')}")
    span = asked.read_span
    if span is None or asked.function in (0x14, 0x18):
        return DecodedReply(detail=pdu[1:].hex(" "))
    if pdu[1] != asked.reply_bytes - 2:
        return DecodedReply(problem="malformed", detail=f"a byte count of {pdu[1]}")
    return DecodedReply(read=bits(pdu[2:], span.count) if span.table in BIT_TABLES else pdu[2:])


def words(span: TouchedSpan, data: bytes) -> tuple[int, ...]:
    """Return the data of `DecodedRequest.written` or `DecodedReply.read` as numbers: register values, or 0 and 1 for bits."""
    return tuple(data) if span.table in BIT_TABLES else _words(data)


def bits(data: bytes, count: int) -> bytes:
    """Return one byte (0 or 1) for each bit: the lowest bit of the first byte is the first (AP 6.1)."""
    return bytes(data[i >> 3] >> (i & 7) & 1 for i in range(min(count, 8 * len(data))))


def _words(data: bytes) -> tuple[int, ...]:
    return tuple(int.from_bytes(data[i : i + 2]) for i in range(0, len(data) - 1, 2))
