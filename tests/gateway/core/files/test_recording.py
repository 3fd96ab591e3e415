"""Recordings: complete, truncated, broken, foreign; and the remains of a killed or failing writer."""

from __future__ import annotations

import math
import os
import resource
import signal
import subprocess
import sys
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.errors import Bug, FileInvalid
from fieldtwin.gateway.core.files.recording import (
    MAX_LINE_BYTES,
    RecordedExchange,
    RecordingHeader,
    RecordingReader,
    RecordingWriter,
    SignalInfo,
    encode_exchange,
    encode_header,
    encode_row,
    shown,
)

SIGNALS = RecordingHeader(
    version=1,
    device="fieldtwin/ctd-reference",
    kind="signals",
    source="measured",
    signals={"pressure": SignalInfo(unit="dbar"), "temperature": SignalInfo(unit="degC")},
)
EXCHANGES = RecordingHeader(
    version=1,
    device="fieldtwin/ctd-reference",
    kind="exchanges",
    source="measured",
    endpoint="rtu:/dev/ttyS0?baudrate=19200&frame=8E1",
    start_utc="2026-01-02T03:04:05Z",
    prototype=True,
)

times = st.floats(0, 1e9, allow_nan=False)
exchanges = st.builds(
    RecordedExchange, times, st.integers(0, 255), st.binary(min_size=1, max_size=253), st.binary(max_size=253), times
) | st.builds(
    lambda t, unit, request, latency, error: RecordedExchange(t, unit, request, None, latency, error),
    times,
    st.integers(0, 255),
    st.binary(min_size=1, max_size=253),
    times,
    st.sampled_from(["timeout", "crc", "desync", "lost"]),
)


def rows_of(path: Path) -> tuple[list[tuple[float, ...]], bool]:
    with RecordingReader(path) as reader:
        rows = [(row.t_s, *row.values) for row in reader.rows()]
        return rows, reader.truncated


@given(st.lists(exchanges, max_size=20))
def test_exchanges_come_back_as_they_were(
    tmp_path_factory: pytest.TempPathFactory, recorded: list[RecordedExchange]
) -> None:
    path = tmp_path_factory.mktemp("recording") / "r.jsonl"
    with RecordingWriter(path, EXCHANGES) as writer:
        for exchange in recorded:
            writer.exchange(exchange)
        assert writer.records == len(recorded)
    with RecordingReader(path) as reader:
        assert reader.header == EXCHANGES
        assert list(reader.exchanges()) == recorded
        assert not reader.truncated


@given(st.lists(st.tuples(times, st.floats(), st.floats()), max_size=20))
def test_rows_come_back_as_they_were(
    tmp_path_factory: pytest.TempPathFactory, recorded: list[tuple[float, float, float]]
) -> None:
    path = tmp_path_factory.mktemp("recording") / "r.jsonl"
    with RecordingWriter(path, SIGNALS) as writer:
        for t, *values in sorted(recorded, key=lambda row: row[0]):
            writer.row(t, values)
    rows, truncated = rows_of(path)
    assert not truncated
    for row, expected in zip(rows, sorted(recorded, key=lambda row: row[0]), strict=True):
        for value, want in zip(row, expected, strict=True):
            assert math.isnan(value) if not math.isfinite(want) else value == want


def test_lines_are_as_documented() -> None:
    exchange = RecordedExchange(1.25, 1, bytes.fromhex("0400000002"), bytes.fromhex("04044148f5c3"), 0.021)
    assert encode_exchange(exchange) == (b'{"t":1.25,"unit":1,"req":"0400000002","rep":"04044148f5c3","lat":0.021}\n')
    silent = RecordedExchange(2.0, 1, b"\x04\x00\x00\x00\x02", None, 0.3, "timeout")
    assert encode_exchange(silent) == b'{"t":2.0,"unit":1,"req":"0400000002","err":"timeout","lat":0.3}\n'
    assert encode_row(1.25, [10.31, math.nan]) == b"[1.25,10.31,null]\n"
    assert encode_header(SIGNALS).startswith(b'{"fieldtwin_recording":1,"device":"fieldtwin/ctd-reference",')


