"""The recorder of a run's events, and the polling behaviour of the client that they show. The number of events is limited:
the oldest ones are dropped and counted.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable
from statistics import median

from fieldtwin.conformance.core.observation import Event, Habit, ReplySent, RequestSeen
from fieldtwin.gateway.core.clock import NS_PER_S

MOST_EVENTS = 200_000


class Recorder:
    """The events of a run in order, at most `MOST_EVENTS`."""

    def __init__(self) -> None:
        self._events: deque[Event] = deque(maxlen=MOST_EVENTS)
        self.total = 0
        self.on_event: Callable[[Event], None] = lambda event: None
        """Called with each event."""

    def add(self, event: Event) -> None:
        self._events.append(event)
        self.total += 1
        self.on_event(event)

    @property
    def dropped(self) -> int:
        """Return the number of dropped events."""
        return self.total - len(self._events)

    def since(self, t_ns: int) -> tuple[Event, ...]:
        """Return the events from `t_ns` on, in order."""
        found: list[Event] = []
        for event in reversed(self._events):
            if event.t_ns < t_ns:
                break
            found.append(event)
        return tuple(reversed(found))

    def habit(self, since_ns: int, until_ns: int, silent_gap_s: float = 0.0) -> Habit:
        """Return the polling behaviour of the client between two moments; `silent_gap_s` is measured elsewhere and only
        passed on.
        """
        asked = [e for e in self._events if isinstance(e, RequestSeen) and since_ns <= e.t_ns <= until_ns]
        gaps = [(b.t_ns - a.t_ns) / NS_PER_S for a, b in itertools.pairwise(asked)]
        times: dict[bytes, list[int]] = {}
        for request in asked:
            times.setdefault(request.target, []).append(request.t_ns)
        periods = {
            target: median(b - a for a, b in itertools.pairwise(when)) / NS_PER_S
            for target, when in times.items()
            if len(when) > 1
        }
        span_s = (asked[-1].t_ns - asked[0].t_ns) / NS_PER_S if len(asked) > 1 else 1.0
        rate = (len(asked) - 1) / span_s if span_s > 0 else 1.0
        return Habit(periods, max(gaps, default=1.0), silent_gap_s, max(rate, 0.01))

    def count(self, kind: type[RequestSeen] | type[ReplySent], since_ns: int) -> int:
        """Return the number of events of a kind since `since_ns`; of replies, only the good ones."""
        return sum(isinstance(e, kind) and (not isinstance(e, ReplySent) or e.good) for e in self.since(since_ns))
