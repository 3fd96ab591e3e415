"""Logs of candump: any frame comes back from its line, and any text is a log or refused."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.canframe import CanFrame, parse_frame
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.candump import MAX_LINE, LeftOut, line_of, read_lines, read_log


@st.composite
def classic_frames(draw: st.DrawFn) -> CanFrame:
    extended = draw(st.booleans())
    can_id = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
    if draw(st.booleans()):
        return CanFrame(can_id, extended=extended, remote=True, dlc=draw(st.integers(0, 8)))
    return CanFrame(can_id, draw(st.binary(max_size=8)), extended=extended)


@given(classic_frames())
def test_the_text_of_a_frame_is_parsed_back(frame: CanFrame) -> None:
    assert parse_frame(str(frame)).key() == frame.key()
    assert parse_frame(str(frame).lower()).key() == frame.key()


@given(st.lists(st.tuples(st.integers(0, 10**12).map(lambda us: us * 1000), classic_frames()), max_size=20))
def test_any_log_comes_back_with_its_times(log: list[tuple[int, CanFrame]]) -> None:
    read = list(read_lines(line_of(t_ns, frame, "can7") for t_ns, frame in log))
    assert [(t_ns, name, frame.key()) for t_ns, name, frame in read] == [(t, "can7", f.key()) for t, f in log]


@pytest.mark.parametrize(
    ("line", "t_ns", "text"),
    [
        ("(1.5) can0 123#", 1_500_000_000, "123#"),
        ("(1.000000001) can0 123#AA R", 1_000_000_001, "123#AA"),
        ("  (0.000001)   slcan0\t1FFFFFFF#r8_9 t", 1000, "1FFFFFFF#R8"),
        ("(12.100000) can0 123#R", 12_100_000_000, "123#R"),
    ],
)
def test_a_line_as_candump_and_other_programs_write_it(line: str, t_ns: int, text: str) -> None:
    (read,) = read_lines([f"{line}\n".encode()])
    assert (read[0], str(read[2])) == (t_ns, text)


def test_fd_and_error_frames_and_invalid_identifiers_are_counted_and_omitted() -> None:
    left = LeftOut()
    lines = [b"(1.0) can0 123##1AB\n", b"(1.0) can0 20000004#00\n", b"(1.0) can0 800#\n", b"(1.0) can0 3FFFFFFF#\n"]
    assert list(read_lines(lines, left=left)) == []
    assert (left.fd, left.errors) == (1, 3)


@given(st.lists(st.binary(max_size=80)))
def test_any_bytes_are_a_log_or_refused(lines: list[bytes]) -> None:
    with contextlib.suppress(FileInvalid):
        list(read_lines(lines, "x.log"))


def test_a_broken_line_is_named_and_a_truncated_last_one_omitted(tmp_path: Path) -> None:
    path = tmp_path / "x.log"
    path.write_bytes(b"(1.0) can0 123#\n(1.0) can0 123#A\n")
    with pytest.raises(FileInvalid, match=r"x\.log:2: not a line of a CAN log"):
        list(read_log(path))
    path.write_bytes(b"(1.0) can0 123#\n(1.0) can0 123#A")
    assert len(list(read_log(path))) == 1
    path.write_bytes(b"(" * (MAX_LINE + 1))
    with pytest.raises(FileInvalid, match=r"x\.log:1"):
        list(read_log(path))
    with pytest.raises(FileInvalid, match="cannot read the log"):
        list(read_log(tmp_path / "none.log"))
