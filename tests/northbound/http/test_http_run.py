"""The HTTP server of a real run, with httpx and websockets as clients: roles, values, faults, writes, limits, and its restart."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
import websockets
from modbus_pki import make_pki
from procs import no_tracebacks, run_to_end, wait_for
from web_shed import OPERATE, TOKENS, VIEW, Served, plant, prototype, write_site

pytestmark = [pytest.mark.long, pytest.mark.timeout(180)]
SHED = "/instances/shed"
TAGS = f"{SHED}/tags"
WITHIN_S = 40.0


@pytest.fixture(scope="module")
def shed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("w")
    with prototype(folder) as served:
        with served.client() as client:
            wait_for(lambda: quality_of(client) == "good", WITHIN_S, "the tank is read")
        yield served
    no_tracebacks(folder)


def quality_of(client: httpx.Client, tag: str = "tank.level") -> str:
    answer = client.get(TAGS)
    return str(answer.json()[tag]["quality"]) if answer.status_code == 200 else ""


def test_a_client_without_a_valid_token_gets_nothing(shed: Served) -> None:
    for token in ("", "a-wrong-token-of-the-tests"):
        with shed.client(token) as client:
            for path in ("/instances", TAGS, "/openapi.json"):
                assert client.get(path).status_code == 401
    with shed.client() as client:
        assert client.get("/instances", headers={"Host": "evil.example"}).status_code == 403


def test_the_server_shows_its_run_only_and_has_no_pages(shed: Served) -> None:
    with shed.client() as client:
        [instance] = client.get("/instances").json()
        assert (instance["name"], instance["mode"], instance["running"]) == ("shed", "prototype", True)
        (shed.run.root / "other").mkdir(exist_ok=True)
        missing = client.get("/instances/other")
        assert (missing.status_code, missing.json()["error"]["kind"]) == (404, "NoInstance")
        assert client.get("/systems").status_code == 404
        assert client.get("/commissioning").status_code == 404
        assert client.get(shed.url + "/").status_code == 404
        described = client.get("/openapi.json").json()
        assert described["info"]["title"] == "fieldtwin run"
        assert "/api/v1/instances/{instance}/tags" in described["paths"]
        assert "post" not in described["paths"]["/api/v1/instances"]


def test_the_role_view_changes_nothing(shed: Served) -> None:
    with shed.client() as client:
        for method, path, body in (
            ("POST", f"{TAGS}/tank.valve/write", {"value": 1, "old": 0}),
            ("PUT", f"{TAGS}/tank.level/set", {"value": 1}),
            ("POST", f"{SHED}/faults", {"fault": {"name": "silence", "device": "tank"}}),
            ("POST", f"{SHED}/plc/pause", {}),
        ):
            answer = client.request(method, path, json=body)
            assert (answer.status_code, "the role operate" in answer.text) == (403, True), path
        assert client.get(f"{SHED}/faults").json()["active"] == []


def test_a_websocket_reports_that_a_silent_device_has_no_good_value(shed: Served) -> None:
    async def follow() -> list[list[Any]]:
        url = f"{shed.url}/api/v1{SHED}/stream".replace("http", "ws", 1)
        seen: list[list[Any]] = []
        async with websockets.connect(url, additional_headers={"Authorization": f"Bearer {VIEW}"}) as stream:
            assert json.loads(await stream.recv())["type"] == "hello"
            fault = {"fault": {"id": "f", "name": "silence", "device": "tank"}}
            await asyncio.to_thread(operate, "POST", f"{SHED}/faults", fault)
            async with asyncio.timeout(WITHIN_S):
                while not any(change[0] == "tank.level" and change[3] == "bad" for change in seen):
                    update = json.loads(await stream.recv())
                    seen += update["changes"] if update["type"] == "tags" else []
        return seen

    def operate(method: str, path: str, body: Any = None) -> None:
        with shed.client(OPERATE) as client:
            client.request(method, path, json=body).raise_for_status()

    try:
        seen = asyncio.run(follow())
        assert next(change[4] for change in seen if change[3] == "bad") == "timeout"
        with shed.client() as client:
            assert quality_of(client) == "bad"
    finally:
        operate("DELETE", f"{SHED}/faults")
    with shed.client() as client:
        wait_for(lambda: quality_of(client) == "good", WITHIN_S, "the tank is read again")


def test_long_messages_are_refused(shed: Served) -> None:
    async def send() -> int:
        url = f"{shed.url}/api/v1{SHED}/stream".replace("http", "ws", 1)
        async with websockets.connect(url, additional_headers={"Authorization": f"Bearer {VIEW}"}) as stream:
            await stream.send("x" * 70_000)
            with contextlib.suppress(websockets.ConnectionClosed):
                async with asyncio.timeout(WITHIN_S):
                    while True:
                        await stream.recv()
            assert stream.close_code is not None
            return stream.close_code

    assert asyncio.run(send()) == 1009
    with shed.client(OPERATE) as client:
        answer = client.post(f"{TAGS}/tank.valve/write", content=b"x" * (1 << 20) + b"x")
        assert (answer.status_code, "too long" in answer.text) == (400, True)


def test_the_status_of_the_gateway_shows_the_server_and_its_clients(shed: Served) -> None:
    gateway = shed.run.control("shed", "gateway")

    def status() -> dict[str, Any]:
        return dict(gateway("get", brief=True)["serve"]["web"])

    with shed.client() as client:
        client.get("/instances")
        found = wait_for(lambda: (s := status()) and s["clients"] and s, WITHIN_S, "a client")
    assert (found["kind"], found["listening"], found["error"]) == ("http", shed.url, "")
    assert found["counters"]["requests"] > 0


def test_a_write_to_a_plant_keeps_the_rules_of_the_run_and_is_audited(tmp_path: Path) -> None:
    with plant(tmp_path, "--allow-writes") as served, served.client(OPERATE) as client:
        wait_for(lambda: quality_of(client, "tank.valve") == "good", WITHIN_S, "the valve is read")
        path = f"{TAGS}/tank.valve/write"
        client.post(path, json={"value": 1, "old": 0}).raise_for_status()
        wait_for(lambda: client.get(TAGS).json()["tank.valve"]["value"] == 1, WITHIN_S, "the valve is open")
        assert [e["by"] for e in served.audit() if e.get("tag") == "tank.valve" and e["result"] == "done"] == [
            "http web 127.0.0.1"
        ]
        beyond = wait_for(
            lambda: (r := client.post(path, json={"value": 7, "old": 1})).status_code != 503 and r, WITHIN_S
        )
        assert beyond.status_code == 403  # beyond the range of the profile
        assert client.post(path, json={"value": 0, "old": 0}).status_code == 409  # the client saw an older value
        assert client.post(f"{TAGS}/tank.level/write", json={"value": 1, "old": 0}).status_code in (403, 409)
        assert client.post(f"{SHED}/faults", json={"fault": {"name": "silence"}}).status_code == 403


def test_a_read_only_plant_takes_no_write(tmp_path: Path) -> None:
    with plant(tmp_path) as served, served.client(OPERATE) as client:
        wait_for(lambda: quality_of(client, "tank.valve") == "good", WITHIN_S, "the valve is read")
        answer = client.post(f"{TAGS}/tank.valve/write", json={"value": 1, "old": 0})
        assert answer.status_code == 403
        [refusal] = [entry for entry in served.audit() if entry.get("tag") == "tank.valve"]
        assert (refusal["action"], refusal["cause"], refusal["by"]) == ("refuse", "read-only", "http web 127.0.0.1")


def test_without_a_token_clients_on_loopback_only_read(tmp_path: Path) -> None:
    with prototype(tmp_path, "clients: 4") as served, served.client("") as client:
        wait_for(lambda: quality_of(client) == "good", WITHIN_S, "the tank is read")
        answer = client.put(f"{TAGS}/tank.level/set", json={"value": 1})
        assert (answer.status_code, "the role operate" in answer.text) == (403, True)

        parts = urlsplit(served.url)
        held = [socket.create_connection((str(parts.hostname), int(parts.port or 0))) for _ in range(4)]
        try:
            wait_for(lambda: httpx.get(f"{served.url}/api/v1/instances").status_code == 503, WITHIN_S, "a refusal")
        finally:
            for connection in held:
                connection.close()
        wait_for(lambda: httpx.get(f"{served.url}/api/v1/instances").status_code == 200, WITHIN_S, "a free place")


def test_https_uses_the_certificate_of_the_system_file(tmp_path: Path) -> None:
    pki = make_pki(tmp_path)
    keys = f"certificate: server.pem, key: server.key, {TOKENS}"
    with prototype(tmp_path, keys, "https://127.0.0.1:8443") as served:
        assert served.url.startswith("https://127.0.0.1:")
        trusted = ssl.create_default_context(cafile=pki.ca)
        with served.client(verify=trusted) as client:
            assert client.get("/instances").status_code == 200
        with pytest.raises(httpx.ConnectError, match="certificate verify failed"):
            httpx.get(served.url)


def test_a_dead_server_process_is_reported_and_restarted(tmp_path: Path) -> None:
    with prototype(tmp_path) as served:
        killed = server_pid(served)
        os.kill(killed, signal.SIGKILL)
        wait_for(lambda: server_pid(served) not in (0, killed), WITHIN_S, "a new process")
        gateway = served.run.control("shed", "gateway")

        def url() -> str:
            listening = gateway("get", brief=True)["serve"]["web"]["listening"]
            return listening if listening and listening != served.url else ""

        again = Served(served.run, wait_for(url, WITHIN_S, "the new server"))
        with again.client() as client:
            assert client.get("/instances").status_code == 200
        served.run.signal(signal.SIGINT)
        served.run.wait()
        assert "http-web: ended with signal 9" in served.run.err + served.run.out


def server_pid(served: Served) -> int:
    """The process ID of the HTTP server of this run, or 0."""
    for entry in Path("/proc").iterdir():
        try:
            words = (entry / "cmdline").read_bytes().split(b"\0") if entry.name.isdigit() else []
        except OSError:
            continue
        if b"fieldtwin.studio.run_api.process" in words and str(served.run.root).encode() in b"".join(words):
            return int(entry.name)
    return 0


def test_an_unusable_token_is_reported_before_the_run_starts(tmp_path: Path) -> None:
    system = write_site(tmp_path, f'url: "http://127.0.0.1:0", {TOKENS}')
    (tmp_path / "view").write_text("short")
    ended = run_to_end(tmp_path, "run", str(system), "--prototype")
    assert ended.process.returncode == 3
    assert "not a token" in ended.err
    assert "short" not in ended.err
