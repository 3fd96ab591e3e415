"""Outputs of a device that are a write group are written completely or not at all: on a serial line, on TCP and on a CAN bus.

Defect: in one scan a program requested 60 Hz, which is out of range, and started the drive: it was started at 20 Hz.
"""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from drive_station import PROTOTYPE, SYSTEM, TOO_FAST, written
from procs import fieldtwin, held_by, no_tracebacks, wait_for
from test_canopen_outputs_system import PROGRAM as WINCH
from test_canopen_outputs_system import PROTOTYPE as WINCH_PROTOTYPE
from test_canopen_outputs_system import SYSTEM as WINCH_SYSTEM

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun
from fieldtwin.twin.site.system import load_system

GROUPED = SYSTEM.replace("    safe: {run: 0}\n", "    write_groups: {drive: [speed, run]}\n")
LINE = GROUPED.replace("tcp://drive:502", "rtu:/dev/ttyS0?baudrate=115200")
ON_PTY = PROTOTYPE.replace("tcp://127.0.0.1:0", "pty:lan")
HALF_AN_HOUR_LATER = TOO_FAST.replace("speed := 60.0", "speed := SEL(pressure > 3.0, 60.0, 40.0)")
"""Request 60 Hz until the pressure is above 3 bar."""


@pytest.mark.long
@pytest.mark.parametrize(("system", "prototype"), [(GROUPED, PROTOTYPE), (LINE, ON_PTY)], ids=["TCP", "serial line"])
def test_a_modbus_drive_is_not_started_with_its_old_speed(tmp_path: Path, system: str, prototype: str) -> None:
    path = written(tmp_path, HALF_AN_HOUR_LATER, system=system, prototype=prototype)
    with fieldtwin(tmp_path, "run", str(path), "--prototype", "--instance", "g", "--json") as run:
        gateway, field = run.control("g", "gateway"), run.control("g", "field")
        wait_for(lambda: gateway("get")["refusals"]["counts"].get("group"), 15, "the start is held back")
        polls = gateway("get")["devices"]["drive"]["polls"]
        wait_for(lambda: gateway("get")["devices"]["drive"]["polls"] > polls + 5, 10, "it goes on reading")
        assert set(held_by(field, "drive", "run")) == {"0000"}
        assert set(held_by(field, "drive", "speed")) == {"41a00000"}  # 20 Hz, as at the start
        field("set", device="drive", tag="pressure", value=3.5)
        wait_for(lambda: held_by(field, "drive", "run")[-1] == "0001", 10, "the whole group is written")
        assert held_by(field, "drive", "speed")[-1] == "42200000"  # 40 Hz
        run.signal(signal.SIGINT)
        run.wait(10)
    by_cause = {(e["tag"], e["cause"]) for e in run.summary["refused"]}
    assert by_cause == {("drive.speed", "limit"), ("drive.run", "group")}
    (error,) = run.summary["errors"]
    assert error.startswith("drive.speed = 60 did not reach the device")
    no_tracebacks(tmp_path)


@pytest.mark.long
@pytest.mark.parametrize("by_rpdo", [True, False], ids=["in one RPDO", "over SDO"])
def test_a_canopen_drive_is_not_started_with_its_old_speed(tmp_path: Path, *, by_rpdo: bool) -> None:
    system = WINCH_SYSTEM.replace(
        "safe: {controlword: 2, target_velocity: 0}", "write_groups: {drive: [target_velocity, controlword]}"
    )
    if not by_rpdo:
        system = system.replace(",\n     rpdo1: {map: [controlword, target_velocity], event_ms: 200}", "")
    (tmp_path / "winch.yaml").write_text(system, encoding="utf-8")
    (tmp_path / "winch.prototype.yaml").write_text(WINCH_PROTOTYPE, encoding="utf-8")
    too_fast = WINCH.replace("self.target = 1500 if self.status & 0x6F == 0x27 else 0", "self.target = 2**40")
    (tmp_path / "winch_control.py").write_text(too_fast, encoding="utf-8")
    with fieldtwin(tmp_path, "run", str(tmp_path / "winch.yaml"), "--prototype", "--instance", "w", "--json") as run:
        gateway, field = run.control("w", "gateway"), run.control("w", "field")
        wait_for(lambda: gateway("get")["refusals"]["counts"].get("group"), 20, "the controlword is held back")
        wait_for(lambda: held_by(field, "io", "analogue_out_1"), 10, "other outputs are written")
        polls = gateway("get")["devices"]["drive"]["polls"]
        wait_for(lambda: gateway("get")["devices"]["drive"]["polls"] > polls + 2, 10, "it goes on reading")
        assert gateway("get")["tags"]["drive.controlword"]["value"] == 0
        assert set(held_by(field, "drive", "controlword")) <= {"0000"}
        run.signal(signal.SIGINT)
        run.wait(10)
    assert any(e.startswith(f"drive.target_velocity = {2**40} did not reach") for e in run.summary["errors"])
    no_tracebacks(tmp_path)


def test_without_a_group_the_drive_is_started_with_its_old_speed_and_the_run_is_not_ok(tmp_path: Path) -> None:
    run = VirtualRun(VirtualOptions(str(written(tmp_path, system=SYSTEM.replace("    safe: {run: 0}\n", ""))), 3.0))
    run.run()
    summary = run.summary()
    assert summary["tags"]["drive.run"]["value"] == 1
    assert summary["tags"]["drive.speed"]["value"] == 20.0
    assert not summary["ok"]


@pytest.mark.parametrize(
    ("groups", "told"),
    [
        ("{drive: [speed, pressure]}", "'pressure' is not an output of a program"),
        ("{drive: [speed, rnu]}", "did you mean 'run'"),
        ("{a: [speed, run], b: [run, speed]}", "is already in the group 'a'"),
        ("{a: [speed, speed]}", "is already in the group 'a'"),
        ("{drive: [speed]}", "at least 2"),
    ],
)
def test_a_group_that_means_nothing_is_refused_with_its_line(tmp_path: Path, groups: str, told: str) -> None:
    path = written(tmp_path, system=GROUPED.replace("{drive: [speed, run]}", groups))
    with pytest.raises(FileInvalid) as caught:
        load_system(str(path))
    assert told in str(caught.value)
    assert caught.value.line == 12
