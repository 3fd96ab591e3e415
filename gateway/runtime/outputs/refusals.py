"""The journal of writes that did not reach their device: tag, value, cause, source and number of repetitions.

An entry is an event for live views, traces, summaries and scenarios. A repetition is counted in the entry that it
repeats, so a program that commands the same impossible value in every scan makes one entry. The journal is limited: it
keeps the newest `KEPT` entries and counts all. It also writes the refusals of commands into the audit log, at most one
line per second and tag; a line gives the number of refusals that it covers.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import (
    DeviceRefused,
    FieldtwinError,
    ModbusExceptionReply,
    NotAllowed,
    Unreachable,
    WrongDevice,
)
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.buses.bus import HeldBack
from fieldtwin.gateway.runtime.gateway_status import RefusalsStatus, RefusalStatus

KEPT = 256
"""The number of entries that are kept."""
MERGE_NS = NS_PER_S
"""A refusal of the same tag for the same cause within this time repeats the previous entry, whatever its value."""
MERGE_AT_MOST_NS = 10 * NS_PER_S
"""After this time a refusal of a different value makes a new entry, so that a later reader sees that refusals
continue."""
AUDIT_EVERY_NS = NS_PER_S
"""The shortest time between two audit-log lines about the same tag, cause and client."""
MOST_AUDITED = 1024
"""The number of combinations of tag, cause and client for which the last audit-log line is remembered."""
LATER = frozenset({5, 6, 10, 11})
"""Modbus exception codes that mean "not now" or come from a gateway on the path: the same write may succeed later."""


class RefusalCause(Enum):
    """The cause for which a write did not reach its device."""

    LIMIT = "limit"
    """The value is outside the limits of the tag, or its type cannot hold it, or it is not a number."""
    NOT_WRITABLE = "not writable"
    """The configuration does not allow writing this tag."""
    READ_ONLY = "read-only"
    """The plant runs without permission to write."""
    WRONG_DEVICE = "wrong device"
    """The device that answers is not the one that the system file expects."""
    DEVICE = "device"
    """The device answered and refused the value, or acknowledged it and holds a different one."""
    GROUP = "group"
    """A different member of the tag's group was refused, so the whole group is held back."""
    AWAY = "away"
    """The device does not answer. The value is written when it is back."""
    FAILED = "failed"
    """The write was sent and not confirmed (no reply, a corrupted reply, a busy device). The gateway tries again."""
    LOCAL = "local"
    """The topside controller sent a command to a plant that accepts none (`remote: local` in the system file)."""
    NOT_NOW = "not now"
    """A client requested a write while another was under way or the outputs were in their safe state."""


OF_PROGRAM = frozenset({RefusalCause.LIMIT, RefusalCause.NOT_WRITABLE})
"""Causes that do not depend on the plant: the program or the configuration has to be changed."""
OF_DEVICE = frozenset({RefusalCause.WRONG_DEVICE, RefusalCause.DEVICE})
"""Causes that a disturbed device may also produce."""


def cause_of(error: FieldtwinError) -> RefusalCause:
    """Return the cause of a write that a driver or a bus ended with `error`."""
    if isinstance(error, HeldBack):
        return RefusalCause.GROUP
    if isinstance(error, WrongDevice):
        return RefusalCause.WRONG_DEVICE
    if isinstance(error, ModbusExceptionReply) and error.code in LATER:
        return RefusalCause.FAILED
    if isinstance(error, DeviceRefused):
        return RefusalCause.DEVICE
    return RefusalCause.WRONG_DEVICE if isinstance(error, NotAllowed) else RefusalCause.FAILED


@dataclass(slots=True)
class RefusedOutput:
    """One entry. `first` is the value of the first refusal, `value` that of the newest; `t_ns` and `last_ns` are
    monotonic.

    `place` is the line of the program that set the value (``pump.st:14``), "" if the line is not known. Another process looks it
    up after the entry was created; until then `known` is False.
    """

    number: int
    tag: str
    first: object
    value: object
    cause: RefusalCause
    reason: str
    by: str
    t_ns: int
    last_ns: int
    count: int = 1
    program: str = ""
    place: str = ""
    known: bool = True
    standing: bool = True
    """Whether the refusal still applies: False once a different value was wanted or the tag was written.

    It is always False for a client's write, because a client requests a single write.
    """

    @property
    def of_program(self) -> bool:
        """Return whether a program or the safe state requested the write, and not a client."""
        return self.by == "plc" or self.by.startswith("safe: ")

    @property
    def fault(self) -> str:
        """Return what has to be corrected: "program" (the program or the configuration) or "device" (a device refused).

        Return "" for a write that is refused by design, is tried again, or was requested by a client."""
        if not self.of_program:
            return ""
        return "program" if self.cause in OF_PROGRAM else "device" if self.cause in OF_DEVICE else ""

    def status(self) -> RefusalStatus:
        """Return the entry for the status of the gateway."""
        return RefusalStatus(
            number=self.number,
            tag=self.tag,
            first=self.first,
            value=self.value,
            cause=self.cause.value,
            reason=self.reason,
            by=self.by,
            t_ns=self.t_ns,
            last_ns=self.last_ns,
            count=self.count,
            program=self.program,
            place=self.place,
            fault=self.fault,
            standing=self.standing,
        )


