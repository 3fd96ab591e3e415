"""The load that Studio puts on a PLC with 5,000 tags, and the source of the values that it shows.

A relay between Studio and the PLC's control socket notes each request and the size of its answer.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fieldtwin.gateway.core.image.image import INPUTS, TagKind, TagSpec
from fieldtwin.gateway.core.values import Quality, TagValue
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.plc.binding import InputBinding, image_for
from fieldtwin.plc.runtime.config import PlcConfig, ProgramConfig
from fieldtwin.run.processes.run_record import SYSTEM_FILE, RunRecord, write_record
from fieldtwin.studio.live.attachment import Attachment
from fieldtwin.studio.live.instances import PLC_SOCKET, FoundInstance
from fieldtwin.twin.plant.physical import attached, make_image
from fieldtwin.twin.site.resolved import write_resolved
from fieldtwin.twin.site.system import load_system

TAGS = 5000
MOST_ANSWER_BYTES = 8192
COPY = """PROGRAM copy
  VAR_INPUT x : REAL; END_VAR
  VAR_OUTPUT y : REAL; END_VAR
  y := x + 1.0;
END_PROGRAM
"""


@dataclass
class Asked:
    """The requests to the PLC, and the size in bytes of the longest answer to `get`."""

    requests: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    longest: int = 0

    @property
    def statuses(self) -> list[dict[str, Any]]:
        return [args for command, args in self.requests if command == "get"]


@asynccontextmanager
async def relay(here: Path, to: Path, asked: Asked) -> AsyncIterator[None]:
    """Listen at `here` and pass each line to `to` and each answer back."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far_reader, far_writer = await asyncio.open_unix_connection(str(to), limit=1 << 22)
        try:
            while line := await reader.readline():
                request = json.loads(line)
                asked.requests.append((request["command"], request["args"]))
                far_writer.write(line)
                answer = await far_reader.readline()
                if request["command"] == "get":
                    asked.longest = max(asked.longest, len(answer))
                writer.write(answer)
        finally:
            far_writer.close()
            writer.close()

    server = await asyncio.start_unix_server(serve, str(here))
    try:
        yield
    finally:
        server.close()


async def eventually(look: Any, what: str, within_s: float = 20.0) -> Any:
    deadline = time.monotonic() + within_s
    while not (found := look()):
        assert time.monotonic() < deadline, f"did not happen within {within_s:g} s: {what}"
        await asyncio.sleep(0.02)
    return found


@asynccontextmanager
async def observed(folder: Path) -> AsyncIterator[tuple[Attachment, Asked, Any]]:
    """A PLC with `TAGS` inputs, observed by Studio through the relay; also a writer of the inputs."""
    (folder / "copy.st").write_text(COPY)
    program = ProgramConfig("copy", "copy.st", {"x": InputBinding("d.t0")})
    specs = {f"d.t{n}": TagSpec(f"d.t{n}", TagKind.REAL) for n in range(TAGS)}
    layout = image_for([program.bind((str(folder),))], specs, specs)
    make_image(layout, folder / "image")
    real = folder / "real.sock"
    config = PlcConfig(
        str(folder / "image"), layout.describe(), str(real), (program,), cycle_ms=20.0, late_ms=1000.0, stop_after=0,
        priority=0, python_path=(str(folder),),
    )  # fmt: skip
    (folder / "plc.json").write_bytes(config.to_json())
    system = load_system("observatory")
    write_resolved(folder / SYSTEM_FILE, system)
    now_ns = time.monotonic_ns()
    record = RunRecord(
        system="observatory", path=str(system.path), prototype=True, allow_writes=True, started_utc_ns=time.time_ns(),
        started_ns=now_ns, pid=os.getpid(),
    )  # fmt: skip
    write_record(folder, record)
    process = await asyncio.create_subprocess_exec(sys.executable, "-m", "fieldtwin.plc", str(folder / "plc.json"))
    asked = Asked()
    try:
        await eventually(real.is_socket, "the PLC listens")
        with attached(layout, folder / "image") as image:
            async with (
                relay(folder / PLC_SOCKET, real, asked),
                Attachment(FoundInstance("many", folder, True, record), WallClock()) as attachment,
            ):
                yield attachment, asked, image.writer(INPUTS)
    finally:
        process.terminate()
        await process.wait()


def test_studio_asks_a_plc_with_thousands_of_tags_for_its_brief_status_only(tmp_path: Path) -> None:
    async def main() -> None:
        async with observed(tmp_path) as (attachment, asked, _):
            await eventually(lambda: len(asked.statuses) >= 4, "Studio asks for the status")
            assert {command for command, _ in asked.requests} == {"get", "about"}
            assert all(args["brief"] is True for args in asked.statuses)
            assert sum(args["buckets"] for args in asked.statuses) < len(asked.statuses) / 2
            assert asked.longest < MOST_ANSWER_BYTES
            assert attachment.plc is not None
            assert len(attachment.plc.inputs) == TAGS

    asyncio.run(main())


def test_values_come_from_the_process_image_with_the_quality_that_programs_see(tmp_path: Path) -> None:
    def shown(attachment: Attachment) -> tuple[Any, ...]:
        plc = attachment.plc
        seen = plc.inputs["d.t0"] if plc else {}
        return seen.get("value"), seen.get("quality"), seen.get("reason"), plc.variables["copy.y"] if plc else None

    async def main() -> None:
        async with observed(tmp_path) as (attachment, _, inputs):

            async def beat() -> None:
                row = [TagValue(41.0, Quality.GOOD, t_ns=1)] * TAGS
                while True:
                    inputs.publish(row, time.monotonic_ns())
                    await asyncio.sleep(0.05)

            beating = asyncio.create_task(beat())
            await eventually(lambda: shown(attachment) == (41.0, "good", "none", 42.0), "the values are shown")
            beating.cancel()
            dead = "the inputs of a dead gateway are bad"
            await eventually(lambda: shown(attachment)[:3] == (41.0, "bad", "gateway dead"), dead)

    asyncio.run(main())
