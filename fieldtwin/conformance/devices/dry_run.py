"""A dry run of a check, `--dry-run`, which shows the frames that would be sent.

The check runs on a simulated device in memory, in virtual time. No port, socket or bus is opened. With a real device some
frames differ, because the answers of the device decide how a case continues.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import replace
from pathlib import Path
from typing import Any

from fieldtwin.conformance.devices.canopen.session import CanopenOptions, check_canopen
from fieldtwin.conformance.devices.checked import Checked
from fieldtwin.conformance.devices.modbus.session import ModbusOptions, check_modbus
from fieldtwin.emulators.canopen.eds.dictionary import load_eds, parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.endpoints.modbus_server import serve_mbap, serve_rtu, serve_udp
from fieldtwin.emulators.endpoints.ports import OnClient
from fieldtwin.emulators.modbus.ascii import AsciiServer
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.functions.identification import Identification
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.endpoint import Endpoint

CELLS = 0x1_0000


def modbus_dry_run(options: ModbusOptions) -> Checked:
    """Run the check on a simulated device that has everything that the options name."""
    loop = VirtualLoop()
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        return runner.run(_modbus(options, loop))


def _device(options: ModbusOptions) -> ModbusUnit:
    end = sum(options.may_write["holding"]) if "holding" in options.may_write else CELLS
    spans = [
        CellSpan("coil", 0, CELLS),
        CellSpan("discrete", 0, CELLS),
        CellSpan("holding", 0, end),
        CellSpan("input", 0, CELLS),
    ]
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
                server = AsciiServer(units) if endpoint.scheme == "ascii" else RtuServer(units)
                nursery.start(serve_rtu(end, server, clock, echo=options.echo), "device of the dry run")
                return await check_modbus(use)
            if endpoint.scheme == "udp":
                datagrams = await net.datagrams(endpoint)
                nursery.start(serve_udp(datagrams, MbapServer(units), clock), "device of the dry run")
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
            await serve_rtu(end, RtuServer(units), clock)
        else:
            await serve_mbap(end, MbapServer(units), clock)

    served: Callable[[ByteConnection], Awaitable[None]] = serve
    return served


# -- CANopen -----------------------------------------------------------------------------------------------------------


def canopen_dry_run(options: CanopenOptions) -> Checked:
    """Run the check on a simulated node as the EDS describes it, or on one with everything that the cases need."""
    loop = VirtualLoop()

    async def main() -> Checked:
        net, clock = MemoryNet(loop), VirtualClock(loop)
        sheet = load_eds(options.eds) if options.eds is not None else parse_eds(_sheet(options))
        bus = await net.can_bus(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), options.bitrate or 125_000, paced=False)
        use = replace(options, endpoint=str(bus.bound), connector=net, clock=clock)
        try:
            async with Nursery() as nursery:
                node = CanopenNode(sheet, options.node)
                nursery.start(serve_node(await bus.join("node of the dry run"), node, clock), "node of the dry run")
                return await check_canopen(use)
        finally:
            await bus.aclose()

    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        return runner.run(main())


def _sheet(options: CanopenOptions) -> str:
    """Return the text of an EDS for a node with the mandatory objects, and with the objects that may be written, as numbers."""
    text = "[DeviceInfo]\nVendorName=paper\n"
    text += _var("1000", 7, "ro", "0x0") + _var("1001", 5, "ro", "0") + _var("1017", 6, "rw", "0")
    text += _var("1008", 9, "const", "a node of the dry run")
    text += "[1003]\nParameterName=1003\nObjectType=0x8\nSubNumber=2\n"
    text += _var("1003sub0", 5, "rw", "0") + _var("1003sub1", 7, "ro", "0")
    text += "[1010]\nParameterName=1010\nObjectType=0x8\nSubNumber=2\n"
    text += _var("1010sub0", 5, "ro", "1") + _var("1010sub1", 7, "rw", "1")
    text += "[1018]\nParameterName=1018\nObjectType=0x9\nSubNumber=5\n" + _var("1018sub0", 5, "ro", "4")
    text += "".join(_var(f"1018sub{sub}", 7, "ro", "0") for sub in range(1, 5))
    for index in sorted(
        {index for index, _ in options.may_write} - {0x1000, 0x1001, 0x1003, 0x1008, 0x1010, 0x1017, 0x1018}
    ):
        subs = {sub for at, sub in options.may_write if at == index}
        if subs == {0}:
            text += _var(f"{index:04X}", 7, "rw", "0")
        else:
            text += f"[{index:04X}]\nParameterName={index:04X}\nObjectType=0x9\nSubNumber={max(subs) + 1}\n"
            text += _var(f"{index:04X}sub0", 5, "ro", str(max(subs)))
            text += "".join(_var(f"{index:04X}sub{sub:X}", 7, "rw", "0") for sub in range(1, max(subs) + 1))
    return text


def _var(section: str, data_type: int, access: str, default: str) -> str:
    return (
        f"[{section}]\nParameterName={section}\nObjectType=0x7\nDataType=0x{data_type:04X}\nAccessType={access}\n"
        f"DefaultValue={default}\nPDOMapping=0\n"
    )
