"""Read tables of measurements in CSV (a time column and signals) as recordings of signals.

The first row names the columns (``pressure (dbar)``: the unit in brackets). Columns are separated by commas, semicolons or
tabs; with semicolons the numbers may have a decimal comma. Times are seconds, milliseconds or ISO 8601. The file is read line
by line; an error states its line.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.input_file import open_input
from fieldtwin.gateway.core.files.recording import RecordingHeader, RecordingWriter, SignalInfo

MAX_LINE = 65_536
MAX_COLUMNS = 1000
TIME_NAMES = ("t", "time", "timestamp", "time_s", "t_s", "seconds", "datetime", "date", "utc")
_NAME = re.compile(r"\s*(.*?)\s*(?:[\[(]\s*([^\])]*?)\s*[\])])?\s*")


@dataclass(frozen=True, slots=True)
class TableSummary:
    """The result of reading a table. `columns` maps signal to column; `bad_values` counts cells without a number."""

    rows: int
    seconds: float
    bad_values: int
    columns: dict[str, str] = field(default_factory=dict)


def import_csv(
    path: Path, out: Path, *, columns: Mapping[str, str], time: str = "", device: str = "", made_by: str = ""
) -> TableSummary:
    """Convert the table at `path` into the recording `out`.

    `columns` maps signal to column (a name, or ``#3`` for the third); without it every column is a signal. Raises
    `FileInvalid` with the line, `UsageError` for a missing column.
    """
    with _open(path) as file:
        rows = _rows(path, file)
        line, names = next(rows, (1, []))
        if not names:
            raise FileInvalid("the table is empty", path=str(path), line=line, expected="a row of column names")
        time_at = _column(names, time) if time else _time_column(names, path)
        chosen = _chosen(names, columns, time_at)
        signals = {s: SignalInfo(unit=_split(names[i])[1], column=names[i]) for s, i in chosen.items()}
        first = next(rows, None)
        if first is None:
            raise FileInvalid("the table has no rows", path=str(path), line=line + 1)
        clock = _Clock(path, names[time_at], *first, time_at)
        header = RecordingHeader(
            version=1, device=device or f"imported/{path.stem}", kind="signals", source="imported", made_by=made_by,
            start_utc=clock.start_utc, signals=signals,
        )  # fmt: skip
        if out.exists():
            raise FileInvalid("the recording exists already", path=str(out), hint="choose another name with --out")
        part = out.with_name(out.name + ".part")
        part.unlink(missing_ok=True)
        try:
            with RecordingWriter(part, header) as writer:
                last_s, bad = _copy(_chain(first, rows), clock, chosen, writer, path)
            part.rename(out)
        finally:
            part.unlink(missing_ok=True)
        return TableSummary(writer.records, last_s, bad, {s: names[i] for s, i in chosen.items()})


def _copy(
    rows: Iterator[tuple[int, list[str]]], clock: _Clock, chosen: Mapping[str, int], writer: RecordingWriter, path: Path
) -> tuple[float, int]:
    """Copy the rows; return the last time, and the number of fields without a number."""
    bad, last_s = 0, 0.0
    for number, row in rows:
        t_s = clock.seconds(number, row)
        if t_s < last_s:
            raise FileInvalid("the time decreases", path=str(path), line=number, got=f"{t_s} s after {last_s} s")
        last_s = t_s
        values = [_value(row[i]) if i < len(row) else math.nan for i in chosen.values()]
        bad += sum(map(math.isnan, values))
        writer.row(round(t_s, 6), values)
    return last_s, bad


def _open(path: Path) -> BinaryIO:
    try:
        return open_input(path)
    except OSError as e:
        raise FileInvalid(f"cannot read the table: {e.strerror or e}", path=str(path)) from e


def _rows(path: Path, file: BinaryIO) -> Iterator[tuple[int, list[str]]]:
    """Yield (line, fields) of each row that is not empty."""
    number, delimiter = 0, ""
    while line := file.readline(MAX_LINE + 1):
        number += 1
        if len(line) > MAX_LINE:
            raise FileInvalid("the line is too long", path=str(path), line=number, expected=f"{MAX_LINE} bytes")
        try:
            text = line.decode("utf-8-sig" if number == 1 else "utf-8").strip("\r\n")
            if not text.strip() or text.lstrip().startswith("#"):
                continue
            delimiter = delimiter or max(";\t,", key=text.count)
            fields = next(csv.reader([text], delimiter=delimiter, strict=True))
        except (UnicodeDecodeError, csv.Error, StopIteration) as e:
            raise FileInvalid(f"not a row of a table: {e}", path=str(path), line=number) from e
        if len(fields) > MAX_COLUMNS:
            raise FileInvalid("too many columns", path=str(path), line=number, expected=str(MAX_COLUMNS))
        yield number, fields


def _chain(first: tuple[int, list[str]], rest: Iterator[tuple[int, list[str]]]) -> Iterator[tuple[int, list[str]]]:
    yield first
    yield from rest


def _split(column: str) -> tuple[str, str]:
    """Return (name, unit) of ``pressure (dbar)``."""
    found = _NAME.fullmatch(column)
    return (found[1], found[2] or "") if found else (column, "")


def _column(names: list[str], wanted: str) -> int:
    """Return the index of a column by its name, with or without its unit, or by ``#3``."""
    if wanted.startswith("#") and wanted[1:].isdigit() and 1 <= int(wanted[1:]) <= len(names):
        return int(wanted[1:]) - 1
    for i, name in enumerate(names):
        if wanted in (name, name.strip(), _split(name)[0]):
            return i
    raise UsageError(f"no column {wanted!r}", expected=", ".join(names[:20]))


def _time_column(names: list[str], path: Path) -> int:
    for wanted in TIME_NAMES:
        for i, name in enumerate(names):
            if _split(name)[0].lower() == wanted:
                return i
    raise UsageError(f"{path.name}: the time column is not known", expected="--time COLUMN", got=", ".join(names[:20]))


def _chosen(names: list[str], columns: Mapping[str, str], time_at: int) -> dict[str, int]:
    if columns:
        return {signal: _column(names, wanted) for signal, wanted in columns.items()}
    chosen: dict[str, int] = {}
    for i, name in enumerate(names):
        if i != time_at:
            plain = re.sub(r"\W+", "_", _split(name)[0].strip().lower()).strip("_") or f"column_{i + 1}"
            chosen[plain if plain not in chosen else f"{plain}_{i + 1}"] = i
    if not chosen:
        raise UsageError("the table has no column except the time")
    return chosen


class _Clock:
    """Converts the time column, in any of its formats, to seconds since the first row."""

    def __init__(self, path: Path, name: str, line: int, row: list[str], at: int) -> None:
        self._path, self._at = path, at
        self._milli = _split(name)[1].lower() in ("ms", "msec") or name.lower().endswith("_ms")
        self.start_utc = ""
        self._dates = False
        text = row[at].strip() if at < len(row) else ""
        if math.isnan(_value(text)):
            self._dates = True
        self._zero = self._read(line, text)
        if self._dates:
            self.start_utc = datetime.fromtimestamp(self._zero, UTC).isoformat(timespec="milliseconds")

    def seconds(self, line: int, row: list[str]) -> float:
        return self._read(line, row[self._at].strip() if self._at < len(row) else "") - self._zero

    def _read(self, line: int, text: str) -> float:
        if not self._dates:
            value = _value(text)
            if math.isfinite(value):
                return value / 1000 if self._milli else value
        else:
            try:
                when = datetime.fromisoformat(text)
                return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
            except (ValueError, OverflowError):
                pass
        raise FileInvalid(
            "not a time",
            path=str(self._path),
            line=line,
            expected="seconds, or a date as 2026-01-31T12:00:00Z",
            got=text[:40],
        )


def _value(text: str) -> float:
    """Return the number in `text`, or NaN for other text.

    A comma is a decimal comma: if commas separate columns, no field contains one.
    """
    try:
        return float(text.strip().replace(",", "."))
    except ValueError:
        return math.nan
