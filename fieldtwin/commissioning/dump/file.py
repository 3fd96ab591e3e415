"""A dump on disk: JSON lines, one for each answer. If the writer is killed, at most the last line is lost, and the dump can
be continued.

::

    {"fieldtwin_dump": 2, "protocol": "modbus", "endpoint": ..., "address": 1, "ranges": ["holding:0..999"], ...}
    {"pass": 0, "at": "2026-11-21T10:00:00.000+00:00"}
    {"read": "holding:0..124", "hex": "...", "us": 3120}        answered after 3120 us
    {"read": "holding:125..249", "code": 2, "us": 1800}         refused; an SDO abort has its code here too
    {"read": "holding:125", "silent": "...", "us": 3000000}     no reply
    {"read": "holding:126", "invalid": "...", "us": 9000}       the received bytes are not a valid reply; `values` as in `Invalid`
    {"map": "holding", "readable": ["holding:0..124"], "refused": [], "silent": [...], "not_asked": [...], "max_read": 125, ...}
    {"function": 17, "hex": "..."}                              likewise `code`, `silent`, `invalid`
    {"latency": {"03": {...}}}
    {"ended": "2026-11-21T10:00:09.000+00:00", "requests": 131}

Version 1 had no `invalid` (it was among `silent`), and its `map` lines called silence a hole. It is still read; the states of
addresses then come from its `read` lines.

This module must not depend on a connection.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fieldtwin.commissioning.dump.coverage import (
    ADDRESSES,
    INVALID,
    NOT_ASKED,
    READABLE,
    REFUSED,
    SILENT,
    STATE_KEYS,
    Coverage,
    describe,
    joined,
)
from fieldtwin.commissioning.dump.objects import ObjectKey
from fieldtwin.commissioning.dump.sweep import Invalid, Outcome, RefusedRead, Silent, Taken
from fieldtwin.gateway.core.clock import NS_PER_S, NS_PER_US
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile import RegisterRange, Table, gap_text, resolve_gap
from fieldtwin.gateway.core.histogram import Histogram

VERSION = 2
READABLE_VERSIONS = (1, 2)
TABLES: tuple[Table, ...] = ("holding", "input", "coil", "discrete")
MOST_LINE_BYTES = 1 << 20
MOST_CELLS = 50_000_000
"""Maximum number of registers, bits and objects in all passes together, limited by memory. A larger file is refused."""

LATENCY_LIMITS_NS = tuple(round(10 * 10 ** (step / 10)) * NS_PER_US for step in range(71))
"""The limits of a dump's histograms of response times: ten per decade, from 10 us to 100 s."""

Cell = tuple[str, int] | tuple[int, int]
"""A register (table, address) or an object (index, subindex)."""


@dataclass
class Pass:
    """The values of one pass. Registers are 2 bytes, bits one byte (0 or 1); objects are as the node sent them.

    `refused` holds exception or abort codes; `silent` and `invalid` hold the reasons for addresses without a reply and with an
    invalid reply. For registers these three hold only addresses that were read one by one. `failed` counts the reads of any
    length without values.
    """

    utc_ns: int
    cells: dict[Cell, bytes] = field(default_factory=dict)
    refused: dict[Cell, int] = field(default_factory=dict)
    silent: dict[Cell, str] = field(default_factory=dict)
    invalid: dict[Cell, str] = field(default_factory=dict)
    failed: int = 0

    @property
    def at(self) -> datetime:
        return datetime.fromtimestamp(self.utc_ns / NS_PER_S, UTC)


