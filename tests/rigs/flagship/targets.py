"""The two targets of the flagship test: our emulators, and an independent implementation of the same devices.

Both are separate processes on real wires. The independent devices get their samples as tables of numbers: the rows of
the shipped recordings at the times at which the emulators replayed them, so that both conversations contain the same
values. Each side encodes the numbers itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import struct
import sys
import tomllib
from collections.abc import AsyncIterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
from conversation import Conversation
from support import eventually

from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.processes.children import Child
from fieldtwin.run.processes.topside import TopsideController
from fieldtwin.twin.plant.mapping import mapped_endpoint
from fieldtwin.twin.prototype.field_process import FieldConfig
from fieldtwin.twin.site.system import load_system

HERE = Path(__file__).parent
DEVICES = HERE / "devices"
ROOT = HERE.parents[2]
RECORDINGS = ROOT / "recordings"
SYSTEM = ROOT / "profiles/systems/observatory.yaml"


class EmulatedTarget:
    """Our emulators, as ``fieldtwin run --prototype`` starts them, with the remote client served by its own driver."""

    def __init__(self, mapping: dict[Endpoint, Endpoint], topside: TopsideController) -> None:
        self.mapping = mapping
        self.topside = topside

    async def command(self, period_s: int) -> None:
        self.topside.send(period_s)


@contextlib.asynccontextmanager
async def field_side(run_dir: Path, **listen: str) -> AsyncIterator[dict[str, Any]]:
    """Run the observatory's emulators as a process. `listen` gives the endpoints of a bus in a different place; yields
    their status."""
    config = run_dir / "field.json"
    config.write_bytes(msgspec.json.encode(FieldConfig(system=str(SYSTEM), run_dir=str(run_dir), listen=listen)))
    field = Child("field", "fieldtwin.twin.prototype.field_process", config, run_dir)
    try:
        client = await field.connect(timeout_s=120)
        status = await client.call("get")
        await client.aclose()
        yield status
    finally:
        await field.end()


@contextlib.asynccontextmanager
async def emulated(run_dir: Path) -> AsyncIterator[EmulatedTarget]:
    """Every emulator, and the remote client."""
    system = load_system(str(SYSTEM))
    async with field_side(run_dir) as status:
        mapping = {}
        for bus, url in status["listening"].items():
            plant = system.buses[bus].endpoint
            mapping[plant] = mapped_endpoint(plant, Endpoint.parse(url))
        topside = TopsideController(system, "modem", Endpoint.parse(status["far"]["modem"]), WallClock())
        async with Nursery() as nursery:
            nursery.start(topside.run([]), "topside")
            yield EmulatedTarget(mapping, topside)
            await topside.halt()


class IndependentTarget:
    """libmodbus on a pty, a socket that answers from a table of bytes, and python-can on a bus."""

    def __init__(self, mapping: dict[Endpoint, Endpoint], modem: asyncio.subprocess.Process) -> None:
        self.mapping = mapping
        self._modem = modem

    async def command(self, period_s: int) -> None:
        assert self._modem.stdin is not None
        self._modem.stdin.write(f"period {period_s}\n".encode())
        await self._modem.stdin.drain()


@contextlib.asynccontextmanager
async def independent(
    run_dir: Path, samples: list[list[float]], slopes: list[list[int]], plants: dict[str, str] | None = None
) -> AsyncIterator[IndependentTarget]:
    """`plants` names, by device, a difference to plant."""
    system, planted = load_system(str(SYSTEM)), plants or {}
    samples_file, slopes_file = run_dir / "samples.json", run_dir / "slopes.json"
    samples_file.write_text(json.dumps(samples))
    slopes_file.write_text(json.dumps(slopes))
    near, far = run_dir / "line1", run_dir / "line1-device"

    def options(device: str) -> list[str]:
        return ["--plant", planted[device]] if device in planted else []

    async with contextlib.AsyncExitStack() as stack:
        await stack.enter_async_context(socat_pair(near, far))
        bus = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 125_000, paced=True)
        stack.push_async_callback(bus.aclose)
        channel = bus.bound.path
        _, ctd_ready = await stack.enter_async_context(device("ctd_libmodbus", far, samples_file, *options("ctd")))
        modem, modem_ready = await stack.enter_async_context(
            device("modem_bytes", DEVICES / "modem.yaml", *options("modem"))
        )
        _, incl_ready = await stack.enter_async_context(
            device(
                "inclinometer_can",
                "fieldtwin",
                channel,
                DEVICES / "inclinometer.yaml",
                slopes_file,
                *options("inclinometer"),
                path=[entry_point(run_dir), ROOT],
            )
        )
        assert (ctd_ready, incl_ready) == ("ready", "ready")
        buses = system.buses
        mapping = {
            buses["line1"].endpoint: buses["line1"].endpoint.with_path(str(near)),
            buses["lan"].endpoint: buses["lan"].endpoint.with_address("127.0.0.1", int(modem_ready.split()[1])),
            buses["can0"].endpoint: Endpoint.parse(f"can:fieldtwin/{channel}"),
        }
        yield IndependentTarget(mapping, modem)


@contextlib.asynccontextmanager
async def socat_pair(one: Path, other: Path) -> AsyncIterator[None]:
    """Two virtual serial ports, wired to each other by socat."""
    process = await asyncio.create_subprocess_exec(
        "socat", f"pty,raw,echo=0,link={one}", f"pty,raw,echo=0,link={other}"
    )
    try:
        await eventually(lambda: os.path.lexists(one) and os.path.lexists(other))
        yield
    finally:
        await _end(process)


@contextlib.asynccontextmanager
async def device(
    name: str, *arguments: object, path: Sequence[Path] = ()
) -> AsyncIterator[tuple[asyncio.subprocess.Process, str]]:
    """Run one of the programs in devices/; yields its line of readiness. `path` is its PYTHONPATH."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        str(DEVICES / f"{name}.py"),
        *(str(a) for a in arguments),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))},
    )
    try:
        assert process.stdout is not None
        line = (await asyncio.wait_for(process.stdout.readline(), 60)).decode().strip()
        assert line.startswith("ready"), f"{name} ended with {await process.wait()}"
        yield process, line
    finally:
        await _end(process)


