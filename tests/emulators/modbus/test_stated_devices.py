"""Server properties in a profile: its cells, side effects of reading and writing them, functions without registers, and busy
times. Tested on a device without a recording, and on one that answers from a recording."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.emulators.codec import decode
from fieldtwin.emulators.emulator import EmulatedUnit
from fieldtwin.emulators.modbus.unit import ModbusUnit, UnitLimits
from fieldtwin.emulators.models.modbus.register_device import ProfileRegisters, add_own_functions
from fieldtwin.emulators.replay.profiled import ProfiledReplay
from fieldtwin.emulators.replay.replay import ExchangeReplay
from fieldtwin.emulators.stated import parts_of
from fieldtwin.gateway.core.connection import RS232Connection
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import RecordedExchange
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun
from fieldtwin.twin.site.data_files import data_root

PROFILE = """
device: mysite/tank
source: "made for a test"
protocol: modbus
numbering: sent
limits: {functions: [1, 3, 4, 5, 6, 8, 11, 12, 16, 17, 20, 21, 22, 23, 24, 43, 100]}
tags:
  level:   {at: "input:0", type: float32, unit: m}
  total:   {at: "holding:0", type: uint32, access: rw, scale: 0.1}
  reset:   {at: "holding:2", access: rw}
  key:     {at: "holding:3", access: wo}
  alarm:   {at: "holding:10"}
  mode:    {at: "holding:11", bits: [0, 3], access: rw, values: {0: "off", 2: "filling"}}
  ready:   {at: "holding:11", bits: [15, 15]}
  current: {at: "holding:12", scale_by: current_sf}
  current_sf: {at: "holding:13", type: int16}
  model:   {at: "holding:20", type: string, registers: 4}
  valve:   {at: "coil:7", type: bool, access: rw, poll: coils}
effects:
  - {written: reset, value: 1, sets: {total: 0, reset: 0}}
  - {read: alarm, sets: {alarm: 0}}
  - {written: key, sets: {alarm: 7}}
functions:
  calibrate: {code: 100, request: "55 AA", reply: "00", sets: {total: 12.5}}
