"""`fieldtwin trace`: a run's trace or capture as text, as JSON, as waveforms; and files that are neither."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest
from click.testing import CliRunner
from report_rig import MS, observatory, run_trace

from fieldtwin.capture.decoding.trace_file import read_events
from fieldtwin.cli.recordings.trace_command import command
from fieldtwin.gateway.connections.tap import TapFile
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid
from fieldtwin.results.trace import Trace


@pytest.fixture
def trace(tmp_path: Path) -> Path:
    path = tmp_path / "run.jsonl"
    with path.open("wb") as sink:
        kept = Trace(sink=sink)
        for event in run_trace(20):
            kept.note(*event)
        kept.flush()
    return path


def shown(*args: str | Path) -> list[str]:
    result = CliRunner().invoke(command, [str(a) for a in args], catch_exceptions=False, standalone_mode=False)
    assert result.return_value == 0
    return result.stdout.splitlines()


def test_trace_as_text(trace: Path) -> None:
    assert shown(trace, "observatory", "--only", "ctd", "--from", "12.3s", "--to", "12.42s") == [
        "   12.303000  tag         ctd.pressure none dbar, bad: timeout",
        "   12.403000  line1 →     ctd: read holding registers 40001 (holding:0) x 2",
        "   12.413000  line1 ←     ctd: status 1 (sampling), sample_period_s 1 s",
    ]
    assert shown(trace, "observatory", "--only", "relay", "--from", "2s", "--to", "10s")[-1].endswith("relay.state = 1")


def test_problems_and_json(trace: Path) -> None:
    assert len(shown(trace, "observatory", "--problems")) == 6
    (line,) = shown(trace, "observatory", "--problems", "--json", "--to", "12.45s")
    found = json.loads(line)
    assert (found["t_s"], found["bus"], found["problem"], found["tags"]["pressure"]) == (
        12.003,
        "line1",
        "no reply",
        None,
    )


def test_the_trace_command_writes_waveforms(trace: Path, tmp_path: Path) -> None:
    assert shown(trace, "observatory", "--vcd", tmp_path / "a.vcd") == []
    assert "$enddefinitions" in (tmp_path / "a.vcd").read_text()
    with pytest.raises(FieldtwinError, match="whole trace"):
        shown(trace, "observatory", "--vcd", tmp_path / "a.vcd", "--problems")


def test_the_trace_command_shows_a_capture(tmp_path: Path) -> None:
    tap, endpoint = TapFile(tmp_path / "c.jsonl"), observatory().buses["can0"].endpoint
    tap.on_frame(endpoint, Direction.RECEIVED, 5_000 * MS, CanFrame(0x705, b"\x05"))
    tap.on_frame(endpoint, Direction.RECEIVED, 5_500 * MS, CanFrame(0x185, bytes.fromhex("9E013500")))
    tap.close()
    assert shown(tmp_path / "c.jsonl", "observatory") == [
        "    0.000000  can0 ←      inclinometer: OPERATIONAL",
        "    0.500000  can0 ←      inclinometer: TPDO1 slope_long 4.14 deg, slope_lateral 0.53 deg",
    ]


def test_invalid_lines_of_a_trace_are_reported_with_their_number(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    good = msgspec.json.encode((1, "note", "run", {"text": "began"}))
    for bad in (b"nonsense", b'[1,"sound","x",{}]', b'[1,"note","x"]', b'["1","note","x",{}]'):
        path.write_bytes(good + b"\n" + bad + b"\n" + good + b"\n")
        with pytest.raises(FileInvalid, match=r"a\.jsonl:2: no event"):
            list(read_events(path, observatory()))
    path.write_bytes(good + b"\n" + good[:-4])  # a run that was ended from outside
    assert [e.data for e in read_events(path, observatory())] == [{"text": "began"}]
    path.write_bytes(b"")
    assert list(read_events(path, observatory())) == []
    with pytest.raises(FileInvalid, match="cannot be read"):
        list(read_events(tmp_path / "none", observatory()))
