"""Store and forward between two twins, the sender: at least once on the link, exactly once in the log, in any order of frames.

Sans-IO. `OutgoingLog` is given the received frames, the stored events and the time, and returns the frames to send and the
events to load. An ACK confirms only what is in the receiver's store (`incoming`). Either side may therefore die at any
instant, and as soon as frames arrive again the two logs become equal.

It sends HELLO until acknowledged, then DATA within a bounded window. It retransmits what an ACK reports missing, and what was not
confirmed in time (RFC 6298, doubled up to a minute). It sends LOST for events that are no longer in the log.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.twin.thread.frames import Ack, Data, Frame, Hello, Lost, tag_of

WINDOW = 2000
"""The largest number of events in memory: those in flight and those that wait to be sent. Further events wait in the store."""
RTO_FIRST_NS, RTO_MIN_NS, RTO_MAX_NS = NS_PER_S, 200 * NS_PER_MS, 60 * NS_PER_S

URGENT = frozenset((Kind.COMMAND, Kind.STATE))
"""Kinds of events that are sent at once, without waiting to fill a frame."""

Fit = Callable[[bytes, Sequence[Event]], int]
"""A function that returns how many of these events fit into one frame of the carrier (`FrameCodec.fit`)."""


@dataclass(slots=True)
class _Slot:
    event: Event
    sent_ns: int = -1
    """Time (ns) at which the event was last sent; -1 if it was not sent yet."""
    tries: int = 0


@dataclass(slots=True)
class _Rto:
    """The retransmission timeout (RFC 6298, without its clock granularity)."""

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
        """Reset the timeout to the measured value, because something arrived."""
        wanted_ns = self.smoothed_ns + 4 * self.varies_ns if self.smoothed_ns else RTO_FIRST_NS
        self.now_ns = min(max(wanted_ns, RTO_MIN_NS), RTO_MAX_NS)


class OutgoingLog:
    """One log that is being sent.

    `first` and `last` are the span of the store. When `wanted` asks for events, the caller passes them to `load`.
    """

    def __init__(self, origin: str, schema: bytes, first: int, last: int, *, prototype: bool, fit: Fit) -> None:
        self.origin = origin
        self.tag = tag_of(origin, schema)
        self.first = first
        self.last = last
        self.through = 0
        """Every event up to this number is in the other side's log."""
        self.refused = False
        """Whether the other side does not have this side's schema. HELLO is repeated periodically, because the other side may
        get the schema later.
        """
        self.resent = 0
        self.linger_ns = 0
        """The time (ns) that events wait for further events that fill the frame. The carrier sets it."""
        self.contradicted = False
        """Whether the other side has more events of this log than this side: the store was replaced by an older copy, for
        example from a backup. New events would have numbers that the other side already has.
        """
        self._schema = schema
        self._prototype = prototype
        self._fit = fit
        self._window: OrderedDict[int, _Slot] = OrderedDict()
        self._loaded = 0
        self._to_send: deque[int] = deque()
        self._gathers_ns: int | None = None
        """Time (ns) since which events wait for further events that fill the frame; None if none waits."""
        self._known = False
        self._hello_ns: int | None = 0
        """Time (ns) of the next HELLO; None while the other side knows this stream and no HELLO is due."""
        self._hello_sent_ns = -1
        self._doubt_ns: int | None = None
        """Time (ns) at which to verify with HELLO that the other side has the events that it confirmed; None while there is no
        doubt.
        """
        self._asked_ns: int | None = None
        """Time (ns) at which this side first sent a HELLO for this verification."""
        self._rto = _Rto()
        self._lost: deque[tuple[int, int]] = deque()
        """Ranges of lost events that are yet to be reported."""
        self._told: dict[tuple[int, int], int] = {}
        """Ranges reported as lost that are not confirmed yet, with the time (ns) of the report."""

    # -- the log ----------------------------------------------------------------------------------------------------------

    def appended(self, last: int) -> None:
        """Note that the log has grown to number `last`."""
        self.last = max(self.last, last)

    def wanted(self) -> tuple[int, int] | None:
        """Return the first number and the count of events to load from the store now; None if enough are loaded."""
        first = max(self._loaded, self.through) + 1
        room = WINDOW - len(self._window)
        if not self._known or first > self.last or room < WINDOW // 2:
            return None
        return first, min(room, self.last - first + 1)

    def load(self, first: int, events: Sequence[Event]) -> None:
        """Take the events that the store has from number `first` on. Numbers that it no longer has are reported as lost."""
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
        """Return the number of events of the log that the other side has not confirmed."""
        return max(0, self.last - self.through)

    # -- what comes -------------------------------------------------------------------------------------------------------

    def connected(self, now_ns: int) -> None:
        """Begin to send over a link that was opened: frames in flight may be lost, and the other side may be a different one."""
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
        """Send HELLO, because the other side no longer knows this stream."""
        if self._hello_ns is None or now_ns - self._hello_sent_ns > self._rto.now_ns:
            self._hello_ns = now_ns
        self._known = False

    def on_refused(self, now_ns: int) -> None:
        self.refused = True
        self._known = False
        self._hello_ns = now_ns + RTO_MAX_NS

    def on_ack(self, ack: Ack, now_ns: int) -> None:
        """Remove confirmed events from the window, and queue missing ones again."""
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
        # An ACK in flight does not cover what was just sent.
        late_ns = now_ns - (self._rto.smoothed_ns or self._rto.now_ns) // 2
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
        """Handle an ACK that confirms fewer events than an earlier one: it is late, or the other side is a different one.

        Schedule a HELLO; the ACK that answers it is used, because a different side may have sent the earlier confirmations.
        Return whether to use this ACK.
        """
        asked_ns = self._asked_ns
        if self._known and (asked_ns is None or now_ns - asked_ns < self._rto.smoothed_ns // 2):
            self._doubt_ns = now_ns if self._doubt_ns is None else self._doubt_ns
            return False
        self.connected(now_ns)
        self.through = self._loaded = through
        return True

    def _confirm_run(self, first: int, last_missing: int, last: int, now_ns: int, late_ns: int) -> bool:
        """Process a gap and a run of an ACK: numbers from `first` to `last_missing` are missing, those after it are
        stored.
        """
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
        if slot.tries == 1 and slot.sent_ns >= 0:  # Karn's algorithm: a retransmitted event gives no round-trip time
            self._rto.measured(now_ns - slot.sent_ns)
        return True

    def _again(self, number: int, slot: _Slot) -> None:
        slot.sent_ns = -1
        self.resent += 1
        self._to_send.append(number)

    # -- what goes --------------------------------------------------------------------------------------------------------

    def next_frame(self, now_ns: int) -> Frame | None:
        """Return the frame to send now, or None."""
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
        """Return whether these last unsent events may wait for more to fill the frame."""
        assert self._gathers_ns is not None
        return now_ns < self._gathers_ns + self.linger_ns and not any(event.kind in URGENT for event in events)

    def _time_out(self, now_ns: int) -> None:
        """Send the events again whose ACK is overdue. It is enough to check the oldest event."""
        oldest = next(iter(self._window.values()), None)
        if oldest is None or oldest.sent_ns < 0 or now_ns < oldest.sent_ns + self._rto.now_ns:
            if oldest is None and not self._lost and self.through < self._loaded and self._tail_due(now_ns):
                self.connected(now_ns)  # a LOST frame did not arrive: start again after the last confirmed event
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
        """Return unsent events with consecutive numbers, as many as fit into a frame."""
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
        """Return the time at which `next_frame` may have a frame even if nothing arrives; None: never."""
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
