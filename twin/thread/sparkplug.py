"""A thread as Sparkplug B: the physical twin is an edge node, the digital twin a host application.

| frame | from the edge node | from the host |
|---|---|---|
| HELLO | NBIRTH, every tag with its alias | NCMD, in the metric `fieldtwin/frame` |
| DATA | NDATA, a metric per event, marked historical when it is late | NCMD, a metric per command |
| ASK | NDATA, `fieldtwin/frame` | NCMD, `Node Control/Rebirth`, which any host may send |
| ACK, LOST, REFUSED | NDATA, `fieldtwin/frame` | NCMD, `fieldtwin/frame` |

A third-party host therefore sees tags with values, times and quality; three more metrics turn them into a log. Commands
of a host that does not use threads have no number and are ignored, except for a rebirth.

This module converts frames to messages and back; it does not connect to a broker.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from fieldtwin.gateway.core.errors import Desync
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.store.event import Event, Value
from fieldtwin.twin.site.system import System
from fieldtwin.twin.thread.frames import Ask, Data, Frame, FrameCodec, Hello, Schema
from fieldtwin.twin.thread.mqtt.message import MqttMessage
from fieldtwin.twin.thread.sparkplug_payloads import (
    BAD_QUALITY,
    GOOD_QUALITY,
    Metric,
    MetricType,
    Payload,
    Property,
    decode_payload,
    encode_payload,
    host_state,
    state_topic,
    topic,
    type_of,
)

SEQUENCE, TAG, FRAME = "fieldtwin/sequence", "fieldtwin/tag", "fieldtwin/frame"
OURS = (SEQUENCE, TAG, FRAME)
OUR_TYPES = {SEQUENCE: MetricType.INT64, TAG: MetricType.BYTES, FRAME: MetricType.BYTES}
REBIRTH = "Node Control/Rebirth"
BD_SEQ = "bdSeq"
JUDGED = "fieldtwin"
"""Property of a metric: kind, quality and reason of the event, one byte each."""
HISTORICAL_MS = 10_000
"""An event that is older than this when it is sent is marked historical: a host stores it and does not show it as current."""
MAX_EVENTS = 250
MAX_BYTES = 60_000


def types_of(system: System) -> dict[str, MetricType]:
    """Return the metric type with which the birth message announces each tag."""

    def kind(tag: Tag) -> MetricType:
        return MetricType.STRING if tag.is_text else MetricType.INT64 if tag.is_integer else MetricType.DOUBLE

    return {f"{d.name}.{t.name}": kind(t) for d in system.devices.values() for t in d.profile.tags.values()}


def metric_of(event: Event, now_ms: int, types: Mapping[str, MetricType], aliases: Mapping[str, int]) -> Metric:
    """Return an event as a metric. The metric contains its type only if it differs from the announced one."""
    announced = types.get(event.name, MetricType.DOUBLE)
    needed = announced if event.value is None else type_of(event.value)
    alias = aliases.get(event.name)
    properties: tuple[tuple[str, Property], ...] = ()
    judged = event.kind << 16 | event.quality << 8 | event.reason
    if judged:
        properties = (("Quality", BAD_QUALITY if event.quality else GOOD_QUALITY), (JUDGED, judged))
    return Metric(
        name="" if alias is not None else event.name,
        alias=alias,
        t_ms=event.t_ms,
        datatype=0 if needed == announced and alias is not None else needed,
        value=event.value,
        historical=now_ms - event.t_ms > HISTORICAL_MS,
        properties=properties,
    )


def event_of(metric: Metric, sequence: int, names: Mapping[int, str], types: Mapping[str, MetricType]) -> Event:
    """Return the original event, unchanged. Raises `Desync` for an alias that no birth announced."""
    name = metric.name or names.get(-1 if metric.alias is None else metric.alias, "")
    if not name:
        raise Desync("a metric without a name", expected="an alias of the last birth", got=str(metric.alias))
    held = dict(metric.properties).get(JUDGED, 0)
    judged = held if isinstance(held, int) else 0
    value = metric.value
    if (metric.datatype or types.get(name)) in (MetricType.FLOAT, MetricType.DOUBLE) and isinstance(value, int):
        value = float(value)
    return Event(sequence, metric.t_ms, judged >> 16 & 7, name, value, judged >> 8 & 7, judged & 31)


class _Side:
    """The base class of `EdgeNode` and `HostApplication`."""

    def __init__(self) -> None:
        self._codec = FrameCodec((), 1400)
        self.not_taken = 0
        """Number of messages that do not belong to a thread."""

    def fit(self, events: Sequence[Event]) -> int:
        """Return how many events one message takes; at least one."""
        size = 0
        for count, event in enumerate(events[:MAX_EVENTS]):
            size += 64 + (len(event.value) * 4 if isinstance(event.value, str | bytes) else 0)
            if size > MAX_BYTES:
                return max(1, count)
        return min(len(events), MAX_EVENTS)

    def _control(self, frame: Frame, now_ms: int, alias: int | None) -> Metric:
        (data,) = self._codec.encode(frame)
        return Metric("" if alias is not None else FRAME, alias, now_ms, MetricType.BYTES, data)

    def _data_frame(
        self, metrics: Sequence[Metric], names: Mapping[int, str], types: Mapping[str, MetricType]
    ) -> Frame | None:
        """Return the frame in a message; None if it does not belong to a thread."""
        ours = {
            name: m.value for m in metrics if (name := m.name or names.get(-1 if m.alias is None else m.alias)) in OURS
        }
        frame, tag, sequence = ours.get(FRAME), ours.get(TAG), ours.get(SEQUENCE)
        if isinstance(frame, bytes):
            return self._codec.decode(frame)
        if not isinstance(tag, bytes) or not isinstance(sequence, int):
            self.not_taken += 1
            return None
        rest = [m for m in metrics if (m.name or names.get(-1 if m.alias is None else m.alias)) not in OURS]
        try:
            return Data(tag, tuple(event_of(m, sequence + i, names, types) for i, m in enumerate(rest)))
        except Desync:
            return Data(tag, ())  # this side did not receive the birth message, and will request one


class EdgeNode(_Side):
    """The physical twin's side.

    Each link needs a new object. `began_ms` is the time (UTC) at which the link began; `bd_seq` numbers the birth and death
    messages of the link and is one higher for each link.
    """

    def __init__(
        self,
        group: str,
        node: str,
        host: str,
        schema: Schema,
        types: Mapping[str, MetricType],
        bd_seq: int,
        began_ms: int = 0,
    ) -> None:
        super().__init__()
        self.subscriptions = (topic(group, "NCMD", node), state_topic(host))
        self._group, self._node, self._state = group, node, state_topic(host)
        self._types = {
            **dict.fromkeys(schema.names, MetricType.DOUBLE),
            **{n: t for n, t in types.items() if n in schema.names},
            **OUR_TYPES,
        }
        self._aliases = {name: i for i, name in enumerate((*schema.names, *OURS), 1)}
        self._bd_seq = bd_seq & 0xFF
        self._began_ms = began_ms
        self._seq = 0
        self._tag = b""

    def will(self) -> MqttMessage:
        """Return the NDEATH, which the broker publishes if this side is lost; this side publishes it before it leaves
        by itself.
        """
        bd = Metric(BD_SEQ, None, self._began_ms, MetricType.INT64, self._bd_seq)
        return MqttMessage(
            topic(self._group, "NDEATH", self._node), encode_payload(Payload(self._began_ms, (bd,))), qos=1
        )

    def hello(self) -> list[MqttMessage]:
        """Return the messages to publish when the link is established: none, because the birth follows with the HELLO."""
        return []

    def messages(self, frame: Frame, now_ms: int) -> list[MqttMessage]:
        if isinstance(frame, Hello):
            self._tag = frame.tag
            self._seq = 0
            return [self._publish("NBIRTH", self._birth(frame, now_ms), now_ms)]
        if isinstance(frame, Data):
            head = (
                Metric(alias=self._aliases[TAG], t_ms=now_ms, value=frame.tag),
                Metric(alias=self._aliases[SEQUENCE], t_ms=now_ms, value=frame.events[0].sequence),
            )
            rest = tuple(metric_of(e, now_ms, self._types, self._aliases) for e in frame.events)
            return [self._publish("NDATA", head + rest, now_ms)]
        return [self._publish("NDATA", (self._control(frame, now_ms, self._aliases[FRAME]),), now_ms)]

    def _birth(self, hello: Hello, now_ms: int) -> tuple[Metric, ...]:
        first = (
            Metric(BD_SEQ, None, now_ms, MetricType.INT64, self._bd_seq),
            Metric(REBIRTH, None, now_ms, MetricType.BOOLEAN, 0),
        )
        tags = tuple(
            Metric(name, alias, now_ms, self._types[name], None)
            for name, alias in self._aliases.items()
            if name not in OURS
        )
        (frame,) = self._codec.encode(hello)
        values: dict[str, Value] = {SEQUENCE: hello.last, TAG: hello.tag, FRAME: frame}
        return first + tags + tuple(Metric(n, self._aliases[n], now_ms, OUR_TYPES[n], values[n]) for n in OURS)

    def _publish(self, kind: str, metrics: tuple[Metric, ...], now_ms: int) -> MqttMessage:
        seq, self._seq = self._seq, (self._seq + 1) & 0xFF
        return MqttMessage(topic(self._group, kind, self._node), encode_payload(Payload(now_ms, metrics, seq)))

    def frame(self, where: str, data: bytes) -> Frame | None:
        """Return the frame in a message: a frame of the host's thread, or an ASK after a rebirth or when the host comes
        online. Raises `Desync`.
        """
        if where == self._state:
            there = host_state(data)
            return Ask(self._tag) if there is not None and there.online and self._tag else None
        metrics = decode_payload(data).metrics
        if any(m.name == REBIRTH and m.value for m in metrics):
            return Ask(self._tag) if self._tag else None
        return self._data_frame(metrics, {}, {})


class HostApplication(_Side):
    """The digital twin's side: host `host` of one edge node.

    Each link needs a new object. `began_ms` is the time (UTC) at which the link began; the birth and the death message of a
    session both carry it (Sparkplug 3.0.0, 6.4.27).
    """

    def __init__(self, group: str, node: str, host: str, began_ms: int = 0) -> None:
        super().__init__()
        self.subscriptions = tuple(topic(group, kind, node) for kind in ("NBIRTH", "NDATA", "NDEATH"))
        self.alive = False
        """Whether the edge node has sent its birth message, and no death message (NDEATH) has arrived since."""
        self.missed = 0
        """Number of messages that are missing according to `seq`."""
        self._group, self._node, self._state = group, node, state_topic(host)
        self._began_ms = began_ms
        self._names: dict[int, str] = {}
        self._types: dict[str, MetricType] = {}
        self._seq = -1
        self._bd_seq: int | None = None
        self._tag = b""

    def _says(self, online: bool) -> MqttMessage:
        state = {"online": online, "timestamp": self._began_ms}
        return MqttMessage(self._state, json.dumps(state, separators=(",", ":")).encode(), qos=1, retain=True)

    def will(self) -> MqttMessage:
        """Return the message that the broker publishes if this side is lost."""
        return self._says(online=False)

    def hello(self) -> list[MqttMessage]:
        """Return the messages to publish when the link is established: that this host is online, and a request for a rebirth."""
        return [self._says(online=True), self._rebirth(self._began_ms)]

    def _rebirth(self, now_ms: int) -> MqttMessage:
        return self._publish((Metric(REBIRTH, None, now_ms, MetricType.BOOLEAN, 1),), now_ms)

    def _publish(self, metrics: tuple[Metric, ...], now_ms: int) -> MqttMessage:
        return MqttMessage(topic(self._group, "NCMD", self._node), encode_payload(Payload(now_ms, metrics)))

    def messages(self, frame: Frame, now_ms: int) -> list[MqttMessage]:
        if isinstance(frame, Ask):
            return [self._rebirth(now_ms)]
        if isinstance(frame, Data):
            head = (
                Metric(TAG, None, now_ms, MetricType.BYTES, frame.tag),
                Metric(SEQUENCE, None, now_ms, MetricType.INT64, frame.events[0].sequence),
            )
            return [self._publish(head + tuple(metric_of(e, now_ms, {}, {}) for e in frame.events), now_ms)]
        return [self._publish((self._control(frame, now_ms, None),), now_ms)]

    def frame(self, where: str, data: bytes) -> Frame | None:
        """Return the frame in a message of the edge node, if any. Raises `Desync`."""
        payload = decode_payload(data)
        if where == self.subscriptions[2]:
            died = next((m.value for m in payload.metrics if m.name == BD_SEQ), None)
            self.alive = self.alive and died != self._bd_seq
            return None
        if payload.seq is not None:
            self.missed += self._seq >= 0 and payload.seq != (self._seq + 1) & 0xFF and where != self.subscriptions[0]
            self._seq = payload.seq
        if where == self.subscriptions[0]:
            return self._born(payload)
        self.alive = self.alive or bool(self._names)
        return self._data_frame(payload.metrics, self._names, self._types)

    def _born(self, payload: Payload) -> Frame | None:
        self.alive = True
        by_name = {m.name: m.value for m in payload.metrics}
        bd_seq, frame = by_name.get(BD_SEQ), by_name.get(FRAME)
        self._bd_seq = bd_seq if isinstance(bd_seq, int) else None
        self._names = {m.alias: m.name for m in payload.metrics if m.alias is not None}
        known = MetricType._value2member_map_
        self._types = {m.name: MetricType(m.datatype) for m in payload.metrics if m.datatype in known}
        return self._codec.decode(frame) if isinstance(frame, bytes) else None
