"""The processes that run the units of one campaign on one computer: at most one for each thread that asks for a unit."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from threading import Event, Lock, Timer
from typing import BinaryIO, cast

from fieldtwin.run.places.unit_process import read_message, write_message
from fieldtwin.twin.plant.child import command

MOST_TRIES = 2
"""How many processes try a unit on one worker, if the process of the unit ends by itself."""


class UnitLost(Exception):
    """The processes of a unit ended before the unit; the text is the reason."""


class UnitProcesses:
    """Processes that wait for units or run one. `work` is the pickled work, `cwd` their working directory, and `limit_s` the time
    limit of a unit in seconds. `without` names environment variables that they do not get. The methods may be called by several
    threads.
    """

    def __init__(self, work: bytes, cwd: Path, limit_s: float, without: tuple[str, ...] = ()) -> None:
        self._work, self._cwd, self._limit_s, self._without = work, cwd, limit_s, without
        self._idle: list[subprocess.Popen[bytes]] = []
        self._all: set[subprocess.Popen[bytes]] = set()
        self._lock = Lock()
        self._closed = False

    def run(self, unit: bytes) -> bytes:
        """Return the pickled answer to the pickled unit. Raises `UnitLost`."""
        reason = ""
        for _ in range(MOST_TRIES):
            process = self._take()
            late = Event()
            with _limited(process, self._limit_s, late):
                answer = _ask(process, unit)
            if answer is not None:
                with self._lock:
                    self._idle.append(process)
                return answer
            reason = self._end(process)
            if late.is_set():
                raise UnitLost(f"it took longer than {self._limit_s:g} s, the time limit of a unit")
        raise UnitLost(f"its process {reason}, {MOST_TRIES} times")

    def close(self) -> None:
        """End all processes, also those that run a unit."""
        with self._lock:
            self._closed = True
            ended, self._all = self._all, set()
        for process in ended:
            process.kill()
        for process in ended:
            process.wait()
            _close_pipes(process)

    def _take(self) -> subprocess.Popen[bytes]:
        with self._lock:
            if self._closed:
                raise UnitLost("the campaign has ended")
            if self._idle:
                return self._idle.pop()
            environment = {name: value for name, value in os.environ.items() if name not in self._without}
            process = subprocess.Popen(
                command("fieldtwin.run.places.unit_process", str(self._cwd)),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                cwd=self._cwd,
                env=environment,
                start_new_session=True,  # Ctrl-C reaches the parent only, which ends this process
            )
            self._all.add(process)
        with contextlib.suppress(OSError):  # a process that ended at once: the first unit finds that
            write_message(cast(BinaryIO, process.stdin), self._work)
        return process

    def _end(self, process: subprocess.Popen[bytes]) -> str:
        """Return how a process that gave no answer has ended."""
        process.kill()
        code = process.wait()
        _close_pipes(process)
        with self._lock:
            self._all.discard(process)
        with contextlib.suppress(ValueError):
            return f"ended by {signal.Signals(-code).name}"
        return f"ended with exit code {code}"


@contextlib.contextmanager
def _limited(process: subprocess.Popen[bytes], limit_s: float, late: Event) -> Iterator[None]:
    """Kill the process and set `late` if the block takes longer than `limit_s` seconds."""

    def end() -> None:
        late.set()
        process.kill()

    limit = Timer(limit_s, end)
    limit.daemon = True
    limit.start()
    try:
        yield
    finally:
        limit.cancel()


def _ask(process: subprocess.Popen[bytes], unit: bytes) -> bytes | None:
    """Return the answer of the process, None if it has ended."""
    try:
        write_message(cast(BinaryIO, process.stdin), unit)
        return read_message(cast(BinaryIO, process.stdout))
    except OSError:
        return None


def _close_pipes(process: subprocess.Popen[bytes]) -> None:
    for pipe in (process.stdin, process.stdout):
        with contextlib.suppress(OSError):  # a message that was not sent yet
            cast(BinaryIO, pipe).close()
