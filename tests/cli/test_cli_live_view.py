"""The live view of a run, on a narrow and a low terminal and without one: no important text is cut, reasons are shown."""

from __future__ import annotations

from io import StringIO

import pytest
from msgspec import structs
from rich.console import Console
from statuses import gateway_status

from fieldtwin.cli.plc.views import Row, tag_table, value_text
from fieldtwin.cli.run.live_view import age_text, line, render
from fieldtwin.cli.run.troubles import interference, troubles
from fieldtwin.plc.status import PlcStatus, Spread
from fieldtwin.run.live.options import RunOptions
from fieldtwin.run.live.session import RunSession

NOBODY = "rtu:/dev/ttyS0?baudrate=19200&frame=8E1: cannot open the serial port: No such file or directory"
SILENT = "tcp://modem:502: unit 1: no reply within 2.0 s; expected unit 1, function 03h"


@pytest.fixture
def session() -> RunSession:
    """A run that was not started, with constructed answers of its gateway and PLC."""
    made = RunSession(RunOptions("observatory", prototype=False, duration_s=20))
    made.started_ns = made.clock.monotonic_ns()
    made.gateway_status = gateway_status(
        devices={
            "ctd": {"bus": "line1", "online": False, "error": NOBODY},
            "inclinometer": {"bus": "can0", "address": 5},
            "modem": {"bus": "lan", "online": False, "error": SILENT},
        },
        buses={
            "line1": {"error": NOBODY},
            "can0": {"counters": {"sdo_requests": 18, "sdo_replies": 17}},
            "lan": {"counters": {"requests": 123456, "replies": 123455}},
        },
        tags={
            f"{d.name}.{t.name}": {"value": 1.0 / 3, "quality": "uncertain", "reason": "not sampling", "age_s": 99.5}
            for d in made.system.devices.values()
            for t in d.profile.tags.values()
        },
        mailboxes={"modem": {"received": 1, "sent": 2, "taken": 1, "queued": 0}},
        plc={"alive": False},
        logged=5,
    )
    late: Spread = {"p50": 70.0, "p99": 2060.0, "max": 21270.0}
    made.plc_status = PlcStatus(cycle_ms=10.0, scans=707, missed_periods=2, state="running", lateness_us=late)
    return made


ALARM = {
    "state": "normal", "active": False, "quality": "good", "reason": "none", "priority": "low", "text": "",
    "condition": "a.b > 1", "acknowledge": True, "by": "", "in_state_s": None, "shelved_for_s": None,
}  # fmt: skip


def test_alarms_that_need_attention_are_shown_the_most_important_first(session: RunSession) -> None:
    session.gateway_status = gateway_status(
        alarms={
            "calm": ALARM,
            "level": ALARM | {"state": "active_unacknowledged", "text": "Open the drain", "in_state_s": 5.0},
            "fire": ALARM | {"state": "active_acknowledged", "priority": "critical", "by": "jo", "in_state_s": 180.0},
            "lost": ALARM | {"quality": "bad", "reason": "never_read"},
            "test": ALARM | {"state": "shelved"},
        }
    )
    rows = [text.split() for text in shown(session, 100)]
    listed = rows[rows.index(["alarm", "state", "quality", "priority", "for", "text"]) + 1 :][:4]
    assert [" ".join(row) for row in listed] == [
        "fire active acknowledged good critical 3 min (by jo)",
        "level active unacknowledged good low 5 s Open the drain",
        "lost normal bad (never read) low -",
        "test shelved good low -",
    ]
    assert "ALARMS=fire,level" in line(session)


def shown(session: RunSession, width: int, height: int = 60) -> list[str]:
    out = StringIO()
    console = Console(file=out, width=width, height=height, force_terminal=False)
    console.print(render(session))
    return out.getvalue().splitlines()


@pytest.mark.parametrize("width", [80, 140])
def test_it_fits_the_terminal_and_nothing_is_cut_off(session: RunSession, width: int) -> None:
    lines = shown(session, width)
    assert max(len(text) for text in lines) <= width
    text = " ".join(" ".join(lines).split())
    for wanted in (
        NOBODY,
        SILENT,
        "123456",
        "123455",
        "uncertain (not sampling)",
        "99.50 s",
        "0.333333",
        "max 21.27 ms",
    ):
        assert wanted in text
    assert "…" not in text


