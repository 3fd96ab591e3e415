"""Run the checks against third-party servers, pymodbus's and libmodbus's, on real sockets and ptys, a few cases per
server.

The servers are those of tests/interop, in a separate program. All checks run at the same time, because they mostly wait
for servers that do not answer.
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

from fieldtwin.conformance.core.case import CasePlan, Impact
from fieldtwin.conformance.devices.device_case import DeviceResult
from fieldtwin.conformance.devices.modbus.cases import CASES
from fieldtwin.conformance.devices.modbus.session import ModbusOptions, check_modbus, traits_of
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable

PROGRAM = Path(__file__).parents[3] / "scripts" / "league_programs" / "servers.py"
A_SERVER = 2
"""Number of cases per server."""
STAGGER_S = 0.02
"""Interval between the starts of two checks. With many simultaneous checks, a server would seem slow to answer."""
TIMEOUT_S = 0.25
"""libmodbus waits 0.5 s before it refuses a request; a check waits three timeouts for an expected answer."""
MAY_WRITE = {"holding": (190, 10), "coil": (3, 1)}


class PtyConnector(OsConnector):
    """Open the near side of a pty; the server has opened the far side."""

    def __init__(self, end: ByteConnection) -> None:
        super().__init__()
        self.end = end

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        if self.end.lost is not None:
            raise Unreachable("the line is gone", where=str(endpoint))
        return self.end


def version_of(peer: str) -> str:
    """Return the installed version of the peer, or an empty text."""
    if peer == "pymodbus":
        return version("pymodbus")
    if (name := find_library("modbus")) is None:
        return ""
    lib = ctypes.CDLL(name)
    return ".".join(str(ctypes.c_uint.in_dll(lib, f"libmodbus_version_{p}").value) for p in ("major", "minor", "micro"))


async def check_all(
    peer: str, wire: str, folder: Path, after_s: float = 0.0, only: frozenset[str] = frozenset()
) -> list[DeviceResult]:
    """Run all cases of `wire` (rtu, ascii or mbap), or the given ones, in order, on as many servers as necessary."""
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
    plan = CasePlan(frozenset(ids), Impact.DISRUPT, frozenset({"holding", "coil", "i-know"}))
    url = f"tcp://127.0.0.1:{port}" if line is None else f"{wire}:/line?baudrate=115200&frame=8N1"
    connector = OsConnector() if line is None else PtyConnector(line)
    options = ModbusOptions(
        url, 1, plan, timeout_s=TIMEOUT_S, spacing_s=0.005, listen_s=0.0, may_write=MAY_WRITE, connector=connector
    )  # fmt: skip
    return (await check_modbus(options)).results
