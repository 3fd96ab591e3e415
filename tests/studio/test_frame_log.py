"""The index of a capture: numbers, filters, links and exports, also while the file grows and when a line is cut."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.studio.live.frame_log import FrameFilter, FrameLog
from fieldtwin.twin.site.system import load_system

LINE = "rtu:/dev/ttyS0?baudrate=19200&frame=8E1"
REQUEST, REPLY = "010300010001d5ca", "01030200057847"


def written(path: Path, *entries: tuple[int, str, str], mode: str = "w") -> None:
    with path.open(mode) as file:
        for t_ms, direction, data in entries:
            line = {"t_ns": t_ms * 1_000_000, "endpoint": LINE, "direction": direction, "hex": data}
            file.write(json.dumps(line, separators=(",", ":")) + "\n")


def read(frames: FrameLog) -> FrameLog:
    while frames.follow():
        pass
    return frames


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    path = tmp_path / "capture.jsonl"
    written(path, (0, "sent", REQUEST), (12, "received", REPLY), (1000, "sent", REQUEST), (3000, "sent", REQUEST))
    return path


def test_an_answered_request_is_linked_and_carries_the_value(capture: Path) -> None:
    frames = read(FrameLog(capture, load_system("observatory")))
    assert len(frames) == 4
    assert frames.verdict(0) == "good"
    assert frames.reply_to(0) == 1
    reply = frames.row(1)
    assert (reply.request, reply.latency_ns, reply.tags) == (0, 12_000_000, {"sample_period_s": 5})
    assert reply.device == "ctd"
    assert not reply.sent
    frames.close()


def test_an_unanswered_request_is_pending_first_and_a_problem_after_the_next_request(
    tmp_path: Path, capture: Path
) -> None:
    frames = read(FrameLog(capture, load_system("observatory")))
    assert frames.verdict(2) == "no reply"
    assert frames.verdict(3) == ""
    problems = FrameFilter(problems=True)
    assert [number for number, _ in frames.page(0, 10, problems)] == [2]
    written(capture, (5000, "sent", REQUEST), mode="a")
    read(frames)
    assert [number for number, _ in frames.page(0, 10, problems)] == [2, 3]
    frames.close()


def test_a_cut_line_is_read_when_the_rest_arrives(capture: Path) -> None:
    whole = capture.read_bytes()
    capture.write_bytes(whole[:-20])
    frames = read(FrameLog(capture, load_system("observatory")))
    assert len(frames) == 3
    capture.write_bytes(whole)
    assert len(read(frames)) == 4
    assert frames.invalid_lines == 0
    frames.close()


def test_frames_are_found_by_time_and_exported_as_they_were_captured(capture: Path) -> None:
    frames = read(FrameLog(capture, load_system("observatory")))
    assert frames.position_at(500_000_000) == 2
    assert frames.position_at(10**12) == 4
    assert [c.item.hex() for c in frames.captured(frames.numbers(0, 1)) if isinstance(c.item, bytes)] == [
        REQUEST,
        REPLY,
    ]
    assert len(read(frames)) == 4
    frames.close()


def test_invalid_lines_are_counted_and_do_not_end_the_reading(capture: Path) -> None:
    text = capture.read_text().splitlines()
    capture.write_text("\n".join([text[0], '{"t_ns": 1, "endpoint": "nonsense"}', "no json", *text[1:], ""]))
    frames = read(FrameLog(capture, load_system("observatory")))
    assert len(frames) == 4
    assert frames.invalid_lines == 1
    frames.close()


def test_a_capture_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="cannot read the capture"):
        FrameLog(tmp_path / "none", load_system("observatory"))


def test_the_last_piece_of_a_reply_is_explained_with_the_pieces_before_it(tmp_path: Path) -> None:
    path = tmp_path / "capture.jsonl"
    written(path, (0, "sent", REQUEST), (12, "received", REPLY[:6]), (14, "received", REPLY[6:]))
    frames = read(FrameLog(path, load_system("observatory")))
    assert frames.row(2).whole == REPLY
    spans = {s.name: s.value for s in frames.fields(2)}
    assert spans["sample_period_s"].startswith("5 s")
    assert spans["CRC"] == "right"
    assert sum(s.length for s in frames.fields(2)) == len(REPLY) // 2
    assert sum(s.length for s in frames.fields(1)) == 3
    assert frames.row(1).whole == ""
    frames.close()


def test_numbers_are_those_of_accepted_frames_in_the_range(capture: Path) -> None:
    frames = read(FrameLog(capture, load_system("observatory")))
    problems = FrameFilter(problems=True)
    assert list(frames.numbers(0, 99, problems)) == [2]
    assert list(frames.numbers(0, 1, problems)) == []
    assert list(frames.numbers(1, 99)) == [1, 2, 3]
    frames.close()
