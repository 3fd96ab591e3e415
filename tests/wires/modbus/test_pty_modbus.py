"""RTU units on a virtual serial port and the TCP server, queried by third-party clients: mbpoll (libmodbus) and pymodbus."""

from __future__ import annotations

import asyncio
import os
import shutil
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.modbus_server import serve_mbap, serve_rtu
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.endpoints.socket_end import SocketListener
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.rtu.receiver import with_crc
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.wallclock import WallClock

needs_mbpoll = pytest.mark.skipif(shutil.which("mbpoll") is None, reason="mbpoll is not installed")
READ = with_crc(bytes.fromhex("01 03 0000 0002"))
READ_REPLY = with_crc(bytes.fromhex("01 03 04 007B 01C8"))


def make_unit() -> ModbusUnit:
    bank = MapBank(
        [CellSpan("holding", 0, 100), CellSpan("input", 0, 10), CellSpan("coil", 0, 16), CellSpan("discrete", 0, 16)]
    )
    bank.poke("holding", 0, 123, 456)
    bank.poke("input", 2, 789)
    bank.poke("coil", 3, 1)
    return ModbusUnit(bank, server_id=b"fieldtwin")


@asynccontextmanager
async def rtu_line(
    link: Path, unit: ModbusUnit, pace: SerialSettings | None = None, slave: RtuServer | None = None
) -> AsyncIterator[list[bytes]]:
    frames: list[bytes] = []
    end = await PtyEnd.open(link, Endpoint.parse("pty:line1"), pace)
    slave = slave or RtuServer({1: unit})
    task = asyncio.create_task(
        serve_rtu(end, slave, WallClock(), on_frame=lambda direction, t_ns, adu: frames.append(adu))
    )
    try:
        yield frames
    finally:
        assert not task.done(), "the server ended on its own"
        task.cancel()
        await asyncio.wait([task])
        await end.aclose()


@asynccontextmanager
async def tcp_server(unit: ModbusUnit) -> AsyncIterator[int]:
    listener = await SocketListener.open(
        Endpoint.parse("tcp://127.0.0.1:0"), lambda c: serve_mbap(c, MbapServer({1: unit}), WallClock())
    )
    try:
        yield listener.bound.port
    finally:
        await listener.aclose()


async def program(*args: str) -> str:
    process = await asyncio.create_subprocess_exec(
        *args, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
    )
    async with asyncio.timeout(15):
        output, _ = await process.communicate()
    text = output.decode()
    assert process.returncode == 0, text
    return text


async def take(port: int, count: int) -> bytes:
    data = bytearray()

    def more() -> bool:
        try:
            data.extend(os.read(port, 4096))
        except BlockingIOError:
            pass
        return len(data) >= count

    await eventually(more, what=f"{count} bytes")
    return bytes(data)


