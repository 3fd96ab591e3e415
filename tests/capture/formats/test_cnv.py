"""Sea-Bird casts: reading, conversion, refusals. All inputs except the last one are synthetic."""

from __future__ import annotations

import bz2
import gzip
import math
import os
import struct
import tracemalloc
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.capture.formats.cnv import import_cnv
from fieldtwin.emulators.signals import SignalTrack
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, UsageError
from fieldtwin.gateway.core.files.recording import RecordingReader

REAL_CAST = Path(os.environ.get("FIELDTWIN_REAL_CAST", "no-such-cast.cnv.gz"))
"""A complete cast of a real instrument, which is not part of the project: name one to test with it."""

NAMES = ("prDM: Pressure, Digiquartz [db]", "t090C: Temperature", "c0S/m: Conductivity [S/m]", "timeS: Time", "flag: 0")
ROWS = ((1.5, 20.25, 4.5, 0.0), (2.5, 19.125, 4.25, 0.5), (3.5, -9.99e-29, 4.125, 1.0))
HEADER = ("start_time = Jul 05 2012 17:39:14 [NMEA time, header]", "bad_flag = -9.990e-29", "file_type = ascii")


def cnv(
    names: Sequence[str] = NAMES, rows: Sequence[Sequence[float]] = ROWS, header: Sequence[str] = HEADER, end: str = ""
) -> bytes:
    """A .cnv file with CR LF, a Latin-1 letter, and 11 characters per column."""
    lines = ["* Sea-Bird SBE 9 Data File:", "** Ship: Polarstern, Süd", f"# nquan = {len(names)}", "# nvalues = 3"]
    lines += [f"# name {i} = {name}" for i, name in enumerate(names)]
    lines += [f"# {line}" for line in header] + ["*END*"]
    lines += ["".join(f"{value:11.6g}" for value in (*row, *[0.0] * (len(names) - len(row)))) for row in rows]
    return ("\r\n".join(lines) + "\r\n" + end).encode("latin-1")


def write(tmp_path: Path, content: bytes, name: str = "cast.cnv") -> Path:
    path = tmp_path / name
    path.write_bytes(content)
    return path


def rows_of(path: Path) -> list[tuple[float, ...]]:
    with RecordingReader(path) as reader:
        return [(row.t_s, *row.values) for row in reader.rows()]


@pytest.mark.parametrize("pack", [bytes, gzip.compress, bz2.compress], ids=["plain", "gz", "bz2"])
def test_a_cast_becomes_a_recording_of_the_ctd(tmp_path: Path, pack: type[bytes]) -> None:
    path, out = write(tmp_path, pack(cnv())), tmp_path / "out.jsonl"
    summary = import_cnv(path, out)
    assert (summary.rows, summary.seconds, summary.bad_values, summary.rows_announced) == (3, 1.0, 1, 3)
    assert summary.columns == {"pressure": "prDM", "temperature": "t090C", "conductivity": "c0S/m", "time": "timeS"}
    with RecordingReader(out) as reader:
        header = reader.header
    assert (header.device, header.kind, header.source) == ("fieldtwin/ctd-reference", "signals", "imported")
    assert header.start_utc == "2012-07-05T17:39:14Z"
    assert "cast.cnv" in header.made_by
    assert {name: (info.unit, info.column) for name, info in header.signals.items()} == {
        "pressure": ("dbar", "prDM"),
        "temperature": ("degC", "t090C"),
        "conductivity": ("S/m", "c0S/m"),
    }
    rows = rows_of(out)
    assert rows[:2] == [(0.0, 1.5, 20.25, 4.5), (0.5, 2.5, 19.125, 4.25)]
    assert rows[2][:2] == (1.0, 3.5)
    assert math.isnan(rows[2][2])


CONVERSIONS = {
    "mS/cm": (("prdM", "tv290C", "c0mS/cm", "timeS"), (1.5, 20.0, 45.123, 0.0), (1.5, 20.0, 4.5123)),
    "uS/cm": (("prSM", "tnc90C", "cond0uS/cm", "timeS"), (1.5, 20.0, 45123.0, 0.0), (1.5, 20.0, 4.5123)),
    "IPTS-68": (("pr50M", "t068C", "c0S/m", "timeS"), (1.5, 15.0, 4.5, 0.0), (1.5, 14.9964008638, 4.5)),
    "psi": (("prDE", "t090C", "c0S/m", "timeS"), (145.03773773, 15.0, 4.5, 0.0), (100.0, 15.0, 4.5)),
    "second sensors": (("prDM", "t190C", "c1S/m", "timeS"), (1.5, 15.0, 4.5, 0.0), (1.5, 15.0, 4.5)),
}