server_id: "74 6B"
identification: {0: mysite, 1: TK-1, 2: "1.0", 128: "%s"}
files: {4: 20}
fifos: {0x04DE: [440, 4740]}
""" % ("x" * 240)
VALUES: dict[str, float | str] = {
    "level": 1.5,
    "total": 1000,
    "alarm": 3,
    "mode": "filling",
    "ready": 1,
    "current_sf": -2,
    "current": 3.21,
    "model": "TK",
    "valve": 1,
}


def profile_of(tmp_path: Path, text: str = PROFILE) -> DeviceProfile:
    path = tmp_path / "tank.yaml"
    path.write_text(text, encoding="utf-8")
    return load_profile(path)


def stated(tmp_path: Path) -> EmulatedUnit:
    profile = profile_of(tmp_path)
    limits = UnitLimits(functions=frozenset(profile.form.limits.functions or ()))
    bank = ProfileRegisters(profile, VALUES, 0)
    unit = EmulatedUnit(bank, profile, RS232Connection, (), limits, "tank", parts_of(profile))
    add_own_functions(unit, bank, profile)
    return unit


def ask(unit: ModbusUnit, request: str, now_ns: int = 0) -> str:
    reply = unit.respond(bytes.fromhex(request), now_ns)
    return "" if reply is None else reply.hex()


@pytest.mark.parametrize(
    ("request_hex", "reply_hex"),
    [
        ("04 0000 0002", "04043fc00000"),
        ("03 0000 0002", "030400002710"),  # 1000 by its scale
        ("03 000B 0001", "03028002"),  # two tags of one register
        ("03 000C 0002", "03040141fffe"),  # 3.21 by its scale factor
        ("03 0014 0004", "0308544b000000000000"),
        ("01 0007 0001", "010101"),
        ("03 0004 0001", "8302"),  # a gap
        ("03 0003 0001", "8302"),  # written only
        ("06 000A 0001", "8602"),  # read only
        ("06 0003 0001", "0600030001"),
        ("10 0000 0002 04 00000001", "1000000002"),
        ("16 0002 00F2 0025", "16000200f20025"),
        ("17 000A 0001 0002 0001 02 0009", "17020003"),
        ("0F 0007 0001 01 01", "8f01"),  # the function does not exist
        ("11", "1103746bff"),
        ("14 07 06 0004 0000 0002", "140605060000" + "0000"),
        ("18 04DE", "180006000201b81284"),
        ("2B 0E 03 00", "2b0e0383ff80" + "03" + "00066d7973697465" + "0104544b2d31" + "0203312e30"),  # more follows
        ("2B 0E 03 80", "2b0e0383000001" + "80f0" + "78" * 240),
        ("64 55AA", "6400"),
        ("64 55AB", "e403"),
        ("65", "e501"),
    ],
)
def test_a_device_without_a_recording(tmp_path: Path, request_hex: str, reply_hex: str) -> None:
    assert ask(stated(tmp_path), request_hex) == reply_hex


def test_side_effects_of_registers(tmp_path: Path) -> None:
    unit = stated(tmp_path)
    assert ask(unit, "06 0002 0002") == "0600020002"
    assert ask(unit, "03 0000 0003") == "0306000027100002", "another value does nothing"
    assert ask(unit, "06 0002 0001", 5) == "0600020001"
    assert ask(unit, "03 0000 0003") == "0306000000000000"
    assert ask(unit, "03 000A 0001") == "03020003"
    assert ask(unit, "03 000A 0001") == "03020000", "cleared by the read before"
    ask(unit, "06 0003 1234")
    assert ask(unit, "03 000A 0001") == "03020007"
    ask(unit, "64 55AA", 9)
    assert ask(unit, "03 0000 0002") == "03040000007d"
    bank = unit.bank
    assert isinstance(bank, ProfileRegisters)
    assert [(h.raw.hex(), h.t_ns) for h in bank.journal.since(0) if h.tag == "total"] == [
        ("00002710", 0),
        ("00000000", 5),
        ("0000007d", 9),
    ]


def test_a_recorded_device_behaves_as_its_profile_states(tmp_path: Path) -> None:
    recorded = [
        ("0300000003", "0306000027100000"),
        ("03000a0001", "03020003"),
        ("06 0002 0001", "06 0002 0001"),
        ("11", "1101ff"),
        ("08 000E 0000", "08 000E 1234"),
    ]
    replay = ExchangeReplay(
        RecordedExchange(0.0, 1, bytes.fromhex(asked), bytes.fromhex(said), 0.01) for asked, said in recorded
    )
    unit = ProfiledReplay(profile_of(tmp_path), replay, 1)
    assert ask(unit, "03 000A 0001") == "03020003"
    assert ask(unit, "03 000A 0001") == "03020000"
    assert ask(unit, "06 0002 0001") == "0600020001"
    assert ask(unit, "03 0000 0003") == "0306000000000000"
    assert ask(unit, "11") == "1101ff", "what was recorded goes first"
    assert ask(unit, "18 04DE") == "180006000201b81284"
    assert ask(unit, "65") == "e501"
    assert ask(unit, "08 000E 0000") == "08000e0008", "true to this wire, not to the recorded one"
    assert ask(unit, "08 000D 0000") == "08000d0001"
    assert ask(unit, "0B") == "0b00000008"  # executed, except the exception
    assert ask(unit, "08 0004 0000") == ""
    assert ask(unit, "03 000A 0001") == "", "listen-only"
    assert ask(unit, "08 0001 0000") == ""
    assert ask(unit, "03 000A 0001") == "03020000"


@pytest.mark.parametrize("recorded", [False, True])
def test_busy_as_stated(tmp_path: Path, recorded: bool) -> None:
    replay = ExchangeReplay([RecordedExchange(0.0, 1, bytes.fromhex("03000a0001"), bytes.fromhex("03020003"), 0.01)])
    unit: ModbusUnit = ProfiledReplay(profile_of(tmp_path), replay, 1) if recorded else stated(tmp_path)
    unit.be_busy_after(3, 100)
    replies = [ask(unit, "03 000A 0001", now_ns) for now_ns in (0, 1, 2, 3, 101, 102, 103, 104, 105)]
    assert [reply[:4] for reply in replies] == ["0302"] * 3 + ["8306"] * 2 + ["0302"] * 3 + ["8306"]
    assert unit.counters.busy == 3
    assert ask(unit, "08 0011 0000", 106) == "0800110003", "diagnostics still work"


def test_impossible_values_are_refused(tmp_path: Path) -> None:
    profile = profile_of(tmp_path)
    for values, told in (
        ({"depth": 1}, "no tag 'depth'"),
        ({"mode": "draining"}, "off, filling"),
        ({"level": "deep"}, "a number"),
        ({"model": 5}, "text"),
    ):
        with pytest.raises(FileInvalid, match=told):
            ProfileRegisters(profile, values, 0)


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        ("{read: alarm,", "{read: key,", "never read"),
        ("{written: key,", "{written: alarm,", "never written"),
        ("{read: alarm,", "{read: alarm, written: key,", "either `read`"),
        ("sets: {alarm: 0}", "sets: {model: 0}", "is text"),
        ("sets: {alarm: 0}", "sets: {nothing: 0}", "no tag 'nothing'"),
        ("24, 43", "24", "2Bh is not in"),
        ("{0: mysite, 1: TK-1,", "{0: mysite,", "objects 0, 1 and 2"),
        ("files: {4: 20}", "files: {4: 20000}", "10000"),
    ],
)
def test_impossible_statements_of_a_profile_are_refused(tmp_path: Path, before: str, after: str, told: str) -> None:
    assert before in PROFILE
    with pytest.raises(FileInvalid) as refused:
        profile_of(tmp_path, PROFILE.replace(before, after))
    assert told in str(refused.value)


SYSTEM = """
fieldtwin: 1
system: pump
buses:
  line1: {url: "rtu:/dev/ttyUSB0?baudrate=9600&frame=8N1"}
