"""Third-party clients on the emulator's wires: pymodbus over ASCII and UDP, with the rarer functions.

TLS is omitted, because pymodbus leaves out the MBAP header there, which MODBUS/TCP Security requires.

Also `fieldtwin emulate` as a user starts it, with one device on every kind of wire, read by our own driver's client.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import shutil
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from modbus_pki import make_pki
from support import eventually, run

from fieldtwin.emulators.endpoints.modbus_server import serve_rtu, serve_udp
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.endpoints.udp_end import UdpEnd
from fieldtwin.emulators.modbus.ascii import AsciiServer
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.functions.fifo import FifoQueues
from fieldtwin.emulators.modbus.functions.file_records import FileRecords
from fieldtwin.emulators.modbus.functions.identification import Identification
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ModbusExceptionReply
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.wallclock import WallClock

CHECKOUT = Path(__file__).parents[3]
needs_openssl = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificates")

PYMODBUS = """
import sys
from pymodbus import FramerType
from pymodbus.client import ModbusSerialClient, ModbusUdpClient
from pymodbus.pdu.file_message import FileRecord
kind, where = sys.argv[1:]
if kind == "ascii":
    client = ModbusSerialClient(where, framer=FramerType.ASCII, baudrate=19200, parity="N", timeout=3, retries=0)
else:
    client = ModbusUdpClient("127.0.0.1", port=int(where), timeout=3, retries=0)
with client:
    assert client.read_holding_registers(0, count=2, device_id=1).registers == [123, 456]
    assert not client.write_registers(10, list(range(100)), device_id=1).isError()
    assert client.read_holding_registers(10, count=100, device_id=1).registers == list(range(100))
    assert not client.write_coils(0, [True, False, True], device_id=1).isError()
    assert client.read_coils(0, count=3, device_id=1).bits[:3] == [True, False, True]
    assert client.read_exception_status(device_id=1).status == 0x6D
    assert client.diag_get_comm_event_counter(device_id=1).count == 6
    log = client.diag_get_comm_event_log(device_id=1)
    assert (log.event_count, log.message_count, len(log.events)) == (6, 8, 15), (log.event_count, log.message_count, log.events)
    assert client.diag_read_bus_message_count(device_id=1).message == 9
    read = client.read_file_record([FileRecord(file_number=4, record_number=1, record_length=4)], device_id=1)
    assert [r.record_data for r in read.records] == [b"\\x00\\x07\\x00\\x08"], [vars(r) for r in read.records]
    first = client.read_device_information(read_code=3, object_id=0, device_id=1)
    assert first.information[0] == b"fieldtwin", first
    assert (first.more_follows, first.next_object_id) == (0xFF, 3), first
    rest = client.read_device_information(read_code=3, object_id=3, device_id=1)
    assert rest.information == {3: b"u" * 230}, rest
    assert client.read_device_information(read_code=4, object_id=9, device_id=1).exception_code == 2
    assert client.read_fifo_queue(address=9, device_id=1).exception_code == 2
    assert client.read_holding_registers(900, count=1, device_id=1).exception_code == 2
