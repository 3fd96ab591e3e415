"""The traces that Studio can show: those that the user names, and those with a description in the working directory.

A page opens only these, so it cannot make the server read any other file.
"""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, UsageError
from fieldtwin.results.trace_about import SUFFIX, TraceAbout, about_path, read_about
from fieldtwin.studio.replay.replay import Replay
from fieldtwin.twin.site.data_files import system_files

MOST_OPEN = 3
"""Largest number of traces that are open at a time. For a further one, the trace that was opened first is closed."""
MOST_LISTED = 200


class NoTrace(UsageError):
    """Raised when Studio knows no trace of this name."""


@dataclass(frozen=True)
class KnownTrace:
    """A trace that can be opened. `about` is None if it has no valid description; `trouble` then gives the error, if any."""

    name: str
    path: Path
    about: TraceAbout | None
    trouble: str = ""

    @property
    def report(self) -> Path | None:
        """Return the HTML report of the run, None if it wrote none."""
        if self.about is None or not self.about.report:
            return None
        path = (self.path.parent / self.about.report).resolve()
        return path if path.is_file() else None

    @property
    def failed(self) -> bool:
        """Return whether the run has ended and has not passed."""
        return self.about is not None and self.about.finished and self.about.verdict != "passed"


def is_trace(path: Path) -> bool:
    """Return whether a path that the user names is a trace, or a folder with traces and without a system file."""
    if path.is_dir():
        return next(path.glob(f"*{SUFFIX}"), None) is not None and not system_files(path)
    return path.is_file() and (path.suffix == ".jsonl" or about_path(path).is_file())


class Traces:
    """The known traces, and those that are open. Use it as ``async with Traces(folder) as traces``.

    `named` are files and folders that the user named; `system` is the system of a trace without a description.
    """

    def __init__(self, folder: Path, named: tuple[Path, ...] = (), system: str = "") -> None:
        self._folder = folder
        self._named = named
        self._system = system
        self.latest_run: Path | None = None
        """The trace of the latest scenario that ran in Studio."""
        self._open: dict[Path, tuple[Replay, AsyncExitStack]] = {}
        self._lock = asyncio.Lock()
        self._read: dict[Path, tuple[tuple[int, int], TraceAbout | None, str]] = {}
        """For each trace: the version of the description file that was read last, and the description or the error."""

    async def __aenter__(self) -> Traces:
        return self

    async def __aexit__(self, *error: object) -> None:
        for path in list(self._open):
            await self._close(path)

    def known(self) -> list[KnownTrace]:
        """Return the known traces, at most `MOST_LISTED`: those that the user named first, and failed runs before others."""
        named = [path for given in self._named for path in (_in(given) if given.is_dir() else [given])]
        found = [*_in(self._folder), *(path for sub in _folders(self._folder) for path in _in(sub))]
        ran = [self.latest_run] if self.latest_run is not None and self.latest_run.is_file() else []
        paths = dict.fromkeys(path.resolve() for path in [*named, *found, *ran])
        own = {path.resolve() for path in named}
        known = [self._look(path) for path in list(paths)[:MOST_LISTED]]
        return sorted(known, key=lambda trace: (trace.path not in own, not trace.failed))

    def named(self, name: str) -> KnownTrace:
        """Return a known trace. Raises `NoTrace`."""
        known = next((trace for trace in self.known() if trace.name == name), None)
        if known is None:
            raise NoTrace(f"no trace {name[:80]!r} is known", hint="name its file: fieldtwin studio TRACE")
        return known

    def in_report(self, report: Path) -> dict[str, str]:
        """Return the traces whose run wrote this report, by the names of their files."""
        return {trace.path.name: trace.name for trace in self.known() if trace.report == report.resolve()}

    async def opened(self, name: str) -> Replay:
        """Return an opened trace. Raises `NoTrace`, and `FileInvalid` if it cannot be read."""
        async with self._lock:
            known = self.named(name)
            found = self._open.get(known.path)
            if found is not None and not _replaced(found[0], known):
                return found[0]
            if found is not None:
                await self._close(known.path)
            if not known.path.is_file():
                raise FileInvalid("cannot read the trace: no such file", path=str(known.path))
            replay = Replay(name, known.path, self._system)
            while len(self._open) >= MOST_OPEN:
                await self._close(next(iter(self._open)))
            stack = AsyncExitStack()
            self._open[known.path] = await stack.enter_async_context(replay), stack
            return replay

    def name_of(self, path: Path) -> str:
        """Return the name of a trace: its path from the working directory, without slashes."""
        try:
            inside = path.resolve().relative_to(self._folder.resolve())
        except ValueError:
            inside = path.resolve()
        return str(inside).strip("/").replace("/", "~")

    def _look(self, path: Path) -> KnownTrace:
        try:
            stat = about_path(path).stat()
            version = stat.st_mtime_ns, stat.st_size
        except OSError:
            return KnownTrace(self.name_of(path), path, None)
        read = self._read.get(path)
        if read is None or read[0] != version:
            try:
                read = version, read_about(path), ""
            except FieldtwinError as e:
                read = version, None, str(e)
            self._read[path] = read
        return KnownTrace(self.name_of(path), path, read[1], read[2])

    async def _close(self, path: Path) -> None:
        _, stack = self._open.pop(path)
        await stack.aclose()


def _in(folder: Path) -> list[Path]:
    """Return the traces with a description in a folder, the latest first."""
    found = [path.with_name(path.name.removesuffix(SUFFIX)) for path in folder.glob(f"*{SUFFIX}")]
    return sorted((path for path in found if path.is_file()), key=_changed_ns, reverse=True)[:MOST_LISTED]


def _folders(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))[:MOST_LISTED]


def _changed_ns(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def _replaced(replay: Replay, now: KnownTrace) -> bool:
    """Return whether another run has overwritten the trace file since `replay` was opened."""
    if replay.about is not None and now.about is not None and replay.about.run != now.about.run:
        return True
    return replay.log.is_replaced
