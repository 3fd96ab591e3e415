"""A system with a bridge on a serial line: a third-party client reads units on TCP while the gateway polls them, in a
prototype and on a plant. The system file is the same, byte for byte."""

from __future__ import annotations

import asyncio
import re
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest
from procs import fieldtwin, no_tracebacks, wait_for
from support import run

from fieldtwin.emulators.endpoints.modbus_server import serve_mbap
from fieldtwin.emulators.endpoints.socket_end import SocketListener
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.connections.serial.line import SerialConnection
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.live.bridge_cable import BridgeCable

LINE = "baudrate=115200&frame=8N1"
SYSTEM = """
fieldtwin: 1
system: reverse
buses:
  modem: {url: "tcp://127.0.0.1:PORT"}
devices:
  relay:
    profile: modem-mailbox
    bus: modem
    unit: 7
    poll: {status: {every_ms: 200}}
plc:
  programs:
    idle: {source: "python: idle:Idle", inputs: {}, outputs: {}}
bridge:
  door:
    url: "rtu:MASTERS?LINE"
    units: {21: modem/7, 22: modem/9}
    allow: [{functions: [read, write]}]
"""
PROGRAM = """
from fieldtwin.plc.program import Program, ScanInfo


class Idle(Program):
    def execute(self, scan: ScanInfo) -> None:
        pass
"""
PROTOTYPE = """
prototype_of: reverse.yaml
buses: {modem: {listen: "tcp://127.0.0.1:0"}}
devices: {relay: {model: mailbox, far: "tcp://127.0.0.1:0"}}
"""


def a_system(folder: Path, port: int, masters: Path) -> Path:
    folder.mkdir()
    text = SYSTEM.replace("PORT", str(port)).replace("MASTERS", str(masters)).replace("LINE", LINE)
    (folder / "reverse.yaml").write_text(text, encoding="utf-8")
    (folder / "reverse.prototype.yaml").write_text(PROTOTYPE, encoding="utf-8")
    (folder / "idle.py").write_text(PROGRAM, encoding="utf-8")
    return folder / "reverse.yaml"


def mbpoll(port: Path, unit: int, address: int, *values: str) -> str:
    command = [
        *("mbpoll", "-m", "rtu", "-b", "115200", "-P", "none", "-d", "8", "-s", "1", "-a", str(unit), "-1", "-0", "-o", "3"),
        *("-t", "4", "-r", str(address), "-c", "1", str(port)),
    ]  # fmt: skip
    if values:
        del command[command.index("-c") : command.index("-c") + 2]
    done = subprocess.run([*command, *values], capture_output=True, text=True, timeout=20)
    return done.stdout + done.stderr


def check_a_client(port: Path) -> None:
    text = mbpoll(port, 21, 200)
    assert re.search(r"^\[200\]:\s+[01]$", text, re.MULTILINE), text
    text = mbpoll(port, 22, 200)
    assert "Gateway path unavailable" in text, text  # the device on that socket identifies itself
    text = mbpoll(port, 5, 200)
    assert "timed out" in text, text  # a request to a different unit: on a shared line, the bridge ignores it


@pytest.mark.long
@pytest.mark.interop
@pytest.mark.skipif(shutil.which("mbpoll") is None, reason="mbpoll is not installed")
def test_a_client_on_a_line_reaches_tcp_units_of_a_prototype(tmp_path: Path) -> None:
    system = a_system(tmp_path / "systems", 1, tmp_path / "no-such-port")
    with fieldtwin(tmp_path / "run", "run", str(system), "--prototype", "--instance", "p") as program:
        gateway = program.control("p", "gateway")
        wait_for(lambda: gateway("get")["bridge"]["door"]["listening"], 15)
        masters = tmp_path / "run" / "p" / "bridge-door"
        wait_for(lambda: f"clients of bridge door  →  {masters}" in program.err, 5)
        check_a_client(masters)
        text = mbpoll(masters, 21, 34, "3")
        assert "Written 1 references" in text, text
        status = gateway("get")
        assert status["bridge"]["door"]["counters"]["requests"] == 3
        assert status["bridge"]["door"]["counters"]["noise_bytes"] == 0
        assert '"done"' in (tmp_path / "run" / "p" / "audit.jsonl").read_text("ascii")
        program.signal(signal.SIGINT)
        # 1: no message came from the remote client, and no program takes messages here
        assert program.wait(10) in (0, 1)
    no_tracebacks(tmp_path / "run")


@pytest.mark.long
@pytest.mark.interop
@pytest.mark.skipif(shutil.which("mbpoll") is None, reason="mbpoll is not installed")
def test_a_client_on_a_line_reaches_tcp_units_of_a_plant(tmp_path: Path) -> None:
    async def main() -> None:
        clock = WallClock()
        bank = MapBank([CellSpan("holding", 0, 300)])
        device = await SocketListener.open(
            Endpoint.parse("tcp://127.0.0.1:0"), lambda c: serve_mbap(c, MbapServer({7: ModbusUnit(bank)}), clock)
        )
        plant = Endpoint.parse(f"rtu:{tmp_path / 'x'}?{LINE}")
        cable = await BridgeCable.open(plant, tmp_path, "plant")
        system = a_system(tmp_path / "systems", device.bound.port, Path(cable.gateway.path))
        try:
            async with Nursery() as nursery:
                nursery.start(cable.run(), "the plant's line")
                await asyncio.to_thread(use_the_plant, tmp_path, system, cable.master)
        finally:
            await cable.aclose()
            await device.aclose()
        assert bank.read("holding", 34, 1, 0) == [0]

    run(main(), timeout_s=60)


def use_the_plant(tmp_path: Path, system: Path, masters: Path) -> None:
    with fieldtwin(tmp_path / "run", "run", str(system), "--plant", "--instance", "p") as program:
        gateway = program.control("p", "gateway")
        wait_for(lambda: gateway("get")["bridge"]["door"]["listening"], 15)
        wait_for(lambda: gateway("get")["devices"]["relay"]["online"], 15)
        check_a_client(masters)
        assert "Illegal function" in mbpoll(masters, 21, 34, "3")  # a plant is read-only unless told otherwise
        status: dict[str, Any] = gateway("get")
        assert status["bridge"]["door"]["counters"]["refused"] == 1
        program.signal(signal.SIGINT)
        assert program.wait(10) == 0, program.err
    no_tracebacks(tmp_path / "run")


def test_a_cable_carries_both_directions_and_remains_when_an_end_is_closed(tmp_path: Path) -> None:
    async def main() -> None:
        plant = Endpoint.parse(f"rtu:/dev/ttyNONE?{LINE}")
        cable = await BridgeCable.open(plant, tmp_path, "door")
        async with Nursery() as nursery:
            nursery.start(cable.run(), "cable")
            for turn in range(2):
                inside = await SerialConnection.open(cable.gateway)
                outside = await SerialConnection.open(plant.with_path(str(cable.master)))
                await outside.write(b"asked %d" % turn)
                assert await inside.read() == b"asked %d" % turn
                await inside.write(b"told %d" % turn)
                assert (await outside.read())[:4] == b"told"
                await inside.aclose()
                await outside.aclose()
        await cable.aclose()
        assert not cable.master.is_symlink()

    run(main())
