"""What happened in a run, in order: frames, values, states, faults, steps. Checks listen to it, reports draw it.

Times are ns since the run's start, so that two runs can be compared. What an event says is plain data; who looks at it knows
nothing of how it came about.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgspec

from gateway.core.errors import FileInvalid

CAPACITY = 200_000
_HASHED_AT_ONCE = 256
FAR_END = "far end"


class Kind(Enum):
    """What an event is about, with what `where` names and `data` holds.

    FRAME   a bus           ``dir`` sent | received (as the gateway sees it), ``bytes`` hex; on CAN ``id`` besides, and ``rtr``,
                            ``ext``, ``err`` where they are set. Bytes of a stream are as the medium cut them
    TAG     a tag           ``value``, ``quality``, ``reason``: what the gateway publishes
    STATE   PROGRAM.VARIABLE  ``value``: an output or local of a program that changed
    FAULT   a fault's id    ``name``, ``on`` true | false, ``target``; ``said``, as a fault file has it, while on
    STEP    a step's number ``text``, ``verdict`` once it has one
    NOTE    who says it     ``text``; of the far end (`FAR_END`) ``period_s``, when it commands one
    """

    FRAME = "frame"
    TAG = "tag"
    STATE = "state"
    FAULT = "fault"
    STEP = "step"
    NOTE = "note"


class Event(NamedTuple):
    """One thing that happened, `t_ns` after the run's start."""

    t_ns: int
    kind: Kind
    where: str
    data: dict[str, Any]


class Trace:
    """The latest `capacity` events, the hash of all, and who listens. `sink`: a file that takes every event as a JSON line."""

    def __init__(self, capacity: int = CAPACITY, sink: BinaryIO | None = None) -> None:
        self.events: deque[Event] = deque(maxlen=capacity)
        self.count = 0
        self.listeners: list[Callable[[Event], None]] = []
        """Told of each event, in the order of their subscription. They may not raise."""
        self._hash = hashlib.sha256()
        self._unhashed: list[bytes] = []
        self._sink = sink
        self._encode = msgspec.json.Encoder(order="sorted").encode

    @property
    def dropped(self) -> int:
        """Events that are no longer in memory; the hash and the sink have them."""
        return self.count - len(self.events)

    def note(self, t_ns: int, kind: Kind, where: str, data: dict[str, Any]) -> None:
        """Something happened. `data` is JSON-able and not changed afterwards."""
        event = Event(t_ns, kind, where, data)
        line = self._encode((t_ns, kind._value_, where, data)) + b"\n"  # `value` goes through a descriptor: slow
        self._unhashed.append(line)
        if len(self._unhashed) == _HASHED_AT_ONCE:
            self._hash_all()
        if self._sink is not None:
            self._sink.write(line)
        self.events.append(event)
        self.count += 1
        for listener in self.listeners:
            listener(event)

    def hexdigest(self) -> str:
        """SHA-256 of every event so far."""
        self._hash_all()
        return self._hash.hexdigest()

    def _hash_all(self) -> None:
        self._hash.update(b"".join(self._unhashed))
        self._unhashed.clear()


def read_trace(lines: list[bytes]) -> list[Event]:
    """The events that a sink took."""
    return [Event(t, Kind(kind), where, data) for t, kind, where, data in map(msgspec.json.decode, lines)]


def open_sink(path: Path) -> BinaryIO:
    """The file that a trace goes to; an older one is overwritten. Raises `FileInvalid` where it cannot be written."""
    try:
        return path.open("wb")
    except OSError as e:
        raise FileInvalid(f"cannot write the trace: {e.strerror or e}", path=str(path)) from e
