"""`fieldtwin bridge` as users run it: a separate process, a serial line as the target, third-party clients."""

from __future__ import annotations

import asyncio
import re
import shutil
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from procs import Fieldtwin, no_tracebacks
from pymodbus.client import AsyncModbusTcpClient
from support import eventually, run

from fieldtwin.cli.main import main
from fieldtwin.emulators.endpoints.modbus_server import serve_rtu
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.wallclock import WallClock

LINE = "baudrate=115200&frame=8N1"


@asynccontextmanager
async def line_of_two(tmp_path: Path) -> AsyncIterator[dict[int, MapBank]]:
    """Units 1 and 2 with holding registers 100... and 200..., on a virtual serial port."""
    banks = {n: MapBank([CellSpan("holding", 0, 64), CellSpan("coil", 0, 16)]) for n in (1, 2)}
    for number, bank in banks.items():
        bank.poke("holding", 0, *(100 * number + i for i in range(64)))
    plant = Endpoint.parse(f"rtu:{tmp_path / 'line'}?{LINE}")
    end = await PtyEnd.open(tmp_path / "line", plant, None)
    server = RtuServer({n: ModbusUnit(bank) for n, bank in banks.items()})
    try:
        async with Nursery() as nursery:
            nursery.start(serve_rtu(end, server, WallClock()), "units")
            yield banks
    finally:
        await end.aclose()


@asynccontextmanager
async def bridge(tmp_path: Path, *options: str) -> AsyncIterator[tuple[Fieldtwin, int]]:
    """The program, once it listens and has its line; yields its port."""
    target = f"rtu:{tmp_path / 'line'}?{LINE}"
    program = Fieldtwin(
        tmp_path / "run", "bridge", "tcp://127.0.0.1:0", target, "--timeout", "150ms", "--instance", "b", *options
    )
    try:
        await eventually(lambda: "→  rtu:" in program.err or program.process.poll() is not None, within_s=15)
        found = re.search(r"tcp://127\.0\.0\.1:(\d+)  →", program.err)
        assert found, program.err
        yield program, int(found[1])
        program.signal(signal.SIGTERM)
        await eventually(lambda: program.process.poll() is not None)
        assert program.process.returncode == 0, program.err
        no_tracebacks(tmp_path / "run")
    finally:
        program.end()


async def mbpoll(port: int, unit: int, *args: str, values: tuple[str, ...] = ()) -> str:
    process = await asyncio.create_subprocess_exec(
        "mbpoll", "-m", "tcp", "-p", str(port), "-a", str(unit), "-1", "-0", "-o", "2", "-t", "4", *args, "127.0.0.1",
        *values, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
    )  # fmt: skip
    async with asyncio.timeout(15):
        output, _ = await process.communicate()
    return output.decode()


@pytest.mark.interop
@pytest.mark.skipif(shutil.which("mbpoll") is None, reason="mbpoll is not installed")
def test_mbpoll_through_the_bridge(tmp_path: Path) -> None:
    async def main() -> None:
        writable = ("--allow-writes", "--unit", "21=1", "--unit", "22=2", "--pause", "20ms", "--idle", "60s")
        async with line_of_two(tmp_path) as banks, bridge(tmp_path, *writable) as (program, port):
            text = await mbpoll(port, 21, "-r", "5", "-c", "2")
            assert re.findall(r"^\[(\d+)\]:\s+(\d+)", text, re.MULTILINE) == [("5", "105"), ("6", "106")]
            text = await mbpoll(port, 22, "-r", "3", values=("777",))
            assert "Written 1 references" in text, text
            assert banks[2].read("holding", 3, 1, 0) == [777]
            text = await mbpoll(port, 9, "-r", "0", "-c", "1")
            assert "Gateway path unavailable" in text, text
            audit = next((tmp_path / "run").glob("*/audit.jsonl"))
            assert audit.read_text(encoding="ascii").count('"done"') == 1
            assert str(audit) in program.err.replace("\n", "")

    run(main(), timeout_s=40)


@pytest.mark.long
def test_pymodbus_clients_through_the_bridge_are_read_only_by_default(tmp_path: Path) -> None:
    async def reads(port: int, unit: int) -> None:
        client = AsyncModbusTcpClient("127.0.0.1", port=port, timeout=10)
        assert await client.connect()
        try:
            for turn in range(30):
                reply = await client.read_holding_registers(turn, count=3, device_id=unit)
                assert reply.registers == [100 * unit + turn + i for i in range(3)]
            refused = await client.write_register(0, 1, device_id=unit)
            assert refused.isError()
            assert refused.exception_code == 1
            silent = await client.read_holding_registers(0, count=1, device_id=77)
            assert silent.exception_code == 0x0B
        finally:
            client.close()

    async def main() -> None:
        async with line_of_two(tmp_path) as banks, bridge(tmp_path, "--json", "--timeout", "1s") as (program, port):
            # pymodbus numbers its transactions from 1 in each client: both use the same ids at the same time (MB-061)
            await asyncio.gather(reads(port, 1), reads(port, 2))
            assert banks[1].read("holding", 0, 1, 0) == [100]
            program.signal(signal.SIGINT)
            await eventually(lambda: program.process.poll() is not None)
            summary = program.summary
            assert summary["refused"] == 2
            assert summary["accepted"] == 2
            assert summary["target"]["replies"] == 60

    run(main(), timeout_s=40)


@pytest.mark.parametrize(
    ("args", "says", "code"),
    [
        (("tcp://127.0.0.1:0", "can:socketcan/can0"), "this kind of endpoint does not carry Modbus", 2),
        (("tcp://127.0.0.1:0", "rtu:/dev/ttyNONE", "--role", "x"), "roles are in clients' certificates", 2),
        (("tls://127.0.0.1:0?cert=c.pem", "rtu:/dev/ttyNONE"), "no ca", 2),
        (("udp://127.0.0.1:0", "rtu:/dev/ttyNONE"), "cannot listen on this kind of endpoint", 2),
        (("tcp://127.0.0.1:0", "rtu:/dev/ttyNONE", "--allow", "10.0.0.300"), "a network of clients", 2),
        (("tcp://192.0.2.1:1502", "rtu:/dev/ttyNONE"), "cannot listen", 4),
    ],
)
def test_impossible_bridges_are_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], args: tuple[str, ...], says: str, code: int
) -> None:
    monkeypatch.setattr(sys, "argv", ["fieldtwin", "bridge", *args])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == code
    told = capsys.readouterr().err
    assert says in told
    assert "Traceback" not in told
