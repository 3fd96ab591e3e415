"""`fieldtwin line`, `scan` and `identify` as programs, on a pty with a hidden baud rate, on TCP, on a software bus."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import termios
from pathlib import Path
from typing import Any

import pytest
from support import eventually, run

from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.wallclock import WallClock

DRIVE = Path("profiles/devices/drive-cia402.eds")


async def fieldtwin(*words: str) -> tuple[int, dict[str, Any], str]:
    """Return exit code, JSON on stdout, diagnostics on stderr."""
    program = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "fieldtwin", *words, "--json", stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    out, err = await program.communicate()
    assert program.returncode is not None
    return program.returncode, json.loads(out), err.decode()


def make_device() -> RtuServer:
    return RtuServer({5: ModbusUnit(MapBank([CellSpan("holding", 0, 8)]))})


async def answer_at(end: PtyEnd, speed: int) -> None:
    """A device whose UART runs at `speed`; data sent at a different speed is noise to it."""
    device, port = make_device(), os.open(end.device, os.O_RDWR | os.O_NOCTTY)
    try:
        while True:
            data = await end.read()
            if termios.tcgetattr(port)[4] != speed:
                continue
            for reply in device.feed(data, WallClock().monotonic_ns()):
                await end.write(reply)
    finally:
        os.close(port)


@pytest.mark.long
def test_a_pty_with_a_hidden_baud_rate(tmp_path: Path) -> None:
    async def main() -> None:
        end = await PtyEnd.open(tmp_path / "line", Endpoint.parse("pty:line"))
        url = f"rtu:{tmp_path / 'line'}"
        async with Nursery() as nursery:
            nursery.start(answer_at(end, termios.B19200), "device")
            log = tmp_path / "log.jsonl"
            words = ("--units", "4-6", "--listen-for", "0", "--timeout", "200ms", "--rate", "100", "--log", str(log))
            code, found, talk = await fieldtwin("scan", url, *words)
            assert code == 0, talk
            assert [(u["unit"], u["settings"][:5]) for u in found["units"]] == [(5, "19200")]
            sent = [json.loads(line) for line in log.read_text().splitlines() if '"sent"' in line]
            assert {bytes.fromhex(line["hex"])[0] for line in sent} <= {4, 5, 6}
            code, report, talk = await fieldtwin(
                "line", f"{url}?baudrate=19200&frame=8N1", "--listen", "200ms", "--probe", "5"
            )
            assert (code, report["probe"]["answer"]) == (0, "good"), talk
            code, told, talk = await fieldtwin(
                "identify", f"{url}?baudrate=19200&frame=8N1", "--unit", "6", "--timeout", "50ms"
            )
            assert (code, told["answers"]) == (4, False), talk
        await end.aclose()

    run(main(), timeout_s=40)


def test_rtu_over_tcp_and_a_missing_device() -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        device = make_device()
        while data := await reader.read(256):
            for reply in device.feed(data, WallClock().monotonic_ns()):
                writer.write(reply)
        writer.close()

    async def main() -> None:
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        code, found, _ = await fieldtwin("scan", f"rtu+tcp://127.0.0.1:{port}", "--units", "4-6", "--timeout", "300ms")
        assert (code, [u["unit"] for u in found["units"]]) == (0, [5])
        server.close()
        await server.wait_closed()
        code, report, _ = await fieldtwin("line", f"tcp://127.0.0.1:{port}")
        assert (code, report["causes"][0]["name"]) == (1, "no program listens there")

    run(main(), timeout_s=40)


def test_a_drive_on_the_software_bus() -> None:
    async def main() -> None:
        server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 250_000, paced=False)
        node = CanopenNode(parse_eds(DRIVE.read_text()), 7, NodeContext())
        async with Nursery() as nursery:
            nursery.start(serve_node(server.attach("drive"), node, WallClock()), "drive")
            words = ("--nodes", "7-8", "--listen-for", "300ms", "--timeout", "500ms", "--no-lss")
            code, found, talk = await fieldtwin("scan", str(server.bound), *words)
            assert code == 0, talk
            assert (found["bitrate"], [n["node"] for n in found["nodes"]]) == (250_000, [7])
            assert found["nodes"][0]["identity"]["device_type"] == 0x20192
            code, told, talk = await fieldtwin("identify", str(server.bound), "--node", "7")
            assert (code, told["certain"]) == (0, None), talk
            assert told["summary"] == "fieldtwin/drive-cia402: likely"
        await server.aclose()

    run(main(), timeout_s=40)


def test_an_interrupt_keeps_the_results_and_marks_them_incomplete(tmp_path: Path) -> None:
    async def main() -> None:
        end = await PtyEnd.open(tmp_path / "line", Endpoint.parse("pty:line"))
        url = f"rtu:{tmp_path / 'line'}?baudrate=19200&frame=8N1"
        async with Nursery() as nursery:
            nursery.start(answer_at(end, termios.B19200), "device")
            program = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "fieldtwin", "scan", url, "--listen-for", "0", "--timeout", "200ms", "--json"),
                *("--log", str(tmp_path / "log")),
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
            )
            await eventually(
                lambda: (tmp_path / "log").exists() and '"hex":"0603' in (tmp_path / "log").read_text(), 20
            )
            program.send_signal(signal.SIGINT)
            out, err = await program.communicate()
            found = json.loads(out)
            assert (program.returncode, found["stopped"]) == (130, True), err.decode()
            assert [u["unit"] for u in found["units"]] == [5]
            assert found["asked"] < 240
        await end.aclose()

    run(main(), timeout_s=40)
