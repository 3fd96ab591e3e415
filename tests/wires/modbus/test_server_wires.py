"""One emulated device on every wire at once, with real ptys and sockets: UDP, TLS with roles, ASCII, echo, latency, limits."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import socket
import ssl
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from modbus_pki import Pki, make_pki
from support import eventually, run

from fieldtwin.emulators.endpoints.modbus_server import as_recorded, serve_mbap, serve_rtu, serve_udp
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.endpoints.socket_end import SocketEnd, SocketListener
from fieldtwin.emulators.endpoints.tls_server import client_role
from fieldtwin.emulators.endpoints.udp_end import UdpEnd
from fieldtwin.emulators.modbus.ascii import AsciiServer
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.line import ServedFrame
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.core.errors import ConnectionLost, EndpointBusy, Unreachable, UsageError
from fieldtwin.gateway.wallclock import WallClock

READ, REPLY = bytes.fromhex("0001 0000 0006 01 03 0000 0001"), bytes.fromhex("0001 0000 0005 01 03 02 0007")
RTU_READ, RTU_REPLY = bytes.fromhex("01 03 0000 0001 840A"), bytes.fromhex("01 03 02 0007 F986")
ASCII_READ, ASCII_REPLY = b":010300000001FB\r\n", b":0103020007F3\r\n"
WRITE = bytes.fromhex("0002 0000 0006 01 06 0001 0005")
ANY_TCP, ANY_UDP = Endpoint.parse("tcp://127.0.0.1:0"), Endpoint.parse("udp://127.0.0.1:0")

needs_openssl = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificates")


def make_unit() -> ModbusUnit:
    bank = MapBank([CellSpan("holding", 0, 16)])
    bank.poke("holding", 0, 7)
    return ModbusUnit(bank)


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Pki:
    made = make_pki(tmp_path_factory.mktemp("pki"))
    made.issue("viewer", role="Viewer")
    made.issue("plain")
    return made


def client_context(pki: Pki, name: str) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=pki.ca)
    if name:
        context.load_cert_chain(pki.cert(name), pki.key(name))
    return context


def tls_endpoint(pki: Pki, *, mutual: bool = True) -> Endpoint:
    ca = f"&ca={pki.ca}" if mutual else ""
    return Endpoint.parse(f"tls://127.0.0.1:0?cert={pki.cert('server')}&key={pki.key('server')}{ca}")


async def ask_tcp(endpoint: Endpoint, request: bytes, length: int, context: ssl.SSLContext | None = None) -> bytes:
    reader, writer = await asyncio.open_connection(*endpoint.address, ssl=context)
    try:
        writer.write(request)
        return await reader.readexactly(length)
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


async def ask_pty(path: Path, request: bytes, length: int) -> bytes:
    port = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        os.write(port, request)
        got = bytearray()

        def all_there() -> bool:
            with contextlib.suppress(BlockingIOError):
                got.extend(os.read(port, 4096))
            return len(got) >= length

        await eventually(all_there)
        return bytes(got)
    finally:
        os.close(port)


class UdpClient:
    """A socket of the operating system, which the emulator's end must work with."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)

    async def ask(self, endpoint: Endpoint, *datagrams: bytes) -> bytes:
        for datagram in datagrams:
            self.socket.sendto(datagram, endpoint.address)
        async with asyncio.timeout(5):
            return await asyncio.get_running_loop().sock_recv(self.socket, 4096)


@contextlib.asynccontextmanager
async def udp_server(unit: ModbusUnit, **options: float) -> AsyncIterator[tuple[UdpEnd, MbapServer, UdpClient]]:
    end = await UdpEnd.open(ANY_UDP)
    server = MbapServer({1: unit})
    task = asyncio.create_task(serve_udp(end, server, WallClock(), **options))
    client = UdpClient()
    try:
        yield end, server, client
    finally:
        client.socket.close()
        await end.aclose()
        await asyncio.wait_for(task, 5)  # a closed end ends the server by itself


