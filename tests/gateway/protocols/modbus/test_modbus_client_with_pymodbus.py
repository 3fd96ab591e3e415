"""The Modbus client against pymodbus's server: an implementation that shares no framing with ours.

Over loopback TCP, and as RTU over two ptys joined byte for byte.
"""

from __future__ import annotations

import asyncio
import os
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager

import pytest
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
from support import run

from fieldtwin.gateway.connections.serial.line import SerialConnection
from fieldtwin.gateway.connections.sockets.tcp import TcpConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ModbusExceptionReply
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.requests.diagnostics import Diagnostics
from fieldtwin.gateway.protocols.modbus.requests.identity import ReadDeviceIdentification
from fieldtwin.gateway.wallclock import WallClock

INPUTS = [(i * 257) & 0xFFFF for i in range(125)]


def device() -> SimDevice:
    return SimDevice(
        id=1,
        simdata=(
            [SimData(0, values=[False] * 64, datatype=DataType.BITS)],
            [SimData(0, values=[i % 3 == 0 for i in range(64)], datatype=DataType.BITS)],
            [SimData(0, values=[0] * 130, datatype=DataType.REGISTERS)],
            [SimData(0, values=INPUTS, datatype=DataType.REGISTERS)],
        ),
    )


@asynccontextmanager
async def over_tcp() -> AsyncIterator[ModbusClient]:
    server = ModbusTcpServer(device(), address=("127.0.0.1", 0))
    await server.serve_forever(background=True)
    port = server.transport.sockets[0].getsockname()[1]  # type: ignore[attr-defined]
    client = ModbusClient(
        await TcpConnection.open(Endpoint.parse(f"tcp://127.0.0.1:{port}")), WallClock(), framing="mbap"
    )
    try:
        yield client
    finally:
        await client.aclose()
        await server.shutdown()  # type: ignore[no-untyped-call]


def forward(loop: asyncio.AbstractEventLoop, source: int, sink: int) -> None:
    loop.add_reader(source, lambda: os.write(sink, os.read(source, 4096)))


@asynccontextmanager
async def over_rtu() -> AsyncIterator[ModbusClient]:
    pairs = [os.openpty(), os.openpty()]  # the slave ends remain open here: no EIO when a user closes
    loop = asyncio.get_running_loop()
    for _, slave in pairs:
        tty.setraw(slave)
    (a, a_slave), (b, b_slave) = pairs
    forward(loop, a, b)
    forward(loop, b, a)
    server = ModbusSerialServer(device(), port=os.ttyname(b_slave), baudrate=115200)
    await server.serve_forever(background=True)
    endpoint = Endpoint.parse(f"rtu:{os.ttyname(a_slave)}?baudrate=115200&frame=8N1")
    connection = await SerialConnection.open(endpoint)
    client = ModbusClient(connection, WallClock(), framing="rtu", serial=endpoint.serial)
    try:
        yield client
    finally:
        await client.aclose()
        await server.shutdown()  # type: ignore[no-untyped-call]
        loop.remove_reader(a)
        loop.remove_reader(b)
        for fd in (a, a_slave, b, b_slave):
            os.close(fd)


@pytest.mark.parametrize("opened", [over_tcp, over_rtu], ids=["tcp", "rtu"])
def test_pymodbus_server_reads_and_writes(opened: Callable[[], AbstractAsyncContextManager[ModbusClient]]) -> None:
    async def main() -> None:
        async with opened() as client:
            assert (await client.read_registers(1, "input", 0, 125)).registers == tuple(INPUTS)
            assert (await client.read_bits(1, "discrete", 0, 13)).bits == tuple(i % 3 == 0 for i in range(13))
            await client.write_register(1, 3, 0xBEEF)
            await client.write_registers(1, 4, list(range(123)))
            assert (await client.read_registers(1, "holding", 3, 4)).registers == (0xBEEF, 0, 1, 2)
            await client.write_coil(1, 9, True)
            await client.write_coils(1, 10, [False, True, True])
            assert (await client.read_bits(1, "coil", 8, 6)).bits == (False, True, False, True, True, False)
            await client.write_register(1, 5, 0x12)
            await client.mask_write(1, 5, 0xF2, 0x25)
            assert (await client.read_write_registers(1, 5, 1, 6, [77])).registers == (0x17,)
            assert (await client.read_registers(1, "holding", 6, 1)).registers == (77,)
            assert (await client.execute(1, Diagnostics(0, 0xA537))).value == 0xA537
            assert (await client.execute(1, ReadDeviceIdentification())).conformity == 0x83
            with pytest.raises(ModbusExceptionReply) as caught:
                await client.read_registers(1, "holding", 128, 10)
            assert caught.value.code == 2
            c = client.counters
            assert (c.requests, c.replies, c.exceptions) == (15, 14, 1)
            assert c.late_bytes == c.noise_bytes == c.foreign_frames == 0

    run(main())
