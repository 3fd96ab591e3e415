"""Compare CANopen nodes by logs of their bus, as `comparing` compares exchanges: SDO transfers one by one, unrequested
messages by kind.

The times of a node's own messages (PDOs, heartbeats) vary. Two kinds of messages are equal if they have the same length and
about the same rate; their contents are signals, which a replay reads according to its own clock. The module does no I/O.
"""

from __future__ import annotations

from array import array
from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass, field, replace

from fieldtwin.capture.decoding.canopen_bus import CanopenBusDecoder
from fieldtwin.capture.decoding.exchange import DecodedExchange
from fieldtwin.capture.decoding.tags import TagMap
from fieldtwin.capture.recordings.comparing import (
    MAX_DIFFERENCES,
    MAX_LATENCIES,
    Comparison,
    ReplyDifference,
    Rules,
    Tolerance,
    compare_latencies,
    pairs_of,
)
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.values import Scalar

TRANSFERS = ("SDO upload", "SDO download")
RARE = 5
"""The rates of a kind of message are compared only if there are at least this many messages of it."""
OFTEN = Tolerance(0.005, 0.5)
"""Permitted difference of the mean time between messages: 5 ms or 50 %, whichever is larger."""

Frames = Iterable[tuple[int, CanFrame]]
"""The frames of a log, each with its time: (time in ns, frame)."""


@dataclass(slots=True)
class _Kind:
    """The statistics of all messages of one kind of one node."""

    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    lengths: set[int] = field(default_factory=set)

    @property
    def period_s(self) -> float:
        return (self.last_ns - self.first_ns) / 1e9 / (self.count - 1) if self.count > 1 else 0.0


class _Side:
    """The content of one log: its transfers in order, and the kinds of messages, which are counted while the transfers are
    read.
    """

    def __init__(self, frames: Frames, nodes: frozenset[int], uploads: int) -> None:
        self.kinds: dict[tuple[int, str], _Kind] = {}
        self._frames, self._nodes, self._uploads = frames, nodes, uploads
        self._told = 0
        self.began_ns = -1

    def transfers(self) -> Iterator[DecodedExchange]:
        """Yield the transfers, once; afterwards `kinds` is complete."""
        wire = CanopenBusDecoder("can", ())
        for t_ns, frame in self._frames:
            self.began_ns = t_ns if self.began_ns < 0 else self.began_ns
            for done in wire.feed(frame, t_ns)[1]:
                yield from self._sorted(done)
        for done in wire.finish():
            yield from self._sorted(done)

    def _sorted(self, done: DecodedExchange) -> Iterator[DecodedExchange]:
        if self._nodes and done.unit not in self._nodes:
            return
        if done.service in TRANSFERS:
            if self._uploads < 0 or (done.service == TRANSFERS[0] and self._told < self._uploads):
                self._told += 1
                yield done
            return
        kind = self.kinds.setdefault((done.unit, done.service), _Kind(first_ns=done.t_ns))
        kind.count += 1
        kind.last_ns = done.t_ns
        if len(kind.lengths) < 9:
            kind.lengths.add(len(done.request))


def compare_logs(
    recorded: Frames,
    other: Frames,
    rules: Rules | None = None,
    *,
    profile: DeviceProfile | None = None,
    nodes: Iterable[int] = (),
    messages: bool = True,
    uploads: int = -1,
) -> Comparison:
    """Compare both logs for `nodes`, or for all nodes if it is empty.

    `messages`: also compare messages that were not requested. `uploads`: compare only the first `uploads` uploads; -1:
    all uploads and downloads.
    """
    rules = rules or Rules()
    tags = TagMap(profile) if profile is not None else None
    result = Comparison(least=rules.least)
    wanted = frozenset(nodes)
    sides = _Side(recorded, wanted, uploads), _Side(other, wanted, uploads)
    latencies: dict[str, tuple[array[float], array[float]]] = {}
    for one, two in pairs_of(sides[0].transfers(), sides[1].transfers(), _transfer):
        if one is None:
            result.extra += 1
            continue
        result.compared += 1
        if two is None:
            _differ(result, one, "missing", _outcome(one), "not asked")
            continue
        if _alike(one, two, rules, tags):
            result.alike += 1
        else:
            what = "abort" if one.abort != two.abort else "silence" if one.problem != two.problem else "value"
            _differ(result, one, what, _outcome(one), _outcome(two))
        if one.latency_ns is not None and two.latency_ns is not None:
            kept = latencies.setdefault(one.service, (array("d"), array("d")))
            if len(kept[0]) < MAX_LATENCIES:
                kept[0].append(one.latency_ns / 1e9)
                kept[1].append(two.latency_ns / 1e9)
    compare_latencies(result, latencies, rules)
    if messages:
        _compare_messages(sides[0].kinds, sides[1].kinds, rules, result)
    began_s = max(sides[0].began_ns, 0) / 1e9
    result.differences = [replace(d, t_s=d.t_s - began_s) for d in result.differences]
    return result


