"""A run as an MCAP file and as a pcapng file: values with their quality, decoded frames, and times in UTC."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import msgspec
import pytest
from click.testing import CliRunner
from mcap_reading import read_mcap
from report_rig import MS, adu, can, chunk, note, observatory, run_trace

from fieldtwin.capture.formats.packet_file import PacketFile
from fieldtwin.capture.recordings.from_packets import PacketImport
from fieldtwin.cli.recordings.trace_command import command
from fieldtwin.emulators.virtual.clock import EPOCH_UTC_NS
from fieldtwin.gateway.connections.tap import TapFile
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.reports.run.mcap import write_mcap
from fieldtwin.reports.run.packets import write_packets
from fieldtwin.results.trace import Trace, TraceEvent, TraceKind
from fieldtwin.results.trace_about import (
    VERSION,
    ProgramAbout,
    SourceAbout,
    TraceAbout,
    VariableAbout,
    write_about,
)
from fieldtwin.twin.site.system import load_system

Messages = dict[str, list[tuple[int, dict[str, Any]]]]


def topics(path: Path) -> Messages:
    """Return (ns, message) of each topic."""
    found: Messages = {}
    for topic, t_ns, message in read_mcap(path).messages:
        found.setdefault(topic, []).append((t_ns, message))
    return found


def written(path: Path, events: list[TraceEvent], **more: Any) -> Messages:
    count = write_mcap(path, lambda: events, observatory(), **more)
    found = topics(path)
    assert count == sum(map(len, found.values()))
    return found


def test_a_run_as_mcap(tmp_path: Path) -> None:
    found = written(tmp_path / "run.mcap", run_trace(20), start_utc_ns=5)
    pressure = [(t, m["pressure"]) for t, m in found["/tags/ctd"] if "pressure" in m]
    assert pressure[0] == (21 * MS + 5, {"value": 12.5, "quality": "good", "unit": "dbar"})
    assert next((t // MS, m) for t, m in pressure if m["quality"] == "bad") == (
        12_303, {"quality": "bad", "reason": "timeout", "unit": "dbar"},
    )  # fmt: skip
    together = found["/tags/ctd"][0][1]
    assert list(together) == ["pressure", "temperature", "sample_count"]
    assert [(t // MS, m["on"]) for t, m in found["/faults"]] == [(12_000, True), (15_000, False)]
    assert [(t // MS, m["state"]["value"]) for t, m in found["/programs/relay"] if "state" in m] == [
        (0, 0), (2010, 1), (16_000, 2), (18_000, 0),
    ]  # fmt: skip
    lost = [m for _, m in found["/exchanges"] if m["problem"] == "no reply"]
    assert len(lost) == 6
    assert (lost[0]["device"], lost[0]["address"], "latency_ms" in lost[0]) == ("ctd", 0, False)
    assert next(m["latency_ms"] for _, m in found["/exchanges"] if m["device"] == "ctd") == 17.5
    assert found["/frames"][0][1]["text"].startswith("ctd: read input registers 30001")
    assert next(m for _, m in found["/frames"] if m["bus"] == "can0")["can_id"] == 0x185
    assert [(m["level"], m["name"]) for _, m in found["/log"]] == [
        (2, "step 1"), (2, "step 1"), (3, "fault f1"), (2, "fault f1"),
    ]  # fmt: skip


def test_a_value_of_bad_quality_is_never_the_value(tmp_path: Path) -> None:
    events = [
        note(1, TraceKind.TAG, "ctd.pressure", value=1.5, quality="good", reason="none"),
        note(2, TraceKind.TAG, "ctd.pressure", value=9e9, quality="bad", reason="out of range"),
        note(3, TraceKind.TAG, "ctd.pressure", value=2.5, quality="uncertain", reason="stale"),
        note(4, TraceKind.TAG, "ctd.pressure", value=float("nan"), quality="bad", reason="not a number"),
    ]
    found = [m["pressure"] for _, m in written(tmp_path / "a.mcap", events)["/tags/ctd"]]
    assert [(m.get("value"), m.get("bad_value"), m.get("reason")) for m in found] == [
        (1.5, None, None), (None, 9e9, "out of range"), (2.5, None, "stale"), (None, None, "not a number"),
    ]  # fmt: skip


def test_changes_at_the_same_time_are_one_message_unless_a_tag_changed_twice(tmp_path: Path) -> None:
    events = [
        note(1, TraceKind.TAG, "ctd.pressure", value=1.0, quality="good"),
        note(1, TraceKind.TAG, "ctd.temperature", value=2.0, quality="good"),
        note(1, TraceKind.TAG, "ctd.pressure", value=3.0, quality="good"),
        note(1, TraceKind.TAG, "elsewhere", value="text", quality="good"),
        note(1, TraceKind.TAG, "a b.ü", value=True, quality="good"),
    ]
    found = written(tmp_path / "a.mcap", events)
    assert [{k: m["value"] for k, m in group.items()} for _, group in found["/tags/ctd"]] == [
        {"pressure": 1.0, "temperature": 2.0}, {"pressure": 3.0},
    ]  # fmt: skip
    assert found["/tags/elsewhere"][0][1] == {"elsewhere": {"value": "text", "quality": "good"}}
    assert found["/tags/a b"][0][1]["ü"]["value"] is True


def test_names_of_states_come_from_the_description(tmp_path: Path) -> None:
    state = VariableAbout(tag="", role="output", kind="int", unit="", words={"0": "STANDBY", "1": "ACTIVE"})
    source = SourceAbout(language="", file="", text="", reason="not kept")
    program = ProgramAbout(variables={"state": state}, machine=None, source=source)
    about = TraceAbout(
        version=VERSION, system="x", system_path="x", system_hash="", programs={"relay": program}, target="virtual"
    )
    found = written(tmp_path / "a.mcap", run_trace(4), description=about)
    assert [m["state"].get("name") for _, m in found["/programs/relay"] if "state" in m][:3] == [
        "STANDBY",
        "ACTIVE",
        None,
    ]


def test_secret_tags_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "lock.yaml").write_text(
        'device: a/lock\nsource: ""\nprotocol: modbus\ntags:\n'
        '  pin: {at: "holding:0", secret: true, access: rw}\n  open: {at: "coil:0"}\n'
    )
    (tmp_path / "door.yaml").write_text(
        "fieldtwin: 1\nsystem: door\nbuses:\n  lan: {url: tcp://192.0.2.9:502}\n"
        f"devices:\n  lock: {{bus: lan, profile: {tmp_path}/lock.yaml, unit: 1}}\n"
    )
    events = [
        chunk(1, True, adu(1, "03 0000 0001"), "lan"), chunk(2, False, adu(1, "03 02 04D2"), "lan"),
        note(3, TraceKind.TAG, "lock.pin", value=1234, quality="good"),
        note(3, TraceKind.TAG, "lock.open", value=True, quality="good"),
    ]  # fmt: skip
    system = load_system(str(tmp_path / "door.yaml"))
    write_mcap(tmp_path / "a.mcap", lambda: events, system)
    found = topics(tmp_path / "a.mcap")
    assert found["/tags/lock"] == [(3 * MS, {"open": {"value": True, "quality": "good"}})]
    assert "request" not in found["/exchanges"][0][1]
    shown = msgspec.json.encode([found[topic] for topic in found if topic != "/frames"])
    assert b"1234" not in shown
    assert b"04d2" not in shown.lower()
    assert b"1234" not in msgspec.json.encode([m.get("text", "") for _, m in found["/frames"]])


def test_log_messages_of_refused_writes_name_the_line_of_the_program(tmp_path: Path) -> None:
    events = [
        note(1, TraceKind.REFUSED, "ctd.x", value=1, reason="no", by="plc", program="p", place="p.py:7", cause="range"),
        note(2, TraceKind.REFUSED, "ctd.x", value=1, reason="no", by="topside", place=""),
        note(3, TraceKind.STEP, "2", text="check", verdict="failed"),
        note(4, TraceKind.NOTE, "topside", text="commands 1 s"),
    ]
    log = [m for _, m in written(tmp_path / "a.mcap", events)["/log"]]
    assert [(m["level"], m["file"], m["line"], m["timestamp"]["nsec"]) for m in log] == [
        (4, "p.py", 7, MS), (4, "", 0, 2 * MS), (4, "", 0, 3 * MS), (2, "", 0, 4 * MS),
    ]  # fmt: skip


# -- the command ----------------------------------------------------------------------------------------------------------


def run(*args: str | Path) -> str:
    result = CliRunner().invoke(command, [str(a) for a in args], catch_exceptions=False, standalone_mode=False)
    assert result.return_value == 0
    return result.stderr


def trace_file(path: Path, events: list[TraceEvent]) -> Path:
    with path.open("wb") as sink:
        kept = Trace(sink=sink)
        for event in events:
            kept.note(*event)
        kept.flush()
    return path


def test_the_trace_command_writes_mcap_and_pcapng(tmp_path: Path) -> None:
    trace = trace_file(tmp_path / "run.jsonl", run_trace(20))
    assert " messages  →  " in run(trace, "observatory", "--mcap", tmp_path / "a.mcap", "--from", "12s", "--to", "13s")
    found = read_mcap(tmp_path / "a.mcap")
    assert all(12_000 * MS <= t <= 13_000 * MS for _, t, _ in found.messages)
    assert (found.metadata["fieldtwin"]["system"], found.metadata["fieldtwin"]["source"]) == (
        "observatory",
        "run.jsonl",
    )

    run(trace, "observatory", "--pcapng", tmp_path / "a.pcapng")
    made = {m.path.name: m.exchanges for m in PacketImport(tmp_path / "a.pcapng", tmp_path / "r.jsonl").run().made}
    assert made == {"r.192.0.2.4-502.jsonl": 40, "r.line1.jsonl": 60, "r.log": 220}
    for wrong in (["--vcd", "x.vcd"], ["--problems"], ["--only", "ctd"], ["--json"], ["--against", str(trace)]):
        with pytest.raises(UsageError, match="whole"):
            run(trace, "observatory", "--pcapng", tmp_path / "b.pcapng", *wrong)
    with pytest.raises(UsageError, match="would overwrite the trace"):
        run(trace, "observatory", "--mcap", trace)
    assert len(trace.read_bytes().splitlines()) == len(run_trace(20))
    with pytest.raises(FileInvalid, match="its folder does not exist"):
        run(trace, "observatory", "--pcapng", tmp_path / "no" / "b.pcapng")
    with trace.open("ab") as file:
        file.write(b"damage\n")
    (tmp_path / "older").write_text("of another run")
    for option in ("--mcap", "--pcapng", "--vcd"):
        with pytest.raises(FileInvalid, match="no event"):
            run(trace, "observatory", option, tmp_path / "older")
        assert (tmp_path / "older").read_text() == "of another run"
    assert not list(tmp_path.glob(".*"))


def test_times_are_utc_where_the_file_states_them(tmp_path: Path) -> None:
    def times(trace: Path) -> list[int]:
        out = trace.with_suffix(".pcapng")
        run(trace, "observatory", "--pcapng", out)
        with PacketFile(out) as file:
            return [t_ns for t_ns, _, _ in file]

    events = [can(5, "705#05")]
    assert times(trace_file(tmp_path / "a.jsonl", events)) == [5 * MS]
    about = TraceAbout(version=VERSION, system="x", system_path="x", system_hash="", target="virtual")
    virtual = trace_file(tmp_path / "b.jsonl", events)
    write_about(virtual, about)
    assert times(virtual) == [EPOCH_UTC_NS + 5 * MS]
    tap = TapFile(tmp_path / "c.jsonl", head={"started": "2026-03-01T12:00:00+00:00", "t_ns": 5_000})
    tap.on_frame(observatory().buses["can0"].endpoint, Direction.RECEIVED, 7_000, CanFrame(0x705, b"\x05"))
    tap.close()
    assert times(tmp_path / "c.jsonl") == [1_772_366_400_000_002_000]


@pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")
def test_tshark_shows_the_decoded_text_of_each_packet(tmp_path: Path) -> None:
    path = tmp_path / "a.pcapng"
    assert write_packets(path, lambda: run_trace(1), observatory(), comment="one second") > 10
    fields = ("frame.interface_name", "frame.comment", "_ws.malformed")
    command = ["tshark", "-n", "-r", str(path), "-T", "fields", *(a for f in fields for a in ("-e", f))]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    rows = [tuple(line.split("\t")) for line in done.stdout.splitlines()]
    assert ("line1", "ctd: read input registers 30001 (input:0) x 10", "") in rows
    assert ("can0", "inclinometer: OPERATIONAL", "") in rows
    replies = [text for bus, text, _ in rows if bus == "line1" and "sample_count" in text]
    assert replies[0].startswith("ctd: pressure 12.5 dbar")  # the reply came in two pieces
