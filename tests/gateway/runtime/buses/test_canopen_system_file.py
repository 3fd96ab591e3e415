"""The keys of a system file for a CANopen node and its bus, executed on the software bus by the whole gateway, with an
emulated node.

In virtual time. Another node causes the errors on the bus: a reset, a disabled heartbeat, a removed node ID.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, cast

import msgspec
import pytest

from fieldtwin import scan_can_bus
from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.values import Quality
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtState
from fieldtwin.gateway.runtime.status import describe
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.virtual import VirtualPrototype
from fieldtwin.twin.site.system import load_system

DEVICES = Path(__file__).parents[4] / "profiles" / "devices"
NODE = 9
SYSTEM = """\
fieldtwin: 1
system: winch
buses: {can0: {url: "can:socketcan/can0", bitrate: 250000, sync: {period_ms: 100, counter: 10}, time_ms: 1000}}
devices:
  winch: {profile: winch.yaml, bus: can0, node: 9, heartbeat: {producer_ms: 100, consumer_ms: 350},
    identity: {device_type: 0x20196, vendor: 0, product: 0x406, revision: 0x10000, serial: SERIAL},
    dcf: winch.dcf, lss: true, tpdos: dcf, start: true, stale_after_ms: 2000}
plc: {cycle_ms: 50, programs: {idle: {source: idle.st, inputs: {}}}}
"""
PROTOTYPE = """\
prototype_of: winch.yaml
buses: {can0: {listen: "can:fieldtwin/127.0.0.1:0"}}
devices: {winch: {model: profile}}
"""
MORE = """
[1012]
ParameterName=COB-ID TIME
DataType=7
AccessType=rw
DefaultValue=0x80000100

[1019]
ParameterName=Synchronous counter overflow
DataType=5
AccessType=rw
DefaultValue=10

[1020]
ParameterName=Verify configuration
ObjectType=8
SubNumber=3

[1020sub0]
ParameterName=Highest
DataType=5
AccessType=const
DefaultValue=2

[1020sub1]
ParameterName=Date
DataType=7
AccessType=rw
DefaultValue=0
PARAMETER=15000

[1020sub2]
ParameterName=Time
DataType=7
AccessType=rw
DefaultValue=0
PARAMETER=1234

[2000]
ParameterName=Table
ObjectType=8
CompactSubObj=3
DataType=6
AccessType=rw
DefaultValue=7
"""
CONFIGURED = {(0x6001, 0): 4096, (0x2000, 1): 7, (0x2000, 2): 99, (0x1020, 1): 15000, (0x1020, 2): 1234}
DELIVERED = {(0x6001, 0): 8192, (0x2000, 1): 7, (0x2000, 2): 7, (0x1020, 1): 0, (0x1020, 2): 0}


class Rig:
    """The run, its node, another node on the bus, and every published value of the winch's position."""

    def __init__(self, run: VirtualPrototype, node: CanopenNode, other: CanConnection) -> None:
        self.run, self.node, self.other = run, node, other
        self.published: list[tuple[int, Quality]] = []

    @property
    def status(self) -> dict[str, Any]:
        found = describe(self.run.gateway, self.run.loop.now_ns).devices["winch"]
        return cast(dict[str, Any], msgspec.to_builtins(found))

    def holds(self) -> dict[tuple[int, int], int]:
        return {key: self.node.data.number(*key) for key in CONFIGURED}

    async def say(self, can_id: int, data: str) -> None:
        await self.other.send(CanFrame(can_id, bytes.fromhex(data).ljust(2 if can_id == 0 else 8, b"\0")))

    async def until_lost_and_found(self) -> None:
        """The position is bad when the heartbeat's 350 ms are over, whatever the TPDOs contain, and good again within 12 s."""
        self.published.clear()
        began_ns = self.run.loop.now_ns
        await asyncio.sleep(12)
        first_bad_ns = next(t_ns for t_ns, quality in self.published if quality is not Quality.GOOD)
        assert (first_bad_ns - began_ns) / 10**6 <= 360
        assert self.published[-1][1] is Quality.GOOD
        assert self.status["online"]


@asynccontextmanager
async def winch(tmp_path: Path, loop: VirtualLoop) -> AsyncIterator[Rig]:
    system = load_system(str(tmp_path / "winch.yaml"))
    async with VirtualPrototype(system, load_prototype(system), loop, tmp_path) as run:
        other = await run.net.open_can(next(iter(run.field.listening.values())), 250_000)
        node = run.field.devices["winch"].node
        assert node is not None
        rig = Rig(run, node, other)
        run.gateway.tags.subscribe(
            lambda name, value: rig.published.append((loop.now_ns, value.quality)) if name == "winch.position" else None
        )
        await asyncio.sleep(3)
        yield rig
        await other.aclose()


