"""Draft a profile of each unit of a recording: the requested registers as tags, for the user to name and interpret.

Only facts from the traffic are written: addresses, functions, limits, writes and refusals. Facts that traffic does not show
(types over several registers, scales, units) are not guessed here: `fieldtwin infer` ranks them from dumps. The module does
no I/O, and its memory is bounded.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Final

from fieldtwin.capture.decoding.exchange import TouchedSpan
from fieldtwin.capture.decoding.modbus_pdu import parse_reply, parse_request
from fieldtwin.gateway.core.files.recording import RecordedExchange

MAX_UNITS = 256
MAX_SHAPES = 10_000
"""Maximum number of different requests of one unit that are remembered; later ones are not in the draft."""
LOOKED_AT = 50
"""Maximum number of replies to one request whose values are examined."""
TABLES: Final = ("coil", "discrete", "input", "holding")
Cell = tuple[str, int]


@dataclass(slots=True)
class _Seen:
    low: int
    high: int
    changes: int = 0
    last: int = 0


@dataclass(slots=True)
class _Unit:
    functions: dict[int, int] = field(default_factory=dict)
    shapes: dict[bytes, int] = field(default_factory=dict)
    values: dict[Cell, _Seen] = field(default_factory=dict)
    written: set[Cell] = field(default_factory=set)
    refused: dict[str, int] = field(default_factory=dict)
    most_read: int = 0
    exchanges: int = 0
    unanswered: int = 0


class Drafts:
    """Collects the facts about each unit from any number of exchanges. `texts` returns the drafted profiles by unit ID."""

    def __init__(self) -> None:
        self.units: dict[int, _Unit] = {}

    def note(self, exchange: RecordedExchange) -> None:
        """Add one more exchange of the recording."""
        unit = self.units.get(exchange.unit)
        if unit is None:
            if len(self.units) >= MAX_UNITS or exchange.reply == b"":
                return
            unit = self.units[exchange.unit] = _Unit()
        unit.exchanges += 1
        reply = exchange.reply
        if not reply:
            unit.unanswered += reply is None
            return
        times = unit.shapes.get(exchange.request)
        if times is None and len(unit.shapes) >= MAX_SHAPES:
            return
        unit.shapes[exchange.request] = (times or 0) + 1
        if times is None or times < LOOKED_AT:
            self._look(unit, exchange.request, reply)

    def _look(self, unit: _Unit, request: bytes, reply: bytes) -> None:
        asked = parse_request(request)
        answer = parse_reply(asked, request, reply)
        if answer.exception is not None:
            where = f"{asked.service} {' and '.join(map(str, asked.spans))}: exception {answer.exception:02X}"
            if len(unit.refused) < 100:
                unit.refused[where] = unit.refused.get(where, 0) + 1
            if answer.exception == 1:
                return
        if answer.exception is None and not answer.problem:
            unit.functions[asked.function] = unit.functions.get(asked.function, 0) + 1
            if asked.read_span is not None and asked.read_span.table in TABLES:
                self._values(unit, asked.read_span, answer.read)
            span = asked.write_span
            if span is not None and span.table in TABLES:
                unit.written |= {(span.table, span.address + i) for i in range(span.count)}

    @staticmethod
    def _values(unit: _Unit, span: TouchedSpan, data: bytes) -> None:
        if span.table in ("coil", "discrete"):
            words: tuple[int, ...] = tuple(data[: span.count])
        else:
            unit.most_read = max(unit.most_read, span.count)
            words = struct.unpack(f">{len(data) // 2}H", data[: len(data) // 2 * 2])
        for i, word in enumerate(words):
            seen = unit.values.get((span.table, span.address + i))
            if seen is None:
                unit.values[span.table, span.address + i] = _Seen(word, word, 0, word)
                continue
            seen.low, seen.high = min(seen.low, word), max(seen.high, word)
            seen.changes += word != seen.last
            seen.last = word

    def texts(self, name: str, origin: str) -> dict[int, str]:
        """Return the YAML of a profile for each unit that answered a read or a write.

        `name` becomes part of the device's name.
        """
        made = {unit_id: _text(unit, unit_id, name, origin) for unit_id, unit in sorted(self.units.items())}
        return {unit_id: text for unit_id, text in made.items() if text}


def _text(unit: _Unit, unit_id: int, name: str, origin: str) -> str:
    cells = sorted({*unit.values, *unit.written}, key=lambda c: (TABLES.index(c[0]), c[1]))
    if not cells:
        return ""
    plain = "".join(c if c.isalnum() or c == "-" else "-" for c in name.lower()).strip("-") or "device"
    functions = ", ".join(map(str, sorted(unit.functions)))
    lines = [
        "# A draft, made from traffic: add names, types over several registers, scales and units.",
        f"# {unit.exchanges} exchanges, {unit.unanswered} without an answer.",
        f"device: draft/{plain}-unit-{unit_id}",
        f'source: "traffic: {origin}"'.replace("\\", "/"),
        "protocol: modbus",
        f"factory: {{unit: {unit_id}}}" if 1 <= unit_id <= 247 else "# unit id on the wire: " + str(unit_id),
        f"limits: {{functions: [{functions}], read_registers: {min(unit.most_read, 125) or 125}, max_gap: 0}}",
    ]
    lines += [f"# refused {times} times: {what}" for what, times in sorted(unit.refused.items())]
    lines.append("tags:")
    for cell in cells:
        table, address = cell
        kind = ", type: bool" if table in ("coil", "discrete") else ""
        access = ""
        if cell in unit.written:
            access = ", access: rw" if cell in unit.values else ", access: wo"
        seen = unit.values.get(cell)
        lines.append(f'  {table}_{address}: {{at: "{table}:{address}"{kind}{access}}}{_comment(seen)}')
    return "\n".join(lines) + "\n"


def _comment(seen: _Seen | None) -> str:
    if seen is None:
        return "    # only written"
    if seen.low == seen.high:
        return f"    # {seen.low}"
    return f"    # {seen.low} to {seen.high}, changed {seen.changes} times"
