"""A recording that never began leaves no file, so that the next attempt with the same name is not refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.capture.recordings.rotating_file import RotatingFile
from fieldtwin.gateway.core.errors import Unreachable


@pytest.mark.parametrize("lines", [0, 1])
def test_an_error_leaves_only_files_with_content(tmp_path: Path, lines: int) -> None:
    path = tmp_path / "meter.jsonl"

    def record() -> None:
        with RotatingFile(path, b"head\n") as file:
            for n in range(lines):
                file.line(float(n), b"line\n")
            raise Unreachable("there is no such serial port")

    with pytest.raises(Unreachable):
        record()
    assert path.exists() == bool(lines)


def test_an_empty_recording_that_was_wanted_stays(tmp_path: Path) -> None:
    with RotatingFile(tmp_path / "quiet.log"):
        pass
    assert (tmp_path / "quiet.log").exists()


def test_a_foreign_file_stays(tmp_path: Path) -> None:
    (tmp_path / "meter.jsonl").write_text("mine")
    with pytest.raises(Exception, match="exists already"), RotatingFile(tmp_path / "meter.jsonl"):
        pass
    assert (tmp_path / "meter.jsonl").read_text() == "mine"
