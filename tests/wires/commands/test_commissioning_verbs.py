"""Read, write, dump and watch on real wires: libmodbus, pymodbus, ptys, TCP, RTU inside TCP, the software CAN bus; kill -9."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path

import pytest
from pymodbus import FramerType
from pymodbus.server import ModbusTcpServer
from support import eventually, run
from third_party_servers import COUNT, INPUTS, libmodbus, null_modem, sim_device

from fieldtwin.commissioning.access.address import RawForm, tags_of
from fieldtwin.commissioning.access.reading import DeviceTarget, point_at
from fieldtwin.commissioning.access.watching import samples
from fieldtwin.commissioning.access.writing import before, carry_out, plan_write, restore
from fieldtwin.commissioning.dump.dump import DumpJob
from fieldtwin.commissioning.dump.file import load_dump
from fieldtwin.commissioning.dump.session import dump, log_path, object_ranges, register_spans
from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.can.software_end import open_can_end
from fieldtwin.emulators.endpoints.modbus_server import serve_mbap, serve_rtu
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.endpoints.socket_end import SocketListener
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit, UnitLimits
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.wallclock import WallClock

ROOT = Path(__file__).parents[3]
Opened = Callable[[Path], AbstractAsyncContextManager[str]]
SHEET = (
    "[DeviceInfo]\nVendorName=x\n"
    "[1000]\nParameterName=type\nObjectType=0x7\nDataType=0x0007\nAccessType=ro\nDefaultValue=0x2019A\nPDOMapping=0\n"
    "[2000]\nParameterName=gain\nObjectType=0x7\nDataType=0x0008\nAccessType=rw\nDefaultValue=1.5\nPDOMapping=0\n"
)


@asynccontextmanager
async def libmodbus_tcp(_: Path) -> AsyncIterator[str]:
    async with libmodbus("tcp") as port:
        yield f"tcp://127.0.0.1:{port}"


@asynccontextmanager
async def libmodbus_pty(_: Path) -> AsyncIterator[str]:
    with null_modem() as (near, far):
        async with libmodbus("rtu", far):
            yield f"rtu:{near}?baudrate=115200&frame=8N1"


@asynccontextmanager
async def pymodbus_rtu_over_tcp(_: Path) -> AsyncIterator[str]:
    server = ModbusTcpServer(sim_device(), address=("127.0.0.1", 0), framer=FramerType.RTU)
    await server.serve_forever(background=True)
    yield f"rtu+tcp://127.0.0.1:{server.transport.sockets[0].getsockname()[1]}"  # type: ignore[attr-defined]
    await server.shutdown()  # type: ignore[no-untyped-call]


def our_unit() -> ModbusUnit:
    made = MapBank([CellSpan("input", 0, COUNT), CellSpan("holding", 0, COUNT), CellSpan("discrete", 0, COUNT)])
    for i, word in enumerate(INPUTS):
        made.poke("input", i, word)
        made.poke("discrete", i, int(i % 3 == 0))
    return ModbusUnit(made, UnitLimits(read_registers=60))


@asynccontextmanager
async def our_pty(folder: Path) -> AsyncIterator[str]:
    end = await PtyEnd.open(folder / "line", Endpoint.parse("pty:line"), None)
    task = asyncio.create_task(serve_rtu(end, RtuServer({1: our_unit()}), WallClock()))
    try:
        yield f"rtu:{folder / 'line'}?baudrate=115200&frame=8N1"
    finally:
        task.cancel()
        await asyncio.wait([task])
        await end.aclose()


@pytest.mark.interop
@pytest.mark.parametrize("opened", [libmodbus_tcp, libmodbus_pty, pymodbus_rtu_over_tcp, our_pty])
def test_a_unit_is_dumped_read_written_and_put_back(opened: Opened, tmp_path: Path) -> None:
    async def main() -> None:
        async with opened(tmp_path) as url:
            target = DeviceTarget(url, 1, timeout_s=2.0)
            # libmodbus sleeps half a second before it refuses, and its RTU server ends at an unknown function.
            polite = opened in (libmodbus_tcp, libmodbus_pty)
            spans = register_spans(
                [f"input:0..{COUNT - 1 if polite else COUNT + 9}", "holding:0..59", "discrete:0..63"]
            )
            await dump(DumpJob(target, spans, functions=not polite), tmp_path / "d.jsonl", words="w")
            found = load_dump(tmp_path / "d.jsonl")
            values = found.passes[0].cells
            assert [int.from_bytes(values[("input", i)]) for i in range(COUNT)] == INPUTS
            assert ("input", COUNT) not in values
            assert [values[("discrete", i)][0] for i in range(64)] == [int(i % 3 == 0) for i in range(64)]
            assert found.maps["input"]["max_read"] == (60 if opened is our_pty else 125)
            assert found.maps["input"]["limit_proved"]
            assert log_path(tmp_path / "d.jsonl").stat().st_size > 1000
            async with point_at(target) as point:
                write = plan_write(tags_of(["holding:4"], "modbus", RawForm("float32", "CDAB"))[0], "12.5")
                done = await carry_out(point, write, await before(point, write))
                assert done.after == bytes.fromhex("00004148")
                assert (await restore(point, done)).after == bytes(4)
                answers = await point.read(tags_of(["input:2", "discrete:3"], "modbus"))
                assert [a.value.value for a in answers.values()] == [514, True]

    run(main())


def test_a_node_on_the_software_bus(tmp_path: Path) -> None:
    async def main() -> None:
        bus = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 1_000_000)
        end = await open_can_end(bus.bound, 1_000_000)
        serving = asyncio.create_task(
            serve_node(end, CanopenNode(parse_eds(SHEET, "x"), 7, NodeContext()), WallClock())
        )
        try:
            target = DeviceTarget(str(bus.bound), 7)
            await dump(DumpJob(target, objects=object_ranges(["1000..1008", "2000"])), tmp_path / "n.jsonl", words="w")
            cells = load_dump(tmp_path / "n.jsonl").passes[0].cells
            assert cells == {(0x1000, 0): bytes.fromhex("9a010200"), (0x2000, 0): bytes.fromhex("0000c03f")}
            tags = tags_of(["2000h:00"], "canopen", RawForm("float32"))
            async with point_at(target) as point:
                write = plan_write(tags[0], "2.5")
                await restore(point, await carry_out(point, write, await before(point, write)))
                seen = [s async for s in samples(point, tags, WallClock(), 0.02, 3)]
            assert [s.answers["2000h:00"].value.value for s in seen] == [1.5, 1.5, 1.5]
        finally:
            serving.cancel()
            await asyncio.wait([serving])
            await end.aclose()
            await bus.aclose()

    run(main())


@pytest.mark.long
def test_a_dump_that_was_killed_continues(tmp_path: Path) -> None:
    """kill -9 in the middle of a dump from the command line; at most the last line is lost, and no request is repeated."""
    out = tmp_path / "d.jsonl"

    async def main() -> None:
        server = MbapServer({1: our_unit()})
        listener = await SocketListener.open(
            Endpoint.parse("tcp://127.0.0.1:0"), lambda c: serve_mbap(c, server, WallClock(), latency_s=0.002)
        )
        arguments = ["dump", str(listener.bound), "input:0..999", "-o", str(out), "--rate", "200", "--json"]

        async def start(*more: str) -> asyncio.subprocess.Process:
            return await asyncio.create_subprocess_exec(
                sys.executable, "-m", "fieldtwin", *arguments, *more, cwd=ROOT,
                stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
            )  # fmt: skip

        try:
            first = await start()
            await eventually(lambda: out.exists() and out.read_bytes().count(b'"us"') > 20, within_s=20)
            os.kill(first.pid, signal.SIGKILL)
            await first.communicate()
            kept = out.read_bytes().count(b'"us"')
            asked = server.requests
            assert asked - 1 <= kept <= asked
            second = await start("--resume")
            stdout, stderr = await second.communicate()
            assert second.returncode == 0, stderr.decode()
            told = json.loads(stdout)
        finally:
            await listener.aclose()
        assert told["values"] == COUNT
        lines = [json.loads(line) for line in out.read_bytes().splitlines()]
        reads = [line["read"] for line in lines if "read" in line]
        assert len(reads) == len(set(reads)) or len(reads) - len(set(reads)) < 3
        assert [int.from_bytes(load_dump(out).passes[0].cells[("input", i)]) for i in range(COUNT)] == INPUTS

    run(main(), timeout_s=40)
