"""Emulated Modbus devices and CANopen nodes in memory and in virtual time, for the checks of devices."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TypeVar

from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.endpoints.modbus_server import serve_mbap, serve_rtu, serve_udp
from fieldtwin.emulators.modbus.ascii import AsciiServer
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.functions.fifo import FifoQueues
from fieldtwin.emulators.modbus.functions.identification import Identification
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.endpoint import Endpoint

T = TypeVar("T")


def make_unit() -> ModbusUnit:
    """Registers 0 to 199, coils 0 to 36, eight input registers, a queue, a name."""
    bank = MapBank([CellSpan("coil", 0, 37), CellSpan("holding", 0, 200), CellSpan("input", 0, 8)])
    bank.poke("holding", 0, 0xAA, 0xBB)
    bank.poke("coil", 3, 1)
    fifos = FifoQueues([0x04DE], capacity=40)
    fifos.push(0x04DE, 0x01B8, 0x1284)
    names = {0: b"fieldtwin", 1: b"FT-1", 2: b"V2.11", 3: b"u" * 200, 4: b"n" * 60}
    return ModbusUnit(bank, fifos=fifos, identification=Identification(names))


def on_modbus(
    url: str,
    use: Callable[[MemoryNet, str, VirtualClock], Awaitable[T]],
    unit: ModbusUnit | None = None,
    at: int = 1,
    serve: Callable[[ByteConnection], Awaitable[None]] | None = None,
) -> T:
    """Return what `use` returns with a device served at `url` in memory. `use` gets the net, the URL and the clock.
    `serve` provides a different device."""
    loop = VirtualLoop()

    async def main() -> T:
        net, endpoint, clock = MemoryNet(loop), Endpoint.parse(url), VirtualClock(loop)
        units = {at: unit or make_unit()}

        async def stream(end: ByteConnection) -> None:
            if serve is not None:
                await serve(end)
            elif endpoint.scheme == "rtu+tcp":
                await serve_rtu(end, RtuServer(units), clock)
            else:
                await serve_mbap(end, MbapServer(units), clock)

        async with Nursery() as nursery:
            if endpoint.is_serial:
                end, _ = await net.serial(Path(endpoint.path), endpoint, endpoint.serial)
                if serve is not None:
                    nursery.start(serve(end), "device")
                    return await use(net, url, clock)
                server = AsciiServer(units) if endpoint.scheme == "ascii" else RtuServer(units)
                nursery.start(serve_rtu(end, server, clock), "device")
                return await use(net, url, clock)
            if endpoint.scheme == "udp":
                datagrams = await net.datagrams(endpoint)
                nursery.start(serve_udp(datagrams, MbapServer(units), clock), "device")
                return await use(net, str(datagrams.bound), clock)
            listener = await net.listen(endpoint, stream, 8)
            try:
                return await use(net, str(listener.bound), clock)
            finally:
                await listener.aclose()

    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        return runner.run(main())
