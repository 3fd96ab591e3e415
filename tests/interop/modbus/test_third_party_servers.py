"""Our client on four third-party servers, over a null modem and TCP: it reads their values, and tshark decodes every frame.

tests/wires/modbus/test_modbus_servers.py tests their other functions.
"""

from __future__ import annotations

import asyncio
import importlib.util
import json
import os
import shutil
import sys
import tty
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from ctypes.util import find_library
from pathlib import Path

import pytest
from support import run
from tshark import dissect

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.connections.tap import Captured, TappedConnector
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ModbusExceptionReply
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.wallclock import WallClock

pytestmark = pytest.mark.interop
PROGRAM = Path(__file__).parents[3] / "scripts" / "league_programs" / "servers.py"
SPOKEN = [
    *[(name, wire) for name in ("libmodbus", "pymodbus", "umodbus") for wire in ("rtu", "mbap")],
    ("pyModbusTCP", "mbap"),
]
FUNCTIONS = Counter({"4": 1, "2": 1, "3": 4, "6": 1, "16": 1, "5": 1, "15": 1, "1": 1})


class Eyes:
    """Record the traffic."""

    def __init__(self) -> None:
        self.captured: list[Captured] = []

    def on_bytes(self, endpoint: Endpoint, direction: Direction, t_ns: int, chunk: bytes) -> None:
        self.captured.append(Captured(t_ns, endpoint, direction, chunk))

    def on_frame(self, endpoint: Endpoint, direction: Direction, t_ns: int, frame: CanFrame) -> None:
        raise AssertionError("no CAN here")


@contextmanager
def null_modem() -> Iterator[tuple[str, str]]:
    """Two ptys joined byte for byte; their far sides remain open, so that neither program sees a hang-up."""
    pairs = [os.openpty(), os.openpty()]
    loop = asyncio.get_running_loop()
    for _, far in pairs:
        tty.setraw(far)
    (a, a_far), (b, b_far) = pairs

    def forward(source: int, sink: int) -> None:
        os.write(sink, os.read(source, 4096))

    loop.add_reader(a, forward, a, b)
    loop.add_reader(b, forward, b, a)
    try:
        yield os.ttyname(a_far), os.ttyname(b_far)
    finally:
        for fd in (a, b):
            loop.remove_reader(fd)
        for fd in (a, a_far, b, b_far):
            os.close(fd)


@asynccontextmanager
async def served(name: str, wire: str, line: str) -> AsyncIterator[int]:
    """Start the program with one unit; return its port."""
    program = await asyncio.create_subprocess_exec(
        *(sys.executable, str(PROGRAM), name), stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
    )
    assert program.stdin is not None
    assert program.stdout is not None
    try:
        job = {"row": 0, "wire": wire, "line": line, "units": [1]}
        program.stdin.write(json.dumps([job]).encode() + b"\n")
        yield int((await program.stdout.readline()).split()[1])
    finally:
        program.stdin.close()
        await program.wait()


async def converse(name: str, wire: str) -> list[Captured]:
    """Run the conversation; return its traffic."""
    eyes = Eyes()
    with null_modem() as (near, far):
        async with served(name, wire, far if wire == "rtu" else "") as port:
            serial = f"rtu:{near}?baudrate=115200&frame=8N1"
            endpoint = Endpoint.parse(serial if wire == "rtu" else f"tcp://127.0.0.1:{port}")
            connector = TappedConnector(OsConnector(), [eyes], WallClock())
            client = ModbusClient.at(endpoint, await connector.open_bytes(endpoint), WallClock(), timeout_s=3)
            try:
                await ask(client)
            finally:
                await client.aclose()
    return eyes.captured


async def ask(client: ModbusClient) -> None:
    assert (await client.read_registers(1, "input", 0, 8)).registers == (0x4120, *[0] * 7)
    assert (await client.read_bits(1, "discrete", 0, 13)).bits == (False,) * 13
    assert (await client.read_registers(1, "holding", 0, 125)).registers == (0xAA, 0xBB, 0, 0, 0x12, *[0] * 120)
    await client.write_register(1, 3, 0xBEEF)
    await client.write_registers(1, 4, list(range(123)))
    assert (await client.read_registers(1, "holding", 3, 4)).registers == (0xBEEF, 0, 1, 2)
    await client.write_coil(1, 9, True)
    await client.write_coils(1, 10, [False, True, True])
    assert (await client.read_bits(1, "coil", 8, 6)).bits == (False, True, False, True, True, False)
    with pytest.raises(ModbusExceptionReply) as caught:
        await client.read_registers(1, "holding", 900, 10)
    assert caught.value.code == 2
    assert (await client.read_registers(1, "holding", 126, 1)).registers == (122,)
    c = client.counters
    assert (c.requests, c.replies, c.exceptions) == (11, 10, 1)
    assert c.late_bytes == c.noise_bytes == c.foreign_frames == 0


@pytest.mark.parametrize(("name", "wire"), SPOKEN)
def test_a_third_party_server_is_read_and_written(name: str, wire: str, tmp_path: Path) -> None:
    there = find_library("modbus") if name == "libmodbus" else importlib.util.find_spec(name)
    if there is None:
        pytest.skip(f"{name} is not installed")
    captured = run(converse(name, wire))
    if shutil.which("tshark"):
        seen_by_tshark(captured, tmp_path)


def seen_by_tshark(captured: list[Captured], path: Path) -> None:
    endpoint = captured[0].endpoint
    if endpoint.scheme == "tcp":  # the pcap file represents a conversation with port 502
        fields = ["modbus.func_code", "modbus.exception_code", "mbtcp.trans_id", "tcp.dstport"]
    else:
        fields = ["modbus.func_code", "modbus.exception_code", "mbrtu.crc16.status"]
    packets = [p for p in dissect(path / "seen.pcap", captured, endpoint, fields) if p["modbus.func_code"]]
    requests, replies = packets[::2], packets[1::2]
    assert Counter(p["modbus.func_code"] for p in requests) == FUNCTIONS
    assert [p["modbus.func_code"] for p in requests] == [p["modbus.func_code"] for p in replies]
    assert [p["modbus.exception_code"] for p in packets].count("2") == 1
    if endpoint.scheme == "tcp":
        assert [p["mbtcp.trans_id"] for p in requests] == [p["mbtcp.trans_id"] for p in replies]
        assert {p["tcp.dstport"] for p in requests} == {"502"}
    else:
        assert {p["mbrtu.crc16.status"] for p in packets} == {"1"}
