"""Run the steps of the commissioning guide: each job is the real command as a child process in the working folder.

Running jobs, kept jobs and lines, and the bytes of a result are limited. Dropped jobs and lines are counted.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import msgspec

from fieldtwin.gateway.core.errors import EndpointBusy, NotAllowed, UsageError
from fieldtwin.gateway.core.escaping import escape_controls
from fieldtwin.studio import child_process
from fieldtwin.studio.commissioning.steps import Command, Step, check_may_start
from fieldtwin.studio.commissioning.work_folder import WorkFolder

MOST_RUNNING = 6
MOST_KEPT = 40
"""Largest number of finished jobs whose results are kept; the oldest are dropped first."""
MOST_LINES = 400
LONGEST_LINE = 500
LAST_LINES = 8
"""Number of the last lines of a job that an overview of all jobs contains."""
MOST_RESULT_BYTES = 8 << 20
LONGEST_S = 86_400.0
MOST_LISTENERS = 50
_INTERRUPTED = 130

RUNNING, DONE, FINDINGS, STOPPED, FAILED = "running", "done", "findings", "stopped", "failed"


class Jobs:
    """All jobs of the guide. Use it as ``async with Jobs(folder) as jobs``; leaving the block stops every job that still runs.

    Each job is stopped after `longest_s` seconds.
    """

    def __init__(self, folder: WorkFolder, longest_s: float = LONGEST_S) -> None:
        self.folder = folder
        self._longest_s = longest_s
        self.forgotten = 0
        self._jobs: dict[int, Job] = {}
        self._listeners: set[asyncio.Event] = set()
        self._last = 0

    async def __aenter__(self) -> Jobs:
        return self

    async def __aexit__(self, *error: object) -> None:
        await asyncio.gather(*(job.stop() for job in self._jobs.values()), return_exceptions=True)

    async def start(self, step: Step) -> Job:
        """Start a step. Raises `EndpointBusy` if a job uses the same port, and `UsageError` for too many jobs or its files."""
        made = step.command(self.folder)
        check_may_start(step, made, self.folder)
        running = [job for job in self._jobs.values() if job.is_running]
        for job in running:
            if made.port and job.command.port == made.port:
                raise EndpointBusy(
                    f"the step {job.step!r} uses this port", where=made.port, hint="stop it, or wait for its end"
                )
            both = {*made.writes, made.adds_to} & {*job.command.writes, job.command.adds_to} - {""}
            if both:
                raise EndpointBusy(
                    f"the step {job.step!r} writes {', '.join(sorted(both))}", hint="choose another name"
                )
        if len(running) >= MOST_RUNNING:
            raise UsageError("too many steps at once", expected=f"at most {MOST_RUNNING}", hint="stop an emulator")
        self._last += 1
        job = self._jobs[self._last] = Job(self._last, step, made, self.folder, self._tell, self._longest_s)
        try:
            await job.begin()
        except BaseException:
            del self._jobs[job.number]
            raise
        for name in {*made.writes, made.adds_to} - {""}:
            self.folder.note_written(name)
        self._forget_old()
        self._tell()
        return job

    def _forget_old(self) -> None:
        finished = [number for number, job in self._jobs.items() if not job.is_running]
        for number in finished[: max(0, len(finished) - MOST_KEPT)]:
            del self._jobs[number]
            self.forgotten += 1

    def job(self, number: int) -> Job | None:
        """Return the job with this number, None for an unknown number or a dropped job."""
        return self._jobs.get(number)

    def clear(self) -> None:
        """Remove all finished jobs, to begin with another device. Raises `NotAllowed` while one runs."""
        running = [job.step for job in self._jobs.values() if job.is_running]
        if running:
            raise NotAllowed("steps are running", expected="no running step", got=", ".join(running))
        self._jobs.clear()
        self._tell()

    def overview(self) -> list[dict[str, Any]]:
        """Return the states of all jobs, the oldest first, without their results."""
        return [job.state() for job in self._jobs.values()]

    @contextlib.contextmanager
    def listening(self) -> Iterator[asyncio.Event]:
        """Yield an event that is set after each change. Raises `UsageError` for too many listeners."""
        if len(self._listeners) >= MOST_LISTENERS:
            raise UsageError("too many pages are open", expected=f"at most {MOST_LISTENERS}")
        event = asyncio.Event()
        self._listeners.add(event)
        try:
            yield event
        finally:
            self._listeners.discard(event)

    def _tell(self) -> None:
        for event in self._listeners:
            event.set()


class Job:
    """A step that runs or has run."""

    def __init__(
        self,
        number: int,
        step: Step,
        command: Command,
        folder: WorkFolder,
        changed: Callable[[], None],
        longest_s: float = LONGEST_S,
    ) -> None:
        self.number = number
        self.command = command
        self.step = str(type(step).__struct_config__.tag)
        self.result: Any = None
        self._form = msgspec.to_builtins(step)
        self._folder = folder
        self._longest_s = longest_s
        self._changed = changed
        self._lines: deque[str] = deque(maxlen=MOST_LINES)
        self._count = 0
        self._trouble = ""
        self._was_stopped = False
        self._exit_code: int | None = None
        self._process: asyncio.subprocess.Process | None = None
        self._following: asyncio.Future[None] | None = None
        self._began_s = asyncio.get_running_loop().time()
        self._took_s = 0.0

    async def begin(self) -> None:
        """Start the process."""
        arguments = [*self.command.arguments, *(["--json"] if self.command.as_json else [])]
        environment = os.environ | {"COLUMNS": "120", "NO_COLOR": "1"}
        self._process = await child_process.start(*arguments, cwd=self._folder.path, env=environment)
        self._following = asyncio.ensure_future(self._follow())

    @property
    def is_running(self) -> bool:
        """Return whether the process, or the reading of its result, has not ended."""
        return self._following is None or not self._following.done()

    def state(self) -> dict[str, Any]:
        """Return the job without its result, with the last lines of its messages."""
        return {
            "number": self.number,
            "step": self.step,
            "form": self._form,
            "command": self.command.line,
            "state": self._verdict(),
            "lasts": self.command.lasts,
            "elapsed_s": asyncio.get_running_loop().time() - self._began_s if self.is_running else self._took_s,
            "exit_code": self._exit_code,
            "trouble": self._trouble,
            "lines": list(self._lines)[-LAST_LINES:],
            "line_count": self._count,
            "writes": self._sizes(),
        }

    def whole(self) -> dict[str, Any]:
        """Return the job with its result and all lines that are kept."""
        dropped = self._count - len(self._lines)
        return self.state() | {"lines": list(self._lines), "dropped_lines": dropped, "result": self.result}

    def _verdict(self) -> str:
        if self.is_running:
            return RUNNING
        if self._was_stopped or self._exit_code == _INTERRUPTED:
            return STOPPED
        if self._exit_code == 0 and not self._trouble:
            return DONE
        return FINDINGS if self.result is not None and not self._trouble else FAILED

    def _sizes(self) -> dict[str, int]:
        found = {}
        for name in sorted({*self.command.writes, self.command.adds_to} - {""}):
            with contextlib.suppress(OSError):
                found[name] = (self._folder.path / name).stat().st_size
        return found

    async def _follow(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        try:
            async with asyncio.timeout(self._longest_s):
                output, _ = await asyncio.gather(
                    self._read(self._process.stdout), self._read_lines(self._process.stderr)
                )
                self._exit_code = await self._process.wait()
        except TimeoutError:
            self._trouble = f"stopped after {self._longest_s:g} s"
        except child_process.OutputTooLong:
            self._trouble = f"stopped: the result is longer than {MOST_RESULT_BYTES} bytes"
        else:
            self._take(output)
        finally:
            self._took_s = asyncio.get_running_loop().time() - self._began_s
            child_process.kill(self._process)
            await self._process.wait()
            if self._was_stopped and self._lines and self._lines[-1] == "KeyboardInterrupt":
                self._forget_traceback()
            asyncio.get_running_loop().call_soon(self._changed)

    async def _read(self, stream: asyncio.StreamReader) -> bytes:
        """Return the command's JSON result. Output that is text for the user becomes lines of the job; then return b""."""
        if self.command.as_json:
            return await child_process.read_whole(stream, MOST_RESULT_BYTES)
        await self._read_lines(stream)
        return b""

    async def _read_lines(self, stream: asyncio.StreamReader) -> None:
        rest = b""
        while chunk := await stream.read(4096):
            *whole, rest = (rest + chunk).split(b"\n")
            self._add(whole)
            if len(rest) > 4 * LONGEST_LINE:
                self._add([rest])
                rest = b""
        self._add([rest] if rest else [])

    def _add(self, lines: list[bytes]) -> None:
        for line in lines:
            text = escape_controls(line.decode(errors="replace").rstrip("\r"))
            self._lines.append(text if len(text) <= LONGEST_LINE else text[: LONGEST_LINE - 1] + "…")
            self._count += 1
        if lines:
            self._changed()

    def _forget_traceback(self) -> None:
        """Remove the traceback that Python prints if the interrupt arrives before the command handles it."""
        lines = list(self._lines)
        begins = next((n for n, line in enumerate(lines) if line.startswith("Traceback ")), len(lines))
        self._lines = deque(lines[:begins], MOST_LINES)
        self._count -= len(lines) - begins

    def _take(self, output: bytes) -> None:
        """Keep the result, and write it to the file that a shell would have redirected it to."""
        if not output.strip():
            return
        try:
            self.result = msgspec.json.decode(output)
        except (msgspec.MsgspecError, ValueError):
            self._trouble = "the command printed something that is not JSON"
            return
        if self.command.out:
            try:
                with (self._folder.path / self.command.out).open("xb") as file:
                    file.write(output)
            except OSError as e:
                self._trouble = f"cannot write {self.command.out}: {e.strerror or e}"

    async def wait(self) -> None:
        """Wait until the job has ended. If the waiting is cancelled, the job runs on."""
        if self._following is not None:
            await asyncio.wait([self._following])

    async def stop(self) -> None:
        """Interrupt the command as Ctrl-C does, and kill it if it does not end."""
        if self._process is None or self._following is None:
            return
        if self.is_running:
            self._was_stopped = True
            await child_process.interrupt(self._process, self._following)
        await asyncio.gather(self._following, return_exceptions=True)
