"""A recorded CANopen node returns its recorded values, object by object, independent of the requests of the next client."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
from canopen_slave_rig import RICH, Rig

from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import NodeContext
from fieldtwin.emulators.context import EndOfRecording, UsedUp
from fieldtwin.emulators.replay.can_log import CanLog
from fieldtwin.emulators.replay.objects import RecordedObjects, recorded_objects
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.candump import read_lines
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.virtual import VirtualPrototype
from fieldtwin.twin.site.system import load_system

LOG = """\
(100.000000) can0 605#4018100400000000
(100.001000) can0 585#43181004EFBEADDE
(100.002000) can0 605#4004200000000000
(100.003000) can0 585#410420000A000000
(100.004000) can0 605#6000000000000000
(100.005000) can0 585#007265636F726465
(100.006000) can0 605#7000000000000000
(100.007000) can0 585#1964206F6B000000
(100.010000) can0 605#4006200000000000
(100.011000) can0 585#4B06200063000000
(100.012000) can0 605#2B06200064000000
(100.013000) can0 585#6006200000000000
(100.100000) can0 185#0A003412
(100.200000) can0 185#0A007856
(100.300000) can0 605#4002200000000000 R
(100.301000) can0 585#4B0220009A780000
(100.400000) can0 701#05
"""


def frames_of(lines: Iterable[str]) -> Iterator[tuple[int, CanFrame]]:
    return ((t_ns, frame) for t_ns, _, frame in read_lines(f"{line}\n".encode() for line in lines))


def recorded(policy: EndOfRecording = EndOfRecording.HOLD) -> tuple[Rig, RecordedObjects]:
    objects = RecordedObjects(frames_of(LOG.splitlines()), parse_eds(RICH), 5, policy)
    return Rig(RICH, NodeContext(source=objects, factory=objects.initial)), objects


def test_read_values_and_values_in_pdos() -> None:
    rig, objects = recorded()
    assert objects.duration_s == pytest.approx(0.4)
    assert rig.read(0x1018, 4) == 0xDEADBEEF
    assert rig.sdo("40 0420 00") == "410420000A000000"
    assert rig.read(0x2002) == 0x1234, "what a TPDO carried, asked by SDO"
    rig.advance(250)
    assert rig.nmt(1) == ["185#0A007856"], "and as a TPDO"
    rig.advance(100)
    assert rig.read(0x2002) == 0x789A
    rig.advance(10_000)
    assert rig.read(0x2002) == 0x789A, "holds"


def test_a_write_of_the_recorded_master_is_a_setting() -> None:
    rig, _ = recorded()
    assert rig.read(0x2006) == 0x63, "as it was before it was written"
    assert rig.write(0x2006, 0, 7, 2) == ""
    rig.advance(1000)
    assert rig.read(0x2006) == 7


def answered(values: str, policy: EndOfRecording = EndOfRecording.HOLD) -> Rig:
    """A log in which 2002h was uploaded once a second with these bytes, each time with a different object in between."""
    lines = []
    for second, value in enumerate(values.split()):
        for at, frame in enumerate(("605#4002200000000000", f"585#4B022000{value}000000", "605#4006200000000000")):
            lines.append(f"({100 + second}.{at:06d}) can0 {frame}")
        lines.append(f"({100 + second}.5) can0 585#4B06200063000000")
    objects = RecordedObjects(frames_of(lines), parse_eds(RICH), 5, policy)
    return Rig(RICH, NodeContext(source=objects, factory=objects.initial))


@pytest.mark.parametrize(("policy", "then"), [(EndOfRecording.HOLD, [3, 3]), (EndOfRecording.LOOP, [1, 2])])
def test_requested_values_answer_read_by_read_at_any_rate(policy: EndOfRecording, then: list[int]) -> None:
    rig = answered("01 02 02 03", policy)
    assert [rig.read(0x2002) for _ in range(4)] == [1, 2, 2, 3], "all at one instant"
    assert rig.read(0x2006) == 0x63, "each object on its own"
    assert [rig.read(0x2002) for _ in range(2)] == then


def test_requested_values_are_used_up() -> None:
    rig = answered("01 02", EndOfRecording.ERROR)
    rig.advance(100)
    assert [rig.read(0x2002), rig.read(0x2002)] == [1, 2]
    with pytest.raises(UsedUp, match="2002h:00"):
        rig.read(0x2002)


def test_a_request_that_was_always_aborted_is_aborted_again() -> None:
    aborted = ["(1.0) can0 605#4002200000000000", "(1.1) can0 585#8002200000000606"]
    at_times = ["(2.0) can0 605#4006200000000000", "(2.1) can0 585#8006200022000008", *aborted]
    log = [*LOG.splitlines()[:4], *at_times]
    objects = RecordedObjects(frames_of(log), parse_eds(RICH), 5)
    rig = Rig(RICH, NodeContext(source=objects, factory=objects.initial, refusals=objects.refusals))
    assert rig.sdo("40 0220 00") == "8002200000000606"
    assert rig.read(0x2006) == 7, "a state that the device was in is none of the object's"


def test_an_object_without_data_that_no_data_sheet_has_is_refused_as_recorded() -> None:
    """The emulated log of a node answered 06090011h for 1003h:01 where its device had answered "no data available"."""
    log = [*LOG.splitlines(), "(2.0) can0 605#4003F00100000000", "(2.1) can0 585#8003F00124000008"]
    objects = RecordedObjects(frames_of(log), parse_eds(RICH), 5)
    rig = Rig(RICH, NodeContext(source=objects, factory=objects.initial, refusals=objects.refusals))
    assert rig.sdo("40 03F0 01") == "8003F00124000008"


def test_a_log_of_the_same_device_under_another_node_id(tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    path.write_text(LOG + "(100.5) can0 605#4000180100000000\n(100.6) can0 585#4300180185010000\n", encoding="ascii")
    log = CanLog(path, speed=10)
    objects = recorded_objects(log, parse_eds(RICH), 9)
    assert (0x1800, 1) not in objects.initial, "its TPDO goes under the id that it has now"
    assert objects.initial[0x2006, 0] == b"\x63\x00"
    assert [objects(at_ms * 10**6)[0x2002, 0] for at_ms in (0, 15, 25)] == [b"\x34\x12", b"\x34\x12", b"\x78\x56"]
    path.write_text(LOG + "(100.5) can0 586#4300180186010000\n", encoding="ascii")
    with pytest.raises(UsageError, match="has no frames of node 9") as e:
        recorded_objects(log, parse_eds(RICH), 9)
    assert e.value.got == "node 5, node 6"
    with pytest.raises(FileInvalid, match="cannot read the log"):
        recorded_objects(CanLog(tmp_path / "none.log"), parse_eds(RICH), 5)


SYSTEM = """\
fieldtwin: 1
system: winch
buses: {can0: {url: "can:socketcan/can0", bitrate: 250000}}
devices:
  winch: {profile: encoder-cia406, bus: can0, node: 9, heartbeat: {producer_ms: 500, consumer_ms: 1500},
    poll: {values: {every_ms: 100}}, stale_after_ms: 5000, start: true}
