"""Answers of an emulated device for registers that its profile does not name: exception 02, zero, or the written value.

Defect: the shipped eastron-sdm630 refused every read across a register without a tag, so drivers that read its first 80
registers at once failed. Its manual allows such reads, and states that a parameter that the meter lacks is zero.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.models.modbus.recorded_device import load_replay
from fieldtwin.emulators.models.modbus.register_device import ProfileRegisters
from fieldtwin.emulators.replay.profiled import ProfiledReplay
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile, resolve
from fieldtwin.gateway.core.files.yaml_file import parse

ROOT = Path(__file__).resolve().parents[3]
TEXT = """
device: test/gaps
source: "a test"
protocol: modbus
numbering: sent
{undeclared}
tags:
  first: {{at: "holding:0"}}
  second: {{at: "holding:4", access: rw}}
  secret: {{at: "holding:6", access: wo}}
"""


def profile(undeclared: str) -> DeviceProfile:
    return resolve(parse(TEXT.format(undeclared=f"undeclared: {undeclared}" if undeclared else ""), "gaps.yaml"))


def stated(undeclared: str) -> ModbusUnit:
    return ModbusUnit(ProfileRegisters(profile(undeclared), {"first": 7, "second": 9}, 0))


def asked(unit: ModbusUnit, pdu: str) -> str:
    reply = unit.respond(bytes.fromhex(pdu), 0)
    assert reply is not None
    return reply.hex(" ").upper()


@pytest.mark.parametrize("undeclared", ["", "exception"])
def test_undeclared_registers_are_refused_by_default(undeclared: str) -> None:
    unit = stated(undeclared)
    assert asked(unit, "03 0000 0005") == "83 02"
    assert asked(unit, "03 0004 0001") == "03 02 00 09"


@pytest.mark.parametrize("undeclared", ["zero", "hold"])
def test_a_read_across_undeclared_registers_gets_zeros_for_them(undeclared: str) -> None:
    unit = stated(undeclared)
    assert asked(unit, "03 0000 0005") == "03 0A 00 07 00 00 00 00 00 00 00 09"
    assert asked(unit, "03 FFFF 0001") == "03 02 00 00"
    assert asked(unit, "03 FFFF 0002") == "83 02"  # after the end of the table
    assert asked(unit, "03 0004 0003") == "83 02"  # 6 is declared, and cannot be read
    assert asked(unit, "04 0000 0001") == "84 02"  # a table without any tag does not exist


def test_only_a_device_that_holds_takes_writes_of_undeclared_registers() -> None:
    assert asked(stated("zero"), "06 0002 1234") == "86 02"
    unit = stated("hold")
    assert asked(unit, "06 0002 1234") == "06 00 02 12 34"
    assert asked(unit, "03 0001 0003") == "03 06 00 00 12 34 00 00"
    assert asked(unit, "10 0003 0003 06 0001 0002 0003") == "10 00 03 00 03"  # across a declared one that is writable
    assert asked(unit, "03 0003 0003") == "03 06 00 01 00 02 00 03"
    assert asked(unit, "06 0000 1234") == "86 02"  # declared, and read-only


def test_an_unknown_value_is_refused_with_its_line() -> None:
    with pytest.raises(FileInvalid, match="undeclared"):
        profile("nothing")


def recorded(name: str) -> ProfiledReplay:
    shipped = load_profile(ROOT / "profiles" / "devices" / f"{name}.yaml")
    return ProfiledReplay(shipped, *load_replay(shipped, ROOT / "recordings" / f"{name}.jsonl"))


def test_the_shipped_meter_answers_a_read_of_its_first_80_registers() -> None:
    unit = recorded("eastron-sdm630")
    whole = bytes.fromhex(asked(unit, "04 0000 0050"))
    assert whole[:2] == bytes([4, 160])
    assert whole[2 + 2 * 52 : 2 + 2 * 54] != b"\0\0\0\0"  # total power, 30053
    assert whole[2 + 2 * 36 : 2 + 2 * 38] == b"\0\0\0\0"  # no tag names 30037
    assert asked(unit, "04 0000 0052") == "84 03"  # 40 parameters at most
    assert asked(unit, "04 0001 0002") == "84 02"  # half a parameter
    assert asked(unit, "10 0024 0002 04 3F800000") == "90 02"


def test_a_device_without_the_option_still_refuses_unrecorded_registers() -> None:
    unit = recorded("renogy-rover")
    assert asked(unit, "03 0200 0001") == "83 02"
