"""Nodes of the CiA device profiles as a user starts them: in a prototype run, and one by one on a shared bus."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest
from procs import fieldtwin, free_port, no_tracebacks, run_to_end, wait_for

SYSTEM = """\
fieldtwin: 1
system: nodes
buses:
  can0: {url: "can:socketcan/can0", bitrate: 250000}
devices:
  io:
    {profile: io-cia401, bus: can0, node: 6, expect: {serial: "17"}, heartbeat: {producer_ms: 200, consumer_ms: 1500},
     tpdo1: {map: [inputs_1, inputs_2], event_ms: 100}, start: true}
  drive:
    {profile: drive-cia402, bus: can0, node: 7, heartbeat: {producer_ms: 200, consumer_ms: 1500},
     tpdo1: {map: [statusword, position], event_ms: 100}, start: true}
  winch:
    {profile: encoder-cia406, bus: can0, node: 9, heartbeat: {producer_ms: 200, consumer_ms: 1500},
     tpdo1: {map: [position, speed], event_ms: 50}, start: true}
plc:
  cycle_ms: 20
  programs:
    watch: {source: watch.st, inputs: {position: {tag: winch.position}, switches: {tag: io.inputs_1}}}
"""
PROTOTYPE = """\
prototype_of: nodes.yaml
buses:
  can0: {listen: "can:fieldtwin/127.0.0.1:0", pace: true}
devices:
  io:    {recording: io-cia401.jsonl, at_end: loop, identity: {serial: "17"}}
  drive: {model: profile}
  winch: {recording: encoder-cia406.jsonl, at_end: loop}
"""
PROGRAM = """\
PROGRAM Watch
VAR_INPUT position : UDINT; switches : USINT; END_VAR
VAR turns : REAL; END_VAR
  turns := UDINT_TO_REAL(position) / 8192.0;
END_PROGRAM
"""


@pytest.mark.long
def test_three_nodes_on_one_bus(tmp_path: Path) -> None:
    for name, text in (("nodes.yaml", SYSTEM), ("nodes.prototype.yaml", PROTOTYPE), ("watch.st", PROGRAM)):
        (tmp_path / name).write_text(text, encoding="utf-8")
    wanted = ("run", str(tmp_path / "nodes.yaml"), "--prototype", "--for", "2s", "--instance", "cn", "--json")
    ended = run_to_end(tmp_path, *wanted, name="nodes")
    assert ended.process.returncode == 0, ended.err
    summary = json.loads(ended.out)
    assert {name: device["state"] for name, device in summary["devices"].items()} == {
        "io": "good", "drive": "good", "winch": "good",
    }  # fmt: skip
    on_can = summary["exchanges"]["can0"]
    assert {what: on_can["gateway"][what] for what in ("requests", "replies")} == on_can["emulators"]
    assert on_can["gateway"]["pdos"] > 30
    assert summary["published"]["checked"] > 60
    assert summary["published"]["wrong"] == 0
    tags = summary["tags"]
    assert tags["io.serial"]["value"] == 17
    assert tags["drive.statusword"]["value"] == 0x0250
    assert 8_000_000 < tags["winch.position"]["value"] < 9_000_000
    assert tags["winch.speed"]["value"] > 0


def test_the_first_process_creates_the_bus_and_one_without_a_bus_reports_it(tmp_path: Path) -> None:
    where = f"can:fieldtwin/127.0.0.1:{free_port()}"
    with fieldtwin(tmp_path, "emulate", "io-cia401", "--on", where, "--bitrate", "500000", name="io") as io:
        wait_for(lambda: "a new bus with 500000 bit/s" in io.err, 15, "the bus")
        with fieldtwin(tmp_path, "emulate", "drive-cia402", "--on", where, name="drive") as drive:
            wait_for(lambda: f"node 7 on {where}, with others" in drive.err, 15, "the second node")
            wrong = run_to_end(
                tmp_path, "emulate", "encoder-cia406", "--on", where, "--bitrate", "125000", name="wrong"
            )
            assert wrong.process.returncode == 2
            assert "expected 125000 bit/s; got 500000 bit/s" in wrong.err
            io.signal(signal.SIGTERM)
            assert io.wait(10) == 0
            assert drive.wait(10) == 4
            assert "the software CAN bus is gone" in drive.err
    no_tracebacks(tmp_path)


def test_a_nearly_correct_name_and_a_recording_of_a_different_device(tmp_path: Path) -> None:
    on = ("--on", "can:fieldtwin/127.0.0.1:0")
    misspelt = run_to_end(tmp_path, "emulate", "drive-cia40", *on, name="misspelt")
    assert misspelt.process.returncode == 2
    assert "did you mean 'drive-cia402'?" in misspelt.err
    other = run_to_end(tmp_path, "emulate", "drive-cia402", *on, "--recording", "cast.jsonl", name="other")
    assert other.process.returncode == 3
    assert "has no signal of this device" in other.err