plc: {cycle_ms: 50, programs: {idle: {source: idle.st, inputs: {}}}}
"""
PROTOTYPE = """\
prototype_of: winch.yaml
buses: {can0: {listen: "can:fieldtwin/127.0.0.1:0"}}
devices: {winch: {recording: winch.log}}
"""


def test_a_prototype_whose_node_is_a_log(tmp_path: Path) -> None:
    """A different gateway reads at its own rate, and gets the recorded values in order."""
    recorded_values = [-5, -6, -6, 7]
    lines = [f"({10 + at}.{half}) can0 {frame}" for at, value in enumerate(recorded_values) for half, frame in enumerate((
        "609#4009650000000000", f"589#43096500{value.to_bytes(4, 'little', signed=True).hex()}"
    ))]  # fmt: skip
    program = "PROGRAM Idle\nVAR n : INT; END_VAR\nn := n + 1;\nEND_PROGRAM\n"
    for name, text in {
        "winch.yaml": SYSTEM, "winch.prototype.yaml": PROTOTYPE, "idle.st": program, "winch.log": "\n".join(lines)
    }.items():  # fmt: skip
        (tmp_path / name).write_text(text, encoding="ascii")
    system = load_system(str(tmp_path / "winch.yaml"))
    loop = VirtualLoop()
    seen: list[object] = []

    async def main() -> None:
        async with VirtualPrototype(system, load_prototype(system), loop, tmp_path) as run:
            run.gateway.tags.subscribe(lambda name, value: seen.append(value.value) if name == "winch.offset" else None)
            await asyncio.sleep(1)

    loop.run_until_complete(main())
    loop.close()
    assert seen[:4] == recorded_values
    assert set(seen[4:]) == {7}


def test_a_log_is_for_nodes(tmp_path: Path) -> None:
    root = Path(__file__).parents[3] / "profiles" / "systems"
    text = (root / "observatory.prototype.yaml").read_text(encoding="utf-8").replace("cast.jsonl", "bus.log")
    (tmp_path / "bus.log").write_text(LOG, encoding="ascii")
    (tmp_path / "p.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(FileInvalid, match="a log of a CAN bus"):
        load_prototype(load_system(str(root / "observatory.yaml")), tmp_path / "p.yaml")


def test_at_the_end() -> None:
    rig, objects = recorded(EndOfRecording.LOOP)
    assert rig.read(0x2002) == 0x1234
    rig.advance(390)
    assert rig.read(0x2002) == 0x789A
    rig.advance(objects.duration_s * 1000)
    rig.advance(20)
    assert rig.read(0x2002) == 0x1234
    rig, _ = recorded(EndOfRecording.ERROR)
    assert rig.read(0x2002) == 0x1234
    rig.advance(500)
    with pytest.raises(UsedUp):
        rig.read(0x2002)