@pytest.mark.parametrize(("names", "row", "expected"), CONVERSIONS.values(), ids=CONVERSIONS)
def test_other_units_are_converted(
    tmp_path: Path, names: Sequence[str], row: Sequence[float], expected: Sequence[float]
) -> None:
    import_cnv(write(tmp_path, cnv(names, [row])), tmp_path / "out.jsonl")
    assert rows_of(tmp_path / "out.jsonl")[0][1:] == pytest.approx(expected, rel=1e-5)


TIMES = {
    "minutes": ("timeM", (2.0, 2.5), 30.0),
    "days of the year": ("timeJ", (187.0, 187.5), 43_200.0),
    "seconds since 2000": ("timeK", (394_821.0, 394_831.0), 10.0),
}


@pytest.mark.parametrize(("name", "times", "seconds"), TIMES.values(), ids=TIMES)
def test_time_comes_from_the_best_column_and_starts_at_0(
    tmp_path: Path, name: str, times: Sequence[float], seconds: float
) -> None:
    rows = [(1.0, 2.0, 3.0, t) for t in times]
    summary = import_cnv(write(tmp_path, cnv(("prDM", "t090C", "c0S/m", name), rows)), tmp_path / "out.jsonl")
    assert (summary.columns["time"], summary.seconds) == (name, seconds)
    assert [row[0] for row in rows_of(tmp_path / "out.jsonl")] == [0.0, seconds]


def test_without_a_time_column_the_interval_counts(tmp_path: Path) -> None:
    path = write(tmp_path, cnv(NAMES[:3], [row[:3] for row in ROWS], ("interval = seconds: 0.0416667",)))
    assert import_cnv(path, tmp_path / "out.jsonl").columns["time"] == "interval"
    assert [row[0] for row in rows_of(tmp_path / "out.jsonl")] == [0.0, 0.041667, 0.083333]


def test_adjacent_values_are_distinguished_by_their_width(tmp_path: Path) -> None:
    content = cnv(rows=[]) + b"   -1.50000-4765.69865  4.5000000      0.500 0.0000e+00\r\n"
    import_cnv(write(tmp_path, content), tmp_path / "out.jsonl")
    assert rows_of(tmp_path / "out.jsonl") == [(0.0, -1.5, -4765.69865, 4.5)]


def test_a_start_that_is_not_marked_utc_is_omitted(tmp_path: Path) -> None:
    header = ("start_time = Jul 05 2012 17:39:14 [Instrument's time stamp, header]",)
    assert import_cnv(write(tmp_path, cnv(header=header)), tmp_path / "out.jsonl").start_utc == ""


def test_a_column_can_be_chosen(tmp_path: Path) -> None:
    path = write(tmp_path, cnv(("prDM", "t090C", "t190C", "c0S/m", "timeS"), [(1.0, 2.0, 3.0, 4.0, 0.0)]))
    out = tmp_path / "out.jsonl"
    assert import_cnv(path, out, columns={"temperature": "t190C"}).columns["temperature"] == "t190C"
    assert rows_of(out) == [(0.0, 1.0, 3.0, 4.0)]
    with pytest.raises(UsageError, match="sal00"):
        import_cnv(path, out, columns={"temperature": "sal00"})
    with pytest.raises(UsageError, match="salinity"):
        import_cnv(path, out, columns={"salinity": "sal00"})


def test_missing_columns_are_named_with_the_existing_ones(tmp_path: Path) -> None:
    path = write(tmp_path, cnv(("depSM: Depth", "t090C: Temperature", "sal00: Salinity")))
    with pytest.raises(FileInvalid) as caught:
        import_cnv(path, tmp_path / "out.jsonl")
    text = str(caught.value)
    assert "pressure (prDM or prdM" in text
    assert "conductivity (c0S/m or c0mS/cm" in text
    assert "time (timeS" in text
    assert "temperature" not in text
    assert "got depSM, t090C, sal00" in text


