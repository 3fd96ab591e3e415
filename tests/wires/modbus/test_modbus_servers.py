"""The Modbus client against servers that share no code with it: pymodbus, libmodbus (C) and pyModbusTCP.

It covers every wire that they support: RTU over TCP, ASCII, UDP and TLS with certificates (pymodbus), TCP and RTU (libmodbus),
TCP (pyModbusTCP). test_modbus_client_with_pymodbus covers pymodbus over TCP and RTU.
"""

from __future__ import annotations

import shutil
import ssl
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path

import pytest
from modbus_pki import make_pki
from pymodbus import FramerType
from pymodbus.server import ModbusSerialServer, ModbusTcpServer, ModbusTlsServer, ModbusUdpServer
from support import eventually, run
from third_party_servers import COUNT, INPUTS, libmodbus, null_modem, sim_device

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ModbusExceptionReply
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.requests.diagnostics import Diagnostics
from fieldtwin.gateway.protocols.modbus.requests.identity import ReportServerId
from fieldtwin.gateway.wallclock import WallClock

Opened = Callable[[Path], AbstractAsyncContextManager[ModbusClient]]


@asynccontextmanager
async def client_at(url: str) -> AsyncIterator[ModbusClient]:
    endpoint = Endpoint.parse(url)
    client = ModbusClient.at(endpoint, await OsConnector().open_bytes(endpoint), WallClock())
    try:
        yield client
    finally:
        await client.aclose()


@asynccontextmanager
async def pymodbus_rtu_over_tcp(_: Path) -> AsyncIterator[ModbusClient]:
    server = ModbusTcpServer(sim_device(), address=("127.0.0.1", 0), framer=FramerType.RTU)
    await server.serve_forever(background=True)
    port = server.transport.sockets[0].getsockname()[1]  # type: ignore[attr-defined]
    async with client_at(f"rtu+tcp://127.0.0.1:{port}") as client:
        yield client
    await server.shutdown()  # type: ignore[no-untyped-call]


@asynccontextmanager
async def pymodbus_udp(_: Path) -> AsyncIterator[ModbusClient]:
    server = ModbusUdpServer(sim_device(), address=("127.0.0.1", 0))
    await server.serve_forever(background=True)
    port = server.transport.get_extra_info("sockname")[1]
    async with client_at(f"udp://127.0.0.1:{port}") as client:
        yield client
    await server.shutdown()  # type: ignore[no-untyped-call]


@asynccontextmanager
async def pymodbus_tls(directory: Path) -> AsyncIterator[ModbusClient]:
    if shutil.which("openssl") is None:
        pytest.skip("openssl makes the certificates")
    pki = make_pki(directory)
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=pki.ca)
    context.load_cert_chain(pki.cert("server"), pki.key("server"))
    context.verify_mode = ssl.CERT_REQUIRED
    # Its TLS framer omits the MBAP header, contrary to the specification, so the TCP framer is used.
    server = ModbusTlsServer(sim_device(), address=("127.0.0.1", 0), framer=FramerType.SOCKET, sslctx=context)
    await server.serve_forever(background=True)
    port = server.transport.sockets[0].getsockname()[1]  # type: ignore[attr-defined]
    files = f"ca={pki.ca}&cert={pki.cert('client')}&key={pki.key('client')}"
    async with client_at(f"tls://127.0.0.1:{port}?{files}") as client:
        yield client
    await server.shutdown()  # type: ignore[no-untyped-call]


@asynccontextmanager
async def pymodbus_ascii(_: Path) -> AsyncIterator[ModbusClient]:
    with null_modem() as (near, far):
        server = ModbusSerialServer(sim_device(), port=far, baudrate=115200, framer=FramerType.ASCII)
        await server.serve_forever(background=True)
        async with client_at(f"ascii:{near}?baudrate=115200&frame=8N1") as client:
            yield client
        await server.shutdown()  # type: ignore[no-untyped-call]


@asynccontextmanager
async def libmodbus_tcp(_: Path) -> AsyncIterator[ModbusClient]:
    async with libmodbus("tcp") as port, client_at(f"tcp://127.0.0.1:{port}") as client:
        yield client


@asynccontextmanager
async def libmodbus_rtu(_: Path) -> AsyncIterator[ModbusClient]:
    with null_modem() as (near, far):
        async with libmodbus("rtu", far), client_at(f"rtu:{near}?baudrate=115200&frame=8N1") as client:
            yield client


@asynccontextmanager
async def pymodbustcp(_: Path) -> AsyncIterator[ModbusClient]:
    server_module = pytest.importorskip("pyModbusTCP.server")
    bank = server_module.DataBank(coils_size=COUNT, d_inputs_size=COUNT, h_regs_size=COUNT, i_regs_size=COUNT)
    bank.set_input_registers(0, INPUTS)
    bank.set_discrete_inputs(0, [i % 3 == 0 for i in range(COUNT)])
    server = server_module.ModbusServer("127.0.0.1", 0, no_block=True, data_bank=bank)
    server.start()
    try:
        await eventually(lambda: server.is_run)
        async with client_at(f"tcp://127.0.0.1:{server._service.socket.getsockname()[1]}") as client:
            yield client
    finally:
        server.stop()


EVERY_WIRE = [
    pymodbus_rtu_over_tcp,
    pymodbus_udp,
    pymodbus_tls,
    pymodbus_ascii,
    libmodbus_tcp,
    libmodbus_rtu,
    pymodbustcp,
]


@pytest.mark.interop
@pytest.mark.parametrize("opened", EVERY_WIRE)
def test_a_strange_server_is_read_and_written(opened: Opened, tmp_path: Path) -> None:
    async def main() -> None:
        async with opened(tmp_path) as client:
            assert (await client.read_registers(1, "input", 0, 125)).registers == tuple(INPUTS[:125])
            assert (await client.read_bits(1, "discrete", 0, 13)).bits == tuple(i % 3 == 0 for i in range(13))
            await client.write_register(1, 3, 0xBEEF)
            await client.write_registers(1, 4, list(range(123)))
            assert (await client.read_registers(1, "holding", 3, 4)).registers == (0xBEEF, 0, 1, 2)
            await client.write_coil(1, 9, True)
            await client.write_coils(1, 10, [False, True, True])
            assert (await client.read_bits(1, "coil", 8, 6)).bits == (False, True, False, True, True, False)
            await client.write_register(1, 5, 0x12)
            assert (await client.read_write_registers(1, 5, 1, 6, [77])).registers == (0x12,)
            with pytest.raises(ModbusExceptionReply) as caught:
                await client.read_registers(1, "holding", COUNT - 2, 10)
            assert caught.value.code == 2
            c = client.counters
            assert (c.requests, c.replies, c.exceptions) == (11, 10, 1)
            assert c.late_bytes == c.noise_bytes == c.foreign_frames == 0

    run(main())


@pytest.mark.interop
@pytest.mark.parametrize("opened", [pymodbus_ascii, pymodbus_rtu_over_tcp, libmodbus_tcp, libmodbus_rtu])
def test_functions_that_only_some_servers_support(opened: Opened, tmp_path: Path) -> None:
    async def main() -> None:
        async with opened(tmp_path) as client:
            await client.write_register(1, 5, 0x12)
            await client.mask_write(1, 5, 0xF2, 0x25)
            assert (await client.read_registers(1, "holding", 5, 1)).registers == (0x17,)
            assert (await client.execute(1, ReportServerId())).raw
            if opened in (pymodbus_ascii, pymodbus_rtu_over_tcp):
                assert (await client.execute(1, Diagnostics(0, 0xA537))).value == 0xA537

    run(main())
