"""`infer` reads recordings: the requests of one client to a unit, at any periods, are as useful as a dump."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from fieldtwin.cli.device.infer_command import command
from fieldtwin.commissioning.infer.recorded_passes import dump_of_recording
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.recording import RecordedExchange, RecordingHeader, encode_exchange, encode_header

HEADER = RecordingHeader(version=1, device="sniffed/line", kind="exchanges", source="measured")
FAST, SLOW = bytes.fromhex("0300000002"), bytes.fromhex("0400100001")


def polled(rounds: int, unit: int = 7) -> list[RecordedExchange]:
    """A counter of two words each second, its low word first, and a temperature every five seconds."""
    found = []
    for n in range(rounds):
        count = 65_400 + 37 * n
        reply = bytes([3, 4]) + (count & 0xFFFF).to_bytes(2) + (count >> 16).to_bytes(2)
        found.append(RecordedExchange(float(n), unit, FAST, reply, 0.01))
        if n % 5 == 0:
            found.append(RecordedExchange(n + 0.1, unit, SLOW, bytes([4, 2]) + (200 + n % 7).to_bytes(2), 0.01))
    return found


def test_a_pass_is_a_round_of_requests_with_the_newest_value_of_slower_ones() -> None:
    dump = dump_of_recording("r.jsonl", HEADER, polled(20))
    assert (dump.header["address"], len(dump.passes)) == (7, 20)
    assert {len(p.cells) for p in dump.passes} == {3}
    assert [int.from_bytes(p.cells["input", 16]) for p in dump.passes[4:7]] == [200, 205, 205]


def test_exceptions_and_replies_of_the_wrong_size_bring_no_values() -> None:
    bad = [RecordedExchange(0.5, 7, FAST, b"\x83\x02", 0.01), RecordedExchange(0.6, 7, FAST, b"\x03\x02\xff\xff", 0.01)]
    dump = dump_of_recording("r.jsonl", HEADER, [*polled(3)[:1], *bad, *polled(3)[1:]])
    assert b"\xff\xff" not in {value for p in dump.passes for value in p.cells.values()}


def test_a_recording_of_several_units_needs_the_unit() -> None:
    both = polled(5) + polled(5, unit=9)
    with pytest.raises(UsageError, match="expected --unit NUMBER; got units 7, 9"):
        dump_of_recording("r.jsonl", HEADER, both)
    assert dump_of_recording("r.jsonl", HEADER, both, 9).header["address"] == 9
    with pytest.raises(FileInvalid, match="no values of unit 3"):
        dump_of_recording("r.jsonl", HEADER, both, 3)


def test_the_command_finds_the_counter_of_a_recording(tmp_path: Path) -> None:
    path, draft = tmp_path / "line.jsonl", tmp_path / "line.yaml"
    path.write_bytes(encode_header(HEADER) + b"".join(encode_exchange(e) for e in polled(60)))
    done = CliRunner().invoke(command, [str(path), "-o", str(draft), "--json"])
    assert done.exit_code == 0, done.output
    readings = json.loads(done.stdout)
    assert "uint32" in json.dumps(readings)
    assert "CDAB" in draft.read_text()
    again = CliRunner().invoke(command, [str(path), "-o", str(draft)])
    assert isinstance(again.exception, FileInvalid)
    assert "choose another name" in str(again.exception)