@needs_openssl
def test_one_device_on_every_wire_at_once(tmp_path: Path, pki: Pki) -> None:
    async def main() -> None:
        unit, clock = make_unit(), WallClock()
        units = {1: unit}
        rtu = await PtyEnd.open(tmp_path / "rtu", Endpoint.parse("pty:rtu"))
        text = await PtyEnd.open(tmp_path / "ascii", Endpoint.parse("pty:ascii"))
        tcp = await SocketListener.open(ANY_TCP, lambda c: serve_mbap(c, MbapServer(units), clock))
        tls = await SocketListener.open(tls_endpoint(pki), lambda c: serve_mbap(c, MbapServer(units), clock))
        line = RtuServer(units)
        tunnel = await SocketListener.open(
            Endpoint.parse("rtu+tcp://127.0.0.1:0"), lambda c: serve_rtu(c, line, clock), 1
        )
        async with udp_server(unit) as (udp, _, client):
            serving = [
                asyncio.create_task(serve_rtu(rtu, RtuServer(units), clock)),
                asyncio.create_task(serve_rtu(text, AsciiServer(units), clock)),
            ]
            answers = await asyncio.gather(
                ask_pty(tmp_path / "rtu", RTU_READ, len(RTU_REPLY)),
                ask_pty(tmp_path / "ascii", ASCII_READ, len(ASCII_REPLY)),
                ask_tcp(tcp.bound, READ, len(REPLY)),
                ask_tcp(tls.bound, READ, len(REPLY), client_context(pki, "client")),
                ask_tcp(tunnel.bound, RTU_READ, len(RTU_REPLY)),
                client.ask(udp.bound, READ),
            )
            assert answers == [RTU_REPLY, ASCII_REPLY, REPLY, REPLY, RTU_REPLY, REPLY]
            await ask_tcp(tcp.bound, WRITE, len(WRITE))
            assert (await ask_pty(tmp_path / "ascii", b":010300010001FA\r\n", 15))[:11] == b":0103020005"
            counters = unit.counters
            assert (counters.requests, counters.replies, counters.bus_messages) == (8, 8, 8), "one device"
            for end in (rtu, text, tls, tcp, tunnel):
                await end.aclose()
            await asyncio.wait_for(asyncio.gather(*serving), 5)

    run(main())


# -- UDP ----------------------------------------------------------------------------------------------------------


def test_udp_each_datagram_for_itself() -> None:
    async def main() -> None:
        unit = make_unit()
        async with udp_server(unit) as (end, server, client):
            # truncated, length FFFFh, not Modbus, empty: none of them damages the next one, or is joined to it
            answer = await client.ask(
                end.bound, READ[:5], READ[:4] + b"\xff\xff" + READ[6:], b"GET / HTTP/1.1", b"", READ
            )
            assert answer == REPLY
            assert unit.counters.requests == 1
            assert server.discarded == 3
            two = await client.ask(end.bound, READ + WRITE + READ[:3])
            assert two == REPLY
            assert await client.ask(end.bound) == WRITE, "a reply a datagram"
            other = UdpClient()
            assert await asyncio.gather(client.ask(end.bound, READ), other.ask(end.bound, WRITE)) == [REPLY, WRITE]
            other.socket.close()

    run(main())


def test_udp_a_flood_is_dropped_and_counted() -> None:
    async def main() -> None:
        end = await UdpEnd.open(ANY_UDP, max_pending=4)
        client = UdpClient()
        for number in range(10):
            client.socket.sendto(bytes([number]), end.bound.address)
        await eventually(lambda: end.dropped == 6)
        assert [(await end.receive())[0] for _ in range(4)] == [b"\0", b"\1", b"\2", b"\3"]
        waiting = asyncio.create_task(end.receive())
        await asyncio.sleep(0)
        await end.aclose()
        with pytest.raises(ConnectionLost, match="closed on this side"):
            await waiting
        with pytest.raises(ConnectionLost):
            await end.send(b"x", ("127.0.0.1", 9))
        await end.aclose()
        client.socket.close()

    run(main())


def test_udp_a_vanished_sender_does_not_affect_the_others() -> None:
    async def main() -> None:
        async with udp_server(make_unit()) as (end, _, client):
            gone = UdpClient()
            gone.socket.sendto(READ, end.bound.address)
            gone.socket.close()
            assert await client.ask(end.bound, READ) == REPLY
            assert await client.ask(end.bound, READ) == REPLY

    run(main())