def test_a_low_terminal_still_shows_devices_scan_and_problems(session: RunSession) -> None:
    top = " ".join(" ".join(shown(session, 80)[:20]).split())
    for wanted in ("ctd", "inclinometer", "modem", "scan 10 ms", NOBODY, SILENT):
        assert wanted in top


def test_without_a_terminal_there_is_no_escape_and_one_line(session: RunSession) -> None:
    text = line(session)
    assert "\n" not in text
    assert "\x1b" not in text + "".join(shown(session, 80))
    for wanted in ("ctd=bad", "inclinometer=good", "tags_good=0/15", "requests=123474", "PLC LOST"):
        assert wanted in text


def test_a_paused_plc_and_forces_are_in_sight(session: RunSession) -> None:
    assert session.plc_status is not None
    assert interference(session) == []
    forces = {f"ctd.tag{n}": {"value": n / 3, "by": "ada" if n else "", "age_ms": 5.0} for n in range(8)}
    session.plc_status = structs.replace(session.plc_status, state="paused", forces=forces)
    assert line(session).endswith("PLC PAUSED FORCED=" + ",".join(f"ctd.tag{n}" for n in range(8)) + " PLC LOST")
    top = " ".join(" ".join(shown(session, 80)[:20]).split())
    assert "PAUSED: the PLC executes no program, its outputs keep their values" in top
    assert "FORCED: ctd.tag0 = 0, ctd.tag1 = 0.333333 by ada, " in top
    assert "and 2 more" in top


def test_every_trouble_is_named_once(session: RunSession) -> None:
    session.note_error("plc: ended with signal 9")
    assert troubles(session) == ["plc: ended with signal 9", f"line1: {NOBODY}", f"modem: {SILENT}"]
    assert session.plc_status is not None
    error = "program pump, pump.st:8: LogicError: division by zero"
    session.plc_status = structs.replace(session.plc_status, error=error)
    assert troubles(session)[-1] == "PLC: program pump, pump.st:8: LogicError: division by zero"
    session.gateway_status = session.plc_status = None
    assert troubles(session) == ["plc: ended with signal 9"]
    shown(session, 80)  # and nothing breaks if no process answers


def test_values_are_formatted_for_users() -> None:
    assert [value_text(v) for v in (None, 1.0 / 3, 5, "0042", True)] == ["-", "0.333333", "5", "0042", "True"]
    assert [age_text(a) for a in (None, 0.049, 99.5, 1234.5)] == ["-", "0.05 s", "99.50 s", "1234 s"]


def test_the_live_table_shows_the_name_of_a_value(session: RunSession) -> None:
    session.gateway_status = gateway_status(tags={"ctd.status": {"value": 7, "text": "FAULT", "age_s": 0.1}})
    assert any(text.startswith("ctd.status  7 (FAULT)") for text in shown(session, 80))


@pytest.mark.parametrize(
    ("value", "row", "text"),
    [
        (7, {"value_names": {"7": "FAULT"}}, "7 (FAULT)"),
        (True, {"value_names": {"1": "OPEN"}}, "True (OPEN)"),
        (5, {"value_names": {"7": "FAULT"}}, "5"),
        (1.5, {"value_names": {"1": "OPEN"}}, "1.5"),
        (None, {"value_names": {"1": "OPEN"}}, "-"),
        (1, {"words": {"1": "PUMPING"}}, "PUMPING"),
    ],
)
def test_plc_watch_shows_a_state_by_its_name_and_a_number_with_its_name(value: object, row: Row, text: str) -> None:
    whole = {"tag": "tank.pump", "value": value, "unit": "", "limits": None, "quality": "good", "reason": "none"}
    whole |= {"age_s": 0.1, "forced": None, "side": "input", "seen": {}, "words": {}, "value_names": {}}
    out = StringIO()
    Console(file=out, width=100).print(tag_table([whole | row]))
    assert text in [cell.strip() for cell in out.getvalue().splitlines()[1].split("  ")]
