"""Import Sea-Bird CTD casts (.cnv, plain, .gz or .bz2) as recordings of the device `ctd`.

The format is Sea-Bird's "converted data file": header lines that begin with ``*`` (instrument) or ``#`` (processing), one
line ``*END*``, then one row per scan with columns 11 characters wide (SBE Data Processing manual, file formats and short
variable names). Text is Latin-1 in practice. Files are read row by row: memory does not grow with the file. The module does
not depend on runs, emulators or the command line.
"""

from __future__ import annotations

import math
import os
import re
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from fieldtwin.__about__ import __version__
from fieldtwin.capture.formats.packed import unpacked
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.input_file import open_input
from fieldtwin.gateway.core.files.recording import RecordingHeader, RecordingWriter, SignalInfo

DEVICE = "fieldtwin/ctd-reference"
MAX_LINE_BYTES = 65_536
MAX_HEADER_LINES = 20_000
COLUMN_WIDTH = 11
ROWS_PER_PROGRESS = 1000

PSI_IN_DBAR = 1.4503773773
"""The number of psi in one dbar (10 kPa)."""
T68_IN_T90 = 1.00024
"""The factor from ITS-90 to IPTS-68 that oceanography uses (Saunders 1990, WOCE Newsletter 10)."""

Progress = Callable[[int, int], None]
"""A function that is called with the number of bytes read and the total number. Both count bytes of the file on disk, which may
be compressed."""


UNITS = {"pressure": "dbar", "temperature": "degC", "conductivity": "S/m"}
"""The signals of the `ctd` and their units."""

COLUMNS: dict[str, dict[str, float]] = {
    "pressure": {
        **dict.fromkeys(("prDM", "prdM", "prSM", "pr50M", "pr50M1", "prM", "pr"), 1.0),
        **dict.fromkeys(("prDE", "prdE", "prSE", "pr50E", "pr50E1", "prE"), PSI_IN_DBAR),
    },
    "temperature": {
        **dict.fromkeys(("t090C", "tv290C", "tnc90C", "t4990C", "t090Cm", "t090", "t190C", "tnc290C"), 1.0),
        **dict.fromkeys(("t068C", "tv268C", "tnc68C", "t4968C", "t068", "t168C", "tnc268C"), T68_IN_T90),
    },
    "conductivity": {
        f"{name}{unit}": divisor
        for name in ("c0", "cond0", "c_", "c1", "cond1")
        for unit, divisor in (("S/m", 1.0), ("mS/cm", 10.0), ("uS/cm", 10_000.0))
    },
}
"""For each signal the columns that can provide it, the best first, and their divisor."""

TIME_COLUMNS = (
    ("timeS", 1.0),
    ("timeM", 60.0),
    ("timeH", 3600.0),
    ("timeK", 1.0),
    ("timeN", 1.0),
    ("timeQ", 1.0),
    ("timeY", 1.0),
    ("timeJV2", 86_400.0),
    ("timeJ", 86_400.0),
    ("timeSCP", 86_400.0),
)
"""The columns that can provide the time, the best first, each with the number of seconds in its unit: elapsed time, then
dates, then days of the year.
"""

_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")
_NAME = re.compile(r"name (\d+) = ([^:]*)")
_START = re.compile(r"([A-Z][a-z]{2}) (\d{1,2}) (\d{4})\s+(\d{2}:\d{2}:\d{2})(?:\s*\[(.*)\])?")


@dataclass(frozen=True, slots=True)
class ImportSummary:
    """The result of importing a cast.

    `seconds` is from the first row to the last. `columns` maps each signal, and ``time``, to its source column.
    `bad_values` counts values that were marked bad or not finite: they are "no value" in the recording.
    `rows_announced` is the number in the header, 0 without one; fewer rows than that mean a truncated file.
    """

    rows: int
    seconds: float
    columns: dict[str, str]
    bad_values: int
    rows_announced: int
    start_utc: str


@dataclass(slots=True)
class CnvHeader:
    """The fields of the header that an import needs. `lines` is the number of the line ``*END*``."""

    names: dict[int, str] = field(default_factory=dict)
    nquan: int = 0
    nvalues: int = 0
    interval_s: float = 0.0
    bad_flag: float = -9.99e-29
    start_utc: str = ""
    lines: int = 0


@dataclass(frozen=True, slots=True)
class _Plan:
    """The columns that an import reads: index and divisor for each signal; `time`: index and factor, None if the interval in
    the header gives the times.
    """

    signals: tuple[tuple[int, float], ...]
    time: tuple[int, float] | None
    used: dict[str, str]


