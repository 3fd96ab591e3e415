"""Compare the behaviour of a device with that of a second device or of a recording: outcomes, values and timing.

Fidelity has two figures. *Values*: the share of exchanges with the same outcome (values inside their tolerance, the same
exception, or no reply on both sides). *Timing*: the similarity of the two distributions of latency, as the mean ratio of
their quantiles. The module does no I/O. Exchanges are compared in pairs; a limited number of differences is stored, and
further ones are only counted.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from fieldtwin.capture.decoding.exchange import TouchedSpan
from fieldtwin.capture.decoding.modbus_pdu import DecodedReply, DecodedRequest, parse_reply, parse_request, words
from fieldtwin.capture.decoding.tags import TagMap
from fieldtwin.capture.recordings.aligning import Shift
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.recording import RecordedExchange
from fieldtwin.gateway.core.values import Scalar

MAX_DIFFERENCES = 1000
MAX_LATENCIES = 200_000
"""Maximum number of latencies kept of each side; later ones are only counted."""
LOOK_AHEAD = 10_000
"""Maximum number of the other side's exchanges that wait for a partner; an exchange that has no partner by then counts as
missing.
"""
MAX_UNWRITTEN = 100_000
"""Maximum number of registers and bits that are remembered as targets of omitted writes."""
QUANTILES = tuple(q / 100 for q in range(5, 100, 5))
FLOOR_S = 0.001
"""Added to both quantiles of a ratio, so that a tenth of a millisecond more than zero is not a difference."""

_COUNTING = frozenset({0x08, 0x0B, 0x0C})
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Tolerance:
    """The permitted difference of a value: `absolute` in its unit, or `share` of the recorded one, whichever is larger."""

    absolute: float = 0.0
    share: float = 0.0

    def holds(self, recorded: float, other: float) -> bool:
        if math.isnan(recorded) or math.isnan(other):
            return math.isnan(recorded) and math.isnan(other)
        return abs(recorded - other) <= max(self.absolute, self.share * abs(recorded))


@dataclass(frozen=True, slots=True)
class Rules:
    """The criteria of equality.

    `tags` override `values`; `latency` is for the median and the 90th percentile in seconds, None if timing is not
    compared. `least` is the minimum share of equal exchanges.
    """

    values: Tolerance = Tolerance()
    tags: Mapping[str, Tolerance] = field(default_factory=dict)
    latency: Tolerance | None = Tolerance(0.02, 0.5)
    least: float = 1.0


@dataclass(frozen=True, slots=True)
class ReplyDifference:
    """An exchange with a different outcome.

    `what` is value, exception, silence, reply or missing; `where` is a tag or register. `after_left_out`: an omitted
    write had set the value that was read.
    """

    t_s: float
    unit: int
    request: str
    what: str
    where: str
    recorded: str
    other: str
    after_left_out: bool = False


@dataclass(frozen=True, slots=True)
class LatencyRow:
    """Latencies of one service on both sides: their number, and the median, the 90th and the 99th percentile in seconds."""

    service: str
    count: int
    recorded_s: tuple[float, float, float]
    other_s: tuple[float, float, float]
    alike: bool


@dataclass(slots=True)
class Comparison:
    """The result of a comparison. `extra` counts exchanges that only the other side has; they do not affect the verdict."""

    compared: int = 0
    alike: int = 0
    differences: list[ReplyDifference] = field(default_factory=list)
    by_kind: dict[str, int] = field(default_factory=dict)
    left_out: int = 0
    left_out_writes: int = 0
    after_left_out: int = 0
    """Number of differing exchanges that read a cell set by an omitted write."""
    not_compared: int = 0
    """Number of repeated exchanges that could not be compared, because the recording has no value at the matching position."""
    shifts: list[Shift] = field(default_factory=list)
    extra: int = 0
    latency: list[LatencyRow] = field(default_factory=list)
    timing: float | None = None
    least: float = 1.0

    @property
    def values(self) -> float:
        """Return the share of equal exchanges; 0 if none was compared."""
        return self.alike / self.compared if self.compared else 0.0

    @property
    def met(self) -> bool:
        """Return whether the comparison is passed, so that one side can replace the other."""
        if not self.compared or not all(row.alike for row in self.latency):
            return False
        return self.alike >= self.least * (self.compared + self.not_compared)

    @property
    def inconclusive(self) -> bool:
        """Return whether the comparison fails only because of exchanges that could not be compared."""
        if self.met or not self.not_compared or not all(row.alike for row in self.latency):
            return False
        return self.alike + self.not_compared >= self.least * (self.compared + self.not_compared)


class Comparer:
    """Compares pairs of exchanges that it is given in sequence. Call `result` after the last pair."""

    def __init__(self, rules: Rules | None = None, profile: DeviceProfile | None = None) -> None:
        self._rules, self._profile = rules or Rules(), profile
        self._maps = (TagMap(profile), TagMap(profile)) if profile is not None else None
        self._counters = {t.name for t in profile.tags.values() if t.counter} if profile is not None else set()
        self._result = Comparison(least=self._rules.least)
        self._latencies: dict[int, tuple[array[float], array[float]]] = {}
        self._requests: dict[bytes, DecodedRequest] = {}
        self._unwritten: set[tuple[int, str, int]] = set()

    def add(self, recorded: RecordedExchange | None, other: RecordedExchange | None) -> None:
        """Compare one exchange of both sides; None if a side does not have it."""
        result = self._result
        if recorded is None:
            result.extra += other is not None
            return
        result.compared += 1
        if other is None:
            self._differ(recorded, "missing", "", _outcome(recorded), _outcome(None))
            return
        before = sum(result.by_kind.values())
        self._judge(recorded, other)
        result.alike += before == sum(result.by_kind.values())
        if recorded.reply and other.reply:
            kept = self._latencies.setdefault(recorded.request[0], (array("d"), array("d")))
            if len(kept[0]) < MAX_LATENCIES:
                kept[0].append(recorded.latency_s)
                kept[1].append(other.latency_s)

    def is_equal(self, recorded: RecordedExchange, other: RecordedExchange) -> bool:
        """Return whether two exchanges are equal by the rules. Counts nothing."""
        if recorded.reply == other.reply and recorded.error == other.error:
            return True
        trial = Comparer(self._rules, self._profile)
        trial.add(recorded, other)
        return not trial._result.by_kind

    def left_out(self, exchange: RecordedExchange) -> None:
        """Count an exchange that was not repeated. If it is a write, later reads may differ because its effect is missing."""
        self._result.left_out += 1
        asked = self._asked(exchange.request)
        if asked.write_span is None or not exchange.reply or exchange.reply[0] & 0x80:
            return
        self._result.left_out_writes += 1
        if len(self._unwritten) < MAX_UNWRITTEN:
            self._unwritten.update((exchange.unit, *cell) for cell in _cells(asked.write_span))

    def not_compared(self) -> None:
        """Count an exchange that was repeated, but with which no value of the recording can be compared."""
        self._result.not_compared += 1

    def shifted(self, shifts: Iterable[Shift]) -> None:
        """Record the positions at which the live dialogue continued the recorded one."""
        self._result.shifts += shifts

    def result(self) -> Comparison:
        """Return the result of the comparison."""
        compare_latencies(self._result, {_service(f): both for f, both in sorted(self._latencies.items())}, self._rules)
        return self._result

    def _asked(self, request: bytes) -> DecodedRequest:
        asked = self._requests.get(request)
        if asked is None:
            if len(self._requests) > LOOK_AHEAD:
                self._requests.clear()
            asked = self._requests[request] = parse_request(request)
        return asked

    def _judge(self, recorded: RecordedExchange, other: RecordedExchange) -> None:
        if recorded.reply == other.reply and recorded.error == other.error:
            return
        if not recorded.reply or not other.reply:
            self._differ(recorded, "silence", "", _outcome(recorded), _outcome(other))
            return
        asked = self._asked(recorded.request)
        one = parse_reply(asked, recorded.request, recorded.reply)
        two = parse_reply(asked, recorded.request, other.reply)
        if one.exception is not None or two.exception is not None:
            self._differ(recorded, "exception", "", _outcome(recorded), _outcome(other))
        elif asked.function in _COUNTING and not (one.problem or two.problem):
            return  # their counts belong to the recorded connection
        elif asked.read_span is None or one.problem or two.problem or not one.read:
            self._differ(recorded, "reply", "", recorded.reply.hex(" "), other.reply.hex(" "))
        else:
            self._compare_values(recorded, asked.read_span, one, two)

    def _compare_values(
        self, recorded: RecordedExchange, span: TouchedSpan, one: DecodedReply, two: DecodedReply
    ) -> None:
        """Compare the values: tags known to the profile, else registers and bits. One difference per exchange is counted."""
        covered: set[int] = set()
        found: list[tuple[str, str, str]] = []
        if self._maps is not None:
            t_ns = round(recorded.t_s * 1e9)
            mine, theirs = (m.of_registers(span, a.read, t_ns) for m, a in zip(self._maps, (one, two), strict=True))
            for name in mine:
                tag = self._maps[0].profile.tags.get(name)
                if tag is not None and tag.bits is None:
                    covered.update(range(tag.registers.address, tag.registers.end))
                if not self._near(name, mine[name], theirs[name]):
                    found.append((name, _shown(mine[name]), _shown(theirs[name])))
        for i, (a, b) in enumerate(zip(words(span, one.read), words(span, two.read), strict=True)):
            if span.address + i not in covered and not self._rules.values.holds(a, b):
                found.append((f"{span.table}:{span.address + i}", str(a), str(b)))
        if found:
            self._differ(recorded, "value", *found[0], more=found[1:])

    def _near(self, name: str, one: Scalar | None, two: Scalar | None) -> bool:
        if isinstance(one, bool | str) or isinstance(two, bool | str) or one is None or two is None:
            return one == two
        if not isinstance(one, int | float) or not isinstance(two, int | float):
            return one == two
        if name in self._counters and name not in self._rules.tags:
            return two >= one  # a counter that has increased is not a difference
        return self._rules.tags.get(name, self._rules.values).holds(one, two)

    def _differ(
        self,
        exchange: RecordedExchange,
        what: str,
        where: str,
        recorded: str,
        other: str,
        more: Iterable[tuple[str, str, str]] = (),
    ) -> None:
        kinds = self._result.by_kind
        kinds[what] = kinds.get(what, 0) + 1
        asked = self._asked(exchange.request)
        unwritten = asked.read_span is not None and not self._unwritten.isdisjoint(
            (exchange.unit, *cell) for cell in _cells(asked.read_span)
        )
        self._result.after_left_out += unwritten
        text = f"{asked.service} {' and '.join(map(str, asked.spans))}".rstrip()
        for place, mine, theirs in ((where, recorded, other), *more):
            if len(self._result.differences) < MAX_DIFFERENCES:
                self._result.differences.append(
                    ReplyDifference(exchange.t_s, exchange.unit, text, what, place, mine, theirs, unwritten)
                )


def compare_latencies(result: Comparison, kept: Mapping[str, tuple[array[float], array[float]]], rules: Rules) -> None:
    """Fill the rows of `result.latency` and its `timing` from the latencies of each service on both sides."""
    weighed, count = 0.0, 0
    result.latency = []
    for service, (recorded, other) in kept.items():
        both = sorted(recorded), sorted(other)
        shown = [(_quantile(b, 0.5), _quantile(b, 0.9), _quantile(b, 0.99)) for b in both]
        near = rules.latency is None or all(rules.latency.holds(shown[0][i], shown[1][i]) for i in (0, 1))
        result.latency.append(LatencyRow(service, len(recorded), shown[0], shown[1], near))
        ratio = sum(_ratio(_quantile(both[0], q), _quantile(both[1], q)) for q in QUANTILES) / len(QUANTILES)
        weighed, count = weighed + ratio * len(recorded), count + len(recorded)
    result.timing = weighed / count if count else None


def pairs_of(
    recorded: Iterable[T], other: Iterable[T], key_of: Callable[[T], Hashable]
) -> Iterator[tuple[T | None, T | None]]:
    """Pair the exchanges of both sides that have the same key: the first with the first, the second with the second, and so on.

    An exchange without a partner within `LOOK_AHEAD` exchanges is paired with None (missing); the other side's remaining
    exchanges follow, also paired with None (extra).
    """
    waiting: dict[Hashable, deque[T]] = {}
    behind, rest = 0, iter(other)
    for exchange in recorded:
        key = key_of(exchange)
        if waiting.get(key):
            yield exchange, waiting[key].popleft()
            behind -= 1
            continue
        found: T | None = None
        while found is None and behind < LOOK_AHEAD and (following := next(rest, None)) is not None:
            if key_of(following) == key:
                found = following
            else:
                waiting.setdefault(key_of(following), deque()).append(following)
                behind += 1
        yield exchange, found
    for left in waiting.values():
        yield from ((None, exchange) for exchange in left)
    yield from ((None, exchange) for exchange in rest)


def request_of(exchange: RecordedExchange) -> Hashable:
    """Return the pairing key of an exchange: unit ID and request."""
    return exchange.unit, exchange.request


def _cells(span: TouchedSpan) -> Iterator[tuple[str, int]]:
    return ((span.table, span.address + at) for at in range(span.count))


def _outcome(exchange: RecordedExchange | None) -> str:
    if exchange is None:
        return "not asked"
    if exchange.reply is None:
        return {"timeout": "no reply", "crc": "a damaged reply", "desync": "an answer to a different request"}.get(
            exchange.error or "", "the connection was lost"
        )
    if not exchange.reply:
        return "no unit answers a broadcast"
    asked = parse_request(exchange.request)
    answer = parse_reply(asked, exchange.request, exchange.reply)
    if answer.exception is not None:
        return answer.detail
    text = exchange.reply.hex(" ")
    return text if len(text) <= 48 else f"{text[:48]}... ({len(exchange.reply)} bytes)"


def _shown(value: Scalar | None) -> str:
    return "none" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)


def _service(function: int) -> str:
    return parse_request(bytes((function, 0, 0, 0, 1))).service


def _quantile(ordered: list[float], share: float) -> float:
    return ordered[min(int(share * len(ordered)), len(ordered) - 1)] if ordered else 0.0


def _ratio(one: float, two: float) -> float:
    low, high = sorted((one + FLOOR_S, two + FLOOR_S))
    return low / high
