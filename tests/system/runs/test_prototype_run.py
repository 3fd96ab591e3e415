"""A whole run of the observatory's prototype, observed from outside: files, streams, exit code, counters."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from procs import Fieldtwin, no_tracebacks, run_to_end


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Fieldtwin:
    """One run of 8 s with its script of commands; every test here checks its results."""
    root = tmp_path_factory.mktemp("run")
    return run_to_end(root, "run", "observatory", "--prototype", "--for", "8s", "--instance", "a", "--json")


def test_it_ends_well_and_reports_it(ended: Fieldtwin) -> None:
    assert ended.process.returncode == 0, ended.err + ended.out
    summary = ended.summary
    assert summary["errors"] == []
    assert summary["ok"] is True
    assert summary["prototype"] is True
    assert summary["outputs_safe"] is True
    assert {n: d["state"] for n, d in summary["devices"].items()} == {
        "ctd": "good", "inclinometer": "good", "modem": "good",
    }  # fmt: skip


def test_the_states_follow_the_commands(ended: Fieldtwin) -> None:
    assert ended.summary["states"] == {"relay": ["STANDBY", "ACTIVE", "STANDBY", "OFF"]}
    assert ended.summary["topside"]["commands_sent"] == [1, 2, 0, -1]
    assert ended.summary["topside"]["responses"] > 0


def test_both_sides_count_the_same(ended: Fieldtwin) -> None:
    for bus, row in ended.summary["exchanges"].items():
        gateway = {what: row["gateway"][what] for what in ("requests", "replies")}
        assert gateway == row["emulators"], bus
        assert gateway["replies"] > 0, bus


def test_every_published_value_was_held(ended: Fieldtwin) -> None:
    published = ended.summary["published"]
    assert published["checked"] > 100
    assert published["checked"] >= published["values"]  # some more while the run stops
    assert published["wrong"] == 0


def test_diagnostics_are_on_stderr_and_name_the_mapping(ended: Fieldtwin) -> None:
    json.loads(ended.out)  # the whole of stdout is one JSON document
    for plant, target in ended.summary["mapping"].items():
        assert f"{plant}  →  {target}" in ended.err
    assert "\x1b" not in ended.err + ended.out


def test_the_exchanges_of_active_times_are_stored(ended: Fieldtwin) -> None:
    with closing(sqlite3.connect(ended.root / "a" / "store.sqlite")) as db:
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert db.execute("SELECT system, prototype FROM run").fetchall() == [("observatory", 1)]
        rows = db.execute("SELECT tag, sequence, payload FROM exchange ORDER BY id").fetchall()
    assert len(rows) == ended.summary["logged"] > 2
    assert {tag for tag, _, _ in rows} == {"relay.log"}
    assert [sequence for _, sequence, _ in rows] == list(range(1, len(rows) + 1))
    entries = [json.loads(payload) for _, _, payload in rows]
    assert [e["t_ns"] for e in entries] == sorted(e["t_ns"] for e in entries)
    commands = [e["data"] for e in entries if e["kind"] == "command"]
    assert commands == ["0001", "0002"]  # without 0 and -1: nothing is logged in STANDBY and OFF
    samples = [e["data"] for e in entries if e["kind"] == "response"]
    assert samples
    assert {len(bytes.fromhex(s)) for s in samples} == {20}  # ten registers, unaltered
    assert ended.summary["topside"]["last_response"] in samples


def test_every_write_is_on_record(ended: Fieldtwin) -> None:
    entries = [json.loads(line) for line in (ended.root / "a" / "audit.jsonl").read_text().splitlines()]
    assert all(e["utc_ns"] > 10**18 and e["by"] and e["result"] for e in entries)
    writes = [e for e in entries if e["action"] == "write" and e["device"] == "ctd"]
    asked = [(e["by"], e["old"], e["new"]) for e in writes if e["result"] == "asked"]
    # The period 0 of the start is not among them, because the sensor already has it.
    assert [(by, new) for by, _, new in asked[:4]] == [("plc", 1), ("plc", 2), ("plc", 0), ("plc", -1)]
    assert [old for _, old, _ in asked[:4]] == [0, 1, 2, 0]
    assert asked[-1][2] == 0
    assert asked[-1][0].startswith("safe: ")
    done = [e["new"] for e in writes if e["result"] == "done"]
    assert done == [new for _, _, new in asked]
    boxes = [(e["tag"], e["result"]) for e in entries if e["device"] == "modem"]
    for tag in ("modem.inbox_ack", "modem.outbox"):
        assert boxes.count((tag, "asked")) == boxes.count((tag, "done")) > 0
    others = [(e["action"], e["by"]) for e in entries if e["device"] == "inclinometer"]
    assert others == [("sdo", "start-up"), ("nmt", "start-up"), ("nmt", "stop")]


def test_no_process_wrote_a_traceback(ended: Fieldtwin) -> None:
    no_tracebacks(ended.root)


def test_nothing_of_it_is_left(ended: Fieldtwin) -> None:
    left = {p.name for p in (ended.root / "a").iterdir()}
    assert not {name for name in left if name.endswith(".sock")}
    assert "line1" not in left  # the link of the virtual serial port


def test_files_are_the_owners_only(ended: Fieldtwin) -> None:
    def others(path: Path) -> int:
        return path.stat().st_mode & 0o077

    assert others(ended.root / "a") == 0
    assert others(ended.root / "a" / "audit.jsonl") == 0
    assert others(ended.root / "a" / "image") == 0


def test_the_plc_kept_its_cycle(ended: Fieldtwin) -> None:
    plc: dict[str, Any] = ended.summary["plc"]
    assert plc["state"] == "running"  # when last requested, before the end
    assert plc["scans"] > 500
    assert plc["error"] == ""
