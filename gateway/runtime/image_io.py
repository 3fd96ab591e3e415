"""The gateway's side of the process image: it publishes inputs, reads outputs, and checks whether the PLC is alive.

`exchange` runs once per PLC cycle. It never waits: it reads the newest complete publication of the PLC, and
publishes one of the gateway.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.concurrency.events import Consumer
from fieldtwin.gateway.core.image.image import (
    INPUTS,
    OUTPUTS,
    Image,
    Message,
    Snapshot,
    TagKind,
    TagSpec,
    consumed_name,
    taken_name,
)
from fieldtwin.gateway.core.values import DATA, NEVER, Quality, Reason, Scalar, TagValue
from fieldtwin.gateway.runtime.tags import FOREVER_NS, TagTable

_BAD = Quality.BAD  # a local name, because looking up an Enum's members is slow


class ImageExchange:
    """The exchange with the PLC: publishes the region INPUTS from the tag table and the message queues, and reads OUTPUTS.

    `sources` are the queues of input messages by tag. The caller reads `outputs` (values by tag) and `new_messages` (by
    tag, in order) after each `exchange`, and sets `undelivered` to how many of the output messages it has not handled yet.
    """

    def __init__(self, image: Image, tags: TagTable, sources: Mapping[str, Consumer[DATA]]) -> None:
        self._writer = image.writer(INPUTS)
        self._reader = image.reader(OUTPUTS)
        self._tags = tags
        self._sources = dict(sources)
        self._queues = [source.queue for source in sources.values()]
        inputs = {region.name: region for region in image.layout.regions}[INPUTS]
        self._inputs = inputs.tags
        self._depth = {t.name: t.depth for t in self._inputs if t.kind is TagKind.MESSAGE}
        outputs = {region.name: region for region in image.layout.regions}[OUTPUTS]
        self._output_names = [t.name for t in outputs.tags if t.kind is not TagKind.MESSAGE]
        self._message_outputs = [t.name for t in outputs.tags if t.kind is TagKind.MESSAGE]
        self._consumed: dict[str, int] = {}
        self.undelivered: dict[str, int] = {}
        """By output message tag: how many messages that were read have not been handled yet."""
        self.outputs: dict[str, TagValue] = {}
        """The PLC's outputs by tag. Replaced by a new dictionary when a value or quality changes; until then, times stay
        unchanged.
        """
        self._seen: Snapshot | None = None
        self._taken = [
            (at, tag) for at, t in enumerate(inputs.tags) for tag in self._message_outputs if t.name == taken_name(tag)
        ]
        self._renewed = [at for at, _ in self._taken]
        self._columns = _Columns(inputs.tags, tags, self._renewed)
        self.new_messages: Mapping[str, tuple[Message, ...]] = {}
        self.plc_counter = 0
        self.plc_stopped = False
        self.plc_heard_ns = 0
        self._resume(image)

    def _resume(self, image: Image) -> None:
        """Continue after the last message that an earlier gateway process reported as taken."""
        before = image.reader(INPUTS).snapshot()
        for tag in self._message_outputs:
            taken = before.value(taken_name(tag)).value
            if isinstance(taken, int) and taken:
                self._reader.resume(tag, taken)

    def exchange(self, now_ns: int) -> None:
        """Read the PLC's outputs, then publish the inputs."""
        snapshot = self._hear()
        self.plc_stopped = snapshot.stopped
        self.new_messages = snapshot.messages
        if snapshot.counter and not self._seen_before(snapshot):
            self.outputs = {name: snapshot.value(name) for name in self._output_names}
            for tag in self._depth:
                value = self.outputs[consumed_name(tag)].value
                self._consumed[tag] = int(value) if value is not None else 0
        self._publish(now_ns)

    def _hear(self) -> Snapshot:
        """Return the PLC's last publication, and note its heartbeat."""
        snapshot = self._reader.snapshot()
        if snapshot.counter != self.plc_counter:
            self.plc_counter = snapshot.counter
            self.plc_heard_ns = snapshot.t_ns
        return snapshot

    def repeats_until(self, until_ns: int) -> bool:
        """Return whether each exchange before `until_ns` would read and publish what the last one did, apart from counters and
        times. See `fieldtwin.gateway.core.concurrency.cycle.Cycle`.
        """
        return (
            not self._tags.news
            and until_ns <= self._columns.earliest_ns
            and self._reader.repeats
            and self._writer.repeats
            and not self.plc_stopped
            and not self.new_messages
            and not any(self._queues)
        )

    def skip(self, count: int, last_ns: int) -> None:
        """Count exchanges that would have repeated the last one, and publish the last of them, which was at `last_ns`."""
        self._seen = self._hear()
        self._writer.skip(count, last_ns, self._renewed)

    def _seen_before(self, snapshot: Snapshot) -> bool:
        """Return whether values, qualities and reasons are the same as at the last call.

        Such snapshots share one list of values. Without this check, a run in virtual time with a scan each 10 ms takes 20 %
        longer.
        """
        before, self._seen = self._seen, snapshot
        return before is not None and snapshot.values is before.values

    def plc_age_ms(self, now_ns: int) -> float:
        """Return the milliseconds since the PLC last published; infinite if it never did."""
        return (now_ns - self.plc_heard_ns) / NS_PER_MS if self.plc_counter else float("inf")

    def last_published(self, tag: str) -> int:
        """Return the number of the last message of `tag` that was published."""
        return self._writer.last_sequence(tag)

    def consumed(self, tag: str) -> int:
        """Return the number of the last message of `tag` that the PLC has consumed."""
        return self._consumed.get(tag, 0)

    def all_consumed(self, tag: str) -> bool:
        """Return whether the PLC has consumed every message of `tag` that was published; always False if no program reads this
        tag.
        """
        return tag in self._depth and self._consumed.get(tag, 0) >= self._writer.last_sequence(tag)

    def _publish(self, now_ns: int) -> None:
        messages: dict[str, list[tuple[int, bytes]]] = {}
        for tag, source in self._sources.items():
            if tag not in self._depth:
                source.queue.clear()
                continue
            if not source.queue:
                continue
            room = self._depth[tag] - (self._writer.last_sequence(tag) - self._consumed.get(tag, 0))
            batch = [(now_ns, source.consume().data) for _ in range(min(max(room, 0), len(source.queue)))]
            if batch:
                messages[tag] = batch
        columns = self._columns
        columns.refresh(now_ns)
        for at, tag in self._taken:
            taken = self._reader.seen(tag)
            if tag in self.undelivered:  # messages that were read just now are handled later
                taken -= self.undelivered[tag] + len(self.new_messages.get(tag, ()))
            columns.put(at, taken, now_ns)
        self._writer.publish_mixed(
            columns.values,
            columns.qualities,
            columns.reasons,
            columns.times_ns,
            now_ns,
            messages,
            same=not columns.changed,
        )
        columns.changed = False


