"""A third party that reads the emulators of a prototype run does not make the run "not ok": its traffic is counted separately.

Defect: after a different program had read one register, a run ended with "gateway counted 48 requests, the emulators 46" and
exit code 1, and likewise after an SDO request of a different client.
"""

from __future__ import annotations

import json
import socket
from contextlib import suppress
from pathlib import Path

import canopen
import pytest
from canopen.sdo.exceptions import SdoError
from procs import Fieldtwin, fieldtwin, free_port, wait_for
from test_canopen_nodes import PROGRAM, PROTOTYPE, SYSTEM

from fieldtwin.gateway.connections.soft_bus import SoftBus

pytestmark = pytest.mark.long

CHECKOUT = Path(__file__).parents[3]
READ_ONE = bytes.fromhex("0001 0000 0006 01 03 0000 0001")


def when_open(port: int, run: Fieldtwin) -> None:
    """Wait until an emulator listens on the port."""

    def listens() -> bool:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
            return True
        return run.process.poll() is not None

    wait_for(listens, 30, "an emulator")


def test_an_outside_modbus_client_is_counted_apart(tmp_path: Path) -> None:
    port, path = free_port(), tmp_path / "lab.prototype.yaml"
    text = (CHECKOUT / "profiles" / "systems" / "lab_vehicle.prototype.yaml").read_text(encoding="utf-8")
    path.write_text(text.replace("tcp://127.0.0.1:0", f"tcp://127.0.0.1:{port}"), encoding="utf-8")
    wanted = ("run", "lab_vehicle", "--prototype", "--prototype-file", str(path), "--for", "5s", "--json")
    with fieldtwin(tmp_path, *wanted, name="run") as run:
        when_open(port, run)

        def read_once() -> bool:
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), 5) as outside:
                outside.sendall(READ_ONE)
                outside.recv(260)
            return run.process.poll() is not None

        wait_for(read_once, 60, "the end")
        summary = json.loads(run.out)
    assert summary["errors"] == []
    others = summary["exchanges"]["lan"]["others"]
    assert others["requests"] == others["replies"] > 20


def test_an_outside_sdo_client_is_counted_apart(tmp_path: Path) -> None:
    port = free_port()
    prototype = PROTOTYPE.replace("127.0.0.1:0", f"127.0.0.1:{port}")
    for name, text in (("nodes.yaml", SYSTEM), ("nodes.prototype.yaml", prototype), ("watch.st", PROGRAM)):
        (tmp_path / name).write_text(text, encoding="utf-8")
    wanted = ("run", str(tmp_path / "nodes.yaml"), "--prototype", "--for", "5s", "--instance", "tp", "--json")
    with fieldtwin(tmp_path, *wanted, name="run") as run:
        when_open(port, run)
        network = canopen.Network(SoftBus(f"127.0.0.1:{port}"))
        network.connect()
        node = network.add_node(6, canopen.ObjectDictionary())

        read = 0

        def read_once() -> bool:
            nonlocal read
            with suppress(SdoError):
                read += len(node.sdo.upload(0x1000, 0)) == 4
            return read == 60

        wait_for(read_once, 60, "sixty reads")
        network.disconnect()
        wait_for(lambda: run.process.poll() is not None, 60, "the end")
        summary = json.loads(run.out)
    assert summary["errors"] == []
    assert summary["exchanges"]["can0"]["others"]["requests"] > 1
