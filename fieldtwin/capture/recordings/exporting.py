"""Export recordings for other programs: tables (CSV, Parquet), candump logs, pcap, pcapng and MCAP files.

The format follows from the kind of the recording and the file's name. Records are processed one by one, so that a recording
of days needs little memory. Raises `FileInvalid` if a file cannot be written, and `UsageError` for a kind that cannot be
written in a format.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fieldtwin.capture.decoding.modbus_pdu import parse_reply, parse_request, words
from fieldtwin.capture.decoding.tags import TagMap
from fieldtwin.capture.formats.pcap import read_capture, utc_offset_ns
from fieldtwin.capture.recordings.exporting_mcap import (
    capture_mcap,
    exchanges_mcap,
    log_mcap,
    problem_of,
    signals_mcap,
)
from fieldtwin.capture.recordings.exporting_packets import (
    PCAPNG,
    capture_packets,
    exchange_packets,
    log_packets,
)
from fieldtwin.capture.recordings.rotating_file import RotatingFile, exchanges_of, header_of, parts_of
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.candump import line_of, read_log
from fieldtwin.gateway.core.files.input_file import open_input, reading
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.recording import RecordingReader, SignalRow
from fieldtwin.gateway.core.values import Scalar
from fieldtwin.installation import install_hint

BATCH = 10_000
"""Number of rows of a Parquet file that are held in memory."""
_PACKETS = (".pcap", PCAPNG)
_MCAP = ".mcap"
TARGETS = (".csv", ".parquet", ".log", *_PACKETS, _MCAP)
Cell = Scalar | None
Rows = Iterator[Sequence[Cell]]


@dataclass(frozen=True, slots=True)
class TableColumn:
    """A column of a table: its name, and the type of its values (float, int, str)."""

    name: str
    kind: type


def export(path: Path, out: Path, *, profile: DeviceProfile | None = None, framing: str = "mbap", url: str = "") -> int:
    """Write the recording, log or capture at `path` as `out`, and return the number of records. `out` must not exist.

    With `profile`, a table of exchanges has a column for each tag, and an MCAP file a topic with tags. `framing` (mbap or rtu) is
    how exchanges are framed in a pcap or pcapng file. `url` selects one endpoint of a capture that has several.
    """
    kind = out.suffix.lower()
    if kind not in TARGETS:
        raise UsageError(f"cannot export to {out.name!r}", expected=", ".join(TARGETS))
    if out.exists():
        raise FileInvalid("the file exists already", path=str(out), hint="choose another name")
    work = _work(path, kind, profile, framing, url)
    part = out.with_name(f".{out.name}.part")
    part.unlink(missing_ok=True)
    try:
        count = work(part)
        part.rename(out)
    except OSError as e:
        raise FileInvalid(f"cannot be written: {e.strerror or e}", path=str(out)) from e
    finally:
        part.unlink(missing_ok=True)
    return count


def _work(path: Path, kind: str, profile: DeviceProfile | None, framing: str, url: str) -> Callable[[Path], int]:
    first = parts_of(path)[0]
    if path.suffix.lower() in _PACKETS:
        raise UsageError(
            f"{path.name!r} has packets, not a recording", hint=f"make recordings of it: fieldtwin import {path}"
        )
    if path.suffix.lower() == _MCAP:
        raise UsageError(
            f"{path.name!r} is an MCAP file, which fieldtwin only writes",
            expected="a recording, a capture or a CAN log",
        )
    if path.suffix == ".log":
        if kind in _PACKETS:
            return log_packets(path, kind)
        if kind == _MCAP:
            return log_mcap(path)
        if kind == ".log":
            return lambda out: _write_log(((t, c, f) for p in parts_of(path) for t, c, f in read_log(p)), out)
        return lambda out: _write_table(out, kind, _FRAME_COLUMNS, _frame_rows(path))
    if _is_capture(first):
        return _capture_work(path, kind, url)
    header = header_of(path)
    if header.kind == "signals":
        if kind == _MCAP:
            return signals_mcap(path, header)
        if kind not in (".csv", ".parquet"):
            raise UsageError("signals are exported as a table", expected=".csv, .parquet or .mcap", got=kind)
        names = [TableColumn(f"{n} ({s.unit})" if s.unit else n, float) for n, s in header.signals.items()]
        return lambda out: _write_table(out, kind, [TableColumn("t_s", float), *names], _signal_rows(path))
    if kind in _PACKETS:
        return exchange_packets(path, header, kind, framing)
    if kind == _MCAP:
        return exchanges_mcap(path, header, profile)
    if kind == ".log":
        raise UsageError("Modbus exchanges cannot become a CAN log", expected=".csv, .parquet, .pcap, .pcapng or .mcap")
    if profile is not None:
        tags = [t for t in profile.tags.values() if t.readable or t.writable]
        columns = [*_EXCHANGE_COLUMNS[:4], *(TableColumn(t.name, str if t.is_text else float) for t in tags)]
        return lambda out: _write_table(out, kind, columns, _tag_rows(path, profile, [t.name for t in tags]))
    return lambda out: _write_table(out, kind, _EXCHANGE_COLUMNS, _exchange_rows(path))


# -- tables ---------------------------------------------------------------------------------------------------------------

_EXCHANGE_COLUMNS = [
    TableColumn("t_s", float), TableColumn("unit", int), TableColumn("outcome", str), TableColumn("latency_ms", float),
    TableColumn("service", str), TableColumn("table", str), TableColumn("address", int), TableColumn("count", int),
    TableColumn("values", str), TableColumn("request", str), TableColumn("reply", str),
]  # fmt: skip
_FRAME_COLUMNS = [
    TableColumn("t_s", float), TableColumn("channel", str), TableColumn("id", int), TableColumn("kind", str),
    TableColumn("dlc", int), TableColumn("data", str),
]  # fmt: skip


def _exchange_rows(path: Path) -> Rows:
    for e in exchanges_of(path):
        asked = parse_request(e.request)
        span = asked.spans[0] if asked.spans else None
        data = asked.written
        if e.reply and asked.read_span is not None:
            data = parse_reply(asked, e.request, e.reply).read or data
        text = " ".join(map(str, words(span, data))) if span is not None and data else ""
        latency_ms = round(1000 * e.latency_s, 3) if e.reply else None
        at = (span.table, span.address, span.count) if span else ("", None, None)
        reply = e.reply.hex() if e.reply is not None else ""
        yield e.t_s, e.unit, problem_of(e) or "ok", latency_ms, asked.service, *at, text, e.request.hex(), reply


def _tag_rows(path: Path, profile: DeviceProfile, names: list[str]) -> Rows:
    """Yield a row for each exchange: the tags that it carried."""
    tags = TagMap(profile)
    for e in exchanges_of(path):
        asked, found = parse_request(e.request), dict[str, Scalar | None]()
        t_ns = round(e.t_s * 1e9)
        if asked.write_span is not None and asked.written and e.reply and not e.reply[0] & 0x80:
            found |= tags.of_registers(asked.write_span, asked.written, t_ns)
        if e.reply and asked.read_span is not None and (read := parse_reply(asked, e.request, e.reply).read):
            found |= tags.of_registers(asked.read_span, read, t_ns)
        latency_ms = round(1000 * e.latency_s, 3) if e.reply else None
        yield (e.t_s, e.unit, problem_of(e) or "ok", latency_ms, *(found.get(name) for name in names))


def _signal_rows(path: Path) -> Rows:
    for part in parts_of(path):
        with RecordingReader(part) as reader:
            rows: Iterable[SignalRow] = reader.rows()
            for row in rows:
                yield (row.t_s, *(None if math.isnan(v) else v for v in row.values))


def _frame_rows(path: Path) -> Rows:
    for part in parts_of(path):
        for t_ns, channel, f in read_log(part):
            kind = "remote" if f.remote else "extended" if f.extended else "standard"
            yield t_ns / 1e9, channel, f.can_id, kind, f.dlc, f.data.hex()


_FORMULA = frozenset("=+-@\t\r\n\0")
"""Characters with which a text cell may not begin."""


def _write_table(out: Path, kind: str, columns: Sequence[TableColumn], rows: Rows) -> int:
    return _write_csv(out, columns, rows) if kind == ".csv" else _write_parquet(out, columns, rows)


def _write_csv(out: Path, columns: Sequence[TableColumn], rows: Rows) -> int:
    count = 0
    try:
        file = out.open("w", encoding="utf-8", newline="")
    except OSError as e:
        raise FileInvalid(f"cannot write the table: {e.strerror or e}", path=str(out)) from e
    with file:
        writer = csv.writer(file)
        writer.writerow(_not_a_formula(c.name) for c in columns)
        for row in rows:
            writer.writerow("" if v is None else _not_a_formula(v) if isinstance(v, str) else v for v in row)
            count += 1
    return count


def _not_a_formula(text: str) -> str:
    """Return `text` in a form that a spreadsheet displays and does not run: cells that begin with =, +, -, @ or a control
    character can be taken for formulas.
    """
    return f"'{text}" if text[:1] in _FORMULA and text else text


def _write_parquet(out: Path, columns: Sequence[TableColumn], rows: Rows) -> int:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise UsageError("Parquet needs pyarrow", hint=install_hint("parquet")) from None
    kinds: dict[type, Any] = {float: pa.float64(), int: pa.int64(), str: pa.string()}
    schema = pa.schema([(c.name, kinds[c.kind]) for c in columns])
    count, batch = 0, list[Sequence[Cell]]()
    with pq.ParquetWriter(str(out), schema) as writer:

        def flush() -> None:
            arrays = [
                pa.array([_cell(row[i], c.kind) for row in batch], type=kinds[c.kind]) for i, c in enumerate(columns)
            ]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
            batch.clear()

        for row in rows:
            batch.append(row)
            count += 1
            if len(batch) >= BATCH:
                flush()
        flush()
    return count


def _cell(value: Cell, kind: type) -> Cell:
    if value is None or (kind is not str and not isinstance(value, bool | int | float)):
        return None
    return kind(value)  # type: ignore[no-any-return]


# -- candump and captures -----------------------------------------------------------------------------------------------


def _write_log(frames: Iterable[tuple[int, str, CanFrame]], out: Path) -> int:
    with RotatingFile(out, max_bytes=1 << 50) as file:
        for t_ns, channel, frame in frames:
            file.line(t_ns / 1e9, line_of(t_ns, frame, channel))
        return file.lines


def _is_capture(path: Path) -> bool:
    with reading(path), open_input(path) as file:
        return b'"t_ns"' in file.readline(4096)


def _capture_work(path: Path, kind: str, url: str) -> Callable[[Path], int]:
    items = (c for part in parts_of(path) for c in read_capture(part))
    endpoints = list(dict.fromkeys(c.endpoint for c in items))
    chosen = [Endpoint.parse(url)] if url else endpoints
    if kind in (PCAPNG, _MCAP) and chosen:
        return capture_mcap(path, chosen) if kind == _MCAP else capture_packets(path, kind, chosen)
    if len(chosen) != 1:
        raise UsageError(
            f"{path.name} holds {len(endpoints)} endpoints",
            expected=", ".join(map(str, endpoints)),
            hint="--endpoint, or a .pcapng or .mcap file, which holds all of them",
        )
    endpoint = chosen[0]
    if kind == ".pcap":
        return capture_packets(path, kind, chosen)
    if kind != ".log" or not endpoint.is_can:
        raise UsageError(
            f"a capture of {endpoint}",
            expected=".pcap, .pcapng or .mcap; of a CAN bus .log too",
            got=kind,
            hint="import it first",
        )
    offset_ns = utc_offset_ns(parts_of(path)[0])
    seen = (c for part in parts_of(path) for c in read_capture(part) if c.endpoint == endpoint)
    frames = ((c.t_ns + offset_ns, "can0", c.item) for c in seen if isinstance(c.item, CanFrame))
    return lambda out: _write_log(frames, out)