class Refusals:
    """The journal of one gateway. `on_new` is called with each new entry; it must not raise."""

    def __init__(self, audit: AuditLog) -> None:
        self.counts: Counter[RefusalCause] = Counter()
        self.faults: Counter[str] = Counter()
        """The number of entries of programs by `RefusedOutput.fault`, including those that are no longer kept."""
        self.on_new: Callable[[RefusedOutput], None] | None = None
        self.looks_up = False
        """Whether the place of each entry of a program is being looked up and reported with `placed`."""
        self.unrecorded = 0
        """The number of refusals that could not be written into the audit log."""
        self._audit = audit
        self._entries: deque[RefusedOutput] = deque(maxlen=KEPT)
        self._newest: dict[str, RefusedOutput] = {}
        self._number = 0
        self._audited: dict[tuple[str, str, RefusalCause], tuple[int, int]] = {}
        """By tag, client and cause: the time of the last audit-log line, and the number of refusals since then."""

    @property
    def total(self) -> int:
        """Return the number of refusals, repetitions included."""
        return sum(self.counts.values())

    def note(
        self,
        device: str,
        tag: str,
        value: object,
        cause: RefusalCause,
        reason: str,
        by: str,
        now_ns: int,
        *,
        old: object = None,
        audit: bool = True,
    ) -> None:
        """Note that a write of `value` did not reach the device. With `audit` it also gets a line in the audit log."""
        self.counts[cause] += 1
        if audit:
            self._record(device, tag, value, cause, reason, by, now_ns, old)
        before = self._newest.get(tag)
        if before is not None and (before.cause, before.by) == (cause, by):
            same = before.standing and before.value == value
            if same or (now_ns - before.last_ns <= MERGE_NS and now_ns - before.t_ns <= MERGE_AT_MOST_NS):
                before.standing = before.of_program
                before.count += 1
                before.value, before.reason, before.last_ns = value, reason, now_ns
                return
        if before is not None:
            before.standing = False
        self._number += 1
        entry = RefusedOutput(self._number, tag, value, value, cause, reason, by, now_ns, now_ns)
        entry.standing = entry.of_program  # a client requests a single write, so its refusal does not stay open
        entry.known = not (self.looks_up and by == "plc")
        if entry.of_program:
            self.faults[entry.fault] += 1
        self._newest[tag] = entry
        self._entries.append(entry)
        if self.on_new is not None:
            self.on_new(entry)

    def settle(self, tag: str) -> None:
        """Set `standing` of the tag's newest entry to False, because the tag was written, or the wanted value is now allowed."""
        if tag in self._newest:
            self._newest[tag].standing = False

    def _record(
        self, device: str, tag: str, value: object, cause: RefusalCause, reason: str, by: str, now_ns: int, old: object
    ) -> None:
        key = (tag, by.partition(" (")[0].rpartition(":")[0] or by, cause)
        last_ns, more = self._audited.pop(key, (None, 0))
        if last_ns is not None and now_ns - last_ns < AUDIT_EVERY_NS:
            self._audited[key] = (last_ns, more + 1)
            return
        self._audited[key] = (now_ns, 0)
        if len(self._audited) > MOST_AUDITED:
            oldest = next(iter(self._audited))
            self._write_rest(oldest, self._audited.pop(oldest)[1])
        details = {"more_refused_since": more} if more else {}
        self._write(device, by, reason, tag=tag, old=old, new=value, cause=cause.value, **details)

    def _write_rest(self, key: tuple[str, str, RefusalCause], more: int) -> None:
        if more:
            tag, by, cause = key
            self._write(
                tag.partition(".")[0], by, "the same again", tag=tag, cause=cause.value, more_refused_since=more
            )

    def _write(self, device: str, by: str, reason: str, **details: object) -> None:
        try:
            self._audit.note("refuse", device, by=by, result=reason, **details)
        except Unreachable:
            self.unrecorded += 1  # the missing record is counted; the write is refused with or without a record

    def flush(self) -> None:
        """Write into the audit log the number of refusals since the last line about their tag. Called when the gateway stops."""
        for key, (last_ns, more) in list(self._audited.items()):
            self._write_rest(key, more)
            self._audited[key] = (last_ns, 0)

    def placed(self, number: int, program: str, place: str) -> None:
        """Set the line of the program that set the value of entry `number`; "" if it is not known."""
        for entry in reversed(self._entries):
            if entry.number == number:
                entry.program, entry.place, entry.known = program, place, True
                return

    def since(self, number: int) -> list[RefusedOutput]:
        """Return the kept entries after `number`, oldest first, up to the first entry whose place is still being looked up."""
        found: list[RefusedOutput] = []
        for entry in self._entries:
            if entry.number > number:
                if not entry.known:
                    break
                found.append(entry)
        return found

    def status(self) -> RefusalsStatus:
        """Return counts by cause, and the entries that are kept."""
        return RefusalsStatus(
            total=self.total,
            entries_made=self._number,
            unrecorded=self.unrecorded,
            faults={"program": self.faults["program"], "device": self.faults["device"]},
            counts={cause.value: n for cause, n in sorted(self.counts.items(), key=lambda item: item[0].value)},
            entries=[entry.status() for entry in self._entries],
        )
