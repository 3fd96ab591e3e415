"""Every function of the client over every transport, against an emulated unit on real ptys and sockets."""

from __future__ import annotations

import shutil
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import pytest
from modbus_pki import make_pki
from support import run

from fieldtwin.emulators.endpoints.modbus_server import serve_mbap, serve_rtu, serve_udp
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.endpoints.socket_end import SocketListener
from fieldtwin.emulators.endpoints.udp_end import UdpEnd
from fieldtwin.emulators.modbus.ascii import AsciiServer
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.functions.fifo import FifoQueues
from fieldtwin.emulators.modbus.functions.file_records import FileRecords
from fieldtwin.emulators.modbus.functions.identification import Identification
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ModbusExceptionReply, ReplyTimeout, UsageError
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.requests.diagnostics import (
    Diagnostics,
    ForceListenOnly,
    GetCommEventCounter,
    GetCommEventLog,
    Loopback,
)
from fieldtwin.gateway.protocols.modbus.requests.files import FileSpan, ReadFifoQueue, ReadFileRecords, WriteFileRecords
from fieldtwin.gateway.protocols.modbus.requests.identity import ReadExceptionStatus, ReportServerId
from fieldtwin.gateway.protocols.modbus.requests.user import CountedShape, UserFunction
from fieldtwin.gateway.wallclock import WallClock

CLOCK = WallClock()
NAMES = {0: b"Maker", 1: b"P1", 2: b"1.0", 3: b"http://m", 4: b"x" * 100, 5: b"y" * 100, 6: b"z" * 100, 0x80: b"own"}
SCHEMES = ["rtu", "ascii", "tcp", "rtu+tcp", "udp", "tls"]


def make_unit() -> tuple[ModbusUnit, MapBank, FifoQueues]:
    bank = MapBank([CellSpan(table, 0, 200) for table in ("coil", "discrete", "input", "holding")])
    fifos = FifoQueues([0x04DE])
    unit = ModbusUnit(
        bank, server_id=b"\x11\xff", identification=Identification(NAMES), files=FileRecords({4: 20}), fifos=fifos
    )
    unit.register(0x41, lambda pdu, now_ns: bytes([0x41, len(pdu) - 1]) + pdu[:0:-1])
    return unit, bank, fifos


@asynccontextmanager
async def client_of(scheme: str, unit: ModbusUnit, tmp_path: Path) -> AsyncIterator[ModbusClient]:
    async with AsyncExitStack() as stack:
        nursery = await stack.enter_async_context(Nursery())
        line = AsciiServer({7: unit}) if scheme == "ascii" else RtuServer({7: unit})
        if scheme in ("rtu", "ascii"):
            settings = "baudrate=115200&frame=" + ("7E1" if scheme == "ascii" else "8N1")
            plant = Endpoint.parse(f"{scheme}:{tmp_path / 'line'}?{settings}")
            end = await PtyEnd.open(tmp_path / "line", plant, None)
            stack.push_async_callback(end.aclose)
            nursery.start(serve_rtu(end, line, CLOCK), "unit")
            endpoint = Endpoint.parse(f"{scheme}:{end.link}?{settings}")
        elif scheme == "udp":
            datagrams = await UdpEnd.open(Endpoint.parse("udp://127.0.0.1:0"))
            stack.push_async_callback(datagrams.aclose)
            nursery.start(serve_udp(datagrams, MbapServer({7: unit}), CLOCK), "unit")
            endpoint = datagrams.bound
        else:
            files = ""
            if scheme == "tls":
                if shutil.which("openssl") is None:
                    pytest.skip("openssl makes the certificates")
                pki = make_pki(tmp_path)
                files = f"?ca={pki.ca}&cert={pki.cert('client')}&key={pki.key('client')}"
                listen = Endpoint.parse(
                    f"tls://127.0.0.1:0?cert={pki.cert('server')}&key={pki.key('server')}&ca={pki.ca}"
                )
            else:
                listen = Endpoint.parse(f"{scheme}://127.0.0.1:0")
            listener = await SocketListener.open(
                listen,
                lambda c: (
                    serve_rtu(c, line, CLOCK) if scheme == "rtu+tcp" else serve_mbap(c, MbapServer({7: unit}), CLOCK)
                ),
                4,
            )
            stack.push_async_callback(listener.aclose)
            host, port = listener.bound.address
            endpoint = Endpoint.parse(f"{scheme}://{host}:{port}{files}")
        connection = await OsConnector().open_bytes(endpoint)
        client = ModbusClient.at(endpoint, connection, CLOCK, timeout_s=2.0, turnaround_s=0.01)
        stack.push_async_callback(client.aclose)
        yield client


