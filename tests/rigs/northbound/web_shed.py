"""A site with one tank whose run is served over HTTP: as a prototype, or as a plant against an emulator on a real socket."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from procs import Fieldtwin, fieldtwin, free_port, wait_for
from shed_site import FILES

VIEW, OPERATE = "view-token-of-the-tests", "operate-token-of-the-tests"
WITHIN_S = 60.0


@dataclass(frozen=True)
class Served:
    """A run with the URL of its HTTP server."""

    run: Fieldtwin
    url: str

    def client(self, token: str = VIEW, **options: Any) -> httpx.Client:
        """Return a client of the interface; without a token for ""."""
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        return httpx.Client(base_url=f"{self.url}/api/v1", headers=headers, timeout=30, **options)

    def audit(self) -> list[dict[str, Any]]:
        """Return the entries of the gateway's audit log."""
        text = (self.run.root / "shed" / "audit.jsonl").read_text(encoding="utf-8")
        return [json.loads(line) for line in text.splitlines()]


def write_site(folder: Path, server: str, port: int = 502) -> Path:
    """Write the files of the site, with `server` as keys of its HTTP server, and return the system file."""
    (folder / "view").write_text(VIEW)
    (folder / "operate").write_text(OPERATE)
    for name, text in FILES.items():
        (folder / name).write_text(text)
    system = folder / "shed.yaml"
    text = FILES["shed.yaml"].replace("tank:502", f"127.0.0.1:{port}")
    system.write_text(f"{text}serve:\n  web: {{kind: http, {server}}}\n")
    return system


TOKENS = "view_token: view, operate_token: operate"


@contextmanager
def prototype(folder: Path, keys: str = TOKENS, url: str = "http://127.0.0.1:8080") -> Iterator[Served]:
    """Run the prototype of the site; its HTTP server has a free port."""
    system = write_site(folder, f'url: "{url}", {keys}' if keys else f'url: "{url}"')
    with fieldtwin(folder, "run", str(system), "--prototype") as run:
        yield Served(run, listening(run))


@contextmanager
def plant(folder: Path, *options: str) -> Iterator[Served]:
    """Run the site as a plant against an emulator on a real socket."""
    port = free_port()
    system = write_site(folder, f'url: "http://127.0.0.1:0", {TOKENS}', port)
    with ExitStack() as stack:
        device = ("emulate", str(folder / "tank.yaml"), "--on", f"tcp://127.0.0.1:{port}")
        emulator = stack.enter_context(fieldtwin(folder, *device, name="emulate"))
        wait_for(lambda: str(port) in emulator.out + emulator.err, WITHIN_S, "the emulator")
        run = stack.enter_context(fieldtwin(folder, "run", str(system), "--plant", *options))
        yield Served(run, listening(run))


def listening(run: Fieldtwin) -> str:
    """Return the URL of the HTTP server as soon as it listens."""
    wait_for((run.root / "shed" / "gateway.sock").is_socket, WITHIN_S, "the gateway")
    gateway = run.control("shed", "gateway")
    return str(wait_for(lambda: gateway("get", brief=True)["serve"]["web"]["listening"], WITHIN_S, "the HTTP server"))