@dataclass
class Dump:
    """A dump as read from its file.

    `lines` are all lines except the header; `ended` means that the dump is complete. `whole_bytes` is the offset in the file
    after the last complete line.
    """

    path: str
    header: dict[str, Any]
    passes: list[Pass] = field(default_factory=list)
    maps: dict[str, dict[str, Any]] = field(default_factory=dict)
    functions: dict[int, dict[str, Any]] = field(default_factory=dict)
    latency: dict[str, Any] = field(default_factory=dict)
    lines: list[dict[str, Any]] = field(default_factory=list)
    ended: bool = False
    whole_bytes: int = 0
    coverage: dict[str, Coverage] = field(default_factory=dict)
    """The states of the addresses of each table, by the first pass."""
    asked: dict[str, list[tuple[int, int]]] = field(default_factory=dict)

    @property
    def protocol(self) -> str:
        return str(self.header["protocol"])

    @property
    def names_ranges(self) -> bool:
        """Return whether the dump covers address ranges, and not the tags of a profile."""
        return bool(self.header["ranges"]) or not self.header.get("profile")

    def scope(self, table: str) -> list[tuple[int, int]]:
        """Return the addresses of a table in the scope of the dump; with a profile, those of its tags."""
        if not self.names_ranges:
            return joined(self.asked.get(table, []))
        spans = [resolve_gap(text, "sent") for text in self.header["ranges"]]
        return joined([(s.address, s.end) for s in spans if s.table == table]) if spans else [(0, ADDRESSES)]

    def holes(self, table: str) -> list[RegisterRange]:
        """Return the ranges in which the device refused every address."""
        return [resolve_gap(text, "sent") for text in self.maps.get(table, {}).get("refused", [])]

    @property
    def unknown(self) -> tuple[int, int]:
        """Return the number of unknown addresses or objects, and the number of all in the scope of the dump."""
        counts = [line["counts"] for line in self.maps.values() if "counts" in line]
        return sum(c["unknown"] for c in counts), sum(n for c in counts for key, n in c.items() if key != "unknown")

    @property
    def not_asked(self) -> int:
        """Return the number of addresses that no request contained, including those between samples."""
        return sum(line["counts"].get(STATE_KEYS[NOT_ASKED], 0) for line in self.maps.values() if "counts" in line)

    @property
    def is_mostly_unknown(self) -> bool:
        """Return whether the device gave no definite answer for more than half of the dump's scope."""
        unknown, asked_for = self.unknown
        return 2 * unknown > asked_for

    def state_of(self, cell: Cell) -> int:
        """Return the state of a register or an object in the first pass, one of the states in `coverage`."""
        if isinstance(cell[0], str):
            known = self.coverage.get(cell[0])
            return known.states[cell[1]] if known is not None else NOT_ASKED
        first = self.passes[0] if self.passes else Pass(0)
        for state, cells in ((READABLE, first.cells), (REFUSED, first.refused), (SILENT, first.silent)):
            if cell in cells:
                return state
        return INVALID if cell in first.invalid else NOT_ASKED


def load_dump(path: Path, *, keep_lines: bool = False) -> Dump:
    """Read a dump. An incomplete last line was left by a writer that was killed, and is skipped.

    Raises `FileInvalid` with the line number for any other line that is not part of a dump.
    """
    dump: Dump | None = None
    cells = 0
    for number, end, line in _lines(path):
        try:
            if dump is None:
                dump = Dump(str(path), _header(line))
                if dump.protocol == "modbus":
                    dump.scope("holding")  # raises if a range is malformed
            else:
                cells += _take(dump, line)
                if keep_lines:
                    dump.lines.append(line)
        except (KeyError, ValueError, TypeError, IndexError, AttributeError, OverflowError) as e:
            raise FileInvalid("not a line of a dump", path=str(path), line=number, got=str(e)[:80]) from e
        if cells > MOST_CELLS:
            raise FileInvalid("more values than can be held", path=str(path), line=number, expected=f"{MOST_CELLS}")
        dump.whole_bytes = end
    if dump is None:
        raise FileInvalid("an empty file is not a dump", path=str(path))
    if dump.protocol == "modbus":
        for table in TABLES:
            if table in dump.maps or table in dump.coverage:
                dump.maps[table] = map_line(dump, table, dump.maps.get(table, {"map": table}))
    return dump


def map_line(dump: Dump, table: Table, found: dict[str, Any]) -> dict[str, Any]:
    """Return `found`, the line of a dump file about the limits of a table, extended by the state of each address that the
    reads of `dump` show.
    """
    states = describe(
        table,
        dump.coverage.get(table) or Coverage(),
        dump.scope(table),
        function_refused=bool(found.get("function_refused")),
    )
    defaults = {"borders": [], "max_read": 0, "limit_proved": False, "pairs": False, "codes": {}, "lengths": []}
    kept = {key: value for key, value in found.items() if key not in ("holes", "voids", "given_up")}
    return defaults | {"stopped": found.get("given_up", "")} | kept | states


