"""A run as a service: events from changes, their form in the journal and in JSON, and notifications to systemd."""

from __future__ import annotations

import io
import json
import os
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from msgspec import structs
from statuses import changed
from test_service_metrics import busy_gateway, plc_status, seen

from fieldtwin.plc.status import ChangesStatus
from fieldtwin.service.events import Priority, ServiceEvent, changes
from fieldtwin.service.journal import EventLog, datagram
from fieldtwin.service.notify import Notifier


def names(events: list[ServiceEvent]) -> list[str]:
    return [event.name for event in events]


def quiet(**others: Any) -> Any:
    gateway = changed(busy_gateway(), writes={"safe": False}, log_dropped=0)
    return seen(gateway=gateway, plc=plc_status(), **others)


def test_no_change_gives_no_event() -> None:
    assert changes(quiet(), quiet()) == []


def test_a_change_is_reported_once() -> None:
    before, after = quiet(), quiet()
    assert after.gateway is not None
    assert after.plc is not None
    gateway = changed(
        after.gateway,
        devices={"ctd0": {"online": False, "error": "no reply"}, "tilt": {"online": True, "emcy": ["8130h"]}},
        buses={"line1": {"connected": False, "error": "no such device"}},
        writes={"safe": True},
        log_dropped=4,
        config={"reloads": 4},
    )
    after = replace(after, gateway=gateway, plc=structs.replace(after.plc, state="stopped", error="division by zero"))
    told = changes(before, after)
    assert names(told) == [
        "bus_closed",
        "device_offline",
        "device_online",
        "device_emcy",
        "plc_state",
        "reloaded",
        "log_dropped",
        "outputs_safe",
    ]
    assert told[1].fields == {"device": "ctd0", "bus": "line1", "error": "no reply"}
    assert told[4].priority is Priority.ERROR
    assert told[5].message == "reloaded: devices.ctd0.poll.values.every_ms: 500 -> 250"
    assert changes(after, after) == []


def test_programs_that_were_replaced_are_an_event() -> None:
    before, after = quiet(), quiet()
    assert after.plc is not None
    replaced = structs.replace(after.plc, changes=ChangesStatus(count=1, last=["plc.programs.pump: new: n"]))
    [told] = changes(before, replace(after, plc=replaced))
    assert (told.name, told.priority, told.fields) == ("reloaded", Priority.NOTICE, {"count": 1})
    assert told.message == "reloaded: plc.programs.pump: new: n"
    assert changes(replace(after, plc=replaced), replace(after, plc=replaced)) == []


def test_a_process_that_ended_is_an_error() -> None:
    gone = quiet(children={"gateway": False, "plc": True})
    assert [(e.name, e.priority) for e in changes(quiet(), replace(gone, gateway=None))] == [
        ("process_ended", Priority.ERROR)
    ]


EVENT = ServiceEvent(Priority.WARNING, "device_offline", "ctd: no reply", {"device": "ctd", "error": "two\nlines"})


def test_events_are_written_as_json_lines() -> None:
    out = io.StringIO()
    EventLog("json", "observatory", lambda: 1_500_000_000, out).write(EVENT)
    assert json.loads(out.getvalue()) == {
        "t": "1970-01-01T00:00:01.500+00:00",
        "priority": 4,
        "event": "device_offline",
        "system": "observatory",
        "message": "ctd: no reply",
        "device": "ctd",
        "error": "two\nlines",
    }


def parsed(entry: bytes) -> dict[str, str]:
    """A reader of the journal's native protocol, written from its specification."""
    fields = {}
    while entry:
        line, _, rest = entry.partition(b"\n")
        name, equals, text = line.partition(b"=")
        if equals:
            fields[name.decode()], entry = text.decode(), rest
        else:
            size = int.from_bytes(rest[:8], "little")
            fields[name.decode()], entry = rest[8 : 8 + size].decode(), rest[8 + size + 1 :]
    return fields


def test_the_journal_gets_fields(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journal:
        journal.bind(str(tmp_path / "j"))
        out = io.StringIO()
        log = EventLog("journal", "observatory", lambda: 0, out, str(tmp_path / "j"))
        log.write(EVENT)
        log.close()
        assert parsed(journal.recv(65536)) == {
            "MESSAGE": "ctd: no reply",
            "PRIORITY": "4",
            "SYSLOG_IDENTIFIER": "fieldtwin",
            "FIELDTWIN_SYSTEM": "observatory",
            "FIELDTWIN_EVENT": "device_offline",
            "FIELDTWIN_DEVICE": "ctd",
            "FIELDTWIN_ERROR": "two\nlines",
        }
    assert out.getvalue() == ""


def test_without_a_journal_it_is_json(tmp_path: Path) -> None:
    out = io.StringIO()
    log = EventLog("journal", "observatory", lambda: 0, out, str(tmp_path / "nobody"))
    log.write(EVENT)
    log.close()
    assert json.loads(out.getvalue())["event"] == "device_offline"
    assert log.lost == 1


def test_a_field_of_the_journal_cannot_be_forged() -> None:
    assert parsed(datagram({"MESSAGE": "a\nPRIORITY=0", "X": "y"})) == {"MESSAGE": "a\nPRIORITY=0", "X": "y"}


@pytest.fixture
def systemd(tmp_path: Path) -> Any:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(2)
        yield listening


def test_systemd_is_notified(systemd: socket.socket) -> None:
    environment = {"NOTIFY_SOCKET": systemd.getsockname(), "WATCHDOG_USEC": "3000000", "WATCHDOG_PID": str(os.getpid())}
    notifier = Notifier.from_environment(environment)
    assert environment == {}  # no child process sends notifications in our name
    assert notifier.watchdog_s == 3.0
    notifier.ready("up\nand running")
    notifier.alive("fine")
    notifier.reloading(5_000_000)
    notifier.stopping()
    told = [systemd.recv(4096).decode() for _ in range(4)]
    assert told == [
        "READY=1\nSTATUS=up and running",
        "WATCHDOG=1\nSTATUS=fine",
        "RELOADING=1\nMONOTONIC_USEC=5000",
        "STOPPING=1",
    ]
    notifier.close()
    notifier.alive("late")  # nothing, and no error


@pytest.mark.parametrize(
    "environment",
    [{}, {"NOTIFY_SOCKET": "vsock:2:1"}, {"WATCHDOG_USEC": "3000000"}],
)
def test_without_systemd_nothing_is_sent(environment: dict[str, str]) -> None:
    notifier = Notifier.from_environment(environment)
    assert not notifier.wanted
    notifier.ready("up")


def test_a_watchdog_meant_for_another_process_is_not_ours(systemd: socket.socket) -> None:
    said = {"NOTIFY_SOCKET": systemd.getsockname(), "WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "1"}
    notifier = Notifier.from_environment(said)
    assert notifier.watchdog_s == 0
    notifier.close()


def test_a_systemd_that_went_away_is_counted(tmp_path: Path) -> None:
    notifier = Notifier(str(tmp_path / "gone"))
    notifier.ready("up")
    assert notifier.lost == 1
    notifier.close()
