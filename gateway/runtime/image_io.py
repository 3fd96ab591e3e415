"""The gateway's side of the process image: tags and messages in, outputs and messages out, and is the PLC alive.

`exchange` runs once a PLC cycle. It never waits: it reads the newest whole publication of the PLC and leaves one of its own.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence

from gateway.core.clock import NS_PER_MS
from gateway.core.events import Consumer
from gateway.core.image import INPUTS, OUTPUTS, Image, Message, TagKind, TagSpec, consumed_name, taken_name
from gateway.core.values import DATA, NEVER, Quality, Reason, Scalar, TagValue
from gateway.runtime.tags import FOREVER_NS, TagTable


class ImageExchange:
    """Publishes INPUTS from the tag table and the message queues; hands on OUTPUTS.

    `sources` are the queues of input messages by tag. Whoever uses this reads `outputs` (values by tag) and `new_messages`
    (by tag, in order) after each `exchange`, and tells through `taken` how far each output message was dealt with.
    """

    def __init__(self, image: Image, tags: TagTable, sources: Mapping[str, Consumer[DATA]]) -> None:
        self._writer = image.writer(INPUTS)
        self._reader = image.reader(OUTPUTS)
        self._tags = tags
        self._sources = dict(sources)
        inputs = {region.name: region for region in image.layout.regions}[INPUTS]
        self._inputs = inputs.tags
        self._depth = {t.name: t.depth for t in self._inputs if t.kind is TagKind.MESSAGE}
        outputs = {region.name: region for region in image.layout.regions}[OUTPUTS]
        self._output_names = [t.name for t in outputs.tags if t.kind is not TagKind.MESSAGE]
        self._message_outputs = [t.name for t in outputs.tags if t.kind is TagKind.MESSAGE]
        self._consumed: dict[str, int] = {}
        self.untaken: dict[str, int] = {}
        """By output message tag: how many messages that were read have not been dealt with yet."""
        self.outputs: dict[str, TagValue] = {}
        """Made anew when a value or quality changed: times are those of that change."""
        self._seen: tuple[object, ...] = ()
        self._taken = [
            (at, tag) for at, t in enumerate(inputs.tags) for tag in self._message_outputs if t.name == taken_name(tag)
        ]
        self._columns = _Columns(inputs.tags, tags, {at for at, _ in self._taken})
        self.new_messages: Mapping[str, tuple[Message, ...]] = {}
        self.plc_counter = 0
        self.plc_stopped = False
        self._plc_heard_ns = 0
        self._resume(image)

    def _resume(self, image: Image) -> None:
        """A restarted gateway goes on behind the last message that its predecessor said it had taken."""
        before = image.reader(INPUTS).snapshot()
        for tag in self._message_outputs:
            taken = before.value(taken_name(tag)).value
            if isinstance(taken, int) and taken:
                self._reader.resume(tag, taken)

    def exchange(self, now_ns: int) -> None:
        """Read the PLC's outputs, then publish the inputs."""
        snapshot = self._reader.snapshot()
        if snapshot.counter != self.plc_counter:
            self.plc_counter = snapshot.counter
            self._plc_heard_ns = snapshot.t_ns
        self.plc_stopped = snapshot.stopped
        self.new_messages = snapshot.messages
        seen = snapshot.values, snapshot.qualities, snapshot.reasons
        if snapshot.counter and seen != self._seen:
            self._seen = seen
            self.outputs = {name: snapshot.value(name) for name in self._output_names}
            for tag in self._depth:
                value = self.outputs[consumed_name(tag)].value
                self._consumed[tag] = int(value) if value is not None else 0
        self._publish(now_ns)

    def plc_age_ms(self, now_ns: int) -> float:
        """Milliseconds since the PLC last published; infinite when it never did."""
        return (now_ns - self._plc_heard_ns) / NS_PER_MS if self.plc_counter else float("inf")

    def all_consumed(self, tag: str) -> bool:
        """True when the PLC has consumed every message of `tag` that it was given; never where no program takes them."""
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
            columns.put(at, self._reader.seen(tag) - self.untaken.get(tag, 0), now_ns)
        self._writer.publish_mixed(
            columns.values, columns.qualities, columns.reasons, columns.times_ns, now_ns, messages
        )


class _Columns:
    """INPUTS as the tag table has them: only what changed, or may have grown stale, is looked up again."""

    def __init__(self, specs: Sequence[TagSpec], tags: TagTable, others: Container[int]) -> None:
        """`others`: the places of what the exchange itself puts."""
        self._tags = tags
        self._index = {s.name: at for at, s in enumerate(specs) if s.kind is not TagKind.MESSAGE and at not in others}
        self.values: list[Scalar | None] = [0 if s.kind is TagKind.MESSAGE else None for s in specs]
        self.qualities = bytearray([Quality.GOOD if s.kind is TagKind.MESSAGE else Quality.BAD for s in specs])
        self.reasons = bytearray([Reason.NONE if s.kind is TagKind.MESSAGE else NEVER.reason for s in specs])
        self.times_ns = [0] * len(specs)
        self._until_ns = [FOREVER_NS] * len(specs)
        self._earliest_ns = -1

    def refresh(self, now_ns: int) -> None:
        """What is new in the table, and what grew stale by `now_ns`."""
        names: Iterable[str] = self._tags.take_news()
        if now_ns > self._earliest_ns:
            names = self._index
        elif not names:
            return
        for name in names:
            at = self._index.get(name)
            if at is None:
                continue
            value = self._tags.current(name, now_ns)
            self.values[at] = value.value
            self.qualities[at] = value.quality
            self.reasons[at] = value.reason
            self.times_ns[at] = value.t_ns
            until_ns = self._tags.fresh_until_ns(name)
            self._until_ns[at] = FOREVER_NS if value.quality is Quality.BAD else until_ns
        self._earliest_ns = min(self._until_ns, default=FOREVER_NS)

    def put(self, at: int, value: int, now_ns: int) -> None:
        """A number of the exchange's own."""
        self.values[at], self.times_ns[at] = value, now_ns
        self.qualities[at], self.reasons[at] = Quality.GOOD, Reason.NONE
