"""A server of kind `http` in a system file: its defaults, its free port in a prototype, and errors with their places."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.twin.site.servers.serving_http import HttpServeConfig
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
    path.write_text(f"{SYSTEM}  web: {server}\n", encoding="utf-8")
    return load_system(str(path))


def test_a_server_has_defaults_and_takes_a_free_port_in_a_prototype(tmp_path: Path) -> None:
    serving = load(tmp_path, '{kind: http, url: "http://127.0.0.1:8080"}').serving
    assert serving.http == (HttpServeConfig("web", "127.0.0.1", 8080),)
    assert serving.for_run(allow_writes=False, free_ports=False).http[0].url == "http://127.0.0.1:8080"
    assert serving.for_run(allow_writes=False, free_ports=True).http[0].port == 0
    assert [server.name for server in serving.separate] == ["web"]


def test_paths_are_relative_to_the_system_file(tmp_path: Path) -> None:
    server = '{kind: http, url: "https://[::1]:8443/", certificate: c.pem, key: k.pem, operate_token: /etc/operate}'
    [config] = load(tmp_path, server).serving.http
    assert (config.certificate, config.key) == (tmp_path / "c.pem", tmp_path / "k.pem")
    assert config.operate_token == Path("/etc/operate")
    assert config.url == "https://[::1]:8443"


@pytest.mark.parametrize(
    "server",
    [
        '{kind: http, url: "https://192.0.2.5:8443", certificate: c, key: k, view_token: t}',
        '{kind: http, url: "http://192.0.2.5:8080", insecure: true, view_token: t}',
        '{kind: http, url: "https://0.0.0.0:8443", certificate: c, key: k, view_token: t, names: [gateway.example]}',
    ],
)
def test_a_server_beyond_loopback_has_a_token_and_tls_or_a_stated_exception(tmp_path: Path, server: str) -> None:
    assert load(tmp_path, server).serving.http[0].view_token == tmp_path / "t"


@pytest.mark.parametrize(
    ("server", "place", "text"),
    [
        ("{kind: http}", "7:3", "the key 'url' is missing"),
        ('{kind: http, url: "http://127.0.0.1:1", tags: {}}', "7:48", "unknown key 'tags'"),
        ('{kind: http, url: "http://127.0.0.1:1", clients: 0}', "7:48", "at least 1"),
        ('{kind: http, url: "tcp://127.0.0.1:8080"}', "7:21", "expected http://HOST:PORT"),
        ('{kind: http, url: "http://127.0.0.1"}', "7:21", "expected http://HOST:PORT"),
        ('{kind: http, url: "http://127.0.0.1:99999"}', "7:21", "expected http://HOST:PORT"),
        ('{kind: http, url: "http://127.0.0.1:80/api"}', "7:21", "expected http://HOST:PORT"),
        ('{kind: http, url: "http://me@127.0.0.1:80"}', "7:21", "expected http://HOST:PORT"),
        ('{kind: http, url: "https://127.0.0.1:8080"}', "7:21", "https needs a certificate"),
        ('{kind: http, url: "http://127.0.0.1:8080", certificate: c.pem}', "7:51", "http has no certificate"),
        ('{kind: http, url: "http://127.0.0.1:8080", key: k.pem}', "7:51", "http has no key"),
        ('{kind: http, url: "http://192.0.2.5:8080"}', "7:21", "without a token a server listens on loopback only"),
        ('{kind: http, url: "http://192.0.2.5:8080", view_token: t}', "7:21", "everyone on the network can read the token"),
        ('{kind: http, url: "http://0.0.0.0:80", view_token: t, insecure: true}', "7:21", r"expected `names: \["),
        ('{kind: http, url: "http://127.0.0.1:1502"}', "7:21", "is taken by serve 'hmi'"),
    ],
)  # fmt: skip
def test_an_error_states_its_place(tmp_path: Path, server: str, place: str, text: str) -> None:
    with pytest.raises(FileInvalid, match=text) as caught:
        load(tmp_path, server)
    assert f"site.yaml:{place}:" in str(caught.value)