class _Columns:
    """The values, qualities, reasons and times of INPUTS, as lists in the order of its tags.

    Only values that are new, or that may have become stale, are looked up again in the tag table.
    """

    def __init__(self, specs: Sequence[TagSpec], tags: TagTable, others: Container[int]) -> None:
        """Create the lists. `others` are the positions of tags that are not in the tag table; `put` sets them."""
        self._tags = tags
        self._index = {s.name: at for at, s in enumerate(specs) if s.kind is not TagKind.MESSAGE and at not in others}
        self.values: list[Scalar | None] = [0 if s.kind is TagKind.MESSAGE else None for s in specs]
        self.qualities = bytearray([Quality.GOOD if s.kind is TagKind.MESSAGE else Quality.BAD for s in specs])
        self.reasons = bytearray([Reason.NONE if s.kind is TagKind.MESSAGE else NEVER.reason for s in specs])
        self.times_ns = [0] * len(specs)
        self.changed = True
        """Whether values, qualities or reasons may differ from those published last; the publisher resets it."""
        self.earliest_ns = -1
        """No tag becomes stale before this time; it may be earlier than the first one that does."""

    def refresh(self, now_ns: int) -> None:
        """Copy the tag table's new values, and mark those that became stale by `now_ns`."""
        news = self._tags.take_changes()
        if now_ns > self.earliest_ns:
            self.earliest_ns = FOREVER_NS
            for name, at in self._index.items():
                held = self._tags.entry(name)
                if held is None:
                    self._set(at, NEVER, FOREVER_NS)
                else:
                    self._set(at, held.as_of(now_ns), held.fresh_until_ns)
            return
        for held in news:
            place = self._index.get(held.name)
            if place is not None:
                self._set(place, held.as_of(now_ns), held.fresh_until_ns)

    def _set(self, at: int, value: TagValue, until_ns: int) -> None:
        self.times_ns[at] = value.t_ns
        self.values[at] = value.value
        self.qualities[at] = value.quality
        self.reasons[at] = value.reason
        self.changed = True
        if until_ns < self.earliest_ns and value.quality is not _BAD:
            self.earliest_ns = until_ns

    def put(self, at: int, value: int, now_ns: int) -> None:
        """Set the number at position `at`, which the exchange itself provides. Its quality is good."""
        self.times_ns[at] = now_ns
        if self.values[at] != value:
            self.values[at] = value
            self.qualities[at], self.reasons[at] = Quality.GOOD, Reason.NONE
            self.changed = True