devices:
  tank: {profile: ./tank.yaml, bus: line1, unit: 1, poll: {values: {every_ms: 200}, coils: {every_ms: 500}}}
plc:
  programs:
    idle: {source: "python: idle_tank:Idle"}
"""
PROTOTYPE = """
prototype_of: pump.yaml
buses:
  line1: {listen: "pty:line1"}
devices:
  tank:
    model: profile
    values: {level: 1.5, total: 1000, mode: filling, current_sf: -2, current: 3.21, valve: 1, alarm: 3}
    identity: {model: TK}
    busy: {every: 20, for_ms: 150}
"""
IDLE = """
from fieldtwin.plc.program import Program


class Idle(Program):
    def execute(self, scan):
        pass
"""


def system(folder: Path, prototype: str) -> str:
    profile_of(folder)
    (folder / "pump.yaml").write_text(SYSTEM, encoding="utf-8")
    (folder / "pump.prototype.yaml").write_text(prototype, encoding="utf-8")
    (folder / "idle_tank.py").write_text(IDLE, encoding="utf-8")
    return str(folder / "pump.yaml")


def test_a_prototype_of_a_device_without_a_recording(tmp_path: Path) -> None:
    run = VirtualRun(VirtualOptions(system(tmp_path, PROTOTYPE), 10.0))
    run.run()
    summary = run.summary()
    assert run.errors == []
    assert summary["published"]["checked"] > 100
    assert summary["published"]["wrong"] == 0
    assert run.checks[""].gateway_status is not None
    tags = run.checks[""].gateway_status.tags
    assert {name.removeprefix("tank."): tag.value for name, tag in tags.items()} == {
        "level": 1.5,
        "total": 1000,
        "reset": 0,
        "alarm": 0,
        "mode": 2,
        "ready": 0,
        "current": pytest.approx(3.21),
        "current_sf": -2,
        "model": "TK",
        "valve": True,
    }
    assert run.checks[""].field_status is not None
    assert run.checks[""].field_status.devices["tank"].counters["exceptions"] > 3, "busy, and the gaps between its tags"


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        ("alarm: 3", "alarms: 3", "no tag 'alarms'"),
        ("mode: filling", "mode: full", "'tank': the value of 'mode'; expected off, filling"),
        ("every: 20", "every: 0", "1"),
        ("model: profile", "recording: tank.jsonl", "`model: profile`"),
    ],
)
def test_impossible_prototype_files_are_refused(tmp_path: Path, before: str, after: str, told: str) -> None:
    (tmp_path / "tank.jsonl").write_text("")
    assert told in why_not(system(tmp_path, PROTOTYPE.replace(before, after)))


def why_not(path: str) -> str:
    try:
        run = VirtualRun(VirtualOptions(path, 1.0))
        run.run()
    except FieldtwinError as e:
        return str(e)
    return " ".join(run.errors)


def test_registers_begin_with_a_value_in_their_range() -> None:
    # Defect: the unit ID of a simulated meter was 0, so that its shadow reported it as outside of 1 to 247.
    meter = load_profile(data_root() / "profiles" / "devices" / "eastron-sdm630.yaml")

    def held(values: dict[str, float | str], name: str) -> float:
        tag = meter.tags[name]
        bank = ProfileRegisters(meter, values, 0)
        cells = [bank.peek(tag.registers.table, at) for at in range(tag.registers.address, tag.registers.end)]
        return float(decode(cells, tag.type, tag.order))

    assert held({}, "unit_id") == 1
    assert held({"unit_id": 3}, "unit_id") == 3
    assert held({}, "demand_period") == 0, "0 is in its range"
