"""A dump on disk: JSON lines, one for each answer, so that a killed dump loses at most its last line and goes on from there.

::

    {"fieldtwin_dump": 1, "protocol": "modbus", "endpoint": ..., "address": 1, "ranges": ["holding:0..999"], ...}
    {"pass": 0, "at": "2026-11-21T10:00:00.000+00:00"}
    {"read": "holding:0..124", "hex": "...", "us": 3120}        answered after 3120 us
    {"read": "holding:125..249", "code": 2, "us": 1800}         refused; an SDO abort has its code here too
    {"read": "holding:125", "silent": "..."}                    no good reply
    {"map": "holding", "readable": ["holding:0..124"], "holes": [], "voids": [...], "max_read": 125, ...}
    {"function": 17, "hex": "..."}                              likewise `code`, `silent`
    {"latency": {"03": {...}}}
    {"ended": "2026-11-21T10:00:09.000+00:00", "requests": 131}

It must never know a wire.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fieldtwin.commissioning.dump_objects import ObjectKey
from fieldtwin.commissioning.dump_sweep import Outcome, Refused, Silent, Taken
from gateway.core.clock import NS_PER_S
from gateway.core.errors import FileInvalid
from gateway.core.profile import RegisterRange, gap_text, resolve_gap

VERSION = 1
MOST_LINE_BYTES = 1 << 20
MOST_CELLS = 50_000_000
"""Cells of all passes together: what a computer holds. A file with more is refused, not loaded."""

Cell = tuple[str, int] | tuple[int, int]
"""A register (table, address) or an object (index, subindex)."""


@dataclass
class Pass:
    """The values of one time through. Registers are 2 bytes, bits one (0 or 1); objects as the node sent them."""

    utc_ns: int
    cells: dict[Cell, bytes] = field(default_factory=dict)
    refused: dict[Cell, int] = field(default_factory=dict)

    @property
    def at(self) -> datetime:
        return datetime.fromtimestamp(self.utc_ns / NS_PER_S, UTC)


@dataclass
class Dump:
    """A dump as read from its file. `lines` are all but the header; `ended` says that it is complete. `whole_bytes` is where its
    last whole line ends."""

    path: str
    header: dict[str, Any]
    passes: list[Pass] = field(default_factory=list)
    maps: dict[str, dict[str, Any]] = field(default_factory=dict)
    functions: dict[int, dict[str, Any]] = field(default_factory=dict)
    latency: dict[str, Any] = field(default_factory=dict)
    lines: list[dict[str, Any]] = field(default_factory=list)
    ended: bool = False
    whole_bytes: int = 0

    @property
    def protocol(self) -> str:
        return str(self.header["protocol"])

    def holes(self, table: str) -> list[RegisterRange]:
        """What was asked one by one and refused."""
        return [resolve_gap(text, "sent") for text in self.maps.get(table, {}).get("holes", [])]


def load_dump(path: Path, *, keep_lines: bool = False) -> Dump:
    """Read a dump. A last line that is not whole was being written when the writer died: it is left out.

    Raises `FileInvalid` with the line for anything else that is no dump.
    """
    dump: Dump | None = None
    cells = 0
    for number, end, line in _lines(path):
        try:
            if dump is None:
                dump = Dump(str(path), _header(line))
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
        raise FileInvalid("an empty file is no dump", path=str(path))
    return dump


def _lines(path: Path) -> Iterator[tuple[int, int, dict[str, Any]]]:
    """Line number, where it ends, and what it says."""
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
    if line.get("fieldtwin_dump") != VERSION:
        raise ValueError(f"expected the header of a dump, version {VERSION}")
    if line["protocol"] not in ("modbus", "canopen") or not isinstance(line["ranges"], list):
        raise ValueError("header")
    return line


def _take(dump: Dump, line: dict[str, Any]) -> int:
    """Put a line where it belongs; how many cells it brought."""
    if "pass" in line:
        at = datetime.fromisoformat(line["at"])
        dump.passes.append(Pass(round(at.timestamp() * 1000) * 1_000_000))
    elif "read" in line:
        return _take_read(dump.passes[-1], dump.protocol, line)
    elif "map" in line:
        dump.maps[str(line["map"])] = line
    elif "function" in line:
        dump.functions[int(line["function"])] = line
    elif "latency" in line:
        dump.latency = dict(line["latency"])
    elif "ended" in line:
        dump.ended = True
    elif "resumed" not in line:
        raise ValueError("what line is this?")
    return 0


def _take_read(current: Pass, protocol: str, line: dict[str, Any]) -> int:
    if protocol == "canopen":
        key = ObjectKey.parse(line["read"])
        cell: Cell = (key.index, key.subindex)
        if "hex" in line:
            current.cells[cell] = bytes.fromhex(line["hex"])
        elif "code" in line:
            current.refused[cell] = int(line["code"])
        return 1
    at = resolve_gap(line["read"], "sent")
    if "hex" not in line:
        if "code" in line and at.count == 1:
            current.refused[(at.table, at.address)] = int(line["code"])
        return 0
    raw = bytes.fromhex(line["hex"])
    width = 1 if at.table in ("coil", "discrete") else 2
    if len(raw) != at.count * width:
        raise ValueError(f"{len(raw)} bytes for {at.count} values")
    for i in range(at.count):
        current.cells[(at.table, at.address + i)] = raw[i * width : i * width + width]
    return at.count


def outcome_of(line: dict[str, Any]) -> Outcome:
    """What a recorded answer was."""
    if "hex" in line:
        return Taken(bytes.fromhex(line["hex"]))
    return Refused(int(line["code"])) if "code" in line else Silent(str(line["silent"]))


def key_of(asked: RegisterRange | ObjectKey) -> str:
    """How a read is named in the file."""
    return gap_text(asked) if isinstance(asked, RegisterRange) else str(asked)


class DumpWriter:
    """Appends lines to `path`; each is the operating system's when the call returns. `resume`: behind the last whole line.

    Raises `FileInvalid` when the file cannot be written; at most `max_bytes` are.
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
            raise FileInvalid("there is such a file already", path=str(path), hint="--resume goes on with it") from e
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
