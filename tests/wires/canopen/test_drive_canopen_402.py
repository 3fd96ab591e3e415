"""The emulated drive with a third-party client: the `canopen` package's CiA 402 state machine, over the software bus."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from pathlib import Path

import canopen
from canopen.profiles.p402 import BaseNode402
from support import run

from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.models.canopen.emulated_node import emulated_node
from fieldtwin.gateway.connections.soft_bus import SoftBus
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.wallclock import WallClock

PROFILE = load_profile(Path(__file__).parents[3] / "profiles" / "devices" / "drive-cia402.yaml")
NODE, EVENT_MS = 7, 20


def drive_it(host: str, port: int) -> list[str]:
    """Run a user's script; return the states that it saw. Blocking."""
    network = canopen.Network(SoftBus(f"{host}:{port}"))
    network.connect()
    try:
        node = BaseNode402(NODE, str(PROFILE.eds_path))
        network.add_node(node)
        for pdo in range(4):  # this client needs TPDOs without a request
            node.sdo[0x1800 + pdo][5].raw = EVENT_MS
        node.nmt.state = "PRE-OPERATIONAL"
        node.setup_402_state_machine()
        node.nmt.state = "OPERATIONAL"
        node.op_mode = "PROFILED VELOCITY"
        states = [node.op_mode]
        node.state = "OPERATION ENABLED"
        states.append(node.state)
        node.sdo[0x60FF].raw = 20_000
        _until(lambda: node.sdo[0x606C].raw == 20_000)
        node.state = "QUICK STOP ACTIVE"
        _until(lambda: node.state == "SWITCH ON DISABLED")
        states.append(node.state)
        node.op_mode = "PROFILED POSITION"
        states.append(node.op_mode)
        node.state = "OPERATION ENABLED"
        node.sdo[0x607A].raw = place = node.sdo[0x6064].raw + 2_000
        node.controlword = 0x3F
        _until(lambda: node.sdo[0x6064].raw == place)
        _until(lambda: bool(node.statusword & 1 << 10))
        return states
    finally:
        network.disconnect()


def _until(condition: Callable[[], bool], within_s: float = 5.0) -> None:
    deadline = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_third_party_state_machine_drives_the_drive() -> None:
    async def main() -> list[str]:
        server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 500_000)
        node = emulated_node(PROFILE, NODE, None, 0).node
        try:
            async with Nursery() as nursery:
                nursery.start(serve_node(server.attach("drive"), node, WallClock()), "drive")
                return await asyncio.to_thread(drive_it, *server.bound.address)
        finally:
            await server.aclose()

    assert run(main()) == ["PROFILED VELOCITY", "OPERATION ENABLED", "SWITCH ON DISABLED", "PROFILED POSITION"]
