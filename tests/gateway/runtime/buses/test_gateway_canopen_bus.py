"""A CAN bus of the gateway with an emulated node on the software bus: bring-up, loss, a wrong node, and read-only mode."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from gateway_canopen_rig import NODE, PROFILE, SDO_TO_NODE, rig
from support import eventually, run

from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import NotAllowed
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.config import CanopenBusConfig, DeviceConfig, Tpdo
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock


def test_a_node_is_identified_configured_and_started_and_its_values_come(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            r.plug_node()
            await eventually(lambda: r.quality("slope_long") == ("good", "none"))
            assert r.tags.current("incl.slope_long", 0).value == 12.34
            assert r.tags.current("incl.slope_lateral", 0).value == -5.0
            assert r.tags.current("incl.serial", 0).value == 1005
            assert r.status.online
            assert r.audit()[:2] == [("sdo", "start-up"), ("nmt", "start-up")]
            first_write = next(f for f in r.frames if f.can_id == SDO_TO_NODE and f.data[0] >> 5 == 1)
            serial_read = next(f for f in r.frames if f.can_id == SDO_TO_NODE and f.data[1:4] == b"\x18\x10\x04")
            assert r.frames.index(serial_read) < r.frames.index(first_write)  # its identity, before anything is written

    run(main())


def test_a_second_node_with_the_id_stays_an_error_of_the_device(tmp_path: Path) -> None:
    """Defect: the error was forgotten at the next bring-up, and a second reply after the next request was not detected."""

    async def main() -> None:
        async with rig(tmp_path) as r:
            other = r.server.attach("another node 5")
            r.plug_node()
            serial = bytes.fromhex("43181004")
            answered = False
            while not answered:
                frame = await other.recv()
                if frame.can_id == SDO_TO_NODE and frame.data[:4] == b"\x40" + serial[1:]:
                    answered = True
                    await other.send(CanFrame(0x580 + NODE, serial + (4711).to_bytes(4, "little")))
            await eventually(lambda: r.status.conflicts == 1)
            await eventually(lambda: r.status.online)
            assert "two replies to one request for 1018h:04" in r.status.conflict
            await other.aclose()

    run(main())


def test_a_second_sync_producer_is_noticed(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, canopen=CanopenBusConfig(sync_ms=50)) as r:
            other = r.server.attach("another producer")
            r.plug_node()
            await eventually(lambda: r.status.online)
            assert r.bus.sync_watch.verdict == ""
            await other.send(CanFrame(0x80))
            await eventually(lambda: "two producers" in r.bus.sync_watch.verdict)
            await other.aclose()

    run(main())


def test_duplicate_syncs_in_a_cycle_are_detected_by_a_gateway_that_produces_none(tmp_path: Path) -> None:
    """Without --allow-writes the gateway only listens, and the system file still gives the expected SYNC interval."""

    async def main() -> None:
        async with rig(tmp_path, allow_writes=False, canopen=CanopenBusConfig(sync_ms=50)) as r:
            await eventually(lambda: r.bus.connected)
            for number in range(20):
                r.bus.sync_watch.feed(b"", number * 25_000_000)
            assert "SYNC comes every 25 ms, and the communication cycle period is 50 ms" in r.bus.sync_watch.verdict

    run(main())


def test_values_without_a_tpdo_are_read_once(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, serial="") as r:
            r.plug_node(serial=4711)
            await eventually(lambda: r.quality("slope_long") == ("good", "none"))
            assert r.tags.current("incl.serial", 0).value == 4711

    run(main())


def test_a_node_that_restarts_is_configured_again(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            r.plug_node()
            await eventually(lambda: r.quality("slope_long") == ("good", "none"))
            ups = r.status.bring_ups
            await r.unplug_node()
            r.plug_node()  # boots in PRE-OPERATIONAL with its factory mapping
            await eventually(lambda: r.status.bring_ups > ups)
            await eventually(lambda: r.quality("slope_long") == ("good", "none"))
            assert r.status.boots >= 1

    run(main())


def test_a_lost_heartbeat_makes_the_values_bad_at_once_and_the_node_is_searched(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            r.plug_node()
            await eventually(lambda: r.quality("slope_long") == ("good", "none") and r.status.online)
            await r.unplug_node()
            loop = asyncio.get_running_loop()
            start = loop.time()
            await eventually(lambda: r.quality("slope_long")[0] == "bad")
            assert r.quality("slope_long") == ("bad", "heartbeat lost")
            assert loop.time() - start < 0.35  # well before the values would be stale
            assert not r.status.online
            await eventually(lambda: r.quality("slope_long") == ("bad", "timeout"))  # asked again: no answer
            asked = len([f for f in r.frames if f.can_id == SDO_TO_NODE])
            await eventually(lambda: len([f for f in r.frames if f.can_id == SDO_TO_NODE]) > asked)

    run(main())


def test_another_serial_number_blocks_every_write(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            r.plug_node(serial=7)
            await eventually(lambda: r.quality("slope_long") == ("bad", "wrong device"))
            assert r.status.driver.identity_error == "serial is 7"
            assert "a different node answers" in r.status.error
            assert r.audit() == []
            assert all(f.data[0] >> 5 != 1 for f in r.sent_by_gateway() if f.can_id == SDO_TO_NODE)  # no download
            assert not [f for f in r.frames if f.can_id == 0]  # no NMT
            await r.unplug_node()
            r.plug_node()
            await eventually(lambda: r.quality("slope_long") == ("good", "none"), within_s=10)

    run(main())


def test_without_permission_the_mapping_is_adopted_and_nothing_is_written(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, allow_writes=False) as r:
            node = r.plug_node()
            await eventually(lambda: r.status.online)
            assert r.quality("slope_long") == ("bad", "not operational")
            told = r.bus.device_statuses(0)["incl"].unstarted
            assert told == (
                "the node has sent no heartbeat and sends no TPDO with slope_long, slope_lateral; a read-only plant starts no "
                "node: another NMT master must start it"
            )
            operator = r.server.attach("operator")
            await operator.send(CanFrame(0, bytes([1, NODE])))  # the plant's own master does
            await eventually(lambda: r.quality("slope_long") == ("good", "none"))
            assert r.tags.current("incl.slope_long", 0).value == 12.34
            assert r.bus.device_statuses(0)["incl"].unstarted == ""
            await operator.aclose()
            uploads = [f.data[0] >> 5 for f in r.frames if f.can_id == SDO_TO_NODE]
            assert set(uploads) == {2}  # SDO uploads, and not one download
            assert r.audit() == []
            assert node.counters.nmt_commands == 1  # the operator's
            await r.bus.halt(0.2)
            assert [f.data for f in r.frames if f.can_id == 0] == [bytes([1, NODE])]

    run(main())


def test_a_read_only_plant_reads_tags_over_sdo_that_the_nodes_tpdo_does_not_carry(tmp_path: Path) -> None:
    """Defect: the mapping of `tpdo1` may not be written, so that no message brought the tag, and programs waited forever."""

    async def main() -> None:
        async with rig(tmp_path, allow_writes=False, serial="", tpdo1=Tpdo(("slope_long", "serial"), 20)) as r:
            r.plug_node()
            await eventually(lambda: r.quality("serial") == ("good", "none"))
            assert r.status.driver.unmapped == ("serial",)
            assert r.quality("slope_long")[0] == "bad"  # the node's TPDO carries it, and no master started the node
            first = r.tags.current("incl.serial", WallClock().monotonic_ns()).t_ns
            await eventually(lambda: r.tags.current("incl.serial", WallClock().monotonic_ns()).t_ns > first)
            uploads = [f.data[0] >> 5 for f in r.frames if f.can_id == SDO_TO_NODE]
            assert set(uploads) == {2}  # SDO uploads, and not one download

    run(main())


def test_on_the_way_out_nodes_that_we_started_are_stopped_even_without_a_record(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            r.plug_node()
            await eventually(lambda: r.quality("slope_long") == ("good", "none") and r.status.online)
            kept, r.bus._audit = r.bus._audit, AuditLog(Path("/dev/full"), WallClock())
            try:
                await r.bus.halt(0.5)
            finally:
                r.bus._audit.close()
                r.bus._audit = kept
            await eventually(lambda: r.quality("slope_long") == ("bad", "not operational"))
            assert bytes([0x80, NODE]) in [f.data for f in r.frames if f.can_id == 0]

    run(main())


def test_no_request_is_sent_after_halt(tmp_path: Path) -> None:
    """Defect: polls went on after the final counters were read, so a run ended with "the gateway counted 235 requests, the
    emulators 236".
    """

    async def main() -> None:
        async with rig(tmp_path, allow_writes=False, serial="", tpdo1=Tpdo(("slope_long", "serial"), 20)) as r:
            r.plug_node()
            await eventually(lambda: r.quality("serial") == ("good", "none"))
            await r.bus.halt(1.0)
            totals = r.bus.totals()
            assert totals["sdo_requests"] == totals["sdo_replies"] + totals["sdo_aborts"]
            with pytest.raises(AssertionError, match="not within"):
                await eventually(lambda: r.bus.totals()["sdo_requests"] > totals["sdo_requests"], within_s=1.0)

    run(main())


def test_a_bus_that_goes_away_is_joined_again(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            r.plug_node()
            await eventually(lambda: r.quality("slope_long") == ("good", "none"))
            port = r.server.bound
            sdo_before = r.bus.totals()["sdo_requests"]
            await r.unplug_node()
            await r.server.aclose()
            await eventually(lambda: not r.bus.connected)
            assert r.quality("slope_long") == ("bad", "unreachable")
            r.server = await SoftBusServer.open(port, 125_000, paced=False)
            try:
                r.plug_node()
                await eventually(lambda: r.quality("slope_long") == ("good", "none"), within_s=8)
                assert r.bus.opens == 2
                assert r.bus.totals()["sdo_requests"] > sdo_before
            finally:
                await r.unplug_node()
                await r.server.aclose()

    run(main())


def test_a_write_to_an_object_that_is_read_only_is_refused(tmp_path: Path) -> None:
    tags = TagTable(WallClock())
    driver = CanopenDriver(DeviceConfig("incl", PROFILE, "can0", NODE), tags, WallClock())
    for tag in ("slope_long", "nothing"):
        with pytest.raises(NotAllowed):
            driver.command(tag, 1)
