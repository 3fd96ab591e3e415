"""`fieldtwin check canopen`: our node passes every case; `canopen`'s LocalNode gets the documented verdicts."""

from __future__ import annotations

import asyncio
import tomllib
from pathlib import Path

import canopen
import pytest
from canopen_localnode import make_localnode
from canopen_slave_rig import NODE
from nodes_on_a_bus import LONG, Serve, local_node, on_bus, ours
from support import run

from fieldtwin.conformance.core.case import CasePlan, Impact
from fieldtwin.conformance.devices.canopen.session import CanopenOptions, check_canopen
from fieldtwin.conformance.devices.checked import Checked
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.gateway.connections.soft_bus import SoftBus
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import NotAllowed
from fieldtwin.results.model import Verdict

ALL = CasePlan(at_most=Impact.DISRUPT, has=frozenset({"object", "eds", "i-know"}))
MAY_WRITE = ((0x2000, 0), (0x2004, 0), (0x1017, 0))
KNOWN = tomllib.loads((Path(__file__).parents[2] / "vectors" / "check_localnode.toml").read_text())


@pytest.fixture
def eds(tmp_path: Path) -> Path:
    """The rig's data sheet; 2004h holds 20 bytes."""
    assert "twenty" in LONG
    path = tmp_path / "rig.eds"
    path.write_text(LONG)
    return path


def check(serve: Serve, eds: Path, plan: CasePlan = ALL) -> Checked:
    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> Checked:
        options = CanopenOptions(
            url, NODE, plan, eds=eds, may_write=MAY_WRITE, connector=net, clock=clock, timeout_s=0.1, boot_s=1.0
        )  # fmt: skip
        return await check_canopen(options)

    return on_bus(serve, use)


def not_passed(checked: Checked) -> dict[str, str]:
    return {r.case.id: f"{r.verdict.value}: {r.reason}" for r in checked.results if r.verdict is not Verdict.PASSED}


def test_our_emulated_node_passes_all_cases(eds: Path) -> None:
    checked = check(ours, eds)
    assert not_passed(checked) == {}
    assert len(checked.results) > 40
    assert checked.identity["serial number"] == "305419896 (12345678h)"
    assert checked.identity["name"] == "a node for tests"


@pytest.mark.skipif(canopen.__version__ != KNOWN["version"], reason="another version than the one that was looked at")
def test_localnode_gets_the_verdicts_that_are_known(eds: Path) -> None:
    checked = check(local_node, eds)
    found = not_passed(checked)
    assert found.pop("CO-041").startswith("failed: 0 heartbeats")  # they would come from a thread of python-can
    assert found == KNOWN["known"]


def test_nothing_is_sent_to_a_node_that_another_master_uses() -> None:
    heard: list[CanFrame] = []

    async def master(connection: CanConnection, clock: VirtualClock) -> None:
        connection.on_arrival = heard.append
        while True:
            await connection.send(CanFrame(0x600 + NODE, bytes.fromhex("4000100000000000")))
            await asyncio.sleep(0.1)

    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> None:
        with pytest.raises(NotAllowed, match="--share-bus"):
            await check_canopen(CanopenOptions(url, NODE, ALL, connector=net, clock=clock))

    on_bus(master, use)
    assert heard == []


@pytest.mark.interop
@pytest.mark.skipif(canopen.__version__ != KNOWN["version"], reason="another version than the one that was looked at")
def test_localnode_with_its_threads_on_the_software_bus(eds: Path) -> None:
    async def main() -> Checked:
        server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 125_000, paced=False)
        network, node, _ = make_localnode(LONG)
        network.bus = await asyncio.to_thread(SoftBus, server.bound.path)
        network.connect()
        try:
            plan = CasePlan(frozenset(["CO-001a", "CO-008a", "CO-008b", "CO-021", "CO-041"]), Impact.WRITE, ALL.has)
            options = CanopenOptions(
                str(server.bound), NODE, plan, eds=eds, may_write=MAY_WRITE, timeout_s=0.3, spacing_s=0.0
            )  # fmt: skip
            return await check_canopen(options)
        finally:
            await asyncio.to_thread(node.nmt.stop_heartbeat)
            await asyncio.to_thread(network.disconnect)
            await server.aclose()

    assert not_passed(run(main())) == {id: KNOWN["known"][id] for id in ("CO-001a", "CO-008b", "CO-021")}
