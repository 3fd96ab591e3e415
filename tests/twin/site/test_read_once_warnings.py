"""A measured value without a poll period is read only once, so that it stays good while the device changes or is lost."""

from __future__ import annotations

from pathlib import Path

from fieldtwin.twin.site.system import load_system

PROFILE = """
device: mysite/transmitter
source: "made for a test"
protocol: modbus
tags:
  temperature: {at: 30001, type: int16}
  pressure:    {at: 30002}
  setpoint:    {at: 40001, access: rw}
  unit_id:     {at: 40002, access: rw, poll: setup}
  fault:       {at: 10001, type: bool, poll: alarms}
"""
SYSTEM = """
fieldtwin: 1
system: cold
buses:
  line1: {url: "rtu:/dev/ttyUSB0?baudrate=9600&frame=8N1"}
devices:
  room: {profile: ./transmitter.yaml, bus: line1, unit: 1, writable: [setpoint]%s}
"""


def warnings(folder: Path, more: str) -> list[str]:
    (folder / "transmitter.yaml").write_text(PROFILE)
    (folder / "cold.yaml").write_text(SYSTEM % more)
    return [text.replace(str(folder), "") for text in load_system(str(folder / "cold.yaml")).warnings]


def test_each_poll_group_without_a_period_gives_one_warning(tmp_path: Path) -> None:
    found = warnings(tmp_path, "")
    assert [text.split(": ", 1)[1] for text in found[1:]] == [
        "room.temperature and 1 more are read only once, after connecting: the poll group 'values' has no period; "
        "expected `values: {every_ms: 1000}` in `poll` of room",
        "room.fault is read only once, after connecting: the poll group 'alarms' has no period; "
        "expected `alarms: {every_ms: 1000}` in `poll` of room",
    ]
    assert "room.setpoint may be written but is never read back" in found[0]


def test_a_polled_group_gives_none(tmp_path: Path) -> None:
    assert not warnings(tmp_path, ", poll: {values: {every_ms: 1000}, alarms: {every_ms: 1000}}")
    (left,) = warnings(tmp_path, ", poll: {values: {every_ms: 1000}}")
    assert "room.fault is read only once" in left