print("done")
"""


def make_unit() -> ModbusUnit:
    bank = MapBank([CellSpan("holding", 0, 120), CellSpan("coil", 0, 8)])
    bank.poke("holding", 0, 123, 456)
    files = FileRecords({4: 20})
    files.poke(4, 1, 7, 8)
    names = {0: b"fieldtwin", 1: b"FT", 2: b"1", 3: b"u" * 230}
    unit = ModbusUnit(bank, fifos=FifoQueues([0]), files=files, identification=Identification(names))
    unit.diagnostics.status = 0x6D
    return unit


@contextlib.asynccontextmanager
async def served(kind: str, unit: ModbusUnit, directory: Path) -> AsyncIterator[str]:
    """Serve the unit on a wire; yields the endpoint for a client."""
    clock, units = WallClock(), {1: unit}
    end: PtyEnd | UdpEnd
    if kind == "ascii":
        end = await PtyEnd.open(directory / "line", Endpoint.parse("pty:line"))
        where, serving = str(end.link), serve_rtu(end, AsciiServer(units), clock)
    else:
        end = await UdpEnd.open(Endpoint.parse("udp://127.0.0.1:0"))
        where, serving = str(end.bound.port), serve_udp(end, MbapServer(units), clock)
    task = asyncio.create_task(serving)
    try:
        yield where
    finally:
        await end.aclose()
        await asyncio.wait_for(task, 5)


@pytest.mark.interop
@pytest.mark.parametrize("kind", ["ascii", "udp"])
def test_pymodbus_as_a_client(kind: str, tmp_path: Path) -> None:
    async def main() -> None:
        unit = make_unit()
        async with served(kind, unit, tmp_path) as where:
            process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-c", PYMODBUS, kind, where),
                stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
            )  # fmt: skip
            output, _ = await process.communicate()
            assert output.decode().endswith("done\n"), output.decode()
        assert unit.counters.requests == unit.counters.replies
        assert unit.counters.exceptions == 3

    run(main())


@pytest.mark.long
@needs_openssl
def test_fieldtwin_emulate_puts_one_device_on_every_wire(tmp_path: Path) -> None:
    pki = make_pki(tmp_path)
    server = f"ca={pki.ca}&cert={pki.cert('server')}&key={pki.key('server')}"
    client = f"ca={pki.ca}&cert={pki.cert('client')}&key={pki.key('client')}"
    wires = [
        *(f"pty:{tmp_path}/rtu", f"ascii:{tmp_path}/ascii", f"pty:{tmp_path}/echo?mode=ascii&echo=1"),
        *("tcp://127.0.0.1:0", "rtu+tcp://127.0.0.1:0", "udp://127.0.0.1:0", f"tls://127.0.0.1:0?{server}"),
    ]

    async def main() -> None:
        out = (tmp_path / "out").open("w+b")
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "fieldtwin", "emulate", "eastron-sdm630"),
            *(argument for wire in wires for argument in ("--on", wire)),
            stdout=out, stderr=out, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(CHECKOUT), "COLUMNS": "500"},
        )  # fmt: skip
        try:

            def said() -> str:
                return (tmp_path / "out").read_text()

            await eventually(lambda: said().count("units 1 on") == len(wires) or process.returncode is not None, 20)
            assert process.returncode is None, said()
            ports = dict(re.findall(r"units 1 on ([a-z+]+)://127.0.0.1:(\d+)", said()))
            urls = [
                *(f"rtu:{tmp_path}/rtu?baudrate=9600&frame=8N1", f"ascii:{tmp_path}/ascii?baudrate=9600"),
                *(f"{scheme}://127.0.0.1:{ports[scheme]}" for scheme in ("tcp", "rtu+tcp", "udp")),
                f"tls://127.0.0.1:{ports['tls']}?{client}",
            ]
            for url in urls:
                await read_meter(Endpoint.parse(url), echo=False)
            await read_meter(Endpoint.parse(f"ascii:{tmp_path}/echo?baudrate=9600"), echo=True)
            process.terminate()
            assert await asyncio.wait_for(process.wait(), 5) == 0, said()
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
            out.close()

    run(main(), timeout_s=40)


async def read_meter(endpoint: Endpoint, *, echo: bool) -> None:
    """Read a voltage, and a table that the meter lacks, with our driver's client and none of the emulator's code."""
    connection = await OsConnector().open_bytes(endpoint)
    client = ModbusClient.at(endpoint, connection, WallClock(), echo=echo)
    try:
        reply = await client.read_registers(1, "input", 0, 2)
        assert 0x4340 <= reply.registers[0] <= 0x4380, f"{endpoint}: no float32 between 192 and 256: {reply}"
        with pytest.raises(ModbusExceptionReply):
            await client.read_bits(1, "coil", 0, 1)
    finally:
        await client.aclose()
