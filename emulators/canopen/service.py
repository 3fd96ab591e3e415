"""Common parts of the node's communication objects: the core that they share and the hooks that they implement.

A service implements the behaviour of some indices (heartbeat of 1016h and 1017h, the TPDOs of 1800h...). A service uses the core,
but neither the SDO server nor a different service, unless its constructor receives that service.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Protocol, runtime_checkable

import msgspec

from fieldtwin.emulators.canopen.node_data import NodeData
from fieldtwin.gateway.core.canframe import CanFrame


class NmtState(IntEnum):
    """NMT states; the values are those of a heartbeat (CiA 301, 7.3.2.2 and 7.2.8.2.2)."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


_OPERATIONAL = NmtState.OPERATIONAL


@dataclass(slots=True)
class NodeCounters:
    """Counters of a node since its creation; NMT never resets them.

    `sdo_requests` counts accepted request frames (not a client's aborts), `sdo_replies` the frames that answered them,
    aborts included: without block transfers the two are equal. `sdo_aborts` counts all aborts sent, including those
    after a timeout, which answer nothing. `ignored` counts frames for this node that the standard requires it to
    ignore, `frames_muted` those that it could not send in bus-off or while its bit rate changes. `tpdos_late` were
    withdrawn because they were not on the bus when the synchronous window ended.
    """

    frames_in: int = 0
    frames_out: int = 0
    frames_muted: int = 0
    nmt_commands: int = 0
    heartbeats: int = 0
    sdo_requests: int = 0
    sdo_replies: int = 0
    sdo_aborts: int = 0
    tpdos: int = 0
    tpdos_late: int = 0
    rpdos: int = 0
    rpdos_refused: int = 0
    syncs: int = 0
    emcys: int = 0
    emcys_dropped: int = 0
    ignored: int = 0

    def as_dict(self) -> dict[str, int]:
        """Return the counters by name, for a summary."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


class SentPdo(msgspec.Struct, frozen=True, gc=False):
    """One TPDO that the node sent."""

    t_ns: int
    cob_id: int
    data: bytes


@dataclass(frozen=True, slots=True)
class ObjectChange:
    """A change of the node.

    `what` is ``nmt``, ``write`` (SDO), ``rpdo``, ``set`` (the device itself), ``emcy``, ``time`` or ``lss``. `index`,
    `subindex` and `data` are the object and its new bytes; for ``nmt`` the state, for ``emcy`` the 8 bytes of the
    message, for ``time`` the TIME_OF_DAY, for ``lss`` the new node ID. Without an object, index is 0.
    """

    t_ns: int
    what: str
    index: int
    subindex: int
    data: bytes


_VALUES = frozenset({"write", "rpdo", "set"})
"""Kinds of changes whose data are the value of an object."""

Held = Callable[[Mapping[tuple[int, int], bytes], int], None]
"""A function that is called with (values by object, now_ns) when the node's objects change. These are the reference values of
a prototype run.
"""


Given = Callable[[Iterable[tuple[int, int]], int], None]
"""A function that is called with the objects whose values the node has sent, in an SDO reply or a TPDO, and the time in ns."""


class ObjectSource(Protocol):
    """Values that change by themselves: a recorded or computed signal."""

    def __call__(self, now_ns: int, /) -> dict[tuple[int, int], bytes]:
        """Return bytes as sent by (index, subindex) at `now_ns`. This must be fast, because every TPDO and SDO read calls it.

        A call is not an event: the source's values are sent by event timer, SYNC or remote frame. Use
        `CanopenNode.set_value` for a change that must trigger a TPDO.
        """
        ...


@runtime_checkable
class AnswersReads(Protocol):
    """A source that can also give a value for each single upload of an object, in the order of recorded uploads."""

    def answer(self, key: tuple[int, int], now_ns: int, /) -> bytes | None:
        """Return the value for the upload that begins, as the bytes to send. Return None to leave the object's present value."""
        ...


