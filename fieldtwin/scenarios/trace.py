"""What happened in a run, in order: frames, values, states, faults, steps. Checks listen to it, reports draw it.

Times are ns since the run's start, so that two runs can be compared. What an event says is plain data; who looks at it knows
nothing of how it came about.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Mapping
from enum import Enum
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgspec

from fieldtwin.gateway.core.errors import FileInvalid

CAPACITY = 200_000
_AT_ONCE = 256
"""Events that are encoded and hashed together: one by one takes three times as long."""
FAR_END = "far end"


class Kind(Enum):
    """What an event is about, with what `where` names and `data` holds.

    FRAME   a bus           ``dir`` sent | received (as the gateway sees it), ``bytes`` hex; on CAN ``id`` besides, and ``rtr``,
                            ``ext``, ``err`` where they are set. Bytes of a stream are as the medium cut them
    TAG     a tag           ``value``, ``quality``, ``reason``: what the gateway publishes
    STATE   PROGRAM.VARIABLE  ``value``: an output or local of a program that changed
    FAULT   a fault's id    ``name``, ``on`` true | false, ``target``; ``said``, as a fault file has it, while on
    STEP    a step's number ``text``, ``verdict`` once it has one
    REFUSED  DEVICE.TAG     a write that did not reach its device: ``value``, ``cause``, ``reason``, ``by``, ``program``,
                            ``place`` (FILE:LINE of the program), ``fault`` program | device | "" (by design, or tried again)
    NOTE    who says it     ``text``; of the far end (`FAR_END`) ``period_s``, when it commands one
    """

    FRAME = "frame"
    TAG = "tag"
    STATE = "state"
    FAULT = "fault"
    STEP = "step"
    REFUSED = "refused"
    NOTE = "note"


class Event(NamedTuple):
    """One thing that happened, `t_ns` after the run's start."""

    t_ns: int
    kind: Kind
    where: str
    data: dict[str, Any]


_Noted = tuple[int, Kind, str, dict[str, Any]]
"""An event's fields."""


class Trace:
    """The latest `capacity` events, the hash of all, and who listens. `sink`: a file that takes every event as a JSON line.

    Hash and sink are given events a block at a time: `hexdigest` has all of them, the sink after `flush` or `close`.
    """

    def __init__(self, capacity: int = CAPACITY, sink: BinaryIO | None = None) -> None:
        self._kept: deque[_Noted] = deque(maxlen=capacity)
        self._told: dict[str, list[Callable[[Event], None]]] = {kind.value: [] for kind in Kind}
        self._hash = hashlib.sha256()
        self._hashed = 0
        self._pending: list[_Noted] = []
        """Neither hashed nor in the sink yet."""
        self._sink = sink
        self._encode_lines = msgspec.json.Encoder(order="sorted").encode_lines

    @property
    def events(self) -> list[Event]:
        """The latest, oldest first."""
        return [Event(*noted) for noted in self._kept]

    @property
    def count(self) -> int:
        """How many events there were."""
        return self._hashed + len(self._pending)

    @property
    def dropped(self) -> int:
        """Events that are no longer in memory; the hash and the sink have them."""
        return self.count - len(self._kept)

    def listen(self, listener: Callable[[Event], None], *kinds: Kind) -> None:
        """From now on `listener` is told of each event, or of each of these kinds, behind those who asked before. It may not
        raise."""
        for kind in kinds or Kind:
            self._told[kind.value].append(listener)

    def note(self, t_ns: int, kind: Kind, where: str, data: dict[str, Any]) -> None:
        """Something happened. `data` is JSON-able and not changed afterwards."""
        noted = t_ns, kind, where, data  # an `Event` only where somebody looks: these are made by the million
        self._kept.append(noted)
        self._pending.append(noted)
        if len(self._pending) >= _AT_ONCE:
            self.flush()
        if self._told[kind._value_]:  # `value` goes through a descriptor, a Kind's hash through Python: slow
            self.tell(t_ns, kind, where, data)

    def tell(self, t_ns: int, kind: Kind, where: str, data: dict[str, Any]) -> None:
        """Those who listen hear of it, in the order in which they asked to."""
        event = Event(t_ns, kind, where, data)
        for listener in self._told[kind._value_]:
            listener(event)

    def hexdigest(self) -> str:
        """SHA-256 of every event so far."""
        self.flush()
        return self._hash.hexdigest()

    def flush(self) -> None:
        """Hash what is pending, and hand it to the sink."""
        pending, self._pending = self._pending, []
        lines = self._encode_lines(pending)
        self._hashed += len(pending)
        self._hash.update(lines)
        if self._sink is not None:
            self._sink.write(lines)

    def close(self) -> None:
        """Nothing more will happen that the sink has to take: it gets what is pending, and is closed. Closing twice does
        nothing."""
        if self._sink is None:
            return
        try:
            self.flush()
        finally:
            self._sink.close()
            self._sink = None


REFUSAL_KEYS = ("value", "cause", "reason", "by", "program", "place", "fault")
"""What an event of the kind REFUSED holds, of an entry of the gateway's journal
(`fieldtwin.gateway.runtime.refusals.Refusal`)."""


def refusal_data(described: Mapping[str, Any]) -> dict[str, Any]:
    """The data of a REFUSED event from an entry of the journal as plain data. Its value is that of the entry's first refusal."""
    return {key: described["first" if key == "value" else key] for key in REFUSAL_KEYS}


def refusal_text(where: str, data: Mapping[str, Any]) -> str:
    """A REFUSED event, or an entry of the journal, in one line: tag, value, who asked, reason, line of the program."""
    by = "" if data.get("by") == "plc" else f" (asked by {data.get('by')})"
    at = ", ".join(part for part in (data.get("program"), data.get("place")) if part)
    said = (
        f"{where} = {_shown(data.get('first', data.get('value')))} did not reach the device{by}: {data.get('reason')}"
    )
    times = f"; {data['count']} times" if data.get("count", 1) > 1 else ""
    return f"{said}{times}" + (f" ({at})" if at else "")


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def read_trace(lines: list[bytes]) -> list[Event]:
    """The events that a sink took."""
    return [Event(t, Kind(kind), where, data) for t, kind, where, data in map(msgspec.json.decode, lines)]


def open_sink(path: Path) -> BinaryIO:
    """The file that a trace goes to; an older one is overwritten. Raises `FileInvalid` where it cannot be written."""
    try:
        return path.open("wb")
    except OSError as e:
        raise FileInvalid(f"cannot write the trace: {e.strerror or e}", path=str(path)) from e
