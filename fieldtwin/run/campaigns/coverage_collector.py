"""Collect the coverage of a run from the events of its trace: variables of programs, qualities of tags, and faults.

Values count as states if they are truth values, texts, or small whole numbers; a measured value is not a state.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from heapq import heappop, heappush

from fieldtwin.emulators.faults.schema import seconds
from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.results.trace import Trace, TraceEvent, TraceKind, state_of
from fieldtwin.run.campaigns.coverage import MOST_OF_KIND, Coverage, Kind, element

NO_FAULT = ""
MOST_VARIABLES = 32
"""Largest number of variables whose states are combined with faults and tags, in the order of their first change."""
MOST_VALUES = 32
"""Largest number of values of one variable that count as states."""
_AGES_NS = tuple(ms * NS_PER_MS for ms in (100, 1_000, 10_000, 100_000))


class CoverageCollector:
    """The coverage of one run. Call `listen` with its trace before it begins, and read `coverage` when it has ended."""

    def __init__(self) -> None:
        self._found: dict[Kind, set[tuple[Hashable, ...]]] = {kind: set() for kind in Kind}
        self._faults: dict[str, str] = {}
        """The name and target of each active fault, by its ID."""
        self._edges: list[tuple[int, str, str]] = []
        """A heap of the coming begins and ends of faults: time in ns, ID, and for a begin the name and target."""
        self._states: dict[str, tuple[object, int]] = {}
        """The value of each variable, and the time of its change in ns."""
        self._values: dict[str, set[object]] = {}
        self._bad: dict[str, str] = {}
        """The quality of each tag that is not good."""

    def listen(self, trace: Trace) -> None:
        """Collect from this trace."""
        trace.listen(self._state, TraceKind.STATE)
        trace.listen(self._fault, TraceKind.FAULT)
        trace.listen(self._tag, TraceKind.TAG)

    @property
    def coverage(self) -> Coverage:
        return Coverage(frozenset(element(kind, *names) for kind, found in self._found.items() for names in found))

    def _add(self, kind: Kind, *names: Hashable) -> None:
        found = self._found[kind]
        if len(found) < MOST_OF_KIND:
            found.add(names)

    @property
    def _active(self) -> Iterable[str]:
        return self._faults.values() or (NO_FAULT,)

    def _state(self, event: TraceEvent) -> None:
        value, variable = state_of(event), event.where
        if value is None:
            return
        self._advance(event.t_ns)
        values = self._values.get(variable)
        if values is None:
            if len(self._values) >= MOST_VARIABLES:
                return
            values = self._values[variable] = set()
        if value not in values:
            if len(values) >= MOST_VALUES:
                return
            values.add(value)
        before = self._states.get(variable)
        self._states[variable] = value, event.t_ns
        for fault in self._active:
            self._add(Kind.STATE, variable, value, fault)
            if before is not None:
                self._add(Kind.TRANSITION, variable, before[0], value, fault)
        for tag, quality in self._bad.items():
            self._add(Kind.TAG, tag, quality, variable, value)

    def _fault(self, event: TraceEvent) -> None:
        """Note when a fault will begin and end. An injected fault has its times in `said`, in seconds of the run."""
        if not event.data.get("on"):
            self._ended(event.where, event.t_ns)
            return
        said = event.data.get("said", {})
        begin_ns = max(event.t_ns, round(seconds(said.get("from", 0.0)) * NS_PER_S))
        end_ns = None if said.get("until") is None else round(seconds(said["until"]) * NS_PER_S)
        if end_ns is None or end_ns > begin_ns:
            heappush(self._edges, (begin_ns, event.where, f"{event.data.get('name')} {event.data.get('target')}"))
            if end_ns is not None:
                heappush(self._edges, (end_ns, event.where, NO_FAULT))
        self._advance(event.t_ns)

    def _advance(self, t_ns: int) -> None:
        """Let the faults begin and end whose times have come."""
        while self._edges and self._edges[0][0] <= t_ns:
            at_ns, id, fault = heappop(self._edges)
            if not fault:
                self._ended(id, at_ns)
                continue
            self._faults[id] = fault
            self._edge(fault, "begins", at_ns)
            for variable, (value, _) in self._states.items():
                self._add(Kind.STATE, variable, value, fault)

    def _ended(self, id: str, t_ns: int) -> None:
        if (fault := self._faults.pop(id, None)) is not None:
            self._edge(fault, "ends", t_ns)

    def _edge(self, fault: str, edge: str, t_ns: int) -> None:
        for variable, (value, since_ns) in self._states.items():
            age = sum(t_ns - since_ns >= limit_ns for limit_ns in _AGES_NS)
            self._add(Kind.BEGIN, fault, edge, variable, value, age)

    def _tag(self, event: TraceEvent) -> None:
        if self._edges and self._edges[0][0] <= event.t_ns:
            self._advance(event.t_ns)
        quality, tag = event.data["quality"], event.where
        if quality == "good":
            if self._bad and self._bad.pop(tag, None) is not None:
                self._seen(tag, quality)
        elif self._bad.get(tag) != quality:
            self._bad[tag] = quality
            self._seen(tag, quality)

    def _seen(self, tag: str, quality: str) -> None:
        for fault in self._active:
            self._add(Kind.TAG, tag, quality, fault)
        for variable, (value, _) in self._states.items():
            self._add(Kind.TAG, tag, quality, variable, value)