def import_cnv(
    path: Path, out: Path, *, progress: Progress | None = None, columns: Mapping[str, str] | None = None
) -> ImportSummary:
    """Write the cast `path` as a recording `out`, which appears only when it is complete and replaces an existing file.

    `columns` picks a column by name for a signal (``{"temperature": "t190C"}``) where the file has several. Pressure is
    in dbar, temperature in degC (ITS-90), conductivity in S/m, converted where the file has other units. Time starts at
    0 with the first row. Raises `FileInvalid` with path and line.
    """
    if not out.parent.is_dir():
        raise FileInvalid("the recording's directory does not exist", path=str(out))
    part = out.with_name(f".{out.name}.{os.getpid()}.part")
    part.unlink(missing_ok=True)
    try:
        with _Lines(path, progress) as lines:
            header = read_header(lines)
            plan = _plan(header, path, columns or {})
            with RecordingWriter(part, _recording_header(path, header, plan)) as writer:
                rows, seconds, bad = _copy_rows(lines, header, plan, writer)
                writer.sync()
            _publish(part, out)
    finally:
        part.unlink(missing_ok=True)
    return ImportSummary(rows, seconds, plan.used, bad, header.nvalues, header.start_utc)


class _Lines:
    """The file's lines as text, decompressed while they are read, with the current line number."""

    def __init__(self, path: Path, progress: Progress | None) -> None:
        self.path = path
        self.number = 0
        self._progress = progress
        try:
            self._raw = open_input(path)
        except OSError as error:
            raise FileInvalid(f"cannot read the cast: {error.strerror}", path=str(path)) from error
        self._total = os.fstat(self._raw.fileno()).st_size
        self._text: BinaryIO = unpacked(self._raw, path) or self._raw

    def __enter__(self) -> _Lines:
        return self

    def __exit__(self, *_: object) -> None:
        self._text.close()
        self._raw.close()

    def __iter__(self) -> Iterator[str]:
        while line := self._next():
            self.number += 1
            if self.number % ROWS_PER_PROGRESS == 0:
                self.report()
            yield line.decode("latin-1").rstrip("\r\n")

    def report(self) -> None:
        """Report how much of the file has been read."""
        if self._progress is not None:
            self._progress(min(self._raw.tell(), self._total), self._total)

    def invalid(self, message: str, *, expected: str = "", got: str = "", line: int | None = None) -> FileInvalid:
        """Return the error for the current line."""
        at = self.number if line is None else line
        return FileInvalid(message, path=str(self.path), line=at, expected=expected, got=got)

    def _next(self) -> bytes:
        try:
            line = self._text.readline(MAX_LINE_BYTES + 1)
        except (EOFError, zlib.error, OSError) as error:  # a damaged or truncated archive, or a disk error
            raise self.invalid(f"cannot read on after this line: {error}") from error
        if len(line) > MAX_LINE_BYTES:
            raise self.invalid("the line is too long: not a .cnv file", line=self.number + 1)
        return line


def read_header(lines: _Lines) -> CnvHeader:
    """Read the header, up to and including the line ``*END*``."""
    header = CnvHeader()
    for line in lines:
        if line.startswith("*END*"):
            header.lines = lines.number
            break
        if line[:1] not in ("*", "#") or lines.number > MAX_HEADER_LINES:
            raise lines.invalid(
                "not a Sea-Bird .cnv file", expected="header lines with * or #, then *END*", got=repr(line[:40])
            )
        if line.startswith("#"):
            _read_header_line(header, line[1:].strip(), lines)
    if not header.lines:
        raise lines.invalid("the header has no end", expected="a line *END*")
    if not header.names:
        raise lines.invalid("the header has no columns", expected="# name 0 = ...")
    width = max(header.names) + 1
    header.nquan = header.nquan or width
    if header.nquan != len(header.names) or header.nquan != width:
        raise lines.invalid("the header is inconsistent", expected=f"{header.nquan} names", got=f"{len(header.names)}")
    return header


def _read_header_line(header: CnvHeader, text: str, lines: _Lines) -> None:
    """Read one ``# key = value`` line; keys that an import does not need are skipped."""
    if match := _NAME.match(text):
        header.names[int(match[1])] = match[2].strip()
        return
    key, _, value = (part.strip() for part in text.partition("="))
    try:
        if key == "nquan":
            header.nquan = int(value)
        elif key == "nvalues":
            header.nvalues = int(value)
        elif key == "bad_flag":
            header.bad_flag = float(value)
        elif key == "interval" and value.startswith("seconds:"):
            header.interval_s = float(value.partition(":")[2])
    except ValueError:
        raise lines.invalid(f"{key} is not a number", got=repr(value)) from None
    if key == "file_type" and value != "ascii":
        raise lines.invalid("only ASCII .cnv files can be read", expected="ascii", got=value)
    if key == "start_time":
        header.start_utc = _start_utc(value)


