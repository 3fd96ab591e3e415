"""Writes from Studio to the devices of a plant: the gateway's rules hold, and the audit log has each attempt."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from shed_site import FILES
from studio_rig import Studio, studio, until

SITE = {
    "shed.yaml": """fieldtwin: 1
system: shed
buses: {lan: {url: "tcp://127.0.0.1:PORT", timeout_ms: 500}}
devices: {tank: {profile: tank.yaml, bus: lan, unit: 1, poll: {values: {every_ms: 100}}, writable: [valve]}}
""",
    "tank.yaml": FILES["tank.yaml"],
}
TAG = "/instances/shed/tags"


@contextmanager
def process(*arguments: str, root: Path, ready: str) -> Iterator[None]:
    log = root / f"{arguments[0]}.log"
    environment = os.environ | {"FIELDTWIN_RUN": str(root / "run")}
    with log.open("wb") as out:
        command = [sys.executable, "-m", "fieldtwin", *arguments]
        child = subprocess.Popen(command, cwd=root, stdout=out, stderr=subprocess.STDOUT, env=environment)
    try:
        until(
            lambda: ready in log.read_text() or child.poll() is not None, f"{arguments[0]} is ready: {log.read_text()}"
        )
        assert child.poll() is None, log.read_text()
        yield
    finally:
        child.send_signal(signal.SIGINT)
        child.wait(20)


def free_port() -> int:
    import socket

    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


@contextmanager
def plant(root: Path, *options: str) -> Iterator[Studio]:
    """A plant with one tank, and a Studio that observes it."""
    port = free_port()
    for name, text in SITE.items():
        (root / name).write_text(text.replace("PORT", str(port)))
    with (
        process("emulate", "tank.yaml", "--on", f"tcp://127.0.0.1:{port}", root=root, ready=str(port)),
        studio(root=root) as running,
        process("run", "shed.yaml", "--plant", *options, "--log", "text", root=root, ready="started"),
    ):
        until(lambda: value(running, "tank.valve") == 0, "the valve is read")
        yield running


def value(running: Studio, tag: str) -> Any:
    with running.client() as client:
        answer = client.get(TAG)
        return answer.json()[tag]["value"] if answer.status_code == 200 else None


def audit(root: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (root / "run" / "shed" / "audit.jsonl").read_text().splitlines()]


@pytest.fixture
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("w")


def test_a_write_reaches_the_device_and_is_audited_with_the_user(root: Path) -> None:
    with plant(root, "--allow-writes") as running, running.client() as client:
        answer = client.post(f"{TAG}/tank.valve/write", json={"value": 1, "old": 0})
        assert answer.status_code == 200, answer.text
        until(lambda: value(running, "tank.valve") == 1, "the device holds the value")
        written = [entry for entry in audit(root) if "tank.valve" in json.dumps(entry)]
        assert any("studio" in json.dumps(entry) for entry in written)

        changed = client.post(f"{TAG}/tank.valve/write", json={"value": 0, "old": 0})
        assert changed.status_code == 409
        assert "has changed since it was shown" in changed.json()["error"]["message"]

        beyond = until(
            lambda: (
                (answer := client.post(f"{TAG}/tank.valve/write", json={"value": 7, "old": 1})).status_code != 503
                and answer
            ),
            "the gateway takes another write",
        )
        assert beyond.status_code == 403, beyond.text
        refused = client.post(f"{TAG}/tank.level/write", json={"value": 7, "old": value(running, "tank.level")})
        assert refused.status_code == 403, refused.text
        assert value(running, "tank.valve") == 1


def test_a_read_only_plant_takes_no_write(root: Path) -> None:
    with plant(root) as running, running.client() as client:
        assert client.get("/instances/shed").json()["allow_writes"] is False
        answer = client.post(f"{TAG}/tank.valve/write", json={"value": 1, "old": 0})
        assert answer.status_code == 403, answer.text
        assert client.put(f"{TAG}/tank.valve/set", json={"value": 1}).status_code == 403
        assert client.post("/instances/shed/faults", json={"fault": {"name": "silence"}}).status_code == 403
        assert value(running, "tank.valve") == 0
        assert any("tank.valve" in json.dumps(entry) for entry in audit(root))