def entry_point(folder: Path) -> Path:
    """Create a folder that makes the software bus known to python-can, installed or not: the entry point of
    pyproject.toml."""
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]["can.interface"]
    info = folder / "fieldtwin_checkout-0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fieldtwin-checkout\nVersion: 0\n")
    lines = "".join(f"{name} = {target}\n" for name, target in declared.items())
    (info / "entry_points.txt").write_text(f"[can.interface]\n{lines}")
    return folder


async def _end(process: asyncio.subprocess.Process) -> None:
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    await process.communicate()


# -- tables for the independent devices ---------------------------------------------------------------------------------


def recording(name: str) -> list[list[float]]:
    """Return the rows of a signal recording, parsed as plain JSON Lines."""
    with (RECORDINGS / name).open(encoding="utf-8") as file:
        next(file)
        return [json.loads(line) for line in file]


def at_time(rows: list[list[float]], t_s: float) -> list[float]:
    """Interpolate all signals linearly at a time between two rows."""
    for (t0, *before), (t1, *after) in pairwise(rows):
        if t0 <= t_s < t1:
            share = (t_s - t0) / (t1 - t0)
            return [a + share * (b - a) for a, b in zip(before, after, strict=True)]
    return rows[-1][1:]


def samples_like(talk: Conversation, count: int = 6) -> list[list[float]]:
    """Return rows for the ctd, from the recording at the times of the first sample of `talk`, and every second after
    it."""
    taken: list[tuple[int, int]] = []
    for e in talk.exchanges:
        if e.request == bytes.fromhex("01 04 0000 000A") and len(e.reply) == 23:
            taken.append(struct.unpack(">II", e.reply[15:23]))
    number, ms = next((n, ms) for n, ms in taken if n)
    first_ms = ms - 1000 * (number - 1)
    rows = recording("cast.jsonl")
    return [[t_ms, *at_time(rows, t_ms / 1000)] for t_ms in range(first_ms, first_ms + 1000 * count, 1000)]


def slopes_like(talk: Conversation) -> list[list[int]]:
    """Return rows for the inclinometer, from the position in the recording where the TPDOs of `talk` began, in
    hundredths of a degree."""
    heard = [struct.unpack("<hh", h.data) for h in talk.heard if h.cob_id == 0x185][:20]
    rows: list[Any] = [[round(100 * a), round(100 * b)] for _, a, b in recording("incl.jsonl")[:-1]]

    def misfit(start: int) -> int:
        return sum(
            (rows[(start + i) % len(rows)][0] - a) ** 2 + (rows[(start + i) % len(rows)][1] - b) ** 2
            for i, (a, b) in enumerate(heard)
        )

    start = min(range(len(rows)), key=misfit)
    return [rows[(start + i) % len(rows)] for i in range(len(rows))]
