"""Store and forward between two twins: at least once on the wire, exactly once in the log, in whatever order frames come.

Sans-IO. `Outgoing` sends one log; `Incoming` receives others. Both are told what came, what is stored and what time it is, and
say what to send, load and keep. What an ACK confirms is in the receiver's store; so either side may die at any instant, and when
frames get through again the two logs become equal.

    sender      HELLO until acknowledged, then DATA as far as the window goes; again what an ACK calls missing, and what was
                not confirmed in time (RFC 6298, doubled up to a minute); LOST for what the log has no more
    receiver    ASK for a tag that it does not know, REFUSED for a schema that it does not have, else ACK

Everything is bounded: the window, ranges behind a gap, streams.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.store.event import Event, Kind, merged
from fieldtwin.twin.thread.frames import MAX_RUNS, Ack, Ask, Data, Frame, Hello, Lost, Refused, tag_of

WINDOW = 2000
"""Events that are under way or wait for their turn in memory; the rest waits in the store."""
FAR_AHEAD = 100_000
"""Numbers so far behind the first gap are not kept: they come again."""
RTO_FIRST_NS, RTO_MIN_NS, RTO_MAX_NS = NS_PER_S, 200 * NS_PER_MS, 60 * NS_PER_S
MAX_STREAMS = 16
MAX_RANGES = 1000

URGENT = frozenset((Kind.COMMAND, Kind.STATE))
"""What waits for nobody."""

Fit = Callable[[bytes, Sequence[Event]], int]
"""How many of these events one frame of the carrier takes (`FrameCodec.fit`)."""


@dataclass(slots=True)
class _Slot:
    event: Event
    sent_ns: int = -1
    """When it was last sent; -1: it is to be sent."""
    tries: int = 0


@dataclass(slots=True)
class _Rto:
    """How long to wait for an ACK (RFC 6298, without its granularity)."""

    now_ns: int = RTO_FIRST_NS
    smoothed_ns: int = 0
    varies_ns: int = 0

    def measured(self, trip_ns: int) -> None:
        if self.smoothed_ns:
            self.varies_ns = (3 * self.varies_ns + abs(self.smoothed_ns - trip_ns)) // 4
            self.smoothed_ns = (7 * self.smoothed_ns + trip_ns) // 8
        else:
            self.smoothed_ns, self.varies_ns = max(trip_ns, 1), trip_ns // 2
        self.calm()

    def doubled(self) -> None:
        self.now_ns = min(2 * self.now_ns, RTO_MAX_NS)

    def calm(self) -> None:
        """Something arrived: no more patience than was measured."""
        wanted_ns = self.smoothed_ns + 4 * self.varies_ns if self.smoothed_ns else RTO_FIRST_NS
        self.now_ns = min(max(wanted_ns, RTO_MIN_NS), RTO_MAX_NS)


class Outgoing:
    """One log on its way. `first` and `last` are the span of the store; `load` brings events when `wanted` asks for them."""

    def __init__(self, origin: str, schema: bytes, first: int, last: int, *, prototype: bool, fit: Fit) -> None:
        self.origin = origin
        self.tag = tag_of(origin, schema)
        self.first = first
        self.last = last
        self.through = 0
        """Everything up to here is in the other side's log."""
        self.refused = False
        """The other side does not have our schema. It is asked again now and then: it may get it."""
        self.resent = 0
        self.linger_ns = 0
        """How long events wait for others that fill the frame; a matter of the carrier."""
        self.contradicted = False
        """The other side has more of our log than we: our store went back in time. What is new here would pass for old there."""
        self._schema = schema
        self._prototype = prototype
        self._fit = fit
        self._window: OrderedDict[int, _Slot] = OrderedDict()
        self._loaded = 0
        self._to_send: deque[int] = deque()
        self._gathers_ns: int | None = None
        """Since when what is to be sent waits for more."""
        self._known = False
        self._hello_ns: int | None = 0
        """When to say HELLO next; None while the other side knows us and nothing is due."""
        self._hello_sent_ns = -1
        self._doubt_ns: int | None = None
        """When to ask with HELLO whether the other side has what it confirmed; None while nobody doubts it."""
        self._asked_ns: int | None = None
        """When that was asked first."""
        self._rto = _Rto()
        self._lost: deque[tuple[int, int]] = deque()
        """To be told."""
        self._told: dict[tuple[int, int], int] = {}
        """Told to be lost, and when, until that is confirmed."""

    # -- the log ----------------------------------------------------------------------------------------------------------

    def appended(self, last: int) -> None:
        """The log has grown to number `last`."""
        self.last = max(self.last, last)

    def wanted(self) -> tuple[int, int] | None:
        """First number and how many events to load from the store now; None: there is enough."""
        first = max(self._loaded, self.through) + 1
        room = WINDOW - len(self._window)
        if not self._known or first > self.last or room < WINDOW // 2:
            return None
        return first, min(room, self.last - first + 1)

    def load(self, first: int, events: Sequence[Event]) -> None:
        """What the store has from number `first` on. Numbers that it has no more are told to be lost."""
        expected = first
        for event in events:
            if event.sequence > expected:
                self._lost.append((expected, event.sequence - 1))
                self.first = max(self.first, event.sequence)
            if event.sequence > self.through:
                self._window[event.sequence] = _Slot(event)
                self._to_send.append(event.sequence)
            expected = event.sequence + 1
        if not events:
            self._lost.append((first, self.last))
            expected = self.first = self.last + 1
        self._loaded = max(self._loaded, expected - 1)

    @property
    def waiting(self) -> int:
        """Events of the log that the other side has not confirmed."""
        return max(0, self.last - self.through)

    # -- what comes -------------------------------------------------------------------------------------------------------

    def connected(self, now_ns: int) -> None:
        """A link is there, perhaps a new one: whatever was under way may be lost, and who is there may be new."""
        self._known = False
        self._hello_ns = now_ns
        self._doubt_ns = self._asked_ns = None
        self._rto = _Rto()
        self._window.clear()
        self._to_send.clear()
        self._lost.clear()
        self._told.clear()
        self._loaded = self.through

    def on_ask(self, now_ns: int) -> None:
        """The other side lost what it knew of us."""
        if self._hello_ns is None or now_ns - self._hello_sent_ns > self._rto.now_ns:
            self._hello_ns = now_ns
        self._known = False

    def on_refused(self, now_ns: int) -> None:
        self.refused = True
        self._known = False
        self._hello_ns = now_ns + RTO_MAX_NS

    def on_ack(self, ack: Ack, now_ns: int) -> None:
        """Take what is confirmed out of the window, and see what is missing."""
        if ack.through > self.last:
            self.contradicted = True
            return
        if ack.through < self.through and not self._is_less(ack.through, now_ns):
            return
        self._doubt_ns = self._asked_ns = None
        if not self._known:
            self._known, self.refused, self._hello_ns = True, False, None
            self._loaded = max(self._loaded, ack.through)
            self._rto.calm()
        progress = self._confirm_through(ack.through, now_ns)
        late_ns = (
            now_ns - (self._rto.smoothed_ns or self._rto.now_ns) // 2
        )  # an ACK under way knows nothing of what was just sent
        at = ack.through
        for gap, run in ack.runs:
            at += gap
            for lost, told_ns in list(self._told.items()):
                if lost[0] <= at and told_ns < late_ns:
                    del self._told[lost]
                    self._lost.append(lost)
            progress |= self._confirm_run(at - gap + 1, at, at + run, now_ns, late_ns)
            at += run
        if progress:
            self._rto.calm()

    def _is_less(self, through: int, now_ns: int) -> bool:
        """The other side has less than it confirmed: an ACK that was late, or one who is there for the first time. HELLO asks,
        and what answers it is believed: what was confirmed before was to somebody else. Whether this ACK is taken."""
        asked_ns = self._asked_ns
        if self._known and (asked_ns is None or now_ns - asked_ns < self._rto.smoothed_ns // 2):
            self._doubt_ns = now_ns if self._doubt_ns is None else self._doubt_ns
            return False
        self.connected(now_ns)
        self.through = self._loaded = through
        return True

    def _confirm_run(self, first: int, last_missing: int, last: int, now_ns: int, late_ns: int) -> bool:
        """Numbers from `first` on are missing, those behind `last_missing` are kept."""
        progress = False
        span = range(first, last + 1)
        for number in [n for n in self._window if n in span] if len(span) > len(self._window) else span:
            slot = self._window.get(number)
            if slot is None:
                continue
            if number > last_missing:
                del self._window[number]
                progress |= self._measure(slot, now_ns)
            elif 0 <= slot.sent_ns < late_ns:
                self._again(number, slot)
        return progress

    def _confirm_through(self, through: int, now_ns: int) -> bool:
        progress = False
        while self._window and next(iter(self._window)) <= through:
            _, slot = self._window.popitem(last=False)
            progress |= self._measure(slot, now_ns)
        self.through = max(self.through, through)
        self._told = {lost: told_ns for lost, told_ns in self._told.items() if lost[1] > self.through}
        return progress

    def _measure(self, slot: _Slot, now_ns: int) -> bool:
        if slot.tries == 1 and slot.sent_ns >= 0:  # Karn: of what was sent twice nobody knows which was confirmed
            self._rto.measured(now_ns - slot.sent_ns)
        return True

    def _again(self, number: int, slot: _Slot) -> None:
        slot.sent_ns = -1
        self.resent += 1
        self._to_send.append(number)

    # -- what goes --------------------------------------------------------------------------------------------------------

    def next_frame(self, now_ns: int) -> Frame | None:
        """What to send now, if anything."""
        if not self._known:
            if self._hello_ns is None or now_ns < self._hello_ns:
                return None
            self._hello_sent_ns = now_ns
            self._hello_ns = now_ns + self._rto.now_ns
            self._rto.doubled()
            return self._hello()
        if self._doubt_ns is not None and now_ns >= self._doubt_ns:
            self._asked_ns = now_ns if self._asked_ns is None else self._asked_ns
            self._doubt_ns = now_ns + self._rto.now_ns
            return self._hello()
        if self._lost:
            first, last = self._lost.popleft()
            self._told[first, last] = now_ns
            return Lost(self.tag, first, last)
        self._time_out(now_ns)
        events = self._next_events()
        if not events:
            self._gathers_ns = None
            return None
        if self._gathers_ns is None:
            self._gathers_ns = now_ns
        if not self._to_send and self._may_wait(events, now_ns):
            self._to_send.extend(event.sequence for event in events)
            return None
        self._gathers_ns = None
        for event in events:
            slot = self._window[event.sequence]
            slot.sent_ns = now_ns
            slot.tries += 1
        return Data(self.tag, tuple(events))

    def _hello(self) -> Hello:
        return Hello(self.origin, self._schema, self.first, self.last, self._prototype)

    def _may_wait(self, events: Sequence[Event], now_ns: int) -> bool:
        """Whether these, of which there are no more, wait for others."""
        assert self._gathers_ns is not None
        return now_ns < self._gathers_ns + self.linger_ns and not any(event.kind in URGENT for event in events)

    def _time_out(self, now_ns: int) -> None:
        """Send again what waits for its ACK for too long; the oldest is enough to know."""
        oldest = next(iter(self._window.values()), None)
        if oldest is None or oldest.sent_ns < 0 or now_ns < oldest.sent_ns + self._rto.now_ns:
            if oldest is None and not self._lost and self.through < self._loaded and self._tail_due(now_ns):
                self.connected(now_ns)  # a LOST was lost: begin anew from what is confirmed
            return
        due_ns = now_ns - self._rto.now_ns
        for number, slot in self._window.items():
            if 0 <= slot.sent_ns <= due_ns:
                self._again(number, slot)
        self._rto.doubled()

    def _tail_due(self, now_ns: int) -> bool:
        if self._hello_sent_ns + self._rto.now_ns > now_ns:
            return False
        self._hello_sent_ns = now_ns
        return True

    def _next_events(self) -> list[Event]:
        """Unsent events that follow one another, as many as a frame takes."""
        run: list[Event] = []
        while self._to_send and len(run) < 1000:
            number = self._to_send[0]
            slot = self._window.get(number)
            if slot is None or slot.sent_ns >= 0:  # confirmed meanwhile, or queued twice
                self._to_send.popleft()
                continue
            if run and number != run[-1].sequence + 1:
                break
            run.append(slot.event)
            self._to_send.popleft()
        if not run:
            return run
        count = self._fit(self.tag, run)
        self._to_send.extendleft(event.sequence for event in reversed(run[count:]))
        return run[:count]

    def wake_ns(self, now_ns: int) -> int | None:
        """When `next_frame` may have something although nothing came; None: never."""
        if not self._known:
            return self._hello_ns
        due_ns = self._wake_ns(now_ns)
        return due_ns if self._doubt_ns is None else min(self._doubt_ns, due_ns or self._doubt_ns)

    def _wake_ns(self, now_ns: int) -> int | None:
        if self._lost or (self._to_send and self._gathers_ns is None):
            return now_ns
        if self._to_send and self._gathers_ns is not None:
            return max(now_ns, self._gathers_ns + self.linger_ns)
        oldest = next(iter(self._window.values()), None)
        if oldest is not None:
            return oldest.sent_ns + self._rto.now_ns
        if self.through < self._loaded:
            return max(now_ns, self._hello_sent_ns + self._rto.now_ns)
        return None


# -- the receiver -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Open:
    """Look up in the store what there is of this origin, and tell `Incoming.opened`."""

    origin: str


@dataclass(frozen=True, slots=True)
class Keep:
    """Store these, then tell `Incoming.kept`."""

    origin: str
    events: tuple[Event, ...]
    prototype: bool


@dataclass(frozen=True, slots=True)
class NoteLost:
    """These will never come; note it, then tell `Incoming.noted`."""

    origin: str
    first: int
    last: int


Effect = Open | Keep | NoteLost


@dataclass(slots=True)
class _Stream:
    hello: Hello
    through: int = 0
    ranges: list[tuple[int, int]] = field(default_factory=list)
    """Kept behind the first gap, in order."""
    under_way: set[int] = field(default_factory=set)
    """Given out to be kept."""
    open: bool = False
    ack_ns: int | None = None
    """When to acknowledge."""

    def has(self, number: int) -> bool:
        return number <= self.through or number in self.under_way or any(a <= number <= b for a, b in self.ranges)

    def add(self, ranges: list[tuple[int, int]]) -> None:
        self.ranges = merged([*self.ranges, *ranges])
        while self.ranges and self.ranges[0][0] <= self.through + 1:
            self.through = max(self.through, self.ranges.pop(0)[1])


class Incoming:
    """Logs of others on their way here. `knows`: whether a schema can be read. By `ack_delay_ns` one ACK serves many frames."""

    def __init__(self, knows: Callable[[bytes], bool], ack_delay_ns: int) -> None:
        self.duplicates = 0
        self.too_far = 0
        self._knows = knows
        self.ack_delay_ns = ack_delay_ns
        self._streams: OrderedDict[bytes, _Stream] = OrderedDict()
        self._answers: deque[Frame] = deque(maxlen=MAX_STREAMS)
        self.unknown_schema = b""
        """The last schema that was refused; empty when there was none."""

    def receive(self, frame: Hello | Data | Lost, now_ns: int) -> list[Effect]:
        """Take a frame; what is to be done with the store."""
        if isinstance(frame, Hello):
            return self._hello(frame, now_ns)
        stream = self._streams.get(frame.tag)
        if stream is None or (isinstance(frame, Data) and not frame.events):
            ask = Ask(frame.tag)
            if ask not in self._answers:
                self._answers.append(ask)
            return []
        if not stream.open:
            return []  # it comes again
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
        self._streams[hello.tag] = _Stream(hello)  # or again: the store did not answer the last time
        if len(self._streams) > MAX_STREAMS:
            self._streams.popitem(last=False)
        return [Open(hello.origin)]

    def opened(self, origin: str, last: int, gaps: Sequence[tuple[int, int]], now_ns: int) -> list[Effect]:
        """What the store has of `origin`: everything up to `last` but the `gaps`."""
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
        """These are in the store."""
        for stream in self._of(origin):
            stream.under_way.difference_update(event.sequence for event in events)
            stream.add([(event.sequence, event.sequence) for event in events])
            self._acknowledge(stream, now_ns)

    def not_kept(self, origin: str, events: Sequence[Event]) -> None:
        """The store refused these: they are not acknowledged, and come again."""
        for stream in self._of(origin):
            stream.under_way.difference_update(event.sequence for event in events)

    def noted(self, origin: str, first: int, last: int, now_ns: int) -> None:
        """The store knows that these are lost."""
        for stream in self._of(origin):
            stream.add([(first, last)])
            self._acknowledge(stream, now_ns)

    def _of(self, origin: str) -> list[_Stream]:
        return [stream for stream in self._streams.values() if stream.hello.origin == origin]

    def through(self, origin: str) -> int:
        """Everything of `origin` up to this number is in the store, or known to be lost."""
        return max((stream.through for stream in self._of(origin) if stream.open), default=0)

    def _acknowledge(self, stream: _Stream, now_ns: int, *, at_once: bool = False) -> None:
        due_ns = now_ns if at_once else now_ns + self.ack_delay_ns
        stream.ack_ns = due_ns if stream.ack_ns is None else min(stream.ack_ns, due_ns)

    def next_frame(self, now_ns: int) -> Frame | None:
        """An answer that is due, if any."""
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
        """When an answer will be due; None: never."""
        if self._answers:
            return now_ns
        due = [s.ack_ns for s in self._streams.values() if s.open and s.ack_ns is not None]
        return min(due, default=None)