def test_udp_a_port_in_use_is_named() -> None:
    async def main() -> None:
        end = await UdpEnd.open(ANY_UDP)
        with pytest.raises(EndpointBusy, match="the port is in use"):
            await UdpEnd.open(end.bound)
        with pytest.raises(Unreachable, match="cannot listen"):
            await UdpEnd.open(Endpoint.parse("udp://192.0.2.1:0"))
        await end.aclose()

    run(main())


# -- TLS ----------------------------------------------------------------------------------------------------------


@needs_openssl
def test_tls_the_role_of_the_client_decides(pki: Pki) -> None:
    """MODBUS/TCP Security: a request that the role does not allow gets exception 01, and nothing is executed."""
    roles: list[str] = []

    async def main() -> None:
        unit = make_unit()

        async def serve(client: SocketEnd) -> None:
            roles.append(client.role)

            def allow(unit_id: int, pdu: bytes) -> bool:
                return client.role == "Operator" or (client.role == "Viewer" and pdu[0] == 3)

            await serve_mbap(client, MbapServer({1: unit}, allow=allow), WallClock())

        listener = await SocketListener.open(tls_endpoint(pki), serve)
        refused = bytes.fromhex("0002 0000 0003 01 86 01")
        assert await ask_tcp(listener.bound, WRITE, len(refused), client_context(pki, "viewer")) == refused
        assert unit.bank.read("holding", 1, 1, 0) == [0]
        assert await ask_tcp(listener.bound, READ, len(REPLY), client_context(pki, "viewer")) == REPLY
        assert await ask_tcp(listener.bound, WRITE, len(WRITE), client_context(pki, "client")) == WRITE
        assert unit.bank.read("holding", 1, 1, 0) == [5]
        assert await ask_tcp(listener.bound, WRITE, len(refused), client_context(pki, "plain")) == refused
        assert (unit.counters.requests, unit.counters.exceptions) == (4, 2)
        await listener.aclose()

    run(main())
    assert roles == ["Viewer", "Viewer", "Operator", ""]


@needs_openssl
def test_tls_a_client_without_a_certificate_is_refused(pki: Pki, tmp_path: Path) -> None:
    served: list[str] = []

    async def serve(client: SocketEnd) -> None:
        served.append(client.peer)
        await serve_mbap(client, MbapServer({1: make_unit()}), WallClock())

    async def main() -> None:
        strangers = make_pki(tmp_path)
        listener = await SocketListener.open(tls_endpoint(pki), serve)
        trusted_stranger = ssl.create_default_context(cafile=pki.ca)
        trusted_stranger.load_cert_chain(strangers.cert("client"), strangers.key("client"))
        for context in (client_context(pki, ""), trusted_stranger):
            with pytest.raises((ssl.SSLError, ConnectionError, asyncio.IncompleteReadError)):
                await ask_tcp(listener.bound, READ, len(REPLY), context)
        with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
            await ask_tcp(listener.bound, READ + READ, len(REPLY))  # no TLS at all
        assert served == []
        assert await ask_tcp(listener.bound, READ, len(REPLY), client_context(pki, "client")) == REPLY
        await listener.aclose()
        open_to_all = await SocketListener.open(tls_endpoint(pki, mutual=False), serve)
        assert await ask_tcp(open_to_all.bound, READ, len(REPLY), client_context(pki, "")) == REPLY
        await open_to_all.aclose()

    run(main())


@needs_openssl
def test_tls_files_that_cannot_be_used(pki: Pki, tmp_path: Path) -> None:
    async def main() -> None:
        for url, error, words in (
            ("tls://127.0.0.1:0", UsageError, "needs a certificate"),
            (f"tls://127.0.0.1:0?cert={tmp_path}/none.pem", Unreachable, "cannot read"),
            (f"tls://127.0.0.1:0?cert={pki.cert('server')}&key={pki.key('client')}", Unreachable, "cannot use"),
        ):
            with pytest.raises(error, match=words):
                await SocketListener.open(Endpoint.parse(url), lambda c: c.aclose())

    run(main())