def _start_utc(text: str) -> str:
    """Return ISO 8601 if the header states UTC, else an empty string: an instrument's own clock is not reliable."""
    match = _START.match(text)
    if not match or match[1] not in _MONTHS or not re.search(r"\b(NMEA|UTC)\b", match[5] or ""):
        return ""
    return f"{match[3]}-{_MONTHS.index(match[1]) + 1:02d}-{int(match[2]):02d}T{match[4]}Z"


def _plan(header: CnvHeader, path: Path, chosen: Mapping[str, str]) -> _Plan:
    """Find the columns. Raises `FileInvalid` with the names of the required and of the existing columns."""
    there = {name: index for index, name in header.names.items()}
    used, missing = {}, []
    for signal, known in _candidates(chosen).items():
        name = next((name for name in known if name in there), None)
        if name is None:
            missing.append(f"{signal} ({' or '.join(list(known)[:3])}{', ...' if len(known) > 3 else ''})")
        else:
            used[signal] = name
    time = next(((there[name], factor) for name, factor in TIME_COLUMNS if name in there), None)
    if time is None and header.interval_s <= 0:
        missing.append("time (timeS, timeJ, or an interval in seconds in the header)")
    if missing:
        raise FileInvalid(
            "columns are missing", path=str(path), line=header.lines, expected="; ".join(missing), got=", ".join(there)
        )
    signals = tuple((there[name], COLUMNS[signal][name]) for signal, name in used.items())
    used["time"] = header.names[time[0]] if time else "interval"
    return _Plan(signals, time, used)


def _candidates(chosen: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the candidate columns for each signal; a chosen column alone."""
    for signal, name in chosen.items():
        if signal not in COLUMNS:
            raise UsageError("no such signal", expected=", ".join(COLUMNS), got=signal)
        if name not in COLUMNS[signal]:
            raise UsageError(f"no column for {signal}", expected=", ".join(COLUMNS[signal]), got=name)
    return {signal: [chosen[signal]] if signal in chosen else list(known) for signal, known in COLUMNS.items()}


def _recording_header(path: Path, header: CnvHeader, plan: _Plan) -> RecordingHeader:
    return RecordingHeader(
        version=1,
        device=DEVICE,
        kind="signals",
        source="imported",
        made_by=f"fieldtwin {__version__} import {path.name}",
        start_utc=header.start_utc,
        signals={name: SignalInfo(unit=unit, column=plan.used[name]) for name, unit in UNITS.items()},
    )


def _copy_rows(lines: _Lines, header: CnvHeader, plan: _Plan, writer: RecordingWriter) -> tuple[int, float, int]:
    """Copy all rows into the recording; return rows, seconds, bad values."""
    origin, last_t, bad = math.nan, 0.0, 0
    for line in lines:
        if not line.strip():
            continue
        cells = _cells(line, header, lines)
        t = _time(cells, header, plan, lines, writer.records)
        if writer.records == 0:
            origin = t
        t = round(t - origin, 6)
        if t < last_t:
            raise lines.invalid("the time decreases", expected=f"{last_t} s or later", got=f"{t} s")
        values = [_value(cells[index], header.bad_flag, lines) / divisor for index, divisor in plan.signals]
        bad += sum(map(math.isnan, values))
        writer.row(t, values)
        last_t = t
    lines.report()
    if not writer.records:
        raise lines.invalid("the cast has no rows")
    return writer.records, last_t, bad


def _cells(line: str, header: CnvHeader, lines: _Lines) -> list[str]:
    """Return a row's columns. If values fill the column width, no blank separates them; the row is then divided by that width."""
    cells = line.split()
    if len(cells) == header.nquan:
        return cells
    if len(line) == COLUMN_WIDTH * header.nquan:
        return [line[i : i + COLUMN_WIDTH] for i in range(0, len(line), COLUMN_WIDTH)]
    raise lines.invalid(
        "a row with a different number of columns", expected=f"{header.nquan} columns", got=f"{len(cells)}"
    )


def _time(cells: list[str], header: CnvHeader, plan: _Plan, lines: _Lines, row: int) -> float:
    if plan.time is None:
        return row * header.interval_s
    index, factor = plan.time
    t = _value(cells[index], header.bad_flag, lines)
    if math.isnan(t):
        raise lines.invalid("a row has no time", got=cells[index].strip())
    return t * factor


def _value(text: str, bad_flag: float, lines: _Lines) -> float:
    """Return a number of the file; NaN if it is marked bad."""
    try:
        value = float(text)
    except ValueError:
        raise lines.invalid("not a number", got=repr(text.strip())) from None
    if value == bad_flag or not math.isfinite(value):
        return math.nan
    return value


def _publish(part: Path, out: Path) -> None:
    try:
        part.replace(out)
    except OSError as error:
        raise FileInvalid(f"cannot write the recording: {error.strerror}", path=str(out)) from error
