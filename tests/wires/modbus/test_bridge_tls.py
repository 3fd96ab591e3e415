"""TLS for the gateway's servers: real certificates, accepted clients, and the permissions of a role (MODBUS/TCP Security)."""

from __future__ import annotations

import asyncio
import json
import shutil
import ssl
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from modbus_pki import Pki, make_pki
from pymodbus.client import AsyncModbusTlsClient
from support import eventually, run

from fieldtwin.emulators.endpoints.modbus_server import serve_mbap
from fieldtwin.emulators.endpoints.socket_end import SocketListener
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.connections.sockets.listeners import TcpListener
from fieldtwin.gateway.connections.sockets.tls import TlsConnection
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, ModbusExceptionReply, Unreachable, UsageError
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.server.analysis import READ_FUNCTIONS, WRITE_FUNCTIONS
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.bridge.bridge import Bridge, BridgeConfig
from fieldtwin.gateway.runtime.bridge.policy import AllowRule, Policy
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.serve import ServeConfig, ServedTag, TagServer
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificates")
CLOCK = WallClock()


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Pki:
    made = make_pki(tmp_path_factory.mktemp("pki"))
    made.issue("viewer", role="Viewer")
    made.issue("plain")
    return made


def listening(pki: Pki, **others: str) -> Endpoint:
    files = {"cert": pki.cert("server"), "key": pki.key("server"), "ca": pki.ca} | others
    return Endpoint.parse("tls://127.0.0.1:0?" + "&".join(f"{k}={v}" for k, v in files.items() if v))


@asynccontextmanager
async def client(pki: Pki, name: str, port: int, issued_by: Pki | None = None) -> AsyncIterator[ModbusClient]:
    """A client that trusts the server's authority and presents NAME's certificate; without a name, no certificate."""
    own = issued_by or pki
    files = f"ca={pki.ca}" + (f"&cert={own.cert(name)}&key={own.key(name)}" if name else "")
    connection = await TlsConnection.open(Endpoint.parse(f"tls://127.0.0.1:{port}?{files}"))
    made = ModbusClient(connection, CLOCK, framing="mbap", timeout_s=3)
    try:
        yield made
    finally:
        await made.aclose()


@asynccontextmanager
async def bridge(pki: Pki, folder: Path, rules: tuple[AllowRule, ...]) -> AsyncIterator[tuple[Bridge, MapBank]]:
    """A bridge with TLS that leads to a unit on TCP."""
    bank = MapBank([CellSpan("holding", 0, 16)])
    bank.poke("holding", 0, 7)
    device = await SocketListener.open(
        Endpoint.parse("tcp://127.0.0.1:0"), lambda c: serve_mbap(c, MbapServer({1: ModbusUnit(bank)}), CLOCK)
    )
    audit = AuditLog(folder / "audit.jsonl", CLOCK)
    bus = ModbusBus(BusConfig("plc", device.bound), [], OsConnector(), CLOCK, TagTable(CLOCK), lambda d: None)
    config = BridgeConfig("b", listening(pki), to="plc", policy=Policy(rules, allow_writes=True))
    made = Bridge(config, {"plc": bus}, OsConnector(), CLOCK, audit)
    try:
        async with Nursery() as nursery:
            nursery.start(bus.run(), "bus")
            nursery.start(made.run(), "bridge")
            await eventually(lambda: made.front.bound is not None and bus.connected)
            yield made, bank
    finally:
        await device.aclose()
        audit.close()


async def code(asking: Any) -> int:
    with pytest.raises(ModbusExceptionReply) as caught:
        await asking
    return caught.value.code


def test_a_role_limits_a_bridges_client_and_is_recorded(pki: Pki, tmp_path: Path) -> None:
    rules = (
        AllowRule(roles=frozenset({"Viewer", "Operator"})),
        AllowRule(roles=frozenset({"Operator"}), functions=READ_FUNCTIONS | WRITE_FUNCTIONS),
    )

    async def main() -> None:
        async with bridge(pki, tmp_path, rules) as (b, bank):
            assert b.front.bound is not None
            port = b.front.bound.port
            async with client(pki, "viewer", port) as viewer:
                assert (await viewer.read_registers(1, "holding", 0, 1)).registers == (7,)
                assert await code(viewer.write_register(1, 0, 8)) == 1
            async with client(pki, "plain", port) as nobody:
                assert await code(nobody.read_registers(1, "holding", 0, 1)) == 1
            async with client(pki, "client", port) as operator:
                await operator.write_register(1, 0, 9)
            assert bank.read("holding", 0, 1, 0) == [9]
            notes = [json.loads(line) for line in (tmp_path / "audit.jsonl").read_text("ascii").splitlines()]
            assert [n["result"] for n in notes] == ["the allow list of the bridge refuses it", "asked", "done"]
            assert notes[0]["by"].endswith("(Viewer)")
            assert notes[-1]["by"].endswith("(Operator)")

    run(main())


