"""How the gateway boots the nodes of a CAN bus: identity, DCF and its date, store, LSS, SYNC and TIME; and the errors it
survives.

In virtual time, against a small node of the tests.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from canopen_master_bus import MemoryEnd
from canopen_peer_node import PeerBus, PeerNode, closing
from canopen_slave_rig import BOOL, RICH, U16, var
from lss_slave import Slave
from modbus_virtual import VirtualLoop, run_virtually

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.devices.canopen_config import CanopenBusConfig, CanopenNodeConfig
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig, Heartbeat
from fieldtwin.gateway.protocols.canopen.boot import Configuration, ExpectedIdentity
from fieldtwin.gateway.protocols.canopen.configure import PdoConfig
from fieldtwin.gateway.protocols.canopen.eds.concise_dcf import Setting
from fieldtwin.gateway.protocols.canopen.lss.frames import LssAddress
from fieldtwin.gateway.protocols.canopen.pdo.mapping import PdoMapping
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.buses.canopen.canopen_bus import CanopenBus
from fieldtwin.gateway.runtime.tags import TagTable

PROFILE = load_profile(Path(__file__).parents[4] / "profiles" / "devices" / "inclinometer-cia410.yaml")
NODE = 5
WHO = LssAddress(0x11, 0x22, 0x33, 0x44)
SLOPES = [(0x6010, 0, 16), (0x6020, 0, 16)]


def u32(value: int) -> bytes:
    return value.to_bytes(4, "little")


def node(*, heartbeat_s: float = 0.1, serial: int = 0x44) -> PeerNode:
    """The inclinometer, mapped to TPDO1 and started by any master."""
    objects = {(0x1000, 0): u32(0x2019A), (0x1001, 0): b"\0", (0x1017, 0): b"\0\0", (0x1010, 1): u32(1)}
    objects |= {(0x1018, sub): u32(v) for sub, v in enumerate((0x11, 0x22, 0x33, serial), 1)} | {(0x1018, 0): b"\x04"}
    objects |= {(0x1020, 1): u32(0), (0x1020, 2): u32(0), (0x2000, 0): b"\x07", (0x2001, 3): b"\0\0"}
    objects |= {(0x1800, 0): b"\x05", (0x1800, 1): u32(0x185), (0x1800, 2): b"\xfe", (0x1800, 5): b"\0\0"}
    objects |= {(0x1A00, 0): b"\x02", (0x1A00, 1): u32(0x6010_0010), (0x1A00, 2): u32(0x6020_0010)}
    objects |= {(0x6010, 0): b"\x01\x00", (0x6020, 0): b"\x02\x00"}
    return PeerNode(NODE, objects, heartbeat_s=heartbeat_s)


DCF = Configuration((Setting(0x2000, 0, b"\x09"), Setting(0x2001, 3, b"\x34\x12")), date=(15000, 1234))


class Dated:
    """The clock of the loop, on a date. 0 is 1970."""

    def __init__(self, today_ns: int) -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        self._loop, self._today_ns = loop, today_ns

    def monotonic_ns(self) -> int:
        return self._loop.monotonic_ns()

    def utc_ns(self) -> int:
        return self._today_ns + self._loop.monotonic_ns()

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        await self._loop.sleep_until_ns(deadline_ns)


class Rig:
    def __init__(self, bus: CanopenBus, peers: PeerBus, tags: TagTable, audit: Path) -> None:
        self.bus, self.peers, self.tags, self._audit = bus, peers, tags, audit

    @property
    def status(self) -> Any:
        return self.bus.nodes[NODE]

    @property
    def peer(self) -> PeerNode:
        return self.peers.nodes[0]

    def quality(self, tag: str = "slope_long") -> tuple[str, str]:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        now = self.tags.current(f"incl.{tag}", loop.monotonic_ns())
        return str(now.quality), str(now.reason)

    def audit(self) -> list[str]:
        return [json.loads(line)["action"] for line in self._audit.read_text(encoding="utf-8").splitlines()]


@asynccontextmanager
async def rig(
    tmp_path: Path,
    peers: PeerBus,
    boot: CanopenNodeConfig | None = None,
    *,
    allow_writes: bool = True,
    bus: CanopenBusConfig | None = None,
    today_ns: int = 1_700_000_000_000_000_000,
    profile: DeviceProfile = PROFILE,
) -> AsyncIterator[Rig]:
    clock = Dated(today_ns)
    config = DeviceConfig(
        "incl", profile, "can0", NODE, heartbeat=Heartbeat(100, 350) if allow_writes else None, start=True,
        canopen=boot or CanopenNodeConfig(), poll={"values": 100},
    )  # fmt: skip
    tags = TagTable(clock)
    tags.declare([f"incl.{tag}" for tag in profile.tags], None)
    audit = AuditLog(tmp_path / "audit", clock)
    driver = CanopenDriver(config, tags, clock)
    wire = BusConfig("can0", Endpoint.parse("can:fieldtwin/h:1"), 0.05, 1, canopen=bus or CanopenBusConfig())
    canopen_bus = CanopenBus(wire, [driver], peers, clock, tags, audit, allow_writes)  # type: ignore[arg-type]
    try:
        async with closing(peers), Nursery() as nursery:
            nursery.start(canopen_bus.run(), "bus")
            await asyncio.sleep(0.001)
            yield Rig(canopen_bus, peers, tags, tmp_path / "audit")
    finally:
        audit.close()


def test_the_dcf_is_written_once_and_again_when_the_node_has_lost_it(tmp_path: Path) -> None:
    async def main() -> None:
        peers = PeerBus([node()])
        peers.nodes[0].power_on()
        async with rig(tmp_path, peers, CanopenNodeConfig(dcf="x.dcf", configuration=DCF)) as r:
            await asyncio.sleep(0.6)
            assert r.status.online
            written = [(0x2000, 0, "09"), (0x2001, 3, "3412"), (0x1020, 1, "983a0000"), (0x1020, 2, "d2040000")]
            assert r.peer.writes == [*written, (0x1017, 0, "6400")]
            assert r.peer.state == 0x05
            r.peer.power_off()  # and on again at once: no heartbeat is missed, only the boot-up shows it (CO-035)
            r.peer.power_on()
            await asyncio.sleep(0.01)
            assert r.status.boots == 1
            assert r.peer.writes == [*written, (0x1017, 0, "6400")] * 2
            assert r.peer.state == 0x05
            assert r.status.online

    run_virtually(main())


def test_a_node_that_holds_the_date_is_not_written_to_again(tmp_path: Path) -> None:
    async def main() -> None:
        boot = CanopenNodeConfig(configuration=Configuration(DCF.settings, DCF.date, store=True))
        async with rig(tmp_path, PeerBus([node()]), boot) as r:
            r.peer.power_on()
            await asyncio.sleep(0.6)
            assert r.peer.writes[4] == (0x1010, 1, b"save".hex())
            r.peer.writes.clear()
            r.peer.power_off()
            r.peer.power_on()
            await asyncio.sleep(0.01)
            assert r.status.online
            assert r.peer.writes == [(0x1017, 0, "6400")]  # the system file's heartbeat, and not that of the DCF

    run_virtually(main())


def test_a_node_that_runs_is_halted_before_its_configuration_changes(tmp_path: Path) -> None:
    async def main() -> None:
        peers = PeerBus([node(heartbeat_s=0.001)])
        peers.nodes[0].power_on()
        peers.nodes[0].command(1)  # a different master has started it already
        async with rig(tmp_path, peers, CanopenNodeConfig(configuration=DCF)) as r:
            await asyncio.sleep(0.6)
            assert [f.data for f in r.peers.sent if f.can_id == 0] == [bytes([0x80, NODE]), bytes([1, NODE])]

    run_virtually(main())


def test_an_object_that_the_node_refuses_is_reported_and_nothing_is_started(tmp_path: Path) -> None:
    async def main() -> None:
        wrong = Configuration((Setting(0x2FFF, 0, b"\x01"),))
        async with rig(tmp_path, PeerBus([node()]), CanopenNodeConfig(configuration=wrong)) as r:
            r.peer.power_on()
            await asyncio.sleep(0.6)
            assert not r.status.online
            assert "2FFFh:00 aborted with 06020000h" in r.status.error
            assert not [f for f in r.peers.sent if f.can_id == 0]

    run_virtually(main())


def test_another_identity_blocks_every_write_until_the_right_one_comes(tmp_path: Path) -> None:
    async def main() -> None:
        expected = ExpectedIdentity(device_type=0x2019A, vendor=0x11, serial=0x44)
        boot = CanopenNodeConfig(identity=expected, configuration=DCF)
        peers = PeerBus([node(serial=0x45)])
        async with rig(tmp_path, peers, boot) as r:
            r.peer.power_on()
            await asyncio.sleep(2)
            assert r.status.driver.identity_error == "serial: expected 44h, got 45h"
            assert "a different node answers" in r.status.error
            assert r.quality() == ("bad", "wrong device")
            assert peers.writes() == []
            assert r.audit() == []
            r.peer.power_off()
            r.peer.factory[(0x1018, 4)] = u32(0x44)
            r.peer.power_on()
            await asyncio.sleep(8)
            assert r.status.online
            assert r.status.driver.identity_error == ""

    run_virtually(main())


def test_a_node_missing_at_boot_is_waited_for(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, PeerBus([node()])) as r:
            await asyncio.sleep(20)
            assert "no reply" in r.status.error or "does not answer" in r.status.error
            assert r.quality() == ("bad", "timeout")
            requests = len(r.peers.sent)
            assert requests < 40  # it is asked less and less often
            r.peer.power_on()
            await asyncio.sleep(11)
            assert r.status.online
            assert r.peer.state == 0x05

    run_virtually(main())


def test_a_lost_heartbeat_makes_values_bad_at_once_and_is_recovered_from(tmp_path: Path) -> None:
    async def main() -> None:
        boot = CanopenNodeConfig(adopt_tpdos=True)
        async with rig(tmp_path, PeerBus([node()]), boot) as r:
            r.peer.power_on()
            await asyncio.sleep(0.5)
            r.peer.say(0x180, bytes.fromhex("D2040CFE"))
            await asyncio.sleep(0.001)
            assert r.tags.current("incl.slope_long", 0).value == 12.34
            r.peer.state = 0  # it hangs: it sends neither a boot-up nor anything else
            await asyncio.sleep(0.352)
            assert r.quality() == ("bad", "heartbeat lost")
            r.peer.state = 0x7F
            r.peer._next_beat()
            await asyncio.sleep(2)
            assert r.status.online
            assert r.peer.state == 0x05

    run_virtually(main())


def test_tpdos_come_from_the_node_or_from_its_dcf(tmp_path: Path) -> None:
    async def main(boot: CanopenNodeConfig, reads: bool) -> None:
        async with rig(tmp_path, PeerBus([node()]), boot, allow_writes=False) as r:
            r.peer.power_on()
            r.peer.command(1)
            await asyncio.sleep(0.6)
            assert r.status.online
            assert any(f.data[1:3] == b"\x00\x1a" for f in r.peers.sent) == reads
            (seen,) = r.status.driver.tpdos
            assert (seen.number, seen.cob_id, seen.tags, seen.frames) == (
                1,
                0x185,
                ("slope_long", "slope_lateral"),
                0,
            ), "never sent so far"
            r.peer.say(0x180, bytes.fromhex("D2040CFE"))
            await asyncio.sleep(0.001)
            assert r.tags.current("incl.slope_long", 0).value == 12.34
            assert r.tags.current("incl.slope_lateral", 0).value == -5.0
            assert seen.frames == 1
            assert r.peers.writes() == []

    from_dcf = (PdoConfig(1, 0x185, True, 254, 100, PdoMapping.of(SLOPES)),)
    run_virtually(main(CanopenNodeConfig(adopt_tpdos=True), True))
    run_virtually(main(CanopenNodeConfig(tpdos=from_dcf), False))


def test_a_tag_that_a_tpdo_maps_with_another_size_is_polled(tmp_path: Path) -> None:
    # A BOOLEAN may be mapped with 1 bit (7.4.8). It never got a value, and neither did a tag whose mapped size was wrong.
    (tmp_path / "inputs.eds").write_text(RICH + var("2F10", BOOL) + var("2F11", U16))
    (tmp_path / "inputs.yaml").write_text(
        "device: test/inputs\nsource: a test\nprotocol: canopen\neds: inputs.eds\ntags:\n"
        '  closed: {object: "2F10:00", type: bool}\n  level: {object: "2F11:00", type: uint16}\n'
    )
    bits = (PdoConfig(1, 0x185, True, 254, 100, PdoMapping.of([(0x2F10, 0, 1), (0x0001, 0, 7), (0x2F11, 0, 8)])),)

    async def main() -> None:
        inputs = node()
        inputs.factory |= {(0x2F10, 0): b"\0", (0x2F11, 0): b"\x34\x12"}
        boot, profile = CanopenNodeConfig(tpdos=bits), load_profile(tmp_path / "inputs.yaml")
        async with rig(tmp_path, PeerBus([inputs]), boot, allow_writes=False, profile=profile) as r:
            r.peer.power_on()
            r.peer.command(1)
            await asyncio.sleep(0.6)
            assert r.status.driver.pdo_tags == ["incl.closed"]
            assert r.tags.current("incl.level", 0).value == 0x1234
            for sent, value in ((b"\x01\x34", True), (b"\x00\x34", False)):
                r.peer.say(0x180, sent)
                await asyncio.sleep(0.001)
                assert r.tags.current("incl.closed", 0).value is value

    run_virtually(main())


def test_sync_and_time_are_produced_if_writing_is_allowed(tmp_path: Path) -> None:
    async def main(allow_writes: bool, expected: tuple[int, int]) -> None:
        wanted = CanopenBusConfig(sync_ms=100, sync_counter=4, time_ms=500)
        async with rig(tmp_path, PeerBus([node()]), allow_writes=allow_writes, bus=wanted) as r:
            await asyncio.sleep(1.05)
            syncs = [f.data for f in r.peers.sent if f.can_id == 0x80]
            assert syncs == [bytes([i % 4 + 1]) for i in range(expected[0])]
            assert len([f for f in r.peers.sent if f.can_id == 0x100]) == expected[1]
            if not allow_writes:
                assert r.peers.writes() == []

    run_virtually(main(True, (10, 2)))
    run_virtually(main(False, (0, 0)))


def test_a_computer_without_a_date_sends_no_time(tmp_path: Path) -> None:
    async def main() -> None:
        wanted = CanopenBusConfig(time_ms=500)
        async with rig(tmp_path, PeerBus([node()]), bus=wanted, today_ns=0) as r:
            await asyncio.sleep(1.05)
            assert not [f for f in r.peers.sent if f.can_id == 0x100]
            assert r.bus.not_produced == 2
            assert r.bus.connected

    run_virtually(main())


def test_a_node_id_is_given_over_lss_to_the_one_that_shall_have_it(tmp_path: Path) -> None:
    async def main() -> None:
        slaves = [Slave(WHO.parts), Slave((1, 1, 1, 1))]
        peers = PeerBus([node()])

        def lss(end: MemoryEnd, frame: CanFrame) -> None:
            if frame.can_id == 0x7E5:
                for slave in slaves:
                    before, reply = slave.node, slave.take(frame.data)
                    if reply is not None:
                        end.peer.feed(CanFrame(0x7E4, reply.ljust(8, b"\0")))
                    if slave.node != before == 0xFF:
                        peers.nodes[0].power_on()  # it boots under its node ID

        peers.listeners.append(lss)
        boot = CanopenNodeConfig(identity=ExpectedIdentity(serial=0x44), lss=WHO)
        async with rig(tmp_path, peers, boot) as r:
            await asyncio.sleep(3)
            assert [(s.node, s.stored) for s in slaves] == [(NODE, NODE), (0xFF, None)]
            assert r.status.online
            assert r.audit()[:1] == ["lss"]

    run_virtually(main())


def test_without_write_permission_there_is_no_lss(tmp_path: Path) -> None:
    async def main() -> None:
        peers = PeerBus([node()])
        async with rig(tmp_path, peers, CanopenNodeConfig(lss=WHO), allow_writes=False) as r:
            await asyncio.sleep(5)
            assert peers.sent
            assert peers.writes() == []
            assert r.audit() == []

    run_virtually(main())


def test_emergencies_are_kept(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, PeerBus([node()])) as r:
            r.peer.power_on()
            r.peer.say(0x80, bytes.fromhex("1081110000000000"))
            await asyncio.sleep(0.5)
            assert r.status.emcys == 1
            assert r.status.emcy_log.active == (0x8110,)
            assert r.status.emcy_log.entries[0].emcy.meaning == "CAN overrun (objects lost)"
            r.peer.command(0x82)
            await asyncio.sleep(0.001)
            assert r.status.emcy_log.active == ()  # it boots again; the history remains
            assert r.status.emcys == 1

    run_virtually(main())


def test_a_bus_that_vanishes_is_joined_again_and_its_nodes_brought_up(tmp_path: Path) -> None:
    async def main() -> None:
        peers = PeerBus([node()])
        async with rig(tmp_path, peers, CanopenNodeConfig(configuration=DCF)) as r:
            r.peer.power_on()
            await asyncio.sleep(0.6)
            assert r.status.online
            peers.gone = True
            assert peers.ours is not None
            peers.ours.feed_lost(ConnectionLost("bus-off"))
            await asyncio.sleep(0.01)
            assert not r.bus.connected
            assert "bus-off" in r.status.error
            assert r.quality() == ("bad", "unreachable")
            await asyncio.sleep(10)
            peers.gone = False
            await asyncio.sleep(6)
            assert r.status.online
            assert r.bus.opens == 2
            assert r.peer.state == 0x05

    run_virtually(main())
