"""The events of a run, in order: frames, values, states, faults, steps. Checks listen to the trace, and reports draw
it.

Times are ns since the run's start, so that two runs can be compared. Events are plain data; their readers do not depend
on their sources.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Mapping
from enum import Enum
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Protocol

import msgspec

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.results.trace_about import about_path

CAPACITY = 200_000
_AT_ONCE = 256
"""Number of events that are encoded and hashed together. Processing one event at a time takes three times as long."""
TOPSIDE = "topside"


class TraceKind(Enum):
    """The kind of an event, with the meaning of its `where` and `data`.

    FRAME   a bus           ``dir`` sent | received (as the gateway sees it), ``bytes`` hex; on CAN also ``id``, and ``rtr``,
                            ``ext``, ``err`` where they are set. Bytes of a stream are divided as the medium delivered them
    TAG     a tag           ``value``, ``quality``, ``reason``: what the gateway publishes
    STATE   PROGRAM.VARIABLE  ``value``: an output or local of a program that changed
    FAULT   a fault's id    ``name``, ``on`` true | false, ``target``; if it is on, ``said``: the fault as in a fault file
    STEP    a step's number ``text``, ``verdict`` once it has one
    REFUSED  DEVICE.TAG     a write that did not reach its device: ``value``, ``cause``, ``reason``, ``by``, ``program``,
                            ``place`` (FILE:LINE of the program), ``fault`` program | device | "" (by design, or tried again)
    ALARM   alarm.NAME      a change of an alarm: ``value`` is its state, ``active`` its condition after the delays, ``quality``,
                            ``reason``, and ``by``, the user who acknowledged or shelved it, "" if its condition changed
    NOTE    its author      ``text``; of the remote client (`TOPSIDE`) ``period_s``, when it commands one
    """

    FRAME = "frame"
    TAG = "tag"
    STATE = "state"
    FAULT = "fault"
    STEP = "step"
    REFUSED = "refused"
    ALARM = "alarm"
    NOTE = "note"


class TraceEvent(NamedTuple):
    """One event, `t_ns` after the run's start."""

    t_ns: int
    kind: TraceKind
    where: str
    data: dict[str, Any]


_Noted = tuple[int, TraceKind, str, dict[str, Any]]
"""The fields of an event that is stored but not yet a `TraceEvent`."""


_decoder = msgspec.json.Decoder(tuple[int, str, str, dict[str, object]])


def decode_event(line: bytes) -> TraceEvent:
    """Return the event of a line that a sink received. Raises `msgspec.MsgspecError` or `ValueError` for any other line."""
    t_ns, kind, where, data = _decoder.decode(line)
    return TraceEvent(t_ns, TraceKind(kind), where, data)


class Sink(Protocol):
    """A file for the lines of a trace."""

    def write(self, data: bytes, /) -> object: ...

    def close(self) -> None: ...


class Trace:
    """The latest `capacity` events, the hash of all, and the listeners. `sink`: a file that takes every event as a JSON
    line.

    Hash and sink get events in blocks: `hexdigest` covers all events, the sink has all after `flush` or `close`.
    """

    def __init__(self, capacity: int = CAPACITY, sink: Sink | None = None) -> None:
        self._kept: deque[_Noted] = deque(maxlen=capacity)
        self._told: dict[str, list[Callable[[TraceEvent], None]]] = {kind.value: [] for kind in TraceKind}
        self._hash = hashlib.sha256()
        self._hashed = 0
        self._pending: list[_Noted] = []
        """Events that are neither hashed nor in the sink yet."""
        self._sink = sink
        self._encode_lines = msgspec.json.Encoder(order="sorted").encode_lines

    @property
    def events(self) -> list[TraceEvent]:
        """Return the latest events, oldest first."""
        return [TraceEvent(*noted) for noted in self._kept]

    @property
    def count(self) -> int:
        """Return the number of events so far."""
        return self._hashed + len(self._pending)

    @property
    def dropped(self) -> int:
        """Return the number of events that are no longer in memory. The hash covers them, and the sink has written them."""
        return self.count - len(self._kept)

    def listen(self, listener: Callable[[TraceEvent], None], *kinds: TraceKind) -> None:
        """Call `listener` from now on with each event, or with each event of these kinds, after the listeners that
        registered before. It must not raise."""
        for kind in kinds or TraceKind:
            self._told[kind.value].append(listener)

    def note(self, t_ns: int, kind: TraceKind, where: str, data: dict[str, Any]) -> None:
        """Add an event. `data` must be JSON data that is not changed afterwards."""
        noted = (
            t_ns,
            kind,
            where,
            data,
        )  # stored as a tuple, because there are millions of events: a `TraceEvent` is created only for listeners
        self._kept.append(noted)
        self._pending.append(noted)
        if len(self._pending) >= _AT_ONCE:
            self.flush()
        # this avoids `value`, which goes through a descriptor, and the hash of a Kind, which is computed in Python: both
        # are slow
        if self._told[kind._value_]:
            self.notify(t_ns, kind, where, data)

    def notify(self, t_ns: int, kind: TraceKind, where: str, data: dict[str, Any]) -> None:
        """Pass an event to the listeners, in the order of their registration."""
        event = TraceEvent(t_ns, kind, where, data)
        for listener in self._told[kind._value_]:
            listener(event)

    def hexdigest(self) -> str:
        """Return the SHA-256 of every event so far."""
        self.flush()
        return self._hash.hexdigest()

    def flush(self) -> None:
        """Hash pending events, and write them to the sink."""
        pending, self._pending = self._pending, []
        lines = self._encode_lines(pending)
        self._hashed += len(pending)
        self._hash.update(lines)
        if self._sink is not None:
            self._sink.write(lines)

    def close(self) -> None:
        """Write pending events to the sink and close it. Closing twice does nothing."""
        if self._sink is None:
            return
        try:
            self.flush()
        finally:
            self._sink.close()
            self._sink = None


