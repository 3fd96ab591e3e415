"""`TlsConnection` against a real TLS server: verification, error messages, roles, loss."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import ssl
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from modbus_pki import Pki, make_pki
from support import run

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.connections.sockets.tls import TlsConnection
from fieldtwin.gateway.connections.sockets.tls_role import ROLE_OID, role_in
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, ModbusExceptionReply, Unreachable, UsageError
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.wallclock import WallClock

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificates")


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Pki:
    made = make_pki(tmp_path_factory.mktemp("pki"))
    made.issue("other", "DNS:elsewhere")
    made.issue("plain")
    return made


def role_of(certificate: bytes | None) -> str:
    """Return the role as the server's side reads it: after its object identifier, by the tags of DER."""
    _, _, rest = (certificate or b"").partition(b"\x06\x0b" + ROLE_OID)
    return rest[4 : 4 + rest[3]].decode() if rest else ""


@contextlib.asynccontextmanager
async def server(
    pki: Pki, name: str = "server", *, version: ssl.TLSVersion = ssl.TLSVersion.TLSv1_3, mutual: bool = True
) -> AsyncIterator[tuple[Endpoint, list[str]]]:
    """A device with TLS: unit 1, register 0 is 42; without a role in the client's certificate it refuses writes."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(pki.cert(name), pki.key(name))
    context.maximum_version = version
    if mutual:
        context.verify_mode = ssl.CERT_REQUIRED
        context.load_verify_locations(pki.ca)
    roles: list[str] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, OSError):
            roles.append(role_of(writer.get_extra_info("ssl_object").getpeercert(True)))
            while True:
                request = await reader.readexactly(12)
                if request[7] == 3:
                    writer.write(request[:4] + bytes([0, 5, 1, 3, 2, 0, 42]))
                elif roles[-1] == "Operator":
                    writer.write(request)
                else:
                    writer.write(request[:4] + bytes([0, 3, 1, request[7] | 0x80, 1]))  # MBTLS 8.5: exception 01
        writer.close()

    listening = await asyncio.start_server(serve, "127.0.0.1", 0, ssl=context)
    try:
        yield Endpoint.parse(f"tls://127.0.0.1:{listening.sockets[0].getsockname()[1]}"), roles
    finally:
        listening.close()
        await listening.wait_closed()
        await asyncio.sleep(0.02)  # the server closes its streams in order


def with_files(endpoint: Endpoint, **files: str) -> Endpoint:
    return Endpoint.parse(str(endpoint) + "?" + "&".join(f"{name}={value}" for name, value in files.items()))


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_a_client_with_a_certificate_reads_and_writes_and_its_role_is_passed_on(
    pki: Pki, version: ssl.TLSVersion
) -> None:
    async def main() -> None:
        async with server(pki, version=version) as (at, roles):
            endpoint = with_files(at, ca=pki.ca, cert=pki.cert("client"), key=pki.key("client"))
            connection = await OsConnector().open_bytes(endpoint)
            assert isinstance(connection, TlsConnection)
            client = ModbusClient.at(endpoint, connection, WallClock())
            assert (await client.read_registers(1, "holding", 0, 1)).registers == (42,)
            assert (await client.write_register(1, 0, 7)).acknowledged
            assert (connection.role, connection.peer_role) == ("Operator", "Server of tests")
            assert connection.version.replace("v1.", "v1_") == version.name
            assert roles == ["Operator"]
            await client.aclose()

    run(main())


def test_without_a_role_the_server_refuses_restricted_functions(pki: Pki) -> None:
    async def main() -> None:
        async with server(pki) as (at, roles):
            endpoint = with_files(at, ca=pki.ca, cert=pki.cert("plain"), key=pki.key("plain"))
            connection = await TlsConnection.open(endpoint)
            client = ModbusClient.at(endpoint, connection, WallClock())
            assert (await client.read_registers(1, "holding", 0, 1)).registers == (42,)
            with pytest.raises(ModbusExceptionReply) as caught:
                await client.write_register(1, 0, 7)
            assert caught.value.code == 1
            assert (connection.role, roles) == ("", [""])
            await client.aclose()

    run(main())


@pytest.mark.parametrize(
    ("name", "files", "says"),
    [
        ("server", {}, "certificate is refused"),
        ("other", {"ca": "ca"}, "IP address mismatch"),
        ("server", {"ca": "ca", "name": "elsewhere"}, "Hostname mismatch"),
    ],
)
def test_a_server_with_a_wrong_certificate_is_refused(pki: Pki, name: str, files: dict[str, str], says: str) -> None:
    async def main() -> None:
        async with server(pki, name, mutual=False) as (at, _):
            given_files = {k: pki.ca if v == "ca" else v for k, v in files.items()}
            with pytest.raises(Unreachable, match=says):
                await TlsConnection.open(with_files(at, **given_files) if given_files else at)

    run(main())


def test_a_server_with_a_different_name_is_accepted_if_configured(pki: Pki) -> None:
    async def main() -> None:
        async with server(pki, "other", mutual=False) as (at, _):
            connection = await TlsConnection.open(with_files(at, ca=pki.ca, name="elsewhere"))
            assert (connection.role, connection.peer_role) == ("", "")
            await connection.aclose()

    run(main())


async def open_and_read(endpoint: Endpoint) -> None:
    connection = await TlsConnection.open(endpoint)
    try:
        await connection.read()
    finally:
        await connection.aclose()


def test_a_server_that_requires_a_certificate_reports_it_before_or_after_opening(pki: Pki) -> None:
    async def main() -> None:
        for version, error in ((ssl.TLSVersion.TLSv1_2, Unreachable), (ssl.TLSVersion.TLSv1_3, ConnectionLost)):
            async with server(pki, version=version) as (at, _):
                with pytest.raises(error):
                    await open_and_read(with_files(at, ca=pki.ca))

    run(main())


def test_a_server_without_tls_is_recognised_and_a_silent_one_times_out(pki: Pki) -> None:
    async def main() -> None:
        async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.read(1)
            writer.write(b"\x00\x01\x00\x00\x00\x03\x01\x83\x01")
            writer.close()

        talking = await asyncio.start_server(talk, "127.0.0.1", 0)
        endpoint = Endpoint.parse(f"tls://127.0.0.1:{talking.sockets[0].getsockname()[1]}?ca={pki.ca}")
        with pytest.raises(Unreachable, match="no TLS with that server"):
            await TlsConnection.open(endpoint)
        talking.close()
        await talking.wait_closed()

        async def listen(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.read()
            writer.close()

        silent = await asyncio.start_server(listen, "127.0.0.1", 0)
        endpoint = endpoint.with_address("127.0.0.1", silent.sockets[0].getsockname()[1])
        with pytest.raises(Unreachable, match="no answer within"):
            await TlsConnection.open(endpoint, timeout_s=0.2)
        silent.close()
        await silent.wait_closed()
        with pytest.raises(Unreachable, match="connection refused"):
            await TlsConnection.open(endpoint)

    run(main())


def test_bad_files_are_named_and_no_secret_is_shown(pki: Pki, tmp_path: Path) -> None:
    empty = tmp_path / "empty.pem"
    empty.write_text("")
    where = Endpoint.parse("tls://127.0.0.1:1")

    async def main() -> None:
        with pytest.raises(Unreachable, match=r"missing\.pem"):
            await TlsConnection.open(with_files(where, ca=str(tmp_path / "missing.pem")))
        with pytest.raises(Unreachable, match="TLS files"):
            await TlsConnection.open(with_files(where, ca=str(empty)))
        with pytest.raises(Unreachable, match="key"):
            await TlsConnection.open(with_files(where, ca=pki.ca, cert=pki.cert("client"), key=pki.key("plain")))
        with pytest.raises(UsageError, match="cert=FILE"):
            await TlsConnection.open(with_files(where, ca=pki.ca, key=pki.key("client")))

    run(main())
    with pytest.raises(UsageError, match="password"):
        with_files(where, password="secret")


def test_a_connection_closed_by_the_peer_is_lost(pki: Pki) -> None:
    async def main() -> None:
        async with server(pki) as (at, _):
            endpoint = with_files(at, ca=pki.ca, cert=pki.cert("client"), key=pki.key("client"))
            connection = await TlsConnection.open(endpoint)
            await connection.write(b"\x00\x01\x00\x00\x00\x06\x01\x03\x00\x00\x00\x01")
            assert len(await connection.read()) == 11
            connection._wire.transport.abort()
            with pytest.raises(ConnectionLost):
                await connection.read()
            await connection.aclose()
            await connection.aclose()

    run(main())


def test_the_role_is_read_from_a_certificate(pki: Pki) -> None:
    der = ssl.PEM_cert_to_DER_cert(Path(pki.cert("client")).read_text())
    assert role_in(der) == "Operator"
    assert role_in(der[:-1]) == role_in(b"") == ""
    at = der.index(ROLE_OID)
    assert role_in(der[:at] + b"\x00" + der[at + 1 :]) == ""


@given(st.binary(max_size=64), st.integers(0, 2000), st.integers(1, 64))
def test_no_bytes_make_the_reader_of_roles_stumble(damage: bytes, at: int, cut: int) -> None:
    body = b"\x30\x15\x06\x0b" + ROLE_OID + b"\x04\x06\x0c\x04Oper"
    wrapped = b"\x30\x1b\x30\x19\xa3\x17" + body
    for data in (damage, wrapped[:at] + damage + wrapped[at + cut :], wrapped + damage):
        assert isinstance(role_in(data), str)
