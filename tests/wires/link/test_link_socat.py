"""The emulated connection against socat, on either side, with the gateway's serial port on the virtual ports."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import re
import shutil
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from support import eventually, run

from fieldtwin.emulators.link import LinkOptions, run_link
from fieldtwin.gateway.connections.serial.line import SerialConnection
from fieldtwin.gateway.core.endpoint import Endpoint

pytestmark = [
    pytest.mark.interop,
    pytest.mark.skipif(shutil.which("socat") is None, reason="socat is not installed"),
]
QUICK = LinkOptions(backoff_s=0.02, backoff_max_s=0.1)


@contextlib.asynccontextmanager
async def socat(*addresses: str) -> AsyncIterator[asyncio.subprocess.Process]:
    process = await asyncio.create_subprocess_exec("socat", "-d", "-d", *addresses, stderr=asyncio.subprocess.PIPE)
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.communicate()


@contextlib.asynccontextmanager
async def linked(near: Endpoint, far: Endpoint) -> AsyncIterator[tuple[Endpoint, Endpoint]]:
    ready: asyncio.Future[tuple[Endpoint, Endpoint]] = asyncio.get_running_loop().create_future()
    task = asyncio.create_task(run_link(near, far, QUICK, on_ready=lambda link: ready.set_result(link.ends)))
    try:
        yield await asyncio.wait_for(ready, 5)
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def talk(one: Path, other: Path) -> None:
    """Send bytes of every value, in both directions at once, between two virtual serial ports opened by the gateway's end."""
    await eventually(lambda: os.path.lexists(one) and os.path.lexists(other))
    a = await SerialConnection.open(Endpoint.parse(f"rtu:{one}?frame=8N1"))
    b = await SerialConnection.open(Endpoint.parse(f"rtu:{other}?frame=8N1"))
    await _until_through(a, b)
    outward, inward = random.Random(1).randbytes(20_000), random.Random(2).randbytes(20_000)
    writing = [asyncio.create_task(a.write(outward)), asyncio.create_task(b.write(inward))]
    assert await _take(b, len(outward)) == outward
    assert await _take(a, len(inward)) == inward
    await asyncio.gather(*writing)
    await a.aclose()
    await b.aclose()


async def _until_through(a: SerialConnection, b: SerialConnection) -> None:
    """The carrier may still be starting; until then a line loses its data. Afterwards wait until it is quiet."""

    async def heard() -> bool:
        await a.write(b"?")
        return bool(b.read_pending())

    await eventually(heard, within_s=10)
    await a.write(b"!")
    last = b""
    while not last.endswith(b"!"):
        last = await asyncio.wait_for(b.read(), 5)


async def _take(connection: SerialConnection, size: int) -> bytes:
    data = b""
    while len(data) < size:
        data += await asyncio.wait_for(connection.read(), 5)
    return data


def test_socat_is_the_controllers_side(tmp_path: Path) -> None:
    async def main() -> None:
        field = Endpoint.parse(f"pty:{tmp_path}/field")
        async with linked(field, Endpoint.parse("tcp://127.0.0.1:0?listen=1")) as (_, bound):
            async with socat(f"pty,raw,echo=0,link={tmp_path}/line1", f"tcp:127.0.0.1:{bound.port}"):
                await talk(tmp_path / "line1", tmp_path / "field")
            async with socat(f"pty,raw,echo=0,link={tmp_path}/line1", f"tcp:127.0.0.1:{bound.port}"):
                await talk(tmp_path / "line1", tmp_path / "field")  # a second one finds the link ready again

    run(main())


def test_socat_on_the_emulators_side(tmp_path: Path) -> None:
    async def main() -> None:
        async with socat("tcp-listen:0,bind=127.0.0.1", f"pty,raw,echo=0,link={tmp_path}/field") as process:
            assert process.stderr is not None
            found = None
            while found is None:
                line = await asyncio.wait_for(process.stderr.readline(), 5)
                assert line, "socat ended"
                found = re.search(rb"listening on .*127\.0\.0\.1:(\d+)", line)
            near = Endpoint.parse(f"pty:{tmp_path}/line1")
            async with linked(near, Endpoint("tcp", host="127.0.0.1", port=int(found[1]))):
                await talk(tmp_path / "line1", tmp_path / "field")

    run(main())
