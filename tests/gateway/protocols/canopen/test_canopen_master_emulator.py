"""Our master against our emulated node on the modelled bus, in virtual time: two implementations of one standard.

They share no protocol code. On this bus identical frames of several nodes are one, as LSS requires.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from canopen_master_bus import running
from canopen_slave_rig import RICH
from dcf_texts import TPDO1, record, var
from modbus_virtual import VirtualLoop, run_virtually

from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_runner import BusRunner
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import SdoAborted
from fieldtwin.gateway.protocols.canopen.boot import (
    Configuration,
    ExpectedIdentity,
    download_configuration,
    identity_differences,
)
from fieldtwin.gateway.protocols.canopen.cob_id import LSS_REPLY
from fieldtwin.gateway.protocols.canopen.configure import read_tpdos
from fieldtwin.gateway.protocols.canopen.eds.concise_dcf import Setting, decode_concise, encode_concise, settings_of
from fieldtwin.gateway.protocols.canopen.eds.dictionary import parse_dictionary
from fieldtwin.gateway.protocols.canopen.lss.master import LssMaster
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.nmt.states import NodeEvent
from fieldtwin.gateway.protocols.canopen.scan import scan_nodes

HERE = Endpoint.parse("can:fieldtwin/127.0.0.1:1")
DOMAIN_EDS = "[DeviceInfo]\nVendorName=x\n" + var("1000", 7, "ro", "0") + var("2000", 0xF, "rw")
DCF = (
    "[DeviceInfo]\nVendorName=x\n\n"
    + var("1000", 7, "ro", "0x2019A")
    + record("1018", [(5, "const", "4", ""), *((7, "ro", str(i), "") for i in range(1, 5))])
    + record("1020", [(5, "const", "2", ""), (7, "rw", "0", "15000"), (7, "rw", "0", "1234")])
    + TPDO1
    + "".join(
        v.replace("PDOMapping=0", "PDOMapping=1") for v in (var("2000", 5, "rw", "7"), var("2001", 6, "rw", "0", "5"))
    )
    + var("2002", 6, "rw", "0", "6").replace("PDOMapping=0", "PDOMapping=1")
)


class Bench:
    """A master and emulated nodes on one modelled bus."""

    def __init__(self, master: CanopenMaster, lss: LssMaster, nodes: list[CanopenNode], loop: VirtualLoop) -> None:
        self.master, self.lss, self.nodes, self.loop = master, lss, nodes, loop
        self.events: list[NodeEvent] = []
        master.on_event = self.events.append


@asynccontextmanager
async def bench(*nodes: CanopenNode, bitrate: int = 125_000) -> AsyncIterator[Bench]:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    runner = BusRunner(bitrate)
    ends = [runner.attach(HERE, f"node {i}") for i, _ in enumerate(nodes)]
    master = CanopenMaster(runner.attach(HERE, "master"), loop)
    lss = LssMaster(master.send, loop, reply_s=0.02)
    master.listen(LSS_REPLY, lss.on_reply)
    tasks = [asyncio.ensure_future(serve_node(end, node, loop)) for end, node in zip(ends, nodes, strict=True)]
    async with running(master):
        await asyncio.sleep(0.1)
        yield Bench(master, lss, list(nodes), loop)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


@pytest.mark.parametrize("size", [0, 1, 7, 8, 441, 442, 889, 890, 5000])
@pytest.mark.parametrize("block", [1, 127])
def test_block_transfers_in_both_directions(size: int, block: int) -> None:
    async def main() -> None:
        node = CanopenNode(parse_eds(DOMAIN_EDS, "x"), 5, NodeContext(sdo_block=block))
        async with bench(node, bitrate=1_000_000) as b:
            value = random.Random(size).randbytes(size)
            await b.master.sdo_download(5, 0x2000, 0, value, block=True)
            assert await b.master.sdo_upload(5, 0x2000, 0, block=True) == value
            assert await b.master.sdo_upload(5, 0x2000, 0) == value
            with pytest.raises(SdoAborted, match="06020000h"):
                await b.master.sdo_upload(5, 0x2FFF, 0, block=True)
            assert b.master.counters.sdo_timeouts == 0

    run_virtually(main())


def test_lss_finds_and_names_three_nodes_whose_replies_overlap() -> None:
    async def main() -> None:
        serials = (0x0102_0304, 0x0102_0305, 0xFFFF_FFFF)
        nodes = [
            CanopenNode(
                parse_eds(RICH, "x"), 255, NodeContext(lss=True, factory={(0x1018, 4): s.to_bytes(4, "little")})
            )
            for s in serials
        ]
        async with bench(*nodes, bitrate=1_000_000) as b:
            assert await b.lss.any_unconfigured()
            for number in (11, 12, 13):
                found = await b.lss.fastscan()
                assert found is not None
                assert found.serial in serials
                await b.lss.configure_node_id(number)
                await b.lss.switch_all(configuration=False)
                await asyncio.sleep(0.1)
            assert await b.lss.fastscan() is None
            assert sorted(n.node_id for n in nodes) == [11, 12, 13]
            assert sorted(e.node for e in b.events if e.kind == "boot-up") == [11, 12, 13]
            for node in nodes:
                held = await b.master.sdo_upload(node.node_id, 0x1018, 4)
                assert int.from_bytes(held, "little") in serials

    run_virtually(main())


def test_a_dcf_is_taken_by_the_node_and_known_by_its_date() -> None:
    async def main() -> None:
        settings = settings_of(parse_dictionary(DCF, 5, path="x.dcf"))
        settings = decode_concise(encode_concise(settings))
        configuration = Configuration(settings, (15000, 1234))
        as_delivered = "\n".join(line for line in DCF.splitlines() if not line.startswith("ParameterValue"))
        async with bench(CanopenNode(parse_eds(as_delivered, "x"), 5)) as b:
            assert await identity_differences(b.master, 5, ExpectedIdentity(0x2019A, 1, 2, 3, 4)) == {}
            wrong = await identity_differences(b.master, 5, ExpectedIdentity(vendor=9))
            assert wrong == {"vendor": "expected 9h, got 1h"}
            assert await download_configuration(b.master, 5, configuration)
            assert not await download_configuration(b.master, 5, configuration)
            assert await b.master.sdo_upload(5, 0x2001, 0) == b"\x05\0"
            (tpdo,) = await read_tpdos(b.master, 5)
            assert (tpdo.cob_id, tpdo.enabled, tpdo.event_ms) == (0x185, True, 100)
            assert str(tpdo.mapping) == "2001h:00/16 2002h:00/16"
            with pytest.raises(SdoAborted):
                await download_configuration(b.master, 5, Configuration((Setting(0x1000, 0, bytes(4)),)))

    run_virtually(main())


def test_the_scan_finds_emulated_nodes() -> None:
    async def main() -> None:
        nodes = [CanopenNode(parse_eds(DCF, "x"), n) for n in (2, 9)]
        async with bench(*nodes) as b:
            found = await scan_nodes(b.master, b.loop, nodes=range(1, 11), listen_s=0.1)
            assert [(f.node, f.answers) for f in found] == [(2, True), (9, True)]
            assert found[0].identity is not None
            assert found[0].identity.serial == 4

    run_virtually(main())