def test_a_client_may_disconnect_and_connect_again(tmp_path: Path) -> None:
    async def main() -> None:
        unit = make_unit()
        slave = RtuServer({1: unit})
        async with rtu_line(tmp_path / "line1", unit, slave=slave) as frames:
            for turn in range(1, 4):
                port = os.open(tmp_path / "line1", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
                os.write(port, READ)
                assert await take(port, len(READ_REPLY)) == READ_REPLY
                os.write(port, READ[:5])  # disconnects in the middle of a request: MB-004
                os.close(port)
                await eventually(
                    lambda turn=turn: slave.counters.noise_bytes == 5 * turn, what="half a request is given up"
                )
            assert frames == [READ, READ_REPLY] * 3

    run(main())


def test_noise_that_looks_like_a_long_frame_delays_and_does_not_swallow(tmp_path: Path) -> None:
    async def main() -> None:
        async with rtu_line(tmp_path / "line1", make_unit()):
            port = os.open(tmp_path / "line1", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            os.write(port, bytes.fromhex("01 10 0000 0064 C8") + READ)
            assert await take(port, len(READ_REPLY)) == READ_REPLY
            os.close(port)

    run(main())


def test_direction_and_latency(tmp_path: Path) -> None:
    told: list[tuple[Direction, int]] = []

    async def main() -> None:
        end = await PtyEnd.open(tmp_path / "line1", Endpoint.parse("pty:line1"))
        slave = RtuServer({1: make_unit()})
        task = asyncio.create_task(
            serve_rtu(end, slave, WallClock(), latency_s=0.02, on_frame=lambda d, t_ns, adu: told.append((d, t_ns)))
        )
        port = os.open(tmp_path / "line1", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        os.write(port, READ)
        await take(port, len(READ_REPLY))
        await eventually(lambda: len(told) == 2)
        assert [d for d, _ in told] == [Direction.SENT, Direction.RECEIVED]
        assert told[1][1] - told[0][1] >= 20_000_000
        os.close(port)
        await end.aclose()
        await asyncio.wait_for(task, 5)  # a lost connection ends the server by itself

    run(main())


@needs_mbpoll
@pytest.mark.interop
@pytest.mark.parametrize("pace", [None, SerialSettings(19200, "8E1")], ids=["unpaced", "paced"])
def test_mbpoll_reads_and_writes_over_rtu(tmp_path: Path, pace: SerialSettings | None) -> None:
    async def main() -> None:
        unit = make_unit()
        line = ("mbpoll", "-m", "rtu", "-a", "1", "-b", "19200", "-d", "8", "-P", "even", "-s", "1", "-0", "-1")
        port = str(tmp_path / "line1")
        async with rtu_line(tmp_path / "line1", unit, pace):
            text = await program(*line, "-t", "4", "-r", "0", "-c", "2", port)
            assert "[0]: \t123" in text
            assert "[1]: \t456" in text
            assert "[2]: \t789" in await program(*line, "-t", "3", "-r", "2", "-c", "1", port)
            assert "[3]: \t1" in await program(*line, "-t", "0", "-r", "3", "-c", "1", port)
            await program(*line, "-t", "4", "-r", "5", port, "11", "22", "33")
            assert list(unit.bank.read("holding", 5, 3, 0)) == [11, 22, 33]
        assert unit.counters.requests == unit.counters.replies == 4
        assert unit.counters.exceptions == 0

    run(main())


@needs_mbpoll
@pytest.mark.interop
def test_mbpoll_reads_and_writes_over_tcp() -> None:
    async def main() -> None:
        unit = make_unit()
        async with tcp_server(unit) as port:
            server = ("mbpoll", "-m", "tcp", "-p", str(port), "-a", "1", "-0", "-1")
            text = await program(*server, "-t", "4", "-r", "0", "-c", "2", "127.0.0.1")
            assert "[0]: \t123" in text
            assert "[1]: \t456" in text
            await program(*server, "-t", "0", "-r", "0", "127.0.0.1", "1", "0", "1")
            assert list(unit.bank.read("coil", 0, 4, 0)) == [1, 0, 1, 1]
        assert unit.counters.requests == unit.counters.replies == 2

    run(main())


PYMODBUS_MASTER = """
import sys
from pymodbus.client import ModbusSerialClient, ModbusTcpClient
kind, where = sys.argv[1:]
if kind == "rtu":
    # parity N: it sets its port twice, and Debian's C library refuses parity on a pty the second time
    client = ModbusSerialClient(where, baudrate=19200, parity="N", timeout=2, retries=0)
else:
    client = ModbusTcpClient("127.0.0.1", port=int(where), timeout=2, retries=0)
with client:
    assert client.read_holding_registers(0, count=2, device_id=1).registers == [123, 456]
    assert client.read_input_registers(2, count=1, device_id=1).registers == [789]
    assert client.read_coils(0, count=4, device_id=1).bits[:4] == [False, False, False, True]
    assert client.read_discrete_inputs(0, count=16, device_id=1).bits == [False] * 16
    assert not client.write_coil(1, True, device_id=1).isError()
    assert not client.write_coils(4, [True] * 10, device_id=1).isError()
    assert not client.write_register(9, 0x12, device_id=1).isError()
    assert not client.mask_write_register(address=9, and_mask=0xF2, or_mask=0x25, device_id=1).isError()
    assert not client.write_registers(10, [1, 2, 3], device_id=1).isError()
    reply = client.readwrite_registers(read_address=9, read_count=2, write_address=10, values=[8], device_id=1)
    assert reply.registers == [0x17, 8], reply
    assert client.diag_query_data(b"\\x12\\x34", device_id=1).message == b"\\x12\\x34"
    assert client.report_device_id(device_id=1).identifier.startswith(b"fieldtwin")
    assert client.read_holding_registers(99, count=2, device_id=1).exception_code == 2
    assert client.read_fifo_queue(address=0, device_id=1).exception_code == 1
    assert client.read_holding_registers(0, count=1, device_id=1).registers == [123]
print("done")
"""


@pytest.mark.interop
@pytest.mark.parametrize("kind", ["rtu", "tcp"])
def test_pymodbus_as_a_client(tmp_path: Path, kind: str) -> None:
    async def main() -> None:
        unit = make_unit()
        script = (sys.executable, "-c", PYMODBUS_MASTER, kind)
        if kind == "rtu":
            async with rtu_line(tmp_path / "line1", unit):
                assert "done" in await program(*script, str(tmp_path / "line1"))
        else:
            async with tcp_server(unit) as port:
                assert "done" in await program(*script, str(port))
        assert list(unit.bank.read("coil", 0, 16, 0)) == [0, 1, 0, 1] + [1] * 10 + [0] * 2
        assert (unit.counters.requests, unit.counters.replies, unit.counters.exceptions) == (15, 15, 2)

    run(main())
