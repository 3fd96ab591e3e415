"""MCAP files: the reader of the library `mcap` finds every record again, and each message fits the schema of its topic."""

from __future__ import annotations

import builtins
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap_reading import Read, read_mcap

from fieldtwin.capture.formats.mcap_file import McapFile, group_schema, group_value, kind_of_values
from fieldtwin.capture.recordings.exporting import export
from fieldtwin.gateway.connections.tap import TapFile
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile_file import load_profile

S = 10**9
START_NS = 1_772_366_400 * S  # 2026-03-01T12:00:00Z
RECORDING = (
    '{"fieldtwin_recording":1,"device":"a/b","kind":"exchanges","source":"measured","start_utc":"2026-03-01T12:00:00Z"}\n'
    '{"t":0.0,"unit":1,"req":"0300000003","rep":"0306000700017fff","lat":0.25}\n'
    '{"t":1.0,"unit":1,"req":"0300000002","err":"timeout"}\n'
    '{"t":2.0,"unit":1,"req":"0300000002","rep":"8302","lat":0.1}\n'
    '{"t":3.0,"unit":2,"req":"0600000009","rep":"0600000009","lat":0.1}\n'
    '{"t":4.0,"unit":2,"req":"11","rep":"110401ff4142","lat":0.1}\n'
)
PROFILE = """device: a/b
source: ""
protocol: modbus
tags:
  level: {at: "holding:0", scale: 0.5, unit: m, access: rw}
  state: {at: "holding:1", values: {0: OFF, 1: ON}}
  depth: {at: "holding:2", unit: m, sentinels: [0x7fff]}
  pin: {at: "holding:1", secret: true}
"""


def by_topic(found: Read) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    """Return (ns after `START_NS`, message) of each topic."""
    topics: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    for topic, t_ns, message in found.messages:
        topics.setdefault(topic, []).append((t_ns - START_NS, message))
    return topics


def recording(folder: Path) -> Path:
    path = folder / "r.jsonl"
    path.write_text(RECORDING)
    return path


