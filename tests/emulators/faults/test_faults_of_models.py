"""Value faults, and values set by the user, in devices with models: by a Modbus profile, the mailboxes of a modem, and
CANopen nodes with a log, with a model, or with a data sheet only."""

from __future__ import annotations

from pathlib import Path
from random import Random
from typing import Any

import pytest

from fieldtwin.emulators.canopen.eds.codec import decode as object_value
from fieldtwin.emulators.codec import decode
from fieldtwin.emulators.distortion import Distortions
from fieldtwin.emulators.faults.fault import Active, Aim
from fieldtwin.emulators.faults.registry import fault_class
from fieldtwin.emulators.modbus.bank import NoSuchAddress
from fieldtwin.emulators.models.canopen.emulated_node import EmulatedNode, emulated_node
from fieldtwin.emulators.models.modbus.distorted_registers import DistortedRegisters
from fieldtwin.emulators.models.modbus.mailbox_modem import ModemPair
from fieldtwin.emulators.models.modbus.register_device import ProfileRegisters
from fieldtwin.emulators.replay.can_log import CanLog
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.files.profile_file import load_profile

DEVICES = Path(__file__).parents[3] / "profiles" / "devices"
TANK = """
device: mysite/tank
source: "made for a test"
protocol: modbus
numbering: sent
tags:
  level:   {at: "input:0", type: float32}
  total:   {at: "holding:0", type: uint32, access: rw, scale: 0.1, offset: 5}
  alarm:   {at: "holding:10"}
  mode:    {at: "holding:11", bits: [0, 3]}
  ready:   {at: "holding:11", bits: [15, 15]}
  current: {at: "holding:12", scale_by: current_sf}
  current_sf: {at: "holding:13", type: int16}
  valve:   {at: "coil:7", type: bool}
effects: [{read: alarm, sets: {alarm: 0}}]
"""


def put(distortions: Distortions, name: str, tag: str, **said: Any) -> str:
    kind = fault_class(name)
    fault = kind(kind.form.model_validate(said))
    distortions.put_in(Active(f"{name} {tag}", fault, Aim(), Random(1), 0, None), tag)
    return f"{name} {tag}"


@pytest.fixture
def tank(tmp_path: Path) -> tuple[ProfileRegisters, DistortedRegisters]:
    (tmp_path / "tank.yaml").write_text(TANK)
    profile = load_profile(tmp_path / "tank.yaml")
    values: dict[str, float | str] = {"level": 1.5, "total": 1000, "alarm": 3, "mode": 2, "ready": 1, "current_sf": -2}
    bank = ProfileRegisters(profile, values, 0)
    return bank, DistortedRegisters(bank, bank.peek, profile, bank.journal)


def test_registers_of_a_model_hold_the_set_value_and_their_own_again(
    tank: tuple[ProfileRegisters, DistortedRegisters],
) -> None:
    bank, seen = tank
    ids = [
        put(seen.distortions, "set", "level", value=-2.5),
        put(seen.distortions, "drift", "total", per_s=10.0),
        put(seen.distortions, "set", "mode", value=9),
        put(seen.distortions, "set", "current", value=1.23),
        put(seen.distortions, "set", "valve", value=1),
    ]
    assert decode(list(seen.read("input", 0, 2, 0)), "float32") == -2.5
    assert list(seen.read("holding", 11, 1, 0)) == [0x8009]  # the other tag of that register is unchanged
    assert list(seen.read("holding", 12, 1, 0)) == [123]
    assert list(seen.read("coil", 7, 1, 0)) == [1]
    seen.read("holding", 0, 2, 0)
    # 995, and 20 more: 0.1 per second from 5 on
    assert decode(list(seen.read("holding", 0, 2, 2 * NS_PER_S)), "uint32") == 10150
    assert list(seen.read("holding", 1, 1, 2 * NS_PER_S)) == [10150]  # half of it
    bank.write("holding", 0, [0, 50], 3 * NS_PER_S)
    assert decode(list(seen.read("holding", 0, 2, 3 * NS_PER_S)), "uint32") == 350  # written values drift as well
    for id in ids:
        seen.distortions.take_away(id)
    assert decode(list(seen.read("holding", 0, 2, 4 * NS_PER_S)), "uint32") == 50
    assert [list(seen.read(*at, 4 * NS_PER_S)) for at in (("holding", 11, 2), ("coil", 7, 1))] == [[0x8002, 0], [0]]
    held = [h.raw.hex() for h in bank.journal.since(0) if h.tag == "mode"]
    assert held == ["8002", "8009", "8002"]  # the oracle has the values of the device


