"""A server of kind `opcua` in a system file: its defaults, its free port in a prototype, and errors with their places."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.twin.site.servers.serving_opcua import OpcuaSecurity, OpcuaServeConfig
from fieldtwin.twin.site.system import System, load_system

SYSTEM = """\
fieldtwin: 1
system: site
buses: {lan: {url: "tcp://192.0.2.1:502"}}
devices: {meter: {profile: eastron-sdm630, bus: lan, unit: 1}}
serve:
  hmi: {url: "tcp://127.0.0.1:1502", tags: {meter.frequency: {input: 0}}}
"""


def load(folder: Path, server: str) -> System:
    path = folder / "site.yaml"
    path.write_text(f"{SYSTEM}  scada: {server}\n", encoding="utf-8")
    return load_system(str(path))


def test_a_server_stands_next_to_modbus_servers_and_takes_a_free_port_in_a_prototype(tmp_path: Path) -> None:
    system = load(tmp_path, '{kind: opcua, url: "opc.tcp://127.0.0.1:4840"}')
    assert [each.name for each in system.serving.serve] == ["hmi"]
    assert system.serving.opcua == (OpcuaServeConfig("scada", "127.0.0.1", 4840, every_ms=100, clients=16),)
    assert system.serving.for_run(allow_writes=False, free_ports=False).opcua[0].url == "opc.tcp://127.0.0.1:4840"
    assert system.serving.for_run(allow_writes=False, free_ports=True).opcua[0].port == 0


@pytest.mark.parametrize("host", ["localhost", "127.0.0.9", "[::1]"])
def test_every_loopback_address_is_accepted(tmp_path: Path, host: str) -> None:
    [server] = load(tmp_path, f'{{kind: opcua, url: "opc.tcp://{host}:4840/"}}').serving.opcua
    assert server.url == f"opc.tcp://{host}:4840"


@pytest.mark.parametrize(
    ("server", "place", "text"),
    [
        ('{kind: opcau, url: "opc.tcp://127.0.0.1:4840"}', "7:11", r"expected modbus or opcua or http or mqtt; got 'opcau'"),
        ("{kind: opcua}", "7:3", "the key 'url' is missing"),
        ('{kind: opcua, url: "opc.tcp://127.0.0.1:4840", tags: {}}', "7:57", "unknown key 'tags'"),
        ('{kind: opcua, url: "opc.tcp://127.0.0.1:1", every_ms: 5}', "7:54", "at least 10"),
        ('{kind: opcua, url: "tcp://127.0.0.1:4840"}', "7:24", "expected opc.tcp://HOST:PORT"),
        ('{kind: opcua, url: "opc.tcp://127.0.0.1"}', "7:24", "expected opc.tcp://HOST:PORT"),
        ('{kind: opcua, url: "opc.tcp://127.0.0.1:99999"}', "7:24", "expected opc.tcp://HOST:PORT"),
        ('{kind: opcua, url: "opc.tcp://me@127.0.0.1:4840"}', "7:24", "expected opc.tcp://HOST:PORT"),
        ('{kind: opcua, url: "opc.tcp://0.0.0.0:4840"}', "7:24", "without `security` listens on loopback only"),
        ('{kind: opcua, url: "opc.tcp://scada.example:4840"}', "7:24", "loopback only"),
        ('{kind: opcua, url: "opc.tcp://127.0.0.1:1502"}', "7:24", "is taken by serve 'hmi'"),
    ],
)  # fmt: skip
def test_an_error_states_its_place(tmp_path: Path, server: str, place: str, text: str) -> None:
    with pytest.raises(FileInvalid, match=text) as caught:
        load(tmp_path, server)
    assert f"site.yaml:{place}:" in str(caught.value)


SECURITY = "security: {certificate: pki/own.der, key: /keys/own.key, trusted: pki/trusted, users: users.yaml}"


@pytest.mark.parametrize("host", ["0.0.0.0", "127.0.0.1", "gateway.example", "[::]"])
def test_a_server_with_security_may_listen_anywhere_and_its_paths_begin_at_the_system_file(
    tmp_path: Path, host: str
) -> None:
    [server] = load(tmp_path, f'{{kind: opcua, url: "opc.tcp://{host}:4840", {SECURITY}}}').serving.opcua
    assert server.url == f"opc.tcp://{host}:4840"
    assert server.security == OpcuaSecurity(
        certificate=tmp_path / "pki/own.der",
        key=Path("/keys/own.key"),
        trusted=tmp_path / "pki/trusted",
        users=tmp_path / "users.yaml",
    )


def test_security_needs_all_of_its_files(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="the key 'users' is missing"):
        load(tmp_path, f'{{kind: opcua, url: "opc.tcp://127.0.0.1:1", {SECURITY.replace(", users: users.yaml", "")}}}')


def test_two_servers_cannot_share_a_port(tmp_path: Path) -> None:
    server = '{kind: opcua, url: "opc.tcp://127.0.0.1:4840"}'
    with pytest.raises(FileInvalid, match=r"site\.yaml:8:24: opc.tcp://127.0.0.1:4840 is taken by serve 'scada'"):
        load(tmp_path, f"{server}\n  again: {server}")
