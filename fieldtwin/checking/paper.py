"""A check on paper: played on a device of ours in memory, in virtual time, to see what would be sent. Nothing is opened.

A real device that answers otherwise leads to other frames in places: what it says decides how a case goes on.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import replace
from pathlib import Path
from typing import Any

from emulators.endpoints.ports import OnClient
from emulators.modbus.ascii import AsciiSlave
from emulators.modbus.bank import MapBank, Span
from emulators.modbus.identification import Identification
from emulators.modbus.mbap import MbapSlave
from emulators.modbus.rtu import RtuSlave
from emulators.modbus.serve import serve_mbap, serve_rtu, serve_udp
from emulators.modbus.unit import ModbusUnit
from emulators.virtual.clock import VirtualClock
from emulators.virtual.loop import VirtualLoop
from emulators.virtual.ports import MemoryNet
from fieldtwin.checking.checked import Checked
from fieldtwin.checking.modbus_session import ModbusOptions, check_modbus
from gateway.core.connection import ByteConnection
from gateway.core.endpoint import Endpoint
from gateway.core.nursery import Nursery

CELLS = 0x1_0000


def modbus_on_paper(options: ModbusOptions) -> Checked:
    """The check as it goes with a device that has everything that the options name."""
    loop = VirtualLoop()
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        return runner.run(_modbus(options, loop))


def _device(options: ModbusOptions) -> ModbusUnit:
    end = sum(options.may_write["holding"]) if "holding" in options.may_write else CELLS
    spans = [Span("coil", 0, CELLS), Span("discrete", 0, CELLS), Span("holding", 0, end), Span("input", 0, CELLS)]
    return ModbusUnit(MapBank(spans), identification=Identification({0: b"paper", 1: b"paper", 2: b"0"}))


def _modbus(options: ModbusOptions, loop: VirtualLoop) -> Coroutine[Any, Any, Checked]:
    async def main() -> Checked:
        net, clock = MemoryNet(loop), VirtualClock(loop)
        endpoint = Endpoint.parse(options.endpoint)
        units = {options.unit: _device(options)}
        use = replace(options, connector=net, clock=clock)
        async with Nursery() as nursery:
            if endpoint.is_serial:
                end, _ = await net.serial(Path(endpoint.path), endpoint, endpoint.serial)
                slave = AsciiSlave(units) if endpoint.scheme == "ascii" else RtuSlave(units)
                nursery.start(serve_rtu(end, slave, clock, echo=options.echo), "device on paper")
                return await check_modbus(use)
            if endpoint.scheme == "udp":
                datagrams = await net.datagrams(endpoint)
                nursery.start(serve_udp(datagrams, MbapSlave(units), clock), "device on paper")
                return await check_modbus(use)
            listener = await net.listen(endpoint, _streams(endpoint, units, clock), 8)
            try:
                return await check_modbus(use)
            finally:
                await listener.aclose()

    return main()


def _streams(endpoint: Endpoint, units: dict[int, ModbusUnit], clock: VirtualClock) -> OnClient:
    async def serve(end: ByteConnection) -> None:
        if endpoint.scheme == "rtu+tcp":
            await serve_rtu(end, RtuSlave(units), clock)
        else:
            await serve_mbap(end, MbapSlave(units), clock)

    served: Callable[[ByteConnection], Awaitable[None]] = serve
    return served