def files(tmp_path: Path, serial: int = 0) -> None:
    eds = (DEVICES / "encoder-cia406.eds").read_text(encoding="ascii") + MORE
    assert "LSS_Supported=0" in eds
    eds = eds.replace("LSS_Supported=0", "LSS_Supported=1")
    dcf = eds.replace("PARAMETER=", "ParameterValue=") + "\n[2000Value]\nNrOfEntries=1\n2=99\n"
    dcf = dcf.replace("DefaultValue=8192\n", "DefaultValue=8192\nParameterValue=4096\n", 1)
    profile = (DEVICES / "encoder-cia406.yaml").read_text(encoding="utf-8").replace("encoder-cia406.eds", "winch.eds")
    program = "PROGRAM Idle\nVAR n : INT; END_VAR\nn := n + 1;\nEND_PROGRAM\n"
    for name, text in {
        "winch.yaml": SYSTEM.replace("SERIAL", str(serial)), "winch.prototype.yaml": PROTOTYPE, "idle.st": program,
        "winch.dcf": dcf, "winch.eds": eds.replace("PARAMETER=", "Denotation="),
    }.items():  # fmt: skip
        (tmp_path / name).write_text(text, encoding="utf-8")
    (tmp_path / "winch-profile.yaml").write_text(profile, encoding="utf-8")
    system = (
        (tmp_path / "winch.yaml")
        .read_text(encoding="utf-8")
        .replace("profile: winch.yaml", "profile: winch-profile.yaml")
    )
    (tmp_path / "winch.yaml").write_text(system, encoding="utf-8")


@pytest.fixture
def loop() -> Any:
    loop = VirtualLoop()
    yield loop
    loop.close()


def test_a_node_is_booted_configured_and_kept_so(tmp_path: Path, loop: VirtualLoop) -> None:
    async def main() -> None:
        async with winch(tmp_path, loop) as rig:
            assert rig.status["online"], rig.status
            assert rig.holds() == CONFIGURED
            assert rig.node.counters.syncs > 20, "SYNC, with the counter that it is told to expect"
            assert rig.node.time_of_day(loop.now_ns) is not None
            assert rig.status["tpdos"]["1"]["frames"] > 0
            boots = rig.status["boots"]

            await rig.say(0x000, "81 09")  # reset by a different master: an unexpected boot-up
            await asyncio.sleep(0.001)
            assert rig.holds() == DELIVERED
            await asyncio.sleep(3)
            assert rig.status["boots"] == boots + 1
            assert rig.holds() == CONFIGURED

            await rig.say(0x609, "2B 17 10 00 00 00 00 00")  # its heartbeat is disabled
            await rig.until_lost_and_found()

            await rig.say(0x000, "02 09")  # it is stopped, its node ID is removed, and it is reset
            for frame in ("04 01", "11 FF", "17"):
                await rig.say(0x7E5, frame)
            await rig.say(0x000, "82 09")
            await asyncio.sleep(0.02)
            assert rig.node.node_id == 255
            await rig.until_lost_and_found()
            assert rig.node.node_id == NODE
            assert rig.holds() == CONFIGURED

    files(tmp_path)
    loop.run_until_complete(main())


def test_nodes_on_the_bus(tmp_path: Path, loop: VirtualLoop) -> None:
    async def main() -> None:
        async with winch(tmp_path, loop) as rig:
            told: list[int] = []
            (found,) = await scan_can_bus(
                str(rig.other.endpoint), nodes=range(8, 11), listen_s=0.3, on_progress=told.append,
                connector=rig.run.net, clock=rig.run.clock,
            )  # fmt: skip
            assert (found.node, found.state, found.answers) == (NODE, NmtState.OPERATIONAL, True)
            assert found.identity is not None
            assert (found.identity.product, found.identity.revision) == (0x406, 0x10000)
            assert told == [8, 9, 10]
            assert rig.status["online"], "the plant does not feel it"
        with pytest.raises(UsageError, match="nodes are on a CAN bus"):
            await scan_can_bus("tcp://127.0.0.1:502")

    files(tmp_path)
    loop.run_until_complete(main())


def test_a_node_with_a_different_identity_is_not_touched(tmp_path: Path, loop: VirtualLoop) -> None:
    async def main() -> None:
        async with winch(tmp_path, loop) as rig:
            assert "serial" in rig.status["identity_error"]
            assert rig.holds() == DELIVERED
            assert rig.published[-1][1] is not Quality.GOOD

    files(tmp_path, serial=17)
    loop.run_until_complete(main())