SMALL = range(-1, 32)
"""Whole numbers that count as states: a counter or a measured value has more of them."""


def state_of(event: TraceEvent) -> bool | int | str | None:
    """Return the value of a STATE event if it is a truth value, a text, or a small whole number; else None."""
    value = event.data.get("value")
    return value if isinstance(value, bool | str) or (isinstance(value, int) and value in SMALL) else None


REFUSAL_KEYS = ("value", "cause", "reason", "by", "program", "place", "fault")
"""The keys in the data of a REFUSED event, from an entry of the gateway's journal
(`fieldtwin.gateway.runtime.outputs.refusals.RefusedOutput`)."""


def refusal_data(described: Mapping[str, Any]) -> dict[str, Any]:
    """Return the data of a REFUSED event from a journal entry as plain data.

    Its value is that of the entry's first refusal.
    """
    return {key: described["first" if key == "value" else key] for key in REFUSAL_KEYS}


def refusal_text(where: str, data: Mapping[str, Any]) -> str:
    """Return a REFUSED event, or a journal entry, in one line: tag, value, requester, reason, line of the program."""
    by = "" if data.get("by") == "plc" else f" (asked by {data.get('by')})"
    at = ", ".join(part for part in (data.get("program"), data.get("place")) if part)
    said = (
        f"{where} = {_shown(data.get('first', data.get('value')))} did not reach the device{by}: {data.get('reason')}"
    )
    times = f"; {data['count']} times" if data.get("count", 1) > 1 else ""
    return f"{said}{times}" + (f" ({at})" if at else "")


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def alarm_data(event: Mapping[str, Any]) -> dict[str, Any]:
    """Return the data of an ALARM event from a change of an alarm as plain data."""
    return {"value": event["state"], **{key: event[key] for key in ("active", "quality", "reason", "by")}}


def read_trace(lines: list[bytes]) -> list[TraceEvent]:
    """Return the events that were written to a sink."""
    return [TraceEvent(t, TraceKind(kind), where, data) for t, kind, where, data in map(msgspec.json.decode, lines)]


class _LimitedFile:
    """A file that discards further lines once it has more than `most_bytes` bytes. Its size then shows that it is incomplete."""

    def __init__(self, file: BinaryIO, most_bytes: int) -> None:
        self._file, self._most_bytes, self._bytes = file, most_bytes, 0

    def write(self, data: bytes, /) -> None:
        if self._bytes <= self._most_bytes:
            self._file.write(data)
            self._bytes += len(data)

    def close(self) -> None:
        self._file.close()


def open_sink(path: Path, most_bytes: int | None = None) -> Sink:
    """Open the file for a trace; an older one is overwritten, and its description is removed.

    `most_bytes`: a trace with more bytes is incomplete, and its file is larger than this limit. Raises `FileInvalid` if the file
    cannot be written.
    """
    try:
        about_path(path).unlink(missing_ok=True)
        file = path.open("wb")
        return file if most_bytes is None else _LimitedFile(file, most_bytes)
    except OSError as e:
        raise FileInvalid(f"cannot write the trace: {e.strerror or e}", path=str(path)) from e