async def ask_everything(client: ModbusClient, unit: ModbusUnit, bank: MapBank, fifos: FifoQueues) -> None:
    bank.poke("input", 5, 0x1234, 0xFFFF)
    bank.poke("discrete", 3, 1)
    await client.write_coils(7, 10, [True, False, True])  # 0Fh
    await client.write_coil(7, 11, True)  # 05h
    assert (await client.read_bits(7, "coil", 9, 5)).bits == (False, True, True, True, False)  # 01h
    assert (await client.read_bits(7, "discrete", 0, 9)).bits == (False,) * 3 + (True,) + (False,) * 5  # 02h
    await client.write_registers(7, 0, list(range(123)))  # 10h, the maximum number
    await client.write_register(7, 1, 0xABCD)  # 06h
    assert (await client.read_registers(7, "holding", 0, 3)).registers == (0, 0xABCD, 2)  # 03h
    assert len((await client.read_registers(7, "holding", 0, 125)).registers) == 125
    assert (await client.read_registers(7, "input", 5, 2)).registers == (0x1234, 0xFFFF)  # 04h
    await client.mask_write(7, 1, 0x00FF, 0x1200)  # 16h
    both = await client.read_write_registers(7, 1, 2, 2, [77])  # 17h: written first
    assert both.registers == (0x12CD, 77)
    assert (await client.execute(7, ReadExceptionStatus())).status == 0  # 07h
    assert (await client.execute(7, Loopback(b"\x00\x00\xff\x00"))).value == 0  # 08h
    assert (await client.execute(7, Diagnostics(0x0B))).value > 0  # 08h/0Bh: messages on the bus
    assert (await client.execute(7, GetCommEventCounter())).event_count > 0  # 0Bh
    assert (await client.execute(7, GetCommEventLog())).raw  # 0Ch
    assert (await client.execute(7, ReportServerId())).raw[:2] == b"\x11\xff"  # 11h
    await client.execute(7, WriteFileRecords(((4, 7, (1, 2, 3)),)))  # 15h
    spans = await client.execute(7, ReadFileRecords((FileSpan(4, 8, 2), FileSpan(4, 0, 1))))  # 14h
    assert [tuple(r) for r in spans.records] == [(2, 3), (0,)]
    fifos.push(0x04DE, 440, 4740)
    assert (await client.execute(7, ReadFifoQueue(0x04DE))).registers == (440, 4740)  # 18h
    assert await client.read_identification(7, 3) == NAMES  # 2Bh/0Eh, in several replies
    echoed = await client.execute(7, UserFunction(0x41, b"\x01\x02\x03", CountedShape()))
    assert echoed.raw == b"\x03\x03\x02\x01"
    with pytest.raises(ModbusExceptionReply) as refused:
        await client.read_registers(7, "holding", 199, 2)
    assert refused.value.code == 2
    with pytest.raises(ModbusExceptionReply) as unknown:
        await client.execute(7, UserFunction(0x42, b"", CountedShape()))
    assert unknown.value.code == 1


@pytest.mark.parametrize("scheme", SCHEMES)
def test_every_function_over_every_transport(scheme: str, tmp_path: Path) -> None:
    async def main() -> None:
        unit, bank, fifos = make_unit()
        async with client_of(scheme, unit, tmp_path) as client:
            await ask_everything(client, unit, bank, fifos)
            before = client.counters.requests
            if scheme in ("rtu", "ascii", "rtu+tcp"):
                written = await client.write_register(0, 9, 99)
                assert not written.acknowledged
                assert (await client.read_registers(7, "holding", 9, 1)).registers == (99,)
                with pytest.raises(UsageError):
                    await client.read_registers(0, "holding", 9, 1)
                assert client.counters.broadcasts == 1
                with pytest.raises(ReplyTimeout):
                    await client.read_registers(8, "holding", 0, 1, timeout_s=0.05)
            await client.execute(7, ForceListenOnly())
            with pytest.raises(ReplyTimeout):
                await client.read_registers(7, "holding", 0, 1, timeout_s=0.05)
            assert client.counters.requests > before

    run(main())
