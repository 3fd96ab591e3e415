"""`scan` and `identify` on third-party servers, pymodbus's and libmodbus's, on a line and on TCP."""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import sys
from collections.abc import AsyncIterator, Callable
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import pytest
from support import run
from targets import socat_pair

from fieldtwin.commissioning.identify.matching import Sureness
from fieldtwin.commissioning.identify.modbus import identify_modbus
from fieldtwin.commissioning.scan.modbus import ModbusScan, ModbusScanner, ScanOptions
from fieldtwin.gateway.core.files.profile_file import load_profile

HERE = Path(__file__).parent
SERVERS = HERE.parents[2] / "scripts" / "league_programs" / "servers.py"
PEERS = [
    "pymodbus",
    pytest.param(
        "libmodbus", marks=pytest.mark.skipif(not find_library("modbus"), reason="libmodbus is not installed")
    ),
]
pytestmark = [pytest.mark.interop, pytest.mark.timeout(60)]
SHIPPED = [load_profile(path) for path in sorted((HERE.parents[2] / "profiles/devices").glob("*.yaml"))]


@contextlib.asynccontextmanager
async def serving(peer: str, wire: str, units: list[int], line: str = "") -> AsyncIterator[int]:
    """Start the server and return its port."""
    job: dict[str, Any] = {"row": 0, "wire": wire, "units": units, "line": line}
    program = await asyncio.create_subprocess_exec(
        sys.executable, str(SERVERS), peer, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
    )  # fmt: skip
    assert program.stdin is not None
    assert program.stdout is not None
    try:
        program.stdin.write(json.dumps([job]).encode() + b"\n")
        yield int((await program.stdout.readline()).split()[1])
    finally:
        program.stdin.close()
        await program.wait()


async def scan(url: str, **options: Any) -> ModbusScan:
    return await ModbusScanner(url, ScanOptions(per_s=1000, listen_s=0, **options)).run()


@pytest.mark.skipif(shutil.which("socat") is None, reason="socat is not installed")
@pytest.mark.parametrize("peer", PEERS)
def test_on_a_line_the_units_are_found(peer: str, short_dir: Callable[[], Path]) -> None:
    async def main() -> None:
        folder = short_dir()
        near, far = folder / "a", folder / "b"
        async with socat_pair(near, far), serving(peer, "rtu", [5], str(far)):
            found = await scan(f"rtu:{near}?baudrate=9600&frame=8N1", units=(3, 4, 5, 6))
        data = [f.answer.unit for f in found.units if not f.answer.exception]
        others = [(f.answer.unit, f.answer.exception) for f in found.units if f.answer.exception]
        assert data == [5]
        assert others == ([(3, 4), (4, 4), (6, 4)] if peer == "pymodbus" else [])
        assert bool(found.notes) == (peer == "pymodbus")

    run(main(), timeout_s=40)


def test_pymodbus_on_tcp_answers_for_missing_units() -> None:
    async def main() -> None:
        async with serving("pymodbus", "mbap", [5, 9]) as port:
            found = await scan(f"tcp://127.0.0.1:{port}", units=(4, 5, 6, 9), timeout_s=1.0)
            assert [f.answer.unit for f in found.units if not f.answer.exception] == [5, 9]
            told = await identify_modbus(f"tcp://127.0.0.1:{port}", 5, SHIPPED, timeout_s=0.3, per_s=1000)
        assert told.answers
        assert told.clues.objects is not None
        assert told.certain is None
        assert all(c.sureness < Sureness.LIKELY for c in told.candidates)

    run(main(), timeout_s=40)


@pytest.mark.skipif(not find_library("modbus"), reason="libmodbus is not installed")
def test_libmodbus_on_tcp_is_one_device_whatever_it_is_asked_as() -> None:
    async def main() -> None:
        async with serving("libmodbus", "mbap", [1]) as port:
            found = await scan(f"tcp://127.0.0.1:{port}", timeout_s=0.5)
            assert found.alike is not None
            assert found.alike.one_device
            assert found.asked == 32, "249 ids need not be asked"
            told = await identify_modbus(f"tcp://127.0.0.1:{port}", 1, SHIPPED, timeout_s=0.3, per_s=1000)
        assert told.clues.server_id is not None
        assert told.certain is None
        assert all(c.sureness < Sureness.LIKELY for c in told.candidates)

    run(main(), timeout_s=40)