def _transfer(done: DecodedExchange) -> Hashable:
    return done.unit, done.service, done.spans, done.value if done.service == "SDO download" else None


def _alike(one: DecodedExchange, two: DecodedExchange, rules: Rules, tags: TagMap | None) -> bool:
    if one.abort != two.abort or one.problem != two.problem:
        return False
    if one.value == two.value:
        return True
    name, mine, theirs = _values(one, two, tags)
    if isinstance(mine, int | float) and isinstance(theirs, int | float):
        return rules.tags.get(name, rules.values).holds(mine, theirs)
    return mine == theirs


def _values(
    one: DecodedExchange, two: DecodedExchange, tags: TagMap | None
) -> tuple[str, Scalar | None, Scalar | None]:
    """Return the tag's name and its values on both sides.

    Without a tag, bytes with the length of a number become a number, lowest byte first.
    """
    span, found = one.spans[0], []
    for done in (one, two):
        value = done.value
        raw = bytes.fromhex(value) if isinstance(value, str) else None
        named = tags.of_object(span.address, span.subindex, raw, done.t_ns) if tags and raw is not None else {}
        if named:
            name, value = next(iter(named.items()))
            found.append((name, value))
        else:
            found.append(("", int.from_bytes(raw, "little") if raw is not None and len(raw) <= 8 else value))
    return found[0][0], found[0][1], found[1][1]


def _compare_messages(
    one: dict[tuple[int, str], _Kind], two: dict[tuple[int, str], _Kind], rules: Rules, result: Comparison
) -> None:
    for key in sorted({*one, *two}):
        mine, theirs = one.get(key), two.get(key)
        result.compared += 1
        if mine is not None and theirs is not None and _same_kind(mine, theirs, rules):
            result.alike += 1
            continue
        what = "missing" if theirs is None else "extra" if mine is None else "message"
        result.by_kind[what] = result.by_kind.get(what, 0) + 1
        if len(result.differences) < MAX_DIFFERENCES:
            result.differences.append(
                ReplyDifference(
                    (mine or theirs or _Kind()).first_ns / 1e9, key[0], key[1], what, "", _told(mine), _told(theirs)
                )
            )


def _same_kind(mine: _Kind, theirs: _Kind, rules: Rules) -> bool:
    if mine.lengths != theirs.lengths:
        return False
    if rules.latency is None or min(mine.count, theirs.count) < RARE:
        return True
    return OFTEN.holds(mine.period_s, theirs.period_s)


def _told(kind: _Kind | None) -> str:
    if kind is None:
        return "none"
    often = f", every {1000 * kind.period_s:.1f} ms" if kind.count >= RARE else ""
    return f"{kind.count} of {', '.join(map(str, sorted(kind.lengths)))} bytes{often}"


def _differ(result: Comparison, done: DecodedExchange, what: str, recorded: str, other: str) -> None:
    result.by_kind[what] = result.by_kind.get(what, 0) + 1
    if len(result.differences) < MAX_DIFFERENCES:
        where = str(done.spans[0]) if done.spans else ""
        result.differences.append(
            ReplyDifference(done.t_ns / 1e9, done.unit, done.service, what, where, recorded, other)
        )


def _outcome(done: DecodedExchange) -> str:
    if done.abort is not None:
        return f"abort {done.abort:08X}h"
    return done.problem or str(done.value if done.value is not None else "nothing")
