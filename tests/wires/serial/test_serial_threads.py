"""COM ports, as far as they can be tested here: the same port with threads instead of descriptors, and commands without POSIX."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.gateway.connections.serial.threads import ThreadedSerialConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, EndpointBusy, Unreachable

WITHOUT_POSIX = """
import sys
from pydantic import BaseModel
import asyncio, can, click, rich.console, serial, serial.tools.list_ports, yaml, canopen, pymodbus.client  # have their own ways
for name in ("termios", "grp", "fcntl", "tty", "pty", "pwd", "resource"):
    sys.modules[name] = None
sys.platform = "win32"
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.connections.serial.threads import ThreadedSerialConnection
from fieldtwin.gateway.core.endpoint import Endpoint
for command in ("line", "scan", "identify"):
    __import__(f"fieldtwin.cli.device.{command}_command")
async def main():
    port = await OsConnector().open_bytes(Endpoint.parse("rtu:" + sys.argv[1]))
    assert type(port) is ThreadedSerialConnection
    await port.write(b"ping")
    print((await port.read()).decode(), port.control_lines(), port.counters())
    await port.aclose()
loop = asyncio.new_event_loop()
loop.run_until_complete(main())
loop.close()
"""


def test_bytes_pass_in_both_directions_and_closing_ends_it(tmp_path: Path) -> None:
    async def main() -> None:
        link = tmp_path / "line"
        device = await PtyEnd.open(link, Endpoint.parse("pty:line"))
        endpoint = Endpoint.parse(f"rtu:{link}?baudrate=9600&frame=8N1")
        port = await ThreadedSerialConnection.open(endpoint)
        await port.write(b"question")
        heard = b""
        while len(heard) < 8:
            heard += await device.read()
        assert heard == b"question"
        answer = os.urandom(3000)
        await device.write(answer)
        got = b""
        while len(got) < len(answer):
            got += await port.read()
        assert got == answer
        with pytest.raises(EndpointBusy):
            await ThreadedSerialConnection.open(endpoint)
        await port.aclose()
        await port.aclose()
        with pytest.raises(ConnectionLost):
            await port.read()
        with pytest.raises(ConnectionLost):
            await port.write(b"x")
        await device.aclose()

    run(main())


def test_a_reader_that_rests_is_not_flooded(tmp_path: Path) -> None:
    async def main() -> None:
        link = tmp_path / "line"
        device = await PtyEnd.open(link, Endpoint.parse("pty:line"))
        port = await ThreadedSerialConnection.open(Endpoint.parse(f"rtu:{link}?baudrate=9600&frame=8N1"), max_pending=4)
        for i in range(12):
            await device.write(bytes([i]) * 10)
            await eventually(lambda: len(port.inbound.data_stream) >= 4 or len(port.inbound.data_stream) > 0)
        assert len(port.inbound.data_stream) <= 4
        got = b""
        while len(got) < 120:
            got += await port.read()
        assert got == b"".join(bytes([i]) * 10 for i in range(12))
        await port.aclose()
        await device.aclose()

    run(main())


def test_a_pulled_port_is_a_loss(tmp_path: Path) -> None:
    async def main() -> None:
        link = tmp_path / "line"
        device = await PtyEnd.open(link, Endpoint.parse("pty:line"))
        port = await ThreadedSerialConnection.open(Endpoint.parse(f"rtu:{link}?baudrate=9600&frame=8N1"))
        await device.aclose()
        with pytest.raises(ConnectionLost, match="serial port is gone"):
            await port.read()
        await port.aclose()
        with pytest.raises(Unreachable):
            await ThreadedSerialConnection.open(Endpoint.parse("rtu:/dev/no-such-port"))

    run(main())


def test_the_commands_and_the_port_work_without_posix(tmp_path: Path) -> None:
    async def main() -> str:
        link = tmp_path / "line"
        device = await PtyEnd.open(link, Endpoint.parse("pty:line"))

        async def echo() -> None:
            heard = b""
            while len(heard) < 4:
                heard += await device.read()
            await device.write(heard)

        import asyncio

        answering = asyncio.ensure_future(echo())
        program = await asyncio.create_subprocess_exec(
            sys.executable, "-c", WITHOUT_POSIX, str(link), stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        out, err = await program.communicate()
        answering.cancel()
        await asyncio.gather(answering, return_exceptions=True)
        await device.aclose()
        assert program.returncode == 0, err.decode()
        return out.decode()

    assert run(main()).startswith("ping {")