def test_exchanges_and_the_tags_that_they_carry(tmp_path: Path) -> None:
    (tmp_path / "p.yaml").write_text(PROFILE)
    count = export(recording(tmp_path), tmp_path / "r.mcap", profile=load_profile(tmp_path / "p.yaml"))
    found = read_mcap(tmp_path / "r.mcap")
    assert count == len(found.messages) == 9
    assert found.metadata["fieldtwin"] | {"version": ""} == {
        "version": "", "source": "r.jsonl", "device": "a/b", "recorded": "measured", "start_utc": "2026-03-01T12:00:00Z",
        "prototype": "false",
    }  # fmt: skip
    topics = by_topic(found)
    assert [(t / S, m["unit"], m["problem"], m.get("latency_ms"), m.get("address")) for t, m in topics["/exchanges"]] == [
        (0, 1, "", 250, 0), (1, 1, "timeout", None, 0), (2, 1, "exception 02", 100, 0), (3, 2, "", 100, 0), (4, 2, "", 100, None),
    ]  # fmt: skip
    bad = {"quality": "bad", "unit": "m"}
    assert topics["/tags/unit1"] == [
        (
            S // 4,
            {
                "level": {"value": 3.5, "quality": "good", "unit": "m"},
                "state": {"value": 1.0, "quality": "good", "name": "ON"},
                "depth": {**bad, "reason": "no value"},
            },
        ),
        (S, {"level": {**bad, "reason": "timeout"}, "state": {"quality": "bad", "reason": "timeout"}}),
        (
            2 * S + S // 10,
            {"level": {**bad, "reason": "exception 02"}, "state": {"quality": "bad", "reason": "exception 02"}},
        ),
    ]
    assert topics["/tags/unit2"] == [(3 * S + S // 10, {"level": {"value": 4.5, "quality": "good", "unit": "m"}})]


def test_signals_keep_their_units_and_have_no_value_where_none_was_measured(tmp_path: Path) -> None:
    path = tmp_path / "s.jsonl"
    path.write_text(
        '{"fieldtwin_recording":1,"device":"a/b","kind":"signals","source":"imported","start_utc":"2026-03-01T12:00:00Z",'
        '"signals":{"level":{"unit":"m"},"flow":{}}}\n[0.5,1.5,null]\n[1.5,2.5,3.5]\n'
    )
    assert export(path, tmp_path / "s.mcap") == 2
    assert by_topic(read_mcap(tmp_path / "s.mcap"))["/signals"] == [
        (S // 2, {"level": {"value": 1.5, "unit": "m"}, "flow": {}}),
        (3 * S // 2, {"level": {"value": 2.5, "unit": "m"}, "flow": {"value": 3.5}}),
    ]


def test_frames_of_a_can_log_and_of_a_capture(tmp_path: Path) -> None:
    log = tmp_path / "bus.log"
    log.write_text("(1772366401.000001) can0 123#AABB\n(1772366401.000002) vcan1 1ABCDEF0#\n")
    export(log, tmp_path / "bus.mcap")
    flags = {"extended": False, "remote": False, "error": False}
    assert by_topic(read_mcap(tmp_path / "bus.mcap"))["/frames"] == [
        (S + 1000, {"bus": "can0", "direction": "received", "bytes": "aabb", "can_id": 0x123, **flags}),
        (
            S + 2000,
            {"bus": "vcan1", "direction": "received", "bytes": "", "can_id": 0x1ABCDEF0, **flags, "extended": True},
        ),
    ]
    tap = TapFile(tmp_path / "run.jsonl", head={"started": "2026-03-01T12:00:00+00:00", "t_ns": 5_000})
    tap.on_bytes(Endpoint.parse("rtu:/dev/ttyS0"), Direction.SENT, 6_000, b"\x01\x03")
    tap.on_frame(Endpoint.parse("can:socketcan/can0"), Direction.RECEIVED, 7_000, CanFrame(0x705, remote=True, dlc=1))
    tap.close()
    export(tmp_path / "run.jsonl", tmp_path / "run.mcap")
    assert by_topic(read_mcap(tmp_path / "run.mcap"))["/frames"] == [
        (1_000, {"bus": "ttyS0", "direction": "sent", "bytes": "0103"}),
        (2_000, {"bus": "can0", "direction": "received", "bytes": "", "can_id": 0x705, **flags, "remote": True}),
    ]


def test_a_trace_is_named_as_such(tmp_path: Path) -> None:
    (tmp_path / "run.jsonl").write_text('[0,"tag","ctd.pressure",{"value":1.5}]\n')
    with pytest.raises(FileInvalid, match="not a recording but a trace: fieldtwin trace"):
        export(tmp_path / "run.jsonl", tmp_path / "run.mcap")


scalars = st.one_of(st.booleans(), st.integers(-(2**53), 2**53), st.floats(), st.text(max_size=20), st.none())


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.tuples(scalars, st.sampled_from(["good", "uncertain", "bad", ""]), st.text(max_size=5)), max_size=8),
    st.integers(-5, 2**62),
)
def test_any_values_are_read_again(tmp_path: Path, values: list[tuple[Any, str, str]], t_ns: int) -> None:
    kind = kind_of_values({type(value) for value, *_ in values})
    schema = group_schema("any", {"x": kind}, {"x": "m"})
    with McapFile(tmp_path / "a.mcap", {"system": "ü"}) as file:
        for value, quality, reason in values:
            message = {"x": group_value(value, kind, quality=quality, reason=reason)}
            file.message("/t", schema, t_ns, message)
    found = read_mcap(tmp_path / "a.mcap")
    assert found.metadata["fieldtwin"]["system"] == "ü"
    assert [(t, m["x"].get("quality", ""), m["x"].get("reason", "")) for _, t, m in found.messages] == [
        (max(0, t_ns), quality, reason) for _, quality, reason in values
    ]
    for (value, quality, _), (_, _, message) in zip(values, found.messages, strict=True):
        written = message["x"].get("bad_value" if quality == "bad" else "value")
        missing = value is None or value != value or value in (float("inf"), float("-inf"))
        assert written == (None if missing else kind(value))
        assert ("value" in message["x"]) == (not missing and quality != "bad")


def test_a_file_that_cannot_be_written_is_a_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileInvalid, match="cannot write the MCAP file"):
        McapFile(tmp_path / "no" / "a.mcap", {})
    with pytest.raises(FileInvalid, match="No space left"), McapFile(Path("/dev/full"), {}):
        pass
    real = builtins.__import__
    monkeypatch.setattr(
        builtins, "__import__", lambda name, *a: _missing() if name == "mcap.writer" else real(name, *a)
    )
    with pytest.raises(UsageError, match="MCAP needs the library mcap"):
        export(recording(tmp_path), tmp_path / "r.mcap")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["r.jsonl"]


def _missing() -> None:
    raise ImportError
