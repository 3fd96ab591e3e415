"""On the kernel's CAN: candump and cansend talk to the emulated inclinometer, and the driver cannot distinguish it from an
independent device."""

from __future__ import annotations

import asyncio
import contextlib
import re
import shutil
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
import yaml
from compare import TOLERANCES, compare, load_tolerances
from conversation import Conversation, canopen_conversation
from flagship import converse_on_can
from support import eventually, run
from targets import DEVICES, device, field_side, slopes_like

from fieldtwin.gateway.core.endpoint import Endpoint

pytestmark = [
    pytest.mark.socketcan,
    pytest.mark.interop,
    pytest.mark.timeout(300),
    pytest.mark.skipif(shutil.which("candump") is None, reason="can-utils is not installed"),
]
CAN0 = "can:socketcan/vcan0"
VCAN0 = Endpoint.parse(CAN0)


class Candump:
    """The output of candump for vcan0, as COB-ID#DATA."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process
        self.frames: list[str] = []

    async def read(self) -> None:
        assert self._process.stdout is not None
        while line := await self._process.stdout.readline():
            found = re.search(rb" vcan0 ([0-9A-F]+#[0-9A-FR]*)", line)
            assert found, line
            self.frames.append(found[1].decode())

    async def sees(self, frame: str) -> None:
        """Wait for a frame with this beginning, and remove it and all earlier ones."""
        await eventually(lambda: any(f.startswith(frame) for f in self.frames), within_s=60, what=f"{frame} on vcan0")
        first = next(i for i, f in enumerate(self.frames) if f.startswith(frame))
        del self.frames[: first + 1]


@contextlib.asynccontextmanager
async def candump() -> AsyncIterator[Candump]:
    process = await asyncio.create_subprocess_exec("candump", "-L", "vcan0", stdout=asyncio.subprocess.PIPE)
    dump = Candump(process)
    reading = asyncio.create_task(dump.read())
    try:

        async def listens() -> bool:
            await cansend("7E5#00")  # an unused identifier: when candump shows it, candump is ready
            return bool(dump.frames)

        await eventually(listens, within_s=60)
        yield dump
    finally:
        process.terminate()
        await reading
        await process.wait()


async def cansend(frame: str) -> None:
    process = await asyncio.create_subprocess_exec("cansend", "vcan0", frame)
    assert await process.wait() == 0


def test_candump_and_cansend_talk_to_the_node(short_dir: Callable[[], Path]) -> None:
    async def main() -> None:
        async with candump() as dump, field_side(short_dir(), can0=CAN0):
            await dump.sees("705#00")  # boot-up
            await cansend("605#4018100400000000")
            await dump.sees("585#43181004ED030000")  # serial number 1005
            await cansend("605#4000200000000000")
            await dump.sees("585#8000200000000206")  # no such object
            await cansend("605#2B17100064000000")  # heartbeat every 100 ms
            await dump.sees("585#6017100000000000")
            await dump.sees("705#7F")
            await cansend("605#2B00180532000000")  # TPDO1 every 50 ms
            await dump.sees("585#6000180500000000")
            await cansend("000#0105")
            await dump.sees("185#")
            await dump.sees("705#05")
            await cansend("000#8105")  # reset
            await dump.sees("705#00")

    run(main(), timeout_s=280)


def test_the_driver_cannot_tell_an_emulator_from_the_device(short_dir: Callable[[], Path]) -> None:
    """The CAN part of the flagship test, where only the driver, or the driver and the emulator, is ours."""

    async def hold(folder: Path) -> Conversation:
        return canopen_conversation("inclinometer", await converse_on_can(VCAN0, folder, patience_s=100), 5)

    async def main() -> tuple[Conversation, Conversation]:
        folder = short_dir()
        async with field_side(folder, can0=CAN0):
            ours = await hold(folder)
        slopes = folder / "slopes.json"
        slopes.write_text(str(slopes_like(ours)))
        table = DEVICES / "inclinometer.yaml"
        async with device("inclinometer_can", "socketcan", "vcan0", table, slopes):
            return ours, await hold(folder)

    ours, theirs = run(main(), timeout_s=280)
    text = yaml.safe_load(TOLERANCES.read_text(encoding="utf-8"))
    # A virtual machine without hardware support is ten times slower than its host; the frames are compared nevertheless.
    rules = load_tolerances(text)["inclinometer"].model_copy(update={"latency_within_ms": 500.0})
    rules = rules.model_copy(
        update={"heard": tuple(h.model_copy(update={"interval_within_ms": 200.0}) for h in rules.heard)}
    )
    assert [str(d) for d in compare(ours, theirs, rules)] == []
    assert len(ours.exchanges) == len(theirs.exchanges) >= 22