class Core:
    """State that all services share: values, NMT state, frames to send, counters and journals."""

    def __init__(self, data: NodeData, node_id: int, source: ObjectSource | None, journal_size: int) -> None:
        self.data = data
        self.node_id = node_id
        self.state = NmtState.INITIALISING
        self.counters = NodeCounters()
        self.journal: deque[SentPdo] = deque(maxlen=journal_size)
        self.changes: deque[ObjectChange] = deque(maxlen=journal_size)
        self.mutes: set[str] = set()
        """The reasons why the node can send nothing now."""
        self._source = source
        self._out: list[CanFrame] = []
        self.held: Held | None = None
        self.answers: AnswersReads | None = None
        self.given: Given | None = None

    @property
    def communicating(self) -> bool:
        """Return whether SDO, SYNC and EMCY are allowed: PRE-OPERATIONAL or OPERATIONAL (CiA 301, table 37)."""
        return self.state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)

    @property
    def operational(self) -> bool:
        return self.state is _OPERATIONAL

    def send(self, can_id: int, data: bytes, now_ns: int) -> None:
        """Queue a frame for output; while the node is mute the frame is dropped and counted."""
        if self.mutes:
            self.counters.frames_muted += 1
            return
        self._out.append(CanFrame(can_id, data, t_ns=now_ns))
        self.counters.frames_out += 1

    def take_output(self) -> list[CanFrame]:
        """Return the queued frames in the order of sending, and clear the queue."""
        out, self._out = self._out, []
        return out

    def refresh(self, now_ns: int) -> None:
        """Set the objects to the values that the source has at `now_ns`. Raises `UsageError` if they do not fit the
        dictionary.
        """
        if self._source is not None:
            values = self._source(now_ns)
            self.data.put_all(values)
            if self.held is not None:
                self.held(values, now_ns)

    def answer(self, key: tuple[int, int], now_ns: int) -> None:
        """Prepare a client's upload: set the source's present values, then its value for this upload.

        Raises the errors of `refresh`.
        """
        self.refresh(now_ns)
        raw = None if self.answers is None else self.answers.answer(key, now_ns)
        if raw is not None:
            self.data.put(*key, raw)
            if self.held is not None:
                self.held({key: raw}, now_ns)

    def note(self, now_ns: int, what: str, index: int, subindex: int, data: bytes) -> None:
        """Add an entry to the journal of changes."""
        self.changes.append(ObjectChange(now_ns, what, index, subindex, data))
        if self.held is not None and what in _VALUES:
            self.held({(index, subindex): data}, now_ns)


NEVER = 1 << 63
"""The time of an event that will not happen."""


class NodeService:
    """The hooks of a service. By default each of them does nothing. `check_*` raise `SdoAborted` to refuse an access."""

    @property
    def waits(self) -> bool:
        """Return whether the service can ever be due. It never can if the data sheet lacks its objects."""
        return True

    @property
    def due_ns(self) -> int:
        """Return the time (ns) of the next call of `tick`.

        The node reads it after every event, so a service that waits for only one time stores it in an attribute of this name.
        """
        return NEVER

    def owns(self, index: int) -> bool:
        """Return whether `check_*` and `wrote` must be called for `index`."""
        return False

    def check_read(self, index: int, subindex: int) -> None:
        """Check a client's read before it is executed."""

    def check_write(self, index: int, subindex: int, raw: bytes) -> None:
        """Check a client's write, after length and limits were checked. The live values are still the old ones."""

    def wrote(self, index: int, subindex: int, now_ns: int) -> None:
        """React to a client's write that was executed."""

    def reset(self, now_ns: int) -> None:
        """React to reset node or reset communication. The objects have their power-on values again."""

    def state_changed(self, now_ns: int) -> None:
        """React to a change of the NMT state, except to INITIALISING."""

    def tick(self, now_ns: int) -> None:
        """Do what is due. Called once `due_ns` has come."""
