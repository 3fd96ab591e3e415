"""An opened trace: its system, its description, and the indexes of its values and frames, which follow the file."""

from __future__ import annotations

import asyncio
from pathlib import Path

from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid
from fieldtwin.results.trace_about import TraceAbout, read_about
from fieldtwin.studio.live.observed import describe_system
from fieldtwin.studio.replay.replayed_history import ReplayedHistory
from fieldtwin.studio.replay.trace_frames import TraceFrames
from fieldtwin.studio.replay.trace_log import TraceLog
from fieldtwin.twin.prototype.group import load_group
from fieldtwin.twin.site.data_files import search_path
from fieldtwin.twin.site.system import System, load_system

LOOK_EVERY_S = 0.25
"""Interval in seconds at which a file that has been read to its end is examined again."""
ABOUT_EVERY_S = 1.0


class Replay:
    """An opened trace. During ``async with Replay(name, path) as replay`` it is indexed, and its file is followed.

    `system` names the system for a trace without a description. Raises `FileInvalid` and `UsageError`.
    """

    def __init__(self, name: str, path: Path, system: str = "", profiles: tuple[Path, ...] = ()) -> None:
        self.name = name
        self.path = path
        self.about = read_about(path)
        self.troubles: dict[str, str] = {}
        self.system = _system_of(path, self.about, system, profiles)
        if self.about is not None and self.system.hash != self.about.system_hash:
            self.troubles["system"] = (
                f"{self.system.path.name} has changed since the run: names and meanings of frames may differ"
            )
        self.description = describe_system(self.system)
        tags = {f"{d.name}.{t.name}": t for d in self.system.devices.values() for t in d.profile.tags.values()}
        self.tag_names = list(tags)
        self.log = TraceLog(path)
        self.frames = TraceFrames(path, self.system)
        self.history = ReplayedHistory(self.log, {name for name, tag in tags.items() if tag.secret})
        self._nursery = Nursery()

    async def __aenter__(self) -> Replay:
        self._nursery.start(self._follow(), "trace")
        self._nursery.start(self._follow_frames(), "frames of the trace")
        self._nursery.start(self._follow_about(), "description of the trace")
        return self

    async def __aexit__(self, *error: object) -> None:
        await self._nursery.__aexit__(None, None, None)
        self.log.close()
        self.frames.close()

    @property
    def end_ns(self) -> int:
        """Return the time of the latest event."""
        return self.log.last_ns

    @property
    def is_growing(self) -> bool:
        """Return whether the run has not ended. False for a trace without a description, of which this is not known."""
        return self.about is not None and not self.about.finished

    @property
    def behind_bytes(self) -> int:
        """Return how many bytes of the file are not indexed yet."""
        return max(self.log.behind_bytes, 0 if self.log.trouble is not None else self.frames.behind_bytes)

    async def _follow(self) -> None:
        while True:
            more = self.log.follow()
            if self.log.trouble is not None:
                self.troubles["trace"] = f"{self.log.trouble}: the events before this line are shown"
            await asyncio.sleep(0 if more else LOOK_EVERY_S)

    async def _follow_frames(self) -> None:
        while True:
            more = self.frames.follow()
            await asyncio.sleep(0 if more else LOOK_EVERY_S)

    async def _follow_about(self) -> None:
        while self.is_growing:
            await asyncio.sleep(ABOUT_EVERY_S)
            try:
                self.about = read_about(self.path) or self.about
            except FieldtwinError as e:
                self.troubles["about"] = str(e)


def _system_of(path: Path, about: TraceAbout | None, named: str, profiles: tuple[Path, ...]) -> System:
    """Return the system of a trace: the one that the user names, else the one of the description.

    Reading a system file executes nothing, and opens no endpoint.
    """
    if named:
        return _load(named, profiles)
    if about is None:
        raise FileInvalid(
            "the trace has no description, so its system is not known",
            path=str(path),
            expected=f"the file {path.name}.about.json, which the run has written into the same folder",
            hint="name the system: fieldtwin studio TRACE --system SYSTEM",
        )
    own = Path(about.system_path)
    folders = (*profiles, *map(Path, about.profiles))
    beside = path.parent / own.name
    shipped = [place / "systems" / own.name for place in search_path()]
    found = next((candidate for candidate in (own, beside, *shipped) if candidate.is_file()), None)
    if found is None:
        raise FileInvalid(
            f"the system file of the trace, {own.name}, is not on this computer",
            path=str(path),
            expected=str(own),
            hint="name the system: fieldtwin studio TRACE --system SYSTEM",
        )
    return _load(str(found), folders)


def _load(name: str, profiles: tuple[Path, ...]) -> System:
    """Return a system; the systems of a network as one, under the names that they have in the trace."""
    group = load_group(name, profiles)
    return load_system(name, profiles) if group is None else group.whole
