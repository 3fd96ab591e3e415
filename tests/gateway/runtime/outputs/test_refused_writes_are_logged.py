"""Every refused write is in the audit log, also a client's write to a bad device; and the log cannot be flooded.

Defect: a client of `serve` wrote to a tag of a device that did not answer and got an exception; the audit log had no line.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from support import eventually, run
from test_serve_writes import rig

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.outputs.refusals import KEPT, RefusalCause, Refusals
from fieldtwin.gateway.wallclock import WallClock

CLOCK = WallClock()


def refused(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [e for e in entries if e["action"] == "refuse"]


def test_a_clients_write_to_a_bad_device_is_on_record(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a") as r:
            r.bus.field.unplug()
            await eventually(lambda: not r.bus.bus.connected)
            assert await r.refused(0, 9) == 4
            (entry,) = refused(r.audit)
            assert (entry["tag"], entry["new"], entry["cause"]) == ("d.level", 9, "away")
            assert entry["by"].startswith("127.0.0.1:")
            (told,) = r.writer.journal.since(0)
            assert (told.tag, told.value, told.fault, told.standing) == ("d.level", 9, "", False)

    run(main())


def test_a_clients_write_to_a_missing_tag_or_without_permission_is_recorded(tmp_path: Path) -> None:
    """The server itself refuses these: they concern no device and no tag."""

    async def main() -> None:
        async with rig(tmp_path / "a") as r:
            assert await r.refused(7, 9) == 2
            (entry,) = refused(r.audit)
            assert (entry["device"], entry["pdu"]) == ("hmi", "0600070009")
            assert entry["by"].startswith("127.0.0.1:")

    run(main())


def test_an_output_that_waits_for_a_device_is_reported_once_and_written_when_it_returns(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a") as r:
            r.bus.field.unplug()
            await eventually(lambda: not r.bus.bus.connected)
            r.writer.want("d.level", 9)
            await eventually(lambda: bool(r.writer.journal.since(0)))
            (told,) = r.writer.journal.since(0)
            assert (told.cause, told.fault, told.count) == (RefusalCause.AWAY, "", 1)
            r.bus.field.plugged = True
            await eventually(lambda: r.cells.peek("holding", 0) == 9)
            await eventually(lambda: not told.standing)

    run(main())


def journal(path: Path) -> tuple[Refusals, AuditLog]:
    audit = AuditLog(path, CLOCK)
    return Refusals(audit), audit


def test_a_program_that_asks_for_another_impossible_value_in_each_scan_floods_nothing(tmp_path: Path) -> None:
    kept, audit = journal(tmp_path / "a")
    for n in range(6000):  # a minute of scans
        kept.note("d", "d.speed", 100.0 + n, RefusalCause.LIMIT, "too fast", "plc", n * 10 * NS_PER_MS)
    kept.flush()
    audit.close()
    lines = [json.loads(line) for line in (tmp_path / "a").read_text(encoding="ascii").splitlines()]
    assert len(lines) <= 62  # one a second
    assert (
        sum(1 + line.get("more_refused_since", 0) for line in lines if line["result"] == "too fast")
        + sum(line["more_refused_since"] for line in lines if line["result"] == "the same again")
        == 6000
    )
    entries = kept.since(0)
    assert 1 < len(entries) <= 7  # it continues, and later readers see that
    assert sum(entry.count for entry in entries) == kept.total == 6000
    assert [e.standing for e in entries] == [False] * (len(entries) - 1) + [True]


def test_the_journal_keeps_the_newest_entries_and_counts_all(tmp_path: Path) -> None:
    kept, audit = journal(tmp_path / "a")
    for n in range(KEPT + 50):
        kept.note("d", f"d.tag{n}", 1.0, RefusalCause.LIMIT, "too fast", "plc", n * NS_PER_S)
    audit.close()
    entries = kept.since(0)
    assert (len(entries), entries[0].number, entries[-1].number) == (KEPT, 51, KEPT + 50)
    assert kept.status().faults["program"] == KEPT + 50


def test_an_entry_whose_line_is_being_looked_up_delays_the_later_ones(tmp_path: Path) -> None:
    kept, audit = journal(tmp_path / "a")
    kept.looks_up = True
    kept.note("d", "d.speed", 60.0, RefusalCause.LIMIT, "too fast", "plc", 0)
    kept.note("d", "d.level", 60.0, RefusalCause.AWAY, "away", "10.0.0.1:5", 0)
    assert kept.since(0) == []
    kept.placed(1, "pump", "pump.st:5")
    assert [(e.tag, e.place) for e in kept.since(0)] == [("d.speed", "pump.st:5"), ("d.level", "")]
    audit.close()


def test_a_full_disk_is_counted_and_the_write_is_refused_all_the_same() -> None:
    kept, audit = journal(Path("/dev/full"))
    kept.note("d", "d.speed", 60.0, RefusalCause.LIMIT, "too fast", "plc", 0)
    audit.close()
    assert (kept.unrecorded, len(kept.since(0))) == (1, 1)
