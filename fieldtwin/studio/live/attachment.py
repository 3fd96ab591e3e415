"""Observe one running instance through its control channels and its capture.

The statuses of gateway, PLC and field simulator are read two to four times a second, changes of tags ten times a second. A
process that does not answer is queried again; its last status is dropped, so that a page never shows an old value as current.
Gateway and PLC get only queries that they answer in a bounded time; present values come from the process image.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec
from msgspec import UNSET, structs

from fieldtwin.capture.decoding.exchange import SECRET
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.control import RemoteError
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.gateway.runtime.gateway_status import GatewayStatus, TagStatus
from fieldtwin.plc.runtime.about import STATE
from fieldtwin.plc.runtime.tag_view import MAX_AT_ONCE
from fieldtwin.plc.status import PlcStatus, WholePlcStatus
from fieldtwin.run.processes.run_record import SYSTEM_FILE, RunRecord, read_record
from fieldtwin.studio.live.frame_log import FrameLog
from fieldtwin.studio.live.instances import FIELD_SOCKET, GATEWAY_SOCKET, PLC_SOCKET, FoundInstance
from fieldtwin.studio.live.marks import FaultMarks
from fieldtwin.studio.live.observed import describe_system
from fieldtwin.studio.live.plc_values import whole_plc_status
from fieldtwin.studio.live.present_tags import PresentTags
from fieldtwin.studio.live.process_image import ProcessImage
from fieldtwin.studio.live.state_history import StateHistory
from fieldtwin.studio.live.subscription import Publisher
from fieldtwin.studio.live.tag_history import Point, TagHistory
from fieldtwin.studio.live.variable_recorder import VariableRecorder
from fieldtwin.twin.plant.channel import Channel
from fieldtwin.twin.prototype.field_status import FieldStatus
from fieldtwin.twin.site.resolved import read_resolved
from fieldtwin.twin.site.system import System

TAGS_EVERY_S = 0.1
GATEWAY_EVERY_S = 0.5
COMPARED_EVERY_S = 0.5
"""Interval in seconds at which the history is compared with the present values: the gateway reports no change when one becomes
stale.
"""
PLC_EVERY_S = 0.25
BUCKETS_EVERY_S = 2.0
"""Interval in seconds at which the scan time distribution is read, which takes the PLC longer than its brief status."""
FIELD_EVERY_S = 0.5
FRAMES_EVERY_S = 0.02
FRAME_COUNT_EVERY_S = 0.04
"""The shortest time in seconds between two messages with the number of frames."""
RECORD_EVERY_S = 0.5
AGAIN_AFTER_S = 1.0
"""Pause in seconds before a process that did not answer is queried again."""
MOST_INTERNAL = 256
"""The largest number of variables that are not tags in one answer."""
NONE_OF_THEM = 1 << 62
"""The number after which refused writes are requested. It excludes all of them, because the status already contains them."""


class Attachment:
    """The observation of one instance. It lasts as long as the block ``async with Attachment(found, clock) as attachment``.

    `gateway`, `plc` and `field` are the latest statuses, None while a process does not answer; `troubles` gives the reasons.
    """

    def __init__(self, found: FoundInstance, clock: Clock) -> None:
        if found.record is None:
            raise FileInvalid(found.trouble or "the run directory has no record of a run", path=str(found.dir))
        self.name = found.name
        self.dir = found.dir
        self.record: RunRecord = found.record
        self.system = system = self._read_system()
        self.description = describe_system(system)
        self.gateway: GatewayStatus | None = None
        self.plc: WholePlcStatus | None = None
        self.field: FieldStatus | None = None
        self.troubles: dict[str, str] = {}
        self.programs: dict[str, Any] = {}
        """The description of the PLC's programs (the command `about`): empty until the PLC has answered."""
        self.state_history = StateHistory()
        self.fault_marks = FaultMarks()
        self.updates = Publisher()
        self.gateway_channel = Channel(found.dir / GATEWAY_SOCKET, "gateway")
        self.plc_channel = Channel(found.dir / PLC_SOCKET, "PLC")
        self.field_channel = Channel(found.dir / FIELD_SOCKET, "field simulator")
        self.history_from_ns = clock.monotonic_ns()
        """The time since which changes of tags are known: the start of the gateway, or the oldest change that it still keeps."""
        self.changes_lost = 0
        """Number of changes of tags that the gateway had dropped before they were read."""
        self.frames: FrameLog | None = None
        self._clock = clock
        tags = {f"{d.name}.{t.name}": t for d in system.devices.values() for t in d.profile.tags.values()}
        self.secrets = {name for name, tag in tags.items() if tag.secret}
        """The tags whose values no client may see."""
        self.history = TagHistory(tags)
        self._seen_change: int | None = None
        """The number of the latest change that was read, None before the first answer."""
        self._history_read = asyncio.Event()
        """Set when all changes that the gateway has kept were read, or when it did not answer."""
        self._present = PresentTags(system, self.secrets, self.history)
        self._compared_ns = 0
        """Time of the last comparison of the history with the present values."""
        self._reloads = 0
        """Number of reloads of the gateway's files when `_present` last took over the names of values."""
        self._gateway_began_ns = 0
        """The start time of the gateway process whose changes are read."""
        self._described: tuple[int, int, int] | None = None
        """Process ID, restarts, and replacements of programs of the PLC that `programs` describes."""
        self._image = ProcessImage(found.dir)
        self._buckets_ns = 0
        """Time at which the distribution of scan times was last read."""
        self.variables = VariableRecorder(self.plc_channel, self._task_of, self.now_ns)
        self._nursery = Nursery()

    def _read_system(self) -> System:
        [system] = read_resolved(str(self.dir / SYSTEM_FILE))
        assert isinstance(system, System)
        return system

    async def __aenter__(self) -> Attachment:
        if self.record.capture:
            try:
                self.frames = FrameLog(Path(self.record.capture), self.system)
            except FileInvalid as e:
                self.troubles["frames"] = str(e)
        self._nursery.start(self._repeat("tags", self._read_tags, TAGS_EVERY_S), "tags")
        self._nursery.start(self._repeat("gateway", self._read_gateway, GATEWAY_EVERY_S), "gateway")
        self._nursery.start(self._repeat("plc", self._read_plc, PLC_EVERY_S), "plc")
        self._nursery.start(self.variables.follow(), "variables")
        if self.record.prototype and not self.record.field_elsewhere:
            self._nursery.start(self._repeat("field", self._read_field, FIELD_EVERY_S), "field")
        if self.frames is not None:
            self._nursery.start(self._follow_frames(self.frames), "frames")
        self._nursery.start(self._until_replaced(), "record")
        return self

    async def __aexit__(self, *error: object) -> None:
        self.updates.end()
        await self._nursery.__aexit__(None, None, None)
        for channel in (self.gateway_channel, self.plc_channel, self.field_channel):
            await channel.aclose()
        self._image.close()
        if self.frames is not None:
            self.frames.close()

    def now_ns(self) -> int:
        """Return the present time on the run's monotonic clock."""
        return self._clock.monotonic_ns()

    def status(self) -> dict[str, Any]:
        """Return the statuses, as data for JSON."""
        frames = self.frames
        return {
            "now_ns": self.now_ns(),
            "gateway": msgspec.to_builtins(self.gateway) if self.gateway is not None else None,
            "plc": msgspec.to_builtins(self.plc) if self.plc is not None else None,
            "transitions": self.state_history.newest,
            "field": msgspec.to_builtins(self.field) if self.field is not None else None,
            "troubles": dict(self.troubles),
            "changes_lost": self.changes_lost,
            "frames": None if frames is None else _counts(frames),
        }

    def present_tags(self) -> dict[str, TagStatus]:
        """Return all tags as of now, while `gateway` may be half a second old. Raises `FileInvalid` or `Unreachable`."""
        return self._present.statuses(self._image.inputs(), self.now_ns())

    def point(self, name: str, t_ns: int, value: Any, quality: str, reason: str) -> Point:
        """Return a change of a tag; the value of a secret tag is masked."""
        return Point(t_ns, SECRET if name in self.secrets else value, quality, reason)

    async def _repeat(self, what: str, read: Callable[[], Awaitable[None]], every_s: float) -> None:
        while True:
            try:
                await read()
            except FieldtwinError as e:
                self._lost(what, str(e))
                await asyncio.sleep(AGAIN_AFTER_S)
                continue
            self.troubles.pop(what, None)
            await asyncio.sleep(every_s)

    def _lost(self, what: str, reason: str) -> None:
        if what == "gateway":
            self.gateway = None
            self._image.close()
        elif what == "plc":
            self.plc = None
        elif what == "field":
            self.field = None
        elif what == "tags":
            self._history_read.set()
        if self.troubles.get(what) != reason:
            self.troubles[what] = reason
            self.updates.publish({"type": "status", "status": self.status()})

    async def _read_gateway(self) -> None:
        await self.wait_for_history()
        gateway = await self.gateway_channel.ask("get", GatewayStatus, brief=True)
        if gateway.config is not UNSET and gateway.config.reloads != self._reloads:
            self._reloads = gateway.config.reloads
            self._present.describe_values(self._read_system())
        self.gateway = structs.replace(gateway, tags=self.present_tags())
        self.updates.publish({"type": "status", "status": self.status()})

    async def read_plc(self, buckets: bool = True) -> WholePlcStatus:
        """Query the PLC's brief status, and return it with the present values; `buckets`: also the scan time distribution."""
        brief = await self.plc_channel.ask("get", PlcStatus, brief=True, buckets=buckets)
        version = brief.pid, brief.restarts, brief.changes.count  # Structured Text is read again at each of them
        if self._described != version:
            self.programs = await self._read_programs()
            self._described = version
        return whole_plc_status(self._image, brief, self.programs, self.secrets, self.now_ns())

    async def read_internal_variables(self) -> dict[str, Any]:
        """Return name, type, value and unit of program variables that are not tags, and how many there are `more`."""
        names: list[str] = (await self.plc_channel.call("image"))["internal"]
        rows: list[dict[str, Any]] = []
        for at in range(0, min(len(names), MOST_INTERNAL), MAX_AT_ONCE):
            rows += (await self.plc_channel.call("image", tags=names[at : at + MAX_AT_ONCE]))["tags"]
        shown = [{"name": row["tag"], "type": row["kind"], "value": row["value"], "unit": row["unit"]} for row in rows]
        return {"variables": shown, "more": len(names) - len(rows)}

    async def variable_names(self) -> list[str]:
        """Return the names of the programs' variables that have a value, those that are tags first.

        While the PLC does not answer, those that are not tags are missing.
        """
        tags = [
            f"{program}.{name}"
            for program, described in self.programs.items()
            for name, about in described["variables"].items()
            if about["kind"] != TagKind.MESSAGE.value and about["tag"] not in self.secrets
        ]
        try:
            internal: list[str] = (await self.plc_channel.call("image"))["internal"]
        except FieldtwinError:  # the troubles in the status give the reason
            return tags
        return tags + internal

    def is_secret_variable(self, name: str) -> bool:
        """Return whether a program's variable has the value of a secret tag."""
        program, _, variable = name.partition(".")
        described = self.programs.get(program, {"variables": {}})["variables"]
        return any(of.lower() == variable.lower() and about["tag"] in self.secrets for of, about in described.items())

    def _task_of(self, program: str) -> str:
        """Return the name of the task of a program, "" for the first one."""
        form = self.system.plc.programs.get(program)
        return (form.task if form is not None else None) or ""

    async def read_drawings(self) -> dict[str, Any]:
        """Return the drawings of each program: number, name and SVG text."""
        try:
            answer = await self.plc_channel.call("drawings")
        except RemoteError:  # the PLC has an older version
            return {}
        drawings: dict[str, Any] = answer["drawings"]
        return drawings

    async def _read_plc(self) -> None:
        known, buckets = self.plc, self.plc is None or self.now_ns() - self._buckets_ns >= BUCKETS_EVERY_S * NS_PER_S
        plc = await self.read_plc(buckets)
        if buckets:
            self._buckets_ns = self.now_ns()
        elif known is not None:
            plc = structs.replace(plc, duration_buckets=known.duration_buckets, lateness_buckets=known.lateness_buckets)
        state_tags = {
            name: program["variables"][STATE]["tag"]
            for name, program in self.programs.items()
            if STATE in program["variables"]
        }
        await self.state_history.look(plc, state_tags, self.plc_channel, self.now_ns())
        self.plc = plc

    async def _read_programs(self) -> dict[str, Any]:
        try:
            answer = await self.plc_channel.call("about")
        except RemoteError:  # the PLC has an older version, so its programs are shown without names of states
            return {}
        programs: dict[str, Any] = answer["programs"]
        return programs

    async def look_at_field(self) -> None:
        """Read the status of the simulated devices at once: after a client's action, so that even a short fault is marked."""
        with contextlib.suppress(FieldtwinError):  # the regular reading reports it
            await self._read_field()

    async def _read_field(self) -> None:
        self.field = await self.field_channel.ask("get", FieldStatus)
        self.fault_marks.look(self.field, self.now_ns())

    async def wait_for_history(self) -> None:
        """Wait until the changes that the gateway has kept are in `history`, or until the gateway did not answer."""
        await self._history_read.wait()

    async def _read_tags(self) -> None:
        while not await self._read_changes():
            pass

    async def _read_changes(self) -> bool:
        """Read the next changes of tags, and return whether these were the last ones."""
        now_ns, since = self.now_ns(), self._seen_change or 0
        inputs = self._image.inputs() if now_ns - self._compared_ns >= COMPARED_EVERY_S * NS_PER_S else None
        names = [] if inputs is None else self._present.texts
        answer = await self.gateway_channel.call("watch", since=since, names=names, refused=NONE_OF_THEM)
        if answer["began_ns"] != self._gateway_began_ns:
            self._gateway_began_ns = answer["began_ns"]
            if self._seen_change is not None:  # the gateway was restarted, so its numbers begin again
                self._seen_change, self._compared_ns = None, 0
                return False
        if self._seen_change is None:
            oldest_ns = answer["changes"][0][1] if answer["dropped"] else answer["began_ns"]
            self.history_from_ns = min(self.history_from_ns, oldest_ns)
        else:
            self.changes_lost += answer["dropped"]
        changes = []
        for _, t_ns, name, value, quality, reason in answer["changes"]:
            point = self.point(name, t_ns, value, quality, reason)
            self.history.add(name, point)
            changes.append([name, *point])
        self._seen_change = answer["changes"][-1][0] if answer["changes"] else answer["last"]
        is_last = bool(self._seen_change >= answer["last"])
        if inputs is not None and is_last:
            self._compared_ns = now_ns
            self._present.take_texts(answer["tags"], answer["now_ns"])
            for name, point in self._present.missing(inputs):
                self.history.add(name, point)
                changes.append([name, *point])
        if changes and self._history_read.is_set():
            self.updates.publish({"type": "tags", "changes": changes})
        if is_last:
            self._history_read.set()
        return is_last

    async def _follow_frames(self, frames: FrameLog) -> None:
        told, told_ns = -1, 0
        while True:
            new = frames.follow()
            if len(frames) != told and self.now_ns() - told_ns >= FRAME_COUNT_EVERY_S * NS_PER_S:
                told, told_ns = len(frames), self.now_ns()
                self.updates.publish({"type": "frames"} | _counts(frames))
            await asyncio.sleep(0 if new else FRAMES_EVERY_S)

    async def _until_replaced(self) -> None:
        """Wait until another run has begun under the same name, then end the updates, so that clients connect to that run."""
        while True:
            await asyncio.sleep(RECORD_EVERY_S)
            try:
                is_same = read_record(self.dir) in (self.record, None)
            except FileInvalid:  # a run of another version
                is_same = False
            if not is_same:
                self.updates.end()
                return


def _counts(frames: FrameLog) -> dict[str, Any]:
    return {
        "total": len(frames),
        "behind_bytes": frames.behind_bytes,
        "full": frames.is_full,
        "invalid_lines": frames.invalid_lines,
    }
