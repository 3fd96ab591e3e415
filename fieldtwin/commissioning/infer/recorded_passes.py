"""Convert a recording of exchanges into a dump for `infer`, for any client and any order of requests.

A client polls groups of registers, each group at its own period. A round ends when a request is repeated; the newest
value of every register then makes one pass. This module sends nothing and opens no file.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from datetime import datetime

from fieldtwin.capture.decoding.exchange import TouchedSpan
from fieldtwin.capture.decoding.modbus_pdu import BIT_TABLES, parse_reply, parse_request
from fieldtwin.commissioning.dump.file import VERSION, Cell, Dump, Pass
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.recording import RecordedExchange, RecordingHeader

MOST_PASSES = 2_000
"""Maximum number of passes of a long recording, spread evenly over it."""
FEWEST_REPLIES = 3
"""Number of answers that a request needs to be used, if any request has as many. A request with fewer answers would
reduce the number of passes, because each pass needs a value of every register.
"""


def dump_of_recording(
    path: str, header: RecordingHeader, exchanges: Iterable[RecordedExchange], unit: int | None = None
) -> Dump:
    """Return the reads of one unit as passes of a dump. Only good replies to functions 01 to 04 and 17h count.

    Raises `UsageError` if the recording has several units and `unit` is not given, `FileInvalid` if it has no read of the unit.
    """
    by_unit: dict[int, list[RecordedExchange]] = {}
    for exchange in exchanges:
        if exchange.reply is not None and parse_request(exchange.request).read_span is not None:
            by_unit.setdefault(exchange.unit, []).append(exchange)
    if unit is None and len(by_unit) > 1:
        units = ", ".join(map(str, sorted(by_unit)))
        raise UsageError("the recording has several units", expected="--unit NUMBER", got=f"units {units}")
    chosen = unit if unit is not None else next(iter(by_unit), 0)
    reads = by_unit.get(chosen, [])
    passes = _thinned(_passes(reads, _start_ns(header)))
    if not passes:
        raise FileInvalid(f"the recording has no values of unit {chosen}", path=path, expected="replies to reads")
    ranges = sorted({str(cell[0]) for cell in passes[0].cells})
    described = {"fieldtwin_dump": VERSION, "protocol": "modbus", "address": chosen, "ranges": ranges}
    return Dump(path, described, passes, ended=True)


def _start_ns(header: RecordingHeader) -> int:
    return round(datetime.fromisoformat(header.start_utc).timestamp() * NS_PER_S) if header.start_utc else 0


def _passes(reads: list[RecordedExchange], start_ns: int) -> list[Pass]:
    answered = Counter(e.request for e in reads)
    often = any(count >= FEWEST_REPLIES for count in answered.values())
    requests = {request for request, count in answered.items() if not often or count >= FEWEST_REPLIES}
    newest: dict[Cell, bytes] = {}
    seen, in_round = set[bytes](), set[bytes]()
    passes: list[Pass] = []

    def end_round(t_s: float) -> None:
        if seen == requests:  # before that, some register has no value yet
            passes.append(Pass(start_ns + round(t_s * NS_PER_S), dict(newest)))
        in_round.clear()

    last_s = 0.0
    for exchange in reads:
        values = _values(exchange)
        if exchange.request not in requests or values is None:
            continue
        if exchange.request in in_round:
            end_round(last_s)
        newest.update(values)
        seen.add(exchange.request)
        in_round.add(exchange.request)
        last_s = exchange.t_s
    if in_round:
        end_round(last_s)
    return passes


def _values(exchange: RecordedExchange) -> dict[Cell, bytes] | None:
    """Return the registers or bits in a reply, with their bytes; None if it is an exception or does not fit its request."""
    asked = parse_request(exchange.request)
    span, reply = asked.read_span, exchange.reply
    if span is None or reply is None:
        return None
    answer = parse_reply(asked, exchange.request, reply)
    if answer.exception is not None or answer.problem:
        return None
    return _cells(span, answer.read)


def _cells(span: TouchedSpan, data: bytes) -> dict[Cell, bytes] | None:
    width = 1 if span.table in BIT_TABLES else 2
    if len(data) != span.count * width:
        return None
    return {(span.table, span.address + i): data[i * width : (i + 1) * width] for i in range(span.count)}


def _thinned(passes: list[Pass]) -> list[Pass]:
    step = -(-len(passes) // MOST_PASSES)
    return passes[::step] if step > 1 else passes
