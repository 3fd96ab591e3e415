"""The PLC process: an image file, programs, one task on the wall clock, and a control channel.

Control verbs (gateway.core.control, on the configured Unix socket):

    ready   {"ready": true, "state": ...}: the image is attached and the task was started
    get     everything a display shows: state, error, statistics, inputs with quality and age, outputs, variables
    stop    outputs safe, then the process ends

SIGTERM and SIGINT do what stop does. The process ends within a second, with its outputs region flagged stopped. A task
that stopped by itself (watchdog, a program that raised) leaves the process up, outputs safe, so that it can be asked.
"""

from __future__ import annotations

import asyncio
import mmap
import os
import signal
from pathlib import Path
from typing import Any

from gateway.core.control import ControlServer
from gateway.core.errors import FileInvalid, Unreachable
from gateway.core.image import Image
from plc.binding import BoundProgram
from plc.config import PlcConfig
from plc.realtime import RealtimeReport, monotonic_ns, prepare, run_task
from plc.scan import Scan
from plc.task import CyclicTask, StopReason


class PlcProcess:
    """One PLC: assembled by the constructor, run once by `run`, which blocks. Raises `FileInvalid`, `Unreachable`."""

    def __init__(self, config: PlcConfig, image: Image) -> None:
        self._config = config
        self._programs: list[BoundProgram] = [p.bind(config.python_path) for p in config.programs]
        self._scan = Scan(image, self._programs, config.heartbeat_limit_ms)
        self._task = CyclicTask(self._scan, config.task(), monotonic_ns)
        self._loop = asyncio.new_event_loop()
        self._server = ControlServer({"ready": self._ready, "get": self._get, "stop": self._stop})
        self._realtime = RealtimeReport((), ())
        self._stopping = False

    def run(self) -> int:
        """Run until told to stop; the exit code: 0, or the error's when the task stopped by itself."""
        before = {s: signal.signal(s, self._on_signal) for s in (signal.SIGTERM, signal.SIGINT)}
        try:
            self._loop.run_until_complete(self._server.listen_unix(Path(self._config.control_path)))
            self._realtime = prepare(self._config.priority)
            run_task(self._task, self._loop, lambda: self._stopping)
        finally:
            self._loop.run_until_complete(self._close())
            self._loop.close()
            for number, handler in before.items():
                signal.signal(number, handler)
        error = self._task.error
        return error.exit_code if error is not None and self._task.stop_reason is not StopReason.REQUESTED else 0

    async def _close(self) -> None:
        await self._server.aclose()
        rest = asyncio.all_tasks() - {asyncio.current_task()}
        if rest:
            await asyncio.wait(rest, timeout=0.3)
        Path(self._config.control_path).unlink(missing_ok=True)

    def _on_signal(self, number: int, frame: object) -> None:
        self._stopping = True

    async def _ready(self, args: dict[str, Any]) -> dict[str, Any]:
        return {"ready": True, "state": self._task.state.value, "pid": os.getpid()}

    async def _stop(self, args: dict[str, Any]) -> dict[str, Any]:
        self._task.stop()  # before the answer: whoever asked may rely on it
        self._loop.call_later(0.02, self._end)  # after it, so that it gets out
        return {"state": self._task.state.value}

    def _end(self) -> None:
        self._stopping = True
        self._loop.stop()

    async def _get(self, args: dict[str, Any]) -> dict[str, Any]:
        now_ns = monotonic_ns()
        outputs = self._scan.outputs()
        return {
            **self._task.describe(),
            "pid": os.getpid(),
            "gateway_alive": self._scan.gateway_alive,
            "counters": self._scan.counters(),
            "realtime": self._realtime.describe(),
            "programs": {p.name: type(p.program).__name__ for p in self._programs},
            "inputs": {tag: value.describe(now_ns) for tag, value in self._scan.inputs().items()},
            "outputs": outputs,
            "variables": {f"{p.name}.{v.name}": outputs[tag] for p in self._programs for v, tag in p.published()},
        }


def plc_main(config: PlcConfig) -> int:
    """Attach, run until told to stop, return the exit code. Raises `FileInvalid` or `Unreachable` before the first scan."""
    try:
        fd = os.open(config.image_path, os.O_RDWR | os.O_CLOEXEC)
    except OSError as e:
        raise Unreachable(f"no process image: {e.strerror or e}", where=config.image_path) from e
    try:
        mapped = mmap.mmap(fd, 0)
    except (OSError, ValueError) as e:
        raise FileInvalid(f"not a process image: {e}", path=config.image_path) from e
    finally:
        os.close(fd)
    with mapped, memoryview(mapped) as memory, config.image_layout().attach(memory) as image:
        return PlcProcess(config, image).run()