def test_a_client_without_our_certificate_is_refused(pki: Pki, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    foreign = make_pki(tmp_path / "elsewhere")

    async def main() -> None:
        async with bridge(pki, tmp_path, (AllowRule(),)) as (b, _):
            assert b.front.bound is not None
            port = b.front.bound.port
            for name in ("", "client"):
                with pytest.raises((ConnectionLost, Unreachable)):
                    # In TLS 1.3 the client completes the handshake before the server has seen its certificate.
                    async with client(pki, name, port, foreign) as shut_out:
                        await shut_out.read_registers(1, "holding", 0, 1)
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(bytes.fromhex("0001 0000 0006 01 03 0000 0001"))  # Modbus without TLS
            assert (await reader.read(64))[:1] in (b"", b"\x15")  # closed, or a TLS alert
            writer.close()
            await eventually(lambda: b.front.status().counters["unshaken"] == 3)
            async with client(pki, "plain", port) as good:
                assert (await good.read_registers(1, "holding", 0, 1)).registers == (7,)
            assert b.counters.requests == 1

    run(main())


def test_served_tags_for_roles(pki: Pki) -> None:
    class Writes:
        asked: list[tuple[str, float, str]]

        def __init__(self) -> None:
            self.asked = []

        def request(self, tag: str, value: float, by: str, done: Any) -> None:
            self.asked.append((tag, value, by))
            done(None)

    async def main() -> None:
        tags, writes = TagTable(CLOCK), Writes()
        tags.declare(["d.period"], 60_000)
        tags.put("d.period", TagValue(5, Quality.GOOD, Reason.NONE, CLOCK.monotonic_ns()))
        config = ServeConfig(
            "hmi",
            listening(pki),
            1,
            (ServedTag("d.period", "holding", 0, "int16", write=True),),
            roles=frozenset({"Viewer", "Operator"}),
            write_roles=frozenset({"Operator"}),
        )
        server = TagServer(config, tags, writes, CLOCK)
        async with Nursery() as nursery:
            nursery.start(server.run(), "server")
            await eventually(lambda: server.front.bound is not None)
            assert server.front.bound is not None
            port = server.front.bound.port
            async with client(pki, "viewer", port) as viewer:
                assert (await viewer.read_registers(1, "holding", 0, 1)).registers == (5,)
                assert await code(viewer.write_register(1, 0, 6)) == 1
            async with client(pki, "plain", port) as nobody:
                assert await code(nobody.read_registers(1, "holding", 0, 1)) == 1
            async with client(pki, "client", port) as operator:
                await operator.write_register(1, 0, 6)
        assert [(tag, value) for tag, value, _ in writes.asked] == [("d.period", 6)]
        assert writes.asked[0][2].endswith("(Operator)")

    run(main())


def test_pymodbus_with_its_own_tls(pki: Pki, tmp_path: Path) -> None:
    async def main() -> None:
        context = ssl.create_default_context(cafile=pki.ca)
        context.check_hostname = False
        context.load_cert_chain(pki.cert("client"), pki.key("client"))
        async with bridge(pki, tmp_path, (AllowRule(),)) as (b, _):
            assert b.front.bound is not None
            theirs = AsyncModbusTlsClient("127.0.0.1", port=b.front.bound.port, sslctx=context, timeout=3)
            assert await theirs.connect()
            try:
                reply = await theirs.read_holding_registers(0, count=1, device_id=1)
                assert reply.registers == [7]
            finally:
                theirs.close()

    run(main())


def test_a_client_that_never_shakes_hands_gives_its_place_away(pki: Pki) -> None:
    async def main() -> None:
        async def serve(connection: Any) -> None:
            await connection.read()

        listener = await TcpListener.open(listening(pki), serve, max_clients=1)
        port = listener.bound.port
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        await eventually(lambda: listener.accepted == 1)
        async with client(pki, "client", port):
            await eventually(lambda: [c.role for c in listener.clients] == ["Operator"])
            assert listener.evicted == 1
            assert await asyncio.wait_for(reader.read(1), 5) == b""
        writer.close()
        await listener.aclose()

    run(main())


def test_the_silent_are_closed_after_a_while() -> None:
    async def main() -> None:
        async def serve(connection: Any) -> None:
            while True:
                await connection.read()

        listener = await TcpListener.open(Endpoint.parse("tcp://127.0.0.1:0"), serve, idle_s=0.15)
        reader, writer = await asyncio.open_connection("127.0.0.1", listener.bound.port)
        other, talking = await asyncio.open_connection("127.0.0.1", listener.bound.port)
        began = asyncio.get_running_loop().time()
        while listener.retired == 0:
            talking.write(b"x")
            await asyncio.sleep(0.02)
            assert asyncio.get_running_loop().time() < began + 5
        assert await asyncio.wait_for(reader.read(1), 5) == b""
        assert len(listener.clients) == 1
        assert await asyncio.wait_for(other.read(1), 5) == b""  # it stops sending too
        assert listener.retired == 2
        writer.close()
        talking.close()
        await listener.aclose()

    run(main())


def test_files_that_cannot_be_used_are_named(pki: Pki, tmp_path: Path) -> None:
    async def nobody(connection: Any) -> None:
        raise AssertionError

    async def main() -> None:
        for endpoint, kind, says in (
            (listening(pki, ca=""), UsageError, "no ca"),
            (listening(pki, cert="", ca=""), UsageError, "no cert and no ca"),
            (listening(pki, name="x"), UsageError, "only for clients"),
            (listening(pki, cert=str(tmp_path / "none.pem")), Unreachable, "cannot read the TLS files"),
            (listening(pki, key=pki.key("client")), Unreachable, "cannot use the TLS files"),
        ):
            with pytest.raises(kind) as caught:
                await TcpListener.open(endpoint, nobody)
            assert says in str(caught.value)

    run(main())
