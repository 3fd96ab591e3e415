"""The driver over a carried line: `fieldtwin link` and socat, one on each side, between a SensorDriver and its ctd."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import shutil
import sys
from collections.abc import AsyncIterator, Callable
from ctypes.util import find_library
from pathlib import Path

import pytest
from support import eventually, run
from targets import SYSTEM, at_time, device, field_side, recording

from fieldtwin.emulators.link import run_link
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.concurrency.events import Consumer
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.values import DATA
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.devices.register_device import SensorDriver
from fieldtwin.gateway.runtime.buses.modbus.jobs import BusJob
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.site.system import load_system

pytestmark = [
    pytest.mark.interop,
    pytest.mark.skipif(shutil.which("socat") is None, reason="socat is not installed"),
]
SETTINGS = "baudrate=19200&frame=8E1"


@contextlib.asynccontextmanager
async def process(*command: str) -> AsyncIterator[asyncio.subprocess.Process]:
    started = await asyncio.create_subprocess_exec(*command, stderr=asyncio.subprocess.PIPE)
    try:
        yield started
    finally:
        with contextlib.suppress(ProcessLookupError):
            started.terminate()
        await started.communicate()


async def sample_twice(port: Path) -> list[bytes]:
    """Identify the ctd at `port`, make it sample every second, and stop it after two samples; return the samples as emitted."""
    clock, system = WallClock(), load_system(str(SYSTEM))
    tags = TagTable(clock)
    driver = SensorDriver(system.devices["ctd"], tags)
    tags.declare(driver.tag_names, None)
    samples: Consumer[DATA] = Consumer(driver.emitter.event, capacity=64)
    driver.emitter.subscribe(samples)
    bus = BusConfig("line1", Endpoint.parse(f"rtu:{port}?{SETTINGS}"), timeout_s=1.0, retries=2)
    line = ModbusBus(bus, [driver], OsConnector(), clock, tags, lambda lost: None)

    async def command(period_s: int) -> None:
        done: asyncio.Future[FieldtwinError | None] = asyncio.get_running_loop().create_future()
        driver.consumer.observe(driver.command("sample_period_s", period_s))
        line.submit(BusJob(driver, driver.send, done.set_result))
        assert await done is None

    async with Nursery() as nursery:
        nursery.start(line.run(), "line1")
        await eventually(lambda: line.online(driver) and tags.current("ctd.sample_count", 0).value == 0, within_s=10)
        await command(1)
        await eventually(lambda: len(samples.queue) >= 2, within_s=10)
        await command(0)
        await line.halt(1.0)
        totals = line.totals()
    assert totals["requests"] == totals["replies"]
    assert tags.current("ctd.serial", 0).value == "0042"
    return [s.data for s in samples.drain()]


def test_socat_on_the_drivers_side(short_dir: Callable[[], Path]) -> None:
    """Driver, socat, TCP, our link, the emulator's port."""

    async def main() -> None:
        folder = short_dir()
        async with field_side(folder) as status:
            ready: asyncio.Future[Endpoint] = asyncio.get_running_loop().create_future()
            field = Endpoint.parse(f"rtu:{Endpoint.parse(status['listening']['line1']).path}?{SETTINGS}")
            async with Nursery() as nursery:
                door = Endpoint.parse("tcp://127.0.0.1:0?listen=1")
                nursery.start(run_link(field, door, on_ready=lambda link: ready.set_result(link.ends[1])), "link")
                port = folder / "carried"
                target = f"tcp:127.0.0.1:{(await ready).port}"
                async with process("socat", f"pty,raw,echo=0,link={port}", target):
                    await eventually(lambda: os.path.lexists(port))
                    first, second = await sample_twice(port)
        assert len(first) == len(second) == 20
        assert (first[12:16], second[12:16]) == (bytes((0, 0, 0, 1)), bytes((0, 0, 0, 2)))

    run(main(), timeout_s=50)


@pytest.mark.skipif(find_library("modbus") is None, reason="libmodbus is not installed")
def test_socat_on_the_devices_side(short_dir: Callable[[], Path]) -> None:
    """Driver, `fieldtwin link` as a command, TCP, socat, and an independent ctd."""

    async def main() -> None:
        folder = short_dir()
        field, port, table = folder / "field", folder / "carried", folder / "samples.json"
        rows = recording("cast.jsonl")
        table.write_text(json.dumps([[1000 * t, *at_time(rows, t)] for t in range(8)]))
        async with process("socat", "-d", "-d", "tcp-listen:0,bind=127.0.0.1", f"pty,raw,echo=0,link={field}") as socat:
            assert socat.stderr is not None
            found = None
            while found is None:
                found = re.search(rb"listening on .*127\.0\.0\.1:(\d+)", await socat.stderr.readline())
            link = [sys.executable, "-m", "fieldtwin", "link", str(port), f"tcp://127.0.0.1:{int(found[1])}"]
            async with process(*link):
                await eventually(lambda: os.path.lexists(field) and os.path.lexists(port), within_s=10)
                async with device("ctd_libmodbus", field, table):
                    first, second = await sample_twice(port)
        assert (first[12:], second[12:]) == (bytes.fromhex("00000001 00000000"), bytes.fromhex("00000002 000003E8"))

    run(main(), timeout_s=50)