def test_every_cut_gives_the_whole_records_before_it(tmp_path: Path) -> None:
    header, rows = encode_header(SIGNALS), [encode_row(t, [t / 3, -t]) for t in (0.0, 0.5, 1.0)]
    whole = header + b"".join(rows)
    path = tmp_path / "r.jsonl"
    for size in range(len(header) - 1, len(whole) + 1):
        path.write_bytes(whole[:size])
        got, truncated = rows_of(path)
        rest = size - len(header)
        complete = sum(rest >= len(b"".join(rows[: i + 1])) - 1 for i in range(len(rows)))  # the newline may be missing
        assert len(got) == complete, size
        cut_inside = rest > len(b"".join(rows[:complete]))
        assert truncated is cut_inside, size


def test_a_tail_of_zeros_after_a_power_cut_is_a_cut(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    path.write_bytes(encode_header(SIGNALS) + encode_row(0, [1, 2]) + b"\0" * 300)
    assert rows_of(path) == ([(0.0, 1.0, 2.0)], True)


BROKEN_ROWS = {
    "half a row": b"[0.5,1.0\n",
    "a value too few": b"[0.5,1.0]\n",
    "a value too many": b"[0.5,1.0,2.0,3.0]\n",
    "no time": b"[null,1.0,2.0]\n",
    "text": b'[0.5,"1.0",2.0]\n',
    "time goes back": b"[-0.5,1.0,2.0]\n",
    "an exchange": b'{"t":0.5}\n',
    "not UTF-8": b'["\xff",1.0,2.0]\n',
    "NaN is no JSON": b"[0.5,NaN,1.0]\n",
}


@pytest.mark.parametrize("line", BROKEN_ROWS.values(), ids=BROKEN_ROWS)
def test_a_broken_row_in_the_middle_names_file_and_line(tmp_path: Path, line: bytes) -> None:
    path = tmp_path / "r.jsonl"
    path.write_bytes(encode_header(SIGNALS) + encode_row(0, [1, 2]) + line + encode_row(1, [1, 2]))
    with pytest.raises(FileInvalid) as caught:
        rows_of(path)
    assert (caught.value.path, caught.value.line) == (str(path), 3)


BROKEN_EXCHANGES = {
    "neither reply nor error": b'{"t":0.5,"unit":1,"req":"03"}\n',
    "both": b'{"t":0.5,"unit":1,"req":"03","rep":"03","err":"timeout"}\n',
    "odd hex": b'{"t":0.5,"unit":1,"req":"030","rep":"03"}\n',
    "no request": b'{"t":0.5,"unit":1,"req":"","rep":"03"}\n',
    "unit": b'{"t":0.5,"unit":256,"req":"03","rep":"03"}\n',
    "unknown error": b'{"t":0.5,"unit":1,"req":"03","err":"tiemout"}\n',
    "unknown key": b'{"t":0.5,"unit":1,"req":"03","rep":"03","latency":1}\n',
    "negative latency": b'{"t":0.5,"unit":1,"req":"03","rep":"03","lat":-1}\n',
}


@pytest.mark.parametrize("line", BROKEN_EXCHANGES.values(), ids=BROKEN_EXCHANGES)
def test_a_broken_exchange_names_file_and_line(tmp_path: Path, line: bytes) -> None:
    path = tmp_path / "r.jsonl"
    path.write_bytes(encode_header(EXCHANGES) + line)
    with RecordingReader(path) as reader, pytest.raises(FileInvalid) as caught:
        list(reader.exchanges())
    assert caught.value.line == 2


HEADERS = {
    "empty": (b"", "empty"),
    "cut off": (encode_header(SIGNALS)[:40], "header"),
    "another file": (b"* Sea-Bird SBE 9 Data File:\n", "header"),
    "a later version": (encode_header(SIGNALS).replace(b":1,", b":2,", 1), "2"),
    "a typo": (encode_header(SIGNALS).replace(b'"kind"', b'"knid"'), "knid"),
    "no signals": (b'{"fieldtwin_recording":1,"device":"d","kind":"signals","source":"measured"}\n', "signals"),
    "too long": (b"[" * (MAX_LINE_BYTES + 1), "too long"),
}


@pytest.mark.parametrize(("text", "says"), HEADERS.values(), ids=HEADERS)
def test_a_file_that_is_not_a_recording_is_refused(tmp_path: Path, text: bytes, says: str) -> None:
    path = tmp_path / "r.jsonl"
    path.write_bytes(text)
    with pytest.raises(FileInvalid, match=says) as caught:
        RecordingReader(path)
    assert (caught.value.path, caught.value.line, caught.value.exit_code) == (str(path), 1, 3)


def test_a_missing_file_and_the_wrong_kind_are_reported_clearly(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="No such file"):
        RecordingReader(tmp_path / "nothing.jsonl")
    with RecordingWriter(tmp_path / "r.jsonl", EXCHANGES):
        pass
    with RecordingReader(tmp_path / "r.jsonl") as reader, pytest.raises(FileInvalid, match="expected signals"):
        reader.rows()


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    with RecordingWriter(path, SIGNALS) as writer:
        writer.row(0.0, [1.0, 2.0])
    before = path.read_bytes()
    with pytest.raises(FileInvalid, match="exists already"):
        RecordingWriter(path, SIGNALS)
    assert path.read_bytes() == before


def test_writing_an_unreadable_record_is_a_bug(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "r.jsonl", SIGNALS) as writer:
        with pytest.raises(Bug):
            writer.row(0.0, [1.0])
        with pytest.raises(Bug):
            writer.exchange(RecordedExchange(0.0, 1, b"\x03", b""))
    with pytest.raises(Bug):
        writer.row(0.0, [1.0, 2.0])
    with RecordingWriter(tmp_path / "e.jsonl", EXCHANGES) as writer, pytest.raises(Bug):
        writer.exchange(RecordedExchange(0.0, 1, b"\x03", None))


def test_a_full_disk_leaves_whole_records(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        with RecordingWriter(path, SIGNALS) as writer:
            resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 50, before[1]))
            writer.row(0.0, [1.0, 2.0])
            with pytest.raises(FileInvalid, match="cannot continue writing"):
                fill(writer, 1, 20)
            written = writer.records
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    rows, truncated = rows_of(path)
    assert len(rows) == written > 0
    assert not truncated


