"""Checks of servers of other makes: pymodbus's and libmodbus's, on real sockets and ptys, a few cases to a server.

The servers are those of tests/interop, as a program of their own. All checks run at once:
most of it is waiting for who is silent.
"""

from __future__ import annotations

import asyncio
import ctypes
import json
import sys
from collections.abc import Sequence
from contextlib import AsyncExitStack
from ctypes.util import find_library
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fieldtwin.conformance.core.case import Danger
from fieldtwin.conformance.devices.device_case import DeviceResult
from fieldtwin.conformance.devices.modbus.cases import CASES
from fieldtwin.conformance.devices.modbus.session import ModbusOptions, check_modbus, traits_of
from fieldtwin.conformance.devices.run import Plan
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable

PROGRAM = Path(__file__).parents[1] / "interop" / "strange_slaves.py"
A_SERVER = 2
"""Cases that one server is asked."""
STAGGER_S = 0.02
"""From the beginning of one check to that of the next: what many do at once would look like a peer that thinks for long."""
TIMEOUT_S = 0.25
"""libmodbus thinks for 0.5 s before it refuses; three timeouts are waited for an answer that is due."""
MAY_WRITE = {"holding": (190, 10), "coil": (3, 1)}


class PtyConnector(OsConnector):
    """Opens the near side of a pty, the far side of which is the server's port."""

    def __init__(self, end: ByteConnection) -> None:
        super().__init__()
        self.end = end

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        if self.end.lost is not None:
            raise Unreachable("the line is gone", where=str(endpoint))
        return self.end


def version_of(peer: str) -> str:
    """The peer's version here, empty where it is not installed."""
    if peer == "pymodbus":
        return version("pymodbus")
    if (name := find_library("modbus")) is None:
        return ""
    lib = ctypes.CDLL(name)
    return ".".join(str(ctypes.c_uint.in_dll(lib, f"libmodbus_version_{p}").value) for p in ("major", "minor", "micro"))


async def check_all(
    peer: str, wire: str, folder: Path, after_s: float = 0.0, only: frozenset[str] = frozenset()
) -> list[DeviceResult]:
    """Every case that `wire` (rtu, ascii or mbap) has, or these, on as many servers as it takes, in their order."""
    await asyncio.sleep(after_s)
    traits = traits_of(Endpoint.parse({"rtu": "rtu:/x", "ascii": "ascii:/x", "mbap": "tcp://x:1"}[wire]))
    ids = [case.id for case in CASES if case.chosen(only) and (not case.wires or traits & set(case.wires))]
    groups = [ids[at : at + A_SERVER] for at in range(0, len(ids), A_SERVER)]
    async with AsyncExitStack() as stack:
        lines: list[PtyEnd] = []
        if wire != "mbap":
            for n in range(len(groups)):
                link = folder / f"{peer[:3]}{wire}{n}"
                lines.append(await PtyEnd.open(link, Endpoint.parse(f"{wire}:{link}?baudrate=115200&frame=8N1")))
                stack.push_async_callback(lines[-1].aclose)
        jobs = [
            {"row": n, "wire": wire, "line": str(folder / f"{peer[:3]}{wire}{n}") if lines else "", "units": [1]}
            for n in range(len(groups))
        ]
        ports = await _serve(stack, peer, jobs)
        found = await asyncio.gather(
            *(_check(wire, ids, ports[n], lines[n] if lines else None, n * STAGGER_S) for n, ids in enumerate(groups))
        )
    return [result for results in found for result in results]


async def _serve(stack: AsyncExitStack, peer: str, jobs: Sequence[dict[str, Any]]) -> dict[int, int]:
    program = await asyncio.create_subprocess_exec(
        sys.executable, str(PROGRAM), peer, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
    )
    stdin, stdout = program.stdin, program.stdout
    assert stdin is not None
    assert stdout is not None
    stack.push_async_callback(program.wait)
    stack.callback(stdin.close)
    stdin.write(json.dumps(jobs).encode() + b"\n")
    async with asyncio.timeout(30):
        ready = [(await stdout.readline()).split() for _ in jobs]
    return {int(row): int(port) for row, port in ready}


async def _check(wire: str, ids: Sequence[str], port: int, line: PtyEnd | None, after_s: float) -> list[DeviceResult]:
    await asyncio.sleep(after_s)
    plan = Plan(frozenset(ids), Danger.DISRUPT, frozenset({"holding", "coil", "i-know"}))
    url = f"tcp://127.0.0.1:{port}" if line is None else f"{wire}:/line?baudrate=115200&frame=8N1"
    connector = OsConnector() if line is None else PtyConnector(line)
    options = ModbusOptions(
        url, 1, plan, timeout_s=TIMEOUT_S, spacing_s=0.005, listen_s=0.0, may_write=MAY_WRITE, connector=connector
    )  # fmt: skip
    return (await check_modbus(options)).results
