"""Five third-party clients on one emulated unit, over pty and TCP: they read the unit's values, and tshark decodes every
frame."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import shutil
import sys
from collections import Counter
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import pytest
from support import run
from tshark import dissect

from fieldtwin.emulators.endpoints.modbus_server import serve_mbap, serve_rtu
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.endpoints.socket_end import SocketListener
from fieldtwin.emulators.modbus.ascii import AsciiServer
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.connections.tap import Captured
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.wallclock import WallClock

pytestmark = pytest.mark.interop
PROGRAM = Path(__file__).with_name("third_party_clients.py")
INPUTS = [i * 257 & 0xFFFF for i in range(125)]
DISCRETE = [int(i % 3 == 0) for i in range(16)]
FUNCTIONS = Counter({"4": 1, "2": 1, "6": 1, "16": 1, "3": 3, "5": 1, "15": 1, "1": 1})
SPOKEN = [
    *[(name, wire) for name in ("libmodbus", "umodbus", "pymodbus") for wire in ("rtu", "tcp")],
    *[("minimalmodbus", "rtu"), ("minimalmodbus", "ascii"), ("pymodbus", "ascii"), ("pyModbusTCP", "tcp")],
]


def make_unit() -> ModbusUnit:
    bank = MapBank(
        [CellSpan("holding", 0, 200), CellSpan("input", 0, 125), CellSpan("coil", 0, 32), CellSpan("discrete", 0, 16)]
    )
    bank.poke("input", 0, *INPUTS)
    bank.poke("discrete", 0, *DISCRETE)
    return ModbusUnit(bank)


def have(name: str) -> None:
    there = find_library("modbus") if name == "libmodbus" else importlib.util.find_spec(name)
    if there is None:
        pytest.skip(f"{name} is not installed")


async def talk(name: str, wire: str, where: str) -> dict[str, Any]:
    """Run the program's conversation; return the values that it printed."""
    program = await asyncio.create_subprocess_exec(
        *(sys.executable, str(PROGRAM), name, wire, where),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        async with asyncio.timeout(15):
            out, err = await program.communicate()
    finally:
        if program.returncode is None:
            program.kill()
            await program.wait()
    assert program.returncode == 0, err.decode()
    said: dict[str, Any] = json.loads(out)
    return said


async def converse(name: str, wire: str, unit: ModbusUnit, path: Path) -> tuple[dict[str, Any], list[Captured]]:
    clock, captured = WallClock(), list[Captured]()
    plant = Endpoint.parse("tcp://unit:502" if wire == "tcp" else f"rtu:{path}/line?baudrate=115200&frame=8N1")

    def note(direction: Direction, t_ns: int, adu: bytes) -> None:
        captured.append(Captured(t_ns, plant, direction, adu))

    if wire == "tcp":
        listener = await SocketListener.open(
            Endpoint.parse("tcp://127.0.0.1:0"),
            lambda connection: serve_mbap(connection, MbapServer({1: unit}), clock, 0.0, note),
        )
        try:
            return await talk(name, wire, str(listener.bound.port)), captured
        finally:
            await listener.aclose()
    end = await PtyEnd.open(path / "line", Endpoint.parse("pty:line"))
    server = AsciiServer({1: unit}) if wire == "ascii" else RtuServer({1: unit})
    try:
        async with Nursery() as nursery:
            nursery.start(serve_rtu(end, server, clock, 0.0, note), "unit")
            return await talk(name, wire, str(end.link)), captured
    finally:
        await end.aclose()


@pytest.mark.parametrize(("name", "wire"), SPOKEN)
def test_a_third_party_client_reads_and_writes(name: str, wire: str, tmp_path: Path) -> None:
    have(name)
    unit = make_unit()
    said, captured = run(converse(name, wire, unit, tmp_path))
    assert said == {
        "inputs": INPUTS,
        "discrete": DISCRETE[:13],
        "holding": [0xBEEF, 0, 1, 2],
        "coils": [0, 1, 0, 1, 1, 0],
        "refused": 2,
        "again": [99],
    }
    c = unit.counters
    assert (c.requests, c.replies, c.exceptions, c.bus_errors) == (10, 10, 1, 0)
    assert [unit.bank.peek("holding", i) for i in (3, 103, 104)] == [0xBEEF, 99, 0]  # type: ignore[attr-defined]
    assert len(captured) == 20
    if wire != "ascii" and shutil.which("tshark"):  # it has no dissector for ASCII
        seen_by_tshark(captured, tmp_path)


def seen_by_tshark(captured: list[Captured], path: Path) -> None:
    endpoint = captured[0].endpoint
    fields = ["modbus.func_code", "modbus.exception_code", "mbtcp.trans_id", "mbrtu.crc16.status"]
    packets = dissect(path / "seen.pcap", captured, endpoint, fields)
    packets = [p for p in packets if p["modbus.func_code"]]
    assert len(packets) == 20
    assert Counter(p["modbus.func_code"] for p in packets[::2]) == FUNCTIONS
    assert [p["modbus.func_code"] for p in packets[::2]] == [p["modbus.func_code"] for p in packets[1::2]]
    assert [p["mbtcp.trans_id"] for p in packets[::2]] == [p["mbtcp.trans_id"] for p in packets[1::2]]
    assert [p["modbus.exception_code"] for p in packets].count("2") == 1
    assert {p["mbrtu.crc16.status"] for p in packets} == ({""} if endpoint.scheme == "tcp" else {"1"})
