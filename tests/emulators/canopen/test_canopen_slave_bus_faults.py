"""An emulated node on a bus whose errors drive it to error-passive and bus-off: its frames, and when it must be silent."""

from __future__ import annotations

import asyncio
import contextlib

from canopen_slave_rig import NODE, RICH
from modbus_virtual import VirtualLoop, run_virtually

from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_runner import BusRunner
from fieldtwin.emulators.wires.can_faults import Disturbance, spoil
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FieldtwinError


async def spoiled(times: int) -> tuple[list[str], CanopenNode]:
    """Return the frames of a node with a heartbeat of 50 ms when so many of its frames are corrupted from 100 ms on."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    bus = BusRunner(125_000)
    where = Endpoint.parse("can:fieldtwin/127.0.0.1:1")
    own, other, third = (bus.attach(where, name) for name in ("node", "tester", "third"))
    node = CanopenNode(parse_eds(RICH), NODE)
    heard: list[str] = []
    tasks = [asyncio.create_task(serve_node(own, node, loop)), asyncio.create_task(listen(other, heard))]
    tasks.append(asyncio.create_task(listen(third, [])))
    try:
        await asyncio.sleep(0.001)
        await other.send(CanFrame(0x600 + NODE, bytes.fromhex("2B17100032000000")))
        await asyncio.sleep(0.099)
        bus.disturb(spoil(Disturbance(at_bit=20), match=lambda f: f.can_id == 0x700 + NODE, times=times))
        await asyncio.sleep(1)
    finally:
        for task in tasks:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        bus.close(FieldtwinError("over"))
    return heard, node


async def listen(end: CanConnection, heard: list[str]) -> None:
    while True:
        frame = await end.recv()
        if not frame.error:
            heard.append(str(frame))


def test_error_passive_is_reported_while_it_lasts() -> None:
    heard, _ = run_virtually(spoiled(17))
    assert next(frame for frame in heard if frame.startswith("085#")) == "085#2081110000000000"
    assert "085#4081110000000000" not in heard


def test_bus_off_is_reported_afterwards() -> None:
    heard, node = run_virtually(spoiled(32))
    assert heard.count("085#4081110000000000") == 1
    assert heard.index("085#4081110000000000") < len(heard) - 5, "the heartbeat goes on"
    assert not node.active_errors