@pytest.mark.parametrize(
    ("extension", "role"),
    [
        pytest.param("06 0B 2B 06 01 04 01 83 89 0C 86 22 01 04 04 0C 02 4F 70", "Op", id="plain"),
        pytest.param("06 0B 2B 06 01 04 01 83 89 0C 86 22 01 01 01 FF 04 04 0C 02 4F 70", "Op", id="critical"),
        pytest.param("06 0B 2B 06 01 04 01 83 89 0C 86 22 01 04 81 04 0C 81 01 4F", "O", id="long form of a length"),
        pytest.param("06 0B 2B 06 01 04 01 83 89 0C 86 22 01 04 03 16 01 4F", "", id="no UTF8String"),
        pytest.param("06 0B 2B 06 01 04 01 83 89 0C 86 22 01", "", id="cut off"),
        pytest.param("06 0B 2B 06 01 04 01 83 89 0C 86 22 02 04 03 0C 01 4F", "", id="another extension"),
        pytest.param("", "", id="nothing"),
    ],
)
def test_roles_in_der(extension: str, role: str) -> None:
    assert client_role(b"\x30\x20" + bytes.fromhex(extension)) == role
    assert client_role(None) == ""


# -- limits, echo, latency ----------------------------------------------------------------------------------------


def test_mb_065_priority_hosts_give_way_only_to_each_other() -> None:
    async def echo(client: SocketEnd) -> None:
        while True:
            await client.write(await client.read())

    async def connect(listener: SocketListener, host: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        accepted = listener.accepted
        pair = await asyncio.open_connection(*listener.bound.address, local_addr=(host, 0))
        await eventually(lambda: listener.accepted == accepted + 1)
        return pair

    async def main() -> None:
        listener = await SocketListener.open(ANY_TCP, echo, 2, frozenset({"127.0.0.7"}))
        first = await connect(listener, "127.0.0.7")
        other = await connect(listener, "127.0.0.8")
        first_writer, other_writer = first[1], other[1]
        other_writer.write(b"x")
        assert await other[0].readexactly(1) == b"x", "the one of no priority was used last"
        second = await connect(listener, "127.0.0.7")
        assert await other[0].read() == b"", "and gives way all the same"
        stranger = await connect(listener, "127.0.0.8")
        assert await stranger[0].read() == b"", "nobody may give way to it"
        third = await connect(listener, "127.0.0.7")
        assert await first[0].read() == b"", "the oldest unused of its kind"
        for reader, writer in (second, third):
            writer.write(b"y")
            assert await reader.readexactly(1) == b"y"
        assert (listener.accepted, listener.evicted, listener.refused) == (5, 2, 1)
        for writer in (first_writer, other_writer, second[1], third[1], stranger[1]):
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()
        await listener.aclose()

    run(main())


def test_mb_010_a_line_that_echoes(tmp_path: Path) -> None:
    async def main() -> None:
        end = await PtyEnd.open(tmp_path / "line", Endpoint.parse("pty:line"))
        task = asyncio.create_task(serve_rtu(end, RtuServer({1: make_unit()}), WallClock(), echo=True))
        assert await ask_pty(tmp_path / "line", RTU_READ, 15) == RTU_READ + RTU_REPLY
        assert await ask_pty(tmp_path / "line", b"\x05\x03", 2) == b"\x05\x03", "what nobody answers echoes too"
        await end.aclose()
        await asyncio.wait_for(task, 5)

    run(main())


def test_latency_is_asked_for_exchange_by_exchange() -> None:
    async def main() -> None:
        unit = make_unit()
        asked: list[bytes] = []

        def latency(exchange: ServedFrame) -> float:
            asked.append(exchange.heard)
            return 0.05 if exchange.heard == WRITE else 0.0

        listener = await SocketListener.open(
            ANY_TCP, lambda c: serve_mbap(c, MbapServer({1: unit}), WallClock(), latency)
        )
        loop = asyncio.get_running_loop()
        assert await ask_tcp(listener.bound, READ, len(REPLY)) == REPLY
        middle = loop.time()
        assert await ask_tcp(listener.bound, WRITE, len(WRITE)) == WRITE
        assert loop.time() - middle >= 0.05
        assert asked == [READ, WRITE]
        await listener.aclose()

    run(main())


def test_a_recorded_latency_ends_with_the_last_byte() -> None:
    line = SerialSettings(9600, "8N1")  # a character takes 1/960 s
    exchange = ServedFrame(RTU_READ, bytes(96), 0.25)
    assert as_recorded()(exchange) == 0.25
    assert as_recorded(line)(exchange) == pytest.approx(0.15)
    assert as_recorded(line)(ServedFrame(RTU_READ, bytes(96), 0.05)) == 0.0