def fill(writer: RecordingWriter, start: int, stop: int) -> None:
    for t in range(start, stop):
        writer.row(float(t), [1.0, 2.0])


WRITE_FOREVER = """
import sys
from pathlib import Path
from fieldtwin.gateway.core.files.recording import RecordingHeader, RecordingWriter, SignalInfo
header = RecordingHeader(version=1, device="d", kind="signals", source="synthetic", signals={"x": SignalInfo()})
with RecordingWriter(Path(sys.argv[1]), header) as writer:
    while True:
        writer.row(float(writer.records), [0.5])
        if writer.records == 1000:
            print("going", flush=True)
"""


def test_a_killed_writer_loses_at_most_the_line_it_was_writing(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    with subprocess.Popen(
        [sys.executable, "-c", WRITE_FOREVER, str(path)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"going\n"
        process.kill()
    rows, _ = rows_of(path)
    assert len(rows) >= 1000
    assert [t for t, _ in rows] == [float(i) for i in range(len(rows))]


def test_reading_needs_memory_for_one_line_only(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    with path.open("wb") as file:
        file.write(encode_header(SIGNALS))
        for i in range(20_000):
            file.write(encode_row(i * 0.25, [i * 0.001, i * 0.002]))
    tracemalloc.start()
    try:
        with RecordingReader(path) as reader:
            assert sum(1 for _ in reader.rows()) == 20_000
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert path.stat().st_size > 400_000
    assert peak < 200_000


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ('"source":"synthetic"', "tank.jsonl (synthetic)"),
        ('"source":"measured"', "tank.jsonl (measured)"),
        ('"source":"measured","prototype":true', "tank.jsonl (measured, of an emulator)"),
    ],
)
def test_the_source_is_named(tmp_path: Path, said: str, told: str) -> None:
    path = tmp_path / "tank.jsonl"
    path.write_text(f'{{"fieldtwin_recording":1,"device":"mysite/tank","kind":"exchanges",{said}}}\n', encoding="utf-8")
    assert shown(path) == told