def test_a_read_of_a_distorted_tag_has_its_effects_once(tank: tuple[ProfileRegisters, DistortedRegisters]) -> None:
    _, seen = tank
    put(seen.distortions, "drift", "alarm", per_s=1.0)
    assert list(seen.read("holding", 10, 1, 0)) == [3]
    assert list(seen.read("holding", 10, 1, 5 * NS_PER_S)) == [5]  # 0 since it was read, plus five seconds of drift
    put(seen.distortions, "nan", "mode")
    assert list(seen.read("holding", 11, 1, 0)) == [0x8002]  # no bit pattern means "not a number"
    with pytest.raises(NoSuchAddress):
        seen.check_read("holding", 9, 1, 0)


def test_a_modems_counters_can_be_set() -> None:
    profile = load_profile(DEVICES / "modem-mailbox.yaml")
    near = ModemPair(profile, bytes_per_s=80, latency_s=1, loss=0, seed=1).near
    seen = DistortedRegisters(near, near.peek, profile, near.journal)
    at = profile.tags["link_state"].registers
    assert list(seen.read(at.table, at.address, at.count, 0)) == [1]
    id = put(seen.distortions, "set", "link_state", value=0)
    assert list(seen.read(at.table, at.address, at.count, 0)) == [0]
    seen.distortions.take_away(id)
    assert list(seen.read(at.table, at.address, at.count, 0)) == [1]


def node(tmp_path: Path, log: str = "", profile: str = "inclinometer-cia410") -> EmulatedNode:
    recording = None
    if log:
        (tmp_path / "x.log").write_text(log)
        recording = CanLog(tmp_path / "x.log")
    made = emulated_node(load_profile(DEVICES / f"{profile}.yaml"), 5, recording, 0)
    made.node.start(0)
    return made


def held(made: EmulatedNode, index: int, now_ns: int) -> float:
    """Return what an SDO client reads from an object of 16 bits."""
    request = CanFrame(0x605, b"\x40" + index.to_bytes(2, "little") + bytes(5), t_ns=now_ns)
    (reply,) = [f for f in made.node.feed(request, now_ns) if f.can_id == 0x585]
    assert reply.data[0] == 0x4B, reply
    return object_value(0x03, reply.data[4:6])


LOG = """
(1.000000) can0 605#4010600000000000
(1.001000) can0 585#4B106000D2040000
(2.000000) can0 605#4010600000000000
(2.001000) can0 585#4B106000D3040000
"""


def test_a_node_that_replays_a_log_holds_a_set_value(tmp_path: Path) -> None:
    made = node(tmp_path, LOG)
    assert held(made, 0x6010, 0) == 1234
    id = put(made.distortions, "set", "slope_long", value=-7.25)
    assert [held(made, 0x6010, 0), held(made, 0x6020, 0)] == [-725, 0]
    made.distortions.take_away(id)
    assert held(made, 0x6010, 0) == 1235
    assert [h.raw for h in made.journal.since(0) if h.tag == "slope_long"][-3:] == [
        b"\x2b\xfd",
        b"\xd2\x04",
        b"\xd3\x04",
    ]


def test_a_node_without_a_recording_holds_a_set_value_and_its_own_again(tmp_path: Path) -> None:
    made = node(tmp_path)
    before = held(made, 0x6010, 0)
    ids = [
        put(made.distortions, "set", "slope_long", value=3.0),
        put(made.distortions, "drift", "slope_long", per_s=1.0),
    ]
    assert held(made, 0x6010, 0) == 300
    assert held(made, 0x6010, 2 * NS_PER_S) == 500
    for id in ids:
        made.distortions.take_away(id)
    assert held(made, 0x6010, 3 * NS_PER_S) == before


def test_a_state_of_a_model_can_be_set_without_a_storm_of_events(tmp_path: Path) -> None:
    made = node(tmp_path, profile="drive-cia402")
    tags = load_profile(DEVICES / "drive-cia402.yaml").tags.values()
    tag = next(t.name for t in tags if t.object == (0x6041, 0))
    put(made.distortions, "set", tag, value=0x1234)
    sent = 0
    for ms in range(100):
        sent += len(made.node.tick(ms * 1_000_000))
        assert held(made, 0x6041, ms * 1_000_000) == 0x1234
    assert sent < 3
    made.distortions.take_away(f"set {tag}")
    assert held(made, 0x6041, NS_PER_S) == held(node(tmp_path, profile="drive-cia402"), 0x6041, NS_PER_S)