FIRST_ROW = cnv(rows=[]).count(b"\n") + 1
REFUSED = {
    "a letter": (cnv(end="        2.5        x.1       4.25        1.5          0\r\n"), FIRST_ROW + 3, "not a number"),
    "a column too few": (cnv(end="        2.5       20.1       4.25\r\n"), FIRST_ROW + 3, "expected 5 columns; got 3"),
    "cut in a row": (cnv()[:-20], FIRST_ROW + 2, "different number of columns"),
    "time goes back": (cnv(rows=[(1, 2, 3, 1.0), (1, 2, 3, 0.5)]), FIRST_ROW + 1, "the time decreases"),
    "a bad time": (cnv(rows=[(1, 2, 3, -9.99e-29)]), FIRST_ROW, "no time"),
    "no rows": (cnv(rows=[]), FIRST_ROW - 1, "no rows"),
    "no end": (cnv().partition(b"*END*")[0], FIRST_ROW - 2, "END"),
    "another file": (b"pressure;temperature\n1;2\n", 1, "not a Sea-Bird"),
    "empty": (b"", 0, "END"),
    "binary rows": (cnv(header=("file_type = binary",)), 10, "ASCII"),
    "a name too few": (cnv().replace(b"# nquan = 5", b"# nquan = 6"), FIRST_ROW - 1, "inconsistent"),
    "nquan is text": (cnv().replace(b"# nquan = 5", b"# nquan = five"), 3, "nquan is not a number"),
    "one endless line": (b"* " + b"x" * 100_000, 1, "too long"),
    "cut gz": (gzip.compress(cnv())[:-30], None, "cannot read on"),
    "cut bz2": (bz2.compress(cnv())[:-30], None, "cannot read on"),
    "damaged gz": (gzip.compress(cnv())[:60] + b"\xff" * 40 + gzip.compress(cnv())[100:], None, "cannot read on"),
}


@pytest.mark.parametrize(("content", "line", "says"), REFUSED.values(), ids=REFUSED)
def test_unreadable_content_is_refused_with_its_line_and_leaves_no_file(
    tmp_path: Path, content: bytes, line: int | None, says: str
) -> None:
    path = write(tmp_path, content)
    with pytest.raises(FileInvalid, match=says) as caught:
        import_cnv(path, tmp_path / "out.jsonl")
    assert caught.value.path == str(path)
    assert line is None or caught.value.line == line
    assert [p.name for p in tmp_path.iterdir()] == ["cast.cnv"]


def test_a_failed_import_leaves_the_recording_that_was_there(tmp_path: Path) -> None:
    out = write(tmp_path, b"precious", "out.jsonl")
    with pytest.raises(FileInvalid):
        import_cnv(write(tmp_path, cnv()[:-20]), out)
    assert out.read_bytes() == b"precious"
    import_cnv(write(tmp_path, cnv()), out)
    assert len(rows_of(out)) == 3


def test_places_that_are_not_there_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match=r"nothing\.cnv"):
        import_cnv(tmp_path / "nothing.cnv", tmp_path / "out.jsonl")
    with pytest.raises(FileInvalid, match="directory"):
        import_cnv(write(tmp_path, cnv()), tmp_path / "nowhere" / "out.jsonl")


@given(st.binary(max_size=300), st.integers(0, 600))
def test_garbage_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, garbage: bytes, at: int) -> None:
    tmp_path = tmp_path_factory.mktemp("cnv")
    whole = cnv()
    try:
        import_cnv(write(tmp_path, whole[:at] + garbage + whole[at:]), tmp_path / "out.jsonl")
    except FieldtwinError:
        assert not (tmp_path / "out.jsonl").exists()


def test_progress_goes_from_the_start_to_the_end_in_bounded_memory(tmp_path: Path) -> None:
    rows = [(i * 0.5, 20.0, 4.5, i * 0.25) for i in range(20_000)]
    path = write(tmp_path, gzip.compress(cnv(rows=rows)), "cast.cnv.gz")
    seen: list[tuple[int, int]] = []
    tracemalloc.start()
    try:
        import_cnv(path, tmp_path / "out.jsonl", progress=lambda done, total: seen.append((done, total)))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    size = path.stat().st_size
    assert [total for _, total in seen] == [size] * len(seen)
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert len(seen) >= 20
    assert seen[-1] == (size, size)
    assert peak < 1_000_000


@pytest.mark.skipif(not REAL_CAST.exists(), reason="the real cast does not ship with the project")
def test_the_real_cast_comes_back_row_by_row_within_float32(tmp_path: Path) -> None:
    summary = import_cnv(REAL_CAST, tmp_path / "out.jsonl")
    assert (summary.rows, summary.seconds, summary.rows_announced) == (65_158, 2714.875, 65_158)
    track = SignalTrack.load(tmp_path / "out.jsonl")
    assert track.nbytes < 5_000_000
    with gzip.open(REAL_CAST, "rt", encoding="latin-1") as file:
        while not next(file).startswith("*END*"):
            pass
        for number, line in enumerate(file):
            if number % 997:
                continue
            cells = line.split()
            for name, column in (("pressure", 14), ("temperature", 18), ("conductivity", 3)):
                want = struct.pack(">f", float(cells[column]))
                assert struct.pack(">f", track.at(float(cells[21]), name)) == want, (number, name)
