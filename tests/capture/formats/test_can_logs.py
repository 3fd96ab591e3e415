"""CAN logs of other programs keep frames, channels and times, through candump's format and pcapng."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import can
import pytest

from fieldtwin.capture.formats.can_files import SUFFIXES
from fieldtwin.capture.recordings.exporting import export
from fieldtwin.capture.recordings.from_packets import PacketImport
from fieldtwin.capture.recordings.importing import import_can
from fieldtwin.gateway.core.files.candump import read_log

START_S = 1_700_000_000
FRAMES = [
    (0.0, 0, 0x181, b"", False), (0.125, 1, 0x182, b"\x01", False), (0.25, 0, 0x1ABCDEF0, bytes(8), True),
    (0.250001, 1, 0x7FF, b"\xff" * 4, False),
]  # fmt: skip
Seen = list[tuple[int, bool, int, bool, bytes]]


def seen(path: Path) -> Seen:
    """Return (us after the first frame, whether on its channel, identifier, whether extended, data) of each frame."""
    found = list(read_log(path))
    return [((t - found[0][0]) // 1000, name == found[0][1], f.can_id, f.extended, f.data) for t, name, f in found]


WANTED = [(round(t_s * 1e6), channel == 0, can_id, extended, data) for t_s, channel, can_id, data, extended in FRAMES]


def written(folder: Path, suffix: str) -> Path:
    """Return a log of `FRAMES` that python-can has written."""
    path = folder / f"bus{suffix}"
    with can.Logger(path) as log:
        for t_s, channel, can_id, data, extended in FRAMES:
            name = f"can{channel}" if suffix == ".log" else channel
            log(
                can.Message(
                    timestamp=START_S + t_s, arbitration_id=can_id, data=data, is_extended_id=extended, channel=name
                )
            )
    return path


@pytest.mark.parametrize("suffix", [".log", *SUFFIXES])
def test_each_format_keeps_frames_channels_and_times(tmp_path: Path, suffix: str) -> None:
    assert import_can(written(tmp_path, suffix), tmp_path / "imported.log").records == len(FRAMES)
    found = seen(tmp_path / "imported.log")
    if suffix == ".trc":  # its times are rounded to 0.1 ms or 1 us, by version
        assert [t for t, *_ in found] == pytest.approx([t for t, *_ in WANTED], abs=100)
        assert [rest for _, *rest in found] == [rest for _, *rest in WANTED]
    else:
        assert found == WANTED
    export(tmp_path / "imported.log", tmp_path / "copy.log")
    assert (tmp_path / "copy.log").read_bytes() == (tmp_path / "imported.log").read_bytes()
    export(tmp_path / "imported.log", tmp_path / "bus.pcapng")
    PacketImport(tmp_path / "bus.pcapng", tmp_path / "again.jsonl").run()
    assert (tmp_path / "again.log").read_bytes() == (tmp_path / "imported.log").read_bytes()


@pytest.mark.skipif(shutil.which("log2asc") is None, reason="can-utils is not installed")
def test_logs_that_can_utils_convert_are_read(tmp_path: Path) -> None:
    log, asc, back = written(tmp_path, ".log"), tmp_path / "converted.asc", tmp_path / "back.log"
    subprocess.run(["log2asc", "-I", log, "-O", asc, "can0", "can1"], check=True, timeout=60)
    import_can(asc, tmp_path / "imported.log")
    assert seen(tmp_path / "imported.log") == WANTED
    subprocess.run(["asc2log", "-I", asc, "-O", back], check=True, timeout=60)
    assert seen(back) == WANTED
    import_can(log, tmp_path / "ours.log")
    assert seen(tmp_path / "ours.log") == WANTED