def describe_latency(times: Histogram) -> dict[str, Any]:
    """Return the response times of one function; `buckets` are pairs of upper limit in us (None: longer) and count, without
    empty ones.
    """
    limits_us = [*(ns // NS_PER_US for ns in times.limits_ns), None]
    return {
        "count": times.count,
        "least_us": times.min_ns // NS_PER_US,
        "p50_us": times.percentile_ns(50) // NS_PER_US,
        "p95_us": times.percentile_ns(95) // NS_PER_US,
        "most_us": times.max_ns // NS_PER_US,
        "buckets": [(limit, count) for limit, count in zip(limits_us, times.counts, strict=True) if count],
    }


def _lines(path: Path) -> Iterator[tuple[int, int, dict[str, Any]]]:
    """Yield the line number, the offset of the line's end, and the content of each complete line."""
    try:
        with path.open("rb") as file:
            end = 0
            for number in range(1, 1 << 40):
                raw = file.readline(MOST_LINE_BYTES)
                if not raw or not raw.endswith(b"\n"):
                    if len(raw) >= MOST_LINE_BYTES:
                        raise FileInvalid("a line without end", path=str(path), line=number)
                    return
                try:
                    line = json.loads(raw)
                except (ValueError, RecursionError) as e:
                    raise FileInvalid("not JSON", path=str(path), line=number, got=str(raw[:40])) from e
                if not isinstance(line, dict):
                    raise FileInvalid("not a line of a dump", path=str(path), line=number)
                end += len(raw)
                yield number, end, line
    except OSError as e:
        raise FileInvalid(f"cannot be read: {e.strerror or e}", path=str(path)) from e


def _header(line: dict[str, Any]) -> dict[str, Any]:
    if line.get("fieldtwin_dump") not in READABLE_VERSIONS:
        raise ValueError(f"expected the header of a dump, version {VERSION}")
    if line["protocol"] not in ("modbus", "canopen") or not isinstance(line["ranges"], list):
        raise ValueError("header")
    return line


def _take(dump: Dump, line: dict[str, Any]) -> int:
    """Add a line of the file to the dump, and return the number of cells whose values it holds."""
    if "pass" in line:
        at = datetime.fromisoformat(line["at"])
        dump.passes.append(Pass(round(at.timestamp() * 1000) * 1_000_000))
    elif "read" in line:
        return take_read(dump, line)
    elif "map" in line:
        dump.maps[str(line["map"])] = line
    elif "function" in line:
        dump.functions[int(line["function"])] = line
    elif "latency" in line:
        dump.latency = dict(line["latency"])
    elif "ended" in line:
        dump.ended = True
    elif "resumed" not in line:
        raise ValueError("unknown kind of line")
    return 0


def take_read(dump: Dump, line: dict[str, Any]) -> int:
    """Add an answer to the last pass, and also to the coverage if it is the first pass. Return the number of values in the
    answer.
    """
    current, outcome = dump.passes[-1], outcome_of(line)
    if dump.protocol == "canopen":
        key = ObjectKey.parse(line["read"])
        _take_outcome(current, (key.index, key.subindex), outcome)
        return 1
    at = resolve_gap(line["read"], "sent")
    if len(dump.passes) == 1:
        known = dump.coverage.setdefault(at.table, Coverage() if dump.names_ranges else Coverage(ADDRESSES))
        known.note(at, STATE_OF[type(outcome)])
        dump.asked.setdefault(at.table, []).append((at.address, at.end))
    if not isinstance(outcome, Taken):
        current.failed += 1
        if at.count == 1:
            _take_outcome(current, (at.table, at.address), outcome)
        return 0
    width = 1 if at.table in ("coil", "discrete") else 2
    if len(outcome.raw) != at.count * width:
        raise ValueError(f"{len(outcome.raw)} bytes for {at.count} values")
    for i in range(at.count):
        current.cells[(at.table, at.address + i)] = outcome.raw[i * width : i * width + width]
    return at.count


def _take_outcome(current: Pass, cell: Cell, outcome: Outcome) -> None:
    if isinstance(outcome, Taken):
        current.cells[cell] = outcome.raw
    elif isinstance(outcome, RefusedRead):
        current.refused[cell] = outcome.code
    elif isinstance(outcome, Silent):
        current.silent[cell] = outcome.problem
    else:
        current.invalid[cell] = outcome.problem


STATE_OF = {Taken: READABLE, RefusedRead: REFUSED, Silent: SILENT, Invalid: INVALID}


def outcome_of(line: dict[str, Any]) -> Outcome:
    """Return the outcome that a line records."""
    us = int(line.get("us", 0))
    if "hex" in line:
        return Taken(bytes.fromhex(line["hex"]), us)
    if "code" in line:
        return RefusedRead(int(line["code"]), us)
    if "invalid" in line:
        return Invalid(str(line["invalid"]), us, int(line.get("values", 0)))
    return Silent(str(line["silent"]), us)


def key_of(asked: RegisterRange | ObjectKey) -> str:
    """Return the name of a read in the file."""
    return gap_text(asked) if isinstance(asked, RegisterRange) else str(asked)


class DumpWriter:
    """A writer that appends lines to `path`. When `write` returns, the line has been passed to the operating system.

    `resume_at`: continue at this offset, after the last complete line. It writes at most `max_bytes` bytes. Raises `FileInvalid`
    when the file cannot be written.
    """

    def __init__(self, path: Path, *, resume_at: int | None = None, max_bytes: int = 4 << 30) -> None:
        self.path = path
        self._room = max_bytes
        try:
            if resume_at is None:
                self._file = path.open("xb", buffering=0)
            else:
                os.truncate(path, resume_at)
                self._file = path.open("ab", buffering=0)
        except FileExistsError as e:
            raise FileInvalid("the file already exists", path=str(path), hint="--resume goes on with it") from e
        except OSError as e:
            raise FileInvalid(f"cannot write the dump: {e.strerror or e}", path=str(path)) from e

    def write(self, line: dict[str, Any]) -> None:
        raw = json.dumps(line, separators=(",", ":")).encode("ascii") + b"\n"
        self._room -= len(raw)
        if self._room < 0:
            raise FileInvalid("the dump has grown too large", path=str(self.path))
        try:
            self._file.write(raw)
        except OSError as e:
            raise FileInvalid(f"cannot write the dump: {e.strerror or e}", path=str(self.path)) from e

    def close(self) -> None:
        self._file.close()
