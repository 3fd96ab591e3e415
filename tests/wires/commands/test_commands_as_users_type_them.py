"""Device commands that failed, or had a wrong effect, when a user typed them as the help suggests."""

from __future__ import annotations

import asyncio
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path

import click
import pytest
from pymodbus.client import AsyncModbusTcpClient
from support import run
from test_commissioning_verbs import SHEET

from fieldtwin.cli.main import cli
from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.can.software_end import open_can_end
from fieldtwin.emulators.endpoints.link_ends import TtyEnd
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.live.bridge import BridgeOptions, run_bridge


async def fieldtwin(*words: str) -> tuple[int, str]:
    """Run the command line. Return its exit code and what it wrote to stderr."""
    program = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "fieldtwin", *words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    _, err = await program.communicate()
    assert program.returncode is not None
    return program.returncode, err.decode()


def test_watch_ends_when_its_time_is_over_although_the_device_is_silent() -> None:
    """`watch --for 3s` ran 11 s: each tag of each sample waited for its own timeout."""

    async def main() -> None:
        async def say_nothing(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            while await reader.read(256):
                pass
            writer.close()

        server = await asyncio.start_server(say_nothing, "127.0.0.1", 0)
        url = f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        items = [f"holding:{100 * n}" for n in range(20)]
        code, said = await fieldtwin("watch", url, *items, "--every", "100ms", "--for", "300ms", "--timeout", "10s")
        assert code == 4
        assert "no sample was complete after 0.3 s" in said
        server.close()
        await server.wait_closed()

    run(main(), timeout_s=40)


async def _with_node(work: Callable[[str], Awaitable[None]]) -> None:
    bus = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 1_000_000)
    end = await open_can_end(bus.bound, 1_000_000)
    serving = asyncio.create_task(serve_node(end, CanopenNode(parse_eds(SHEET, "x"), 7, NodeContext()), WallClock()))
    try:
        await work(str(bus.bound))
    finally:
        serving.cancel()
        await asyncio.wait([serving])
        await end.aclose()
        await bus.aclose()


def test_record_with_an_eds_reads_the_objects_of_the_eds(tmp_path: Path) -> None:
    """With --eds and without --profile, `record` on CAN polled nothing, without a message."""
    (tmp_path / "x.eds").write_text(SHEET)
    log = tmp_path / "node.log"

    async def main() -> None:
        async def work(url: str) -> None:
            words = (
                "--node",
                "7",
                "--eds",
                str(tmp_path / "x.eds"),
                "--rounds",
                "1",
                "--every",
                "10ms",
                "-o",
                str(log),
            )
            code, said = await fieldtwin("record", url, *words)
            assert code == 0, said

        await _with_node(work)

    run(main(), timeout_s=40)
    text = log.read_text()
    assert "607#4000100000000000" in text, "the SDO upload request of 1000h"
    assert "607#4000200000000000" in text, "the SDO upload request of 2000h"


def test_record_of_a_node_without_profile_and_eds_is_refused(tmp_path: Path) -> None:
    async def main() -> None:
        async def work(url: str) -> None:
            code, said = await fieldtwin("record", url, "--node", "7", "--for", "1s", "-o", str(tmp_path / "node.log"))
            assert code == 2
            assert "nothing to read from the node; expected --profile NAME or --eds FILE" in said

        await _with_node(work)

    run(main(), timeout_s=40)


def test_a_link_opens_a_pseudo_terminal_with_parity_as_often_as_it_likes() -> None:
    """`link rtu:PTY?frame=8E1` failed at the second opening with "this is no serial device", where `read` worked."""

    async def main() -> None:
        near, far = os.openpty()
        try:
            for _ in range(3):
                end = TtyEnd.open(Endpoint.parse(f"rtu:{os.ttyname(far)}?baudrate=9600&frame=8E1"))
                await end.aclose()
        finally:
            os.close(near)
            os.close(far)

    run(main())


def test_a_bridge_reads_through_an_adapter_that_echoes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`bridge` had no --echo, so a two-wire adapter that returns its own transmissions gave no answer."""
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path / "r"))

    async def main() -> None:
        target = Endpoint.parse(f"rtu:{tmp_path / 'line'}?baudrate=115200&frame=8N1")
        end = await PtyEnd.open(tmp_path / "line", target, None)
        bank = MapBank([CellSpan("holding", 0, 8)])
        bank.poke("holding", 0, 7, 8)
        unit = RtuServer({1: ModbusUnit(bank)})

        async def adapter() -> None:
            clock = WallClock()
            while True:
                data = await end.read()
                await end.write(data)
                for reply in unit.feed(data, clock.monotonic_ns()):
                    await end.write(reply)

        said: list[str] = []
        options = BridgeOptions(Endpoint.parse("tcp://127.0.0.1:0"), target, timeout_s=0.5, echo=True, instance="echo")
        tasks = [asyncio.create_task(adapter()), asyncio.create_task(run_bridge(options, said.append))]
        try:
            while not (found := re.search(r"127\.0\.0\.1:(\d+)", " ".join(said))):
                await asyncio.sleep(0.01)
            async with AsyncModbusTcpClient("127.0.0.1", port=int(found[1])) as client:
                reply = await client.read_holding_registers(0, count=2, device_id=1)
                assert reply.registers == [7, 8]
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
            await end.aclose()

    run(main())


def test_the_path_of_a_serial_port_is_answered_with_the_endpoint_that_it_means() -> None:
    with pytest.raises(UsageError, match=r"a serial port is rtu:/dev/ttyUSB0\?baudrate=9600&frame=8N1"):
        Endpoint.parse("/dev/ttyUSB0")


def _examples() -> list[tuple[str, str]]:
    found = []
    for name in cli.list_commands(click.Context(cli)):
        command = cli.get_command(click.Context(cli), name)
        text = re.sub(r"\\\n\s*", "", (command.help or "") if command else "")  # a line goes on after a backslash
        found += [(name, line.strip()) for line in text.splitlines() if line.strip().startswith(f"fieldtwin {name} ")]
    return found


def test_every_example_of_the_help_can_be_pasted_into_a_shell() -> None:
    """`fieldtwin read rtu:/dev/ttyUSB0?baudrate=9600&frame=8N1 ...` ends at the `&`."""
    assert len(_examples()) > 20
    wrong = []
    for name, line in ((name, re.split(" {2,}", line)[0]) for name, line in _examples()):
        tokens = list(shlex.shlex(line, posix=True, punctuation_chars="&;|<>()"))
        if {"&", ";", "|", "(", ")"} & set(tokens):
            wrong.append((name, line))
    assert not wrong
