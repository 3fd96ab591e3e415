"""Store and forward between two twins, the receiver of other sides' logs (`outgoing` is the sender).

Sans-IO. `IncomingLogs` is given the received frames, the stored events and the time, and returns the frames to send and the
events to store. It answers ASK for an unknown tag, REFUSED for an unknown schema, else ACK, which confirms only what is in
the store. The ranges after a gap and the streams are bounded.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from fieldtwin.gateway.store.event import Event, merged
from fieldtwin.twin.thread.frames import MAX_RUNS, Ack, Ask, Data, Frame, Hello, Lost, Refused

FAR_AHEAD = 100_000
"""Events whose numbers are more than this after the first gap are not stored; the sender will send them again."""
MAX_STREAMS = 16
MAX_RANGES = 1000


@dataclass(frozen=True, slots=True)
class Open:
    """The effect "look up in the store which events it has of this origin"; then the caller calls `IncomingLogs.opened`."""

    origin: str


@dataclass(frozen=True, slots=True)
class Keep:
    """The effect "store these events", after which the caller calls `IncomingLogs.kept`."""

    origin: str
    events: tuple[Event, ...]
    prototype: bool


@dataclass(frozen=True, slots=True)
class NoteLost:
    """The effect "record that these events will never arrive", after which the caller calls `IncomingLogs.noted`."""

    origin: str
    first: int
    last: int


Effect = Open | Keep | NoteLost


@dataclass(slots=True)
class _Stream:
    hello: Hello
    through: int = 0
    ranges: list[tuple[int, int]] = field(default_factory=list)
    """Ranges of numbers that are stored after the first gap, in order."""
    under_way: set[int] = field(default_factory=set)
    """Numbers of the events that are being stored now."""
    open: bool = False
    ack_ns: int | None = None
    """Time (ns) at which this end has to acknowledge the stored events."""

    def has(self, number: int) -> bool:
        return number <= self.through or number in self.under_way or any(a <= number <= b for a, b in self.ranges)

    def add(self, ranges: list[tuple[int, int]]) -> None:
        self.ranges = merged([*self.ranges, *ranges])
        while self.ranges and self.ranges[0][0] <= self.through + 1:
            self.through = max(self.through, self.ranges.pop(0)[1])


class IncomingLogs:
    """The receiver of the logs of other sides.

    `knows` returns whether a schema can be decoded. ACKs are delayed by `ack_delay_ns`, so that one ACK confirms many frames.
    """

    def __init__(self, knows: Callable[[bytes], bool], ack_delay_ns: int) -> None:
        self.duplicates = 0
        self.too_far = 0
        self._knows = knows
        self.ack_delay_ns = ack_delay_ns
        self._streams: OrderedDict[bytes, _Stream] = OrderedDict()
        self._answers: deque[Frame] = deque(maxlen=MAX_STREAMS)
        self.unknown_schema = b""
        """The last schema that was refused; empty if none was."""

    def receive(self, frame: Hello | Data | Lost, now_ns: int) -> list[Effect]:
        """Process a frame and return the effects on the store."""
        if isinstance(frame, Hello):
            return self._hello(frame, now_ns)
        stream = self._streams.get(frame.tag)
        if stream is None or (isinstance(frame, Data) and not frame.events):
            ask = Ask(frame.tag)
            if ask not in self._answers:
                self._answers.append(ask)
            return []
        if not stream.open:
            return []  # it will be sent again
        if isinstance(frame, Lost):
            return [NoteLost(stream.hello.origin, frame.first, frame.last)] if frame.last >= frame.first else []
        return self._data(stream, frame, now_ns)

    def _hello(self, hello: Hello, now_ns: int) -> list[Effect]:
        if not self._knows(hello.schema):
            self.unknown_schema = hello.schema
            self._answers.append(Refused(hello.tag, hello.schema))
            return []
        stream = self._streams.get(hello.tag)
        if stream is not None and stream.open:
            self._acknowledge(stream, now_ns, at_once=True)
            if hello.first > stream.through + 1:
                return [NoteLost(hello.origin, stream.through + 1, hello.first - 1)]
            return []
        self._streams[hello.tag] = _Stream(hello)  # a new stream, or one whose lookup the store did not answer
        if len(self._streams) > MAX_STREAMS:
            self._streams.popitem(last=False)
        return [Open(hello.origin)]

    def opened(self, origin: str, last: int, gaps: Sequence[tuple[int, int]], now_ns: int) -> list[Effect]:
        """Note which events of `origin` the store has: all up to `last` except the `gaps`."""
        effects: list[Effect] = []
        for stream in self._of(origin):
            at = 0
            for first, end in [*gaps, (last + 1, last)]:
                if first > at + 1:
                    stream.add([(at + 1, first - 1)])
                at = end
            stream.open = True
            self._acknowledge(stream, now_ns, at_once=True)
            if stream.hello.first > stream.through + 1:
                effects.append(NoteLost(origin, stream.through + 1, stream.hello.first - 1))
        return effects

    def _data(self, stream: _Stream, frame: Data, now_ns: int) -> list[Effect]:
        new = []
        for event in frame.events:
            if stream.has(event.sequence):
                self.duplicates += 1
            elif event.sequence > stream.through + FAR_AHEAD or len(stream.ranges) >= MAX_RANGES:
                self.too_far += 1
            else:
                new.append(event)
        self._acknowledge(stream, now_ns)
        if not new:
            return []
        stream.under_way.update(event.sequence for event in new)
        return [Keep(stream.hello.origin, tuple(new), stream.hello.prototype)]

    def kept(self, origin: str, events: Sequence[Event], now_ns: int) -> None:
        """Note that these events are in the store."""
        for stream in self._of(origin):
            stream.under_way.difference_update(event.sequence for event in events)
            stream.add([(event.sequence, event.sequence) for event in events])
            self._acknowledge(stream, now_ns)

    def not_kept(self, origin: str, events: Sequence[Event]) -> None:
        """Note that the store refused these events: they are not acknowledged, and will be sent again."""
        for stream in self._of(origin):
            stream.under_way.difference_update(event.sequence for event in events)

    def noted(self, origin: str, first: int, last: int, now_ns: int) -> None:
        """Note that the store has recorded these events as lost."""
        for stream in self._of(origin):
            stream.add([(first, last)])
            self._acknowledge(stream, now_ns)

    def _of(self, origin: str) -> list[_Stream]:
        return [stream for stream in self._streams.values() if stream.hello.origin == origin]

    def through(self, origin: str) -> int:
        """Return the number up to which every event of `origin` is in the store, or recorded as lost."""
        return max((stream.through for stream in self._of(origin) if stream.open), default=0)

    def _acknowledge(self, stream: _Stream, now_ns: int, *, at_once: bool = False) -> None:
        due_ns = now_ns if at_once else now_ns + self.ack_delay_ns
        stream.ack_ns = due_ns if stream.ack_ns is None else min(stream.ack_ns, due_ns)

    def next_frame(self, now_ns: int) -> Frame | None:
        """Return an answer that is due, or None."""
        if self._answers:
            return self._answers.popleft()
        for tag, stream in self._streams.items():
            if stream.open and stream.ack_ns is not None and stream.ack_ns <= now_ns:
                stream.ack_ns = None
                runs, at = [], stream.through
                for first, last in stream.ranges[:MAX_RUNS]:
                    runs.append((first - 1 - at, last - first + 1))
                    at = last
                return Ack(tag, stream.through, tuple(runs))
        return None

    def wake_ns(self, now_ns: int) -> int | None:
        """Return the time at which an answer will be due; None: never."""
        if self._answers:
            return now_ns
        due = [s.ack_ns for s in self._streams.values() if s.open and s.ack_ns is not None]
        return min(due, default=None)
