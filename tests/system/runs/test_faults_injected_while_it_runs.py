"""A fault that Studio or a script injects into a running prototype does not make the run "not ok", as one of `--faults` does not.

Defect: a silence injected through the control channel took requests away, and the run ended with "the gateway counted 3382
requests, the emulators 3362" and exit code 1, although the sensor had answered again for minutes.
"""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest
from procs import fieldtwin, wait_for

from fieldtwin.gateway.core.control import ControlClient

pytestmark = pytest.mark.long

FAULT = {"id": "cut", "name": "silence", "device": "gauge"}
FILES = {
    "gauge.yaml": "device: test/gauge\nsource: none\nprotocol: modbus\ntags: {level: {at: 30001}}\n",
    "site.yaml": """\
fieldtwin: 1
system: site
buses: {lan: {url: "tcp://192.0.2.1:502", timeout_ms: 100, retries: 0}}
devices: {gauge: {profile: ./gauge.yaml, bus: lan, unit: 1, poll: {values: {every_ms: 100}}}}
""",
    "site.prototype.yaml": """\
prototype_of: site.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {gauge: {model: profile}}
""",
}


async def silent_for_a_while(socket: Path) -> None:
    field = await ControlClient.connect_unix(socket)
    try:
        await field.call("fault", fault=FAULT)
        async with asyncio.timeout(20):
            while (await field.call("get"))["struck"][0]["struck"] < 2:
                await asyncio.sleep(0.1)
        await field.call("clear", id="cut")
    finally:
        await field.aclose()


def test_a_fault_injected_while_it_runs_is_no_error_of_the_counts(tmp_path: Path) -> None:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    with fieldtwin(tmp_path, "run", str(tmp_path / "site.yaml"), "--prototype", "--for", "8s", "--json") as run:
        socket = tmp_path / "site" / "field.sock"
        wait_for(socket.is_socket, 30, "the field simulator")
        asyncio.run(silent_for_a_while(socket))
        wait_for(lambda: run.process.poll() is not None, 60, "the end")
        summary = json.loads(run.out)
    assert summary["exchanges"]["lan"]["timeouts"] > 0
    assert summary["errors"] == []
    assert run.process.returncode == 0
