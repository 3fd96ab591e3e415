"""A Sparkplug B edge node (Eclipse Sparkplug 3.0.0) whose devices are those of a system.

| message | contents |
|---|---|
| NBIRTH, NDATA | the variables of programs, as PROGRAM/VARIABLE |
| DBIRTH, DDATA | the tags of a device |
| DDEATH | the device does not answer: all its tags are bad, for a reason in `AWAY` |
| NDEATH | the session has ended; the broker publishes it if the connection is lost |

Samples that waited when their device was born are marked historical.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.northbound.mqtt.backlog import Backlog, Entry
from fieldtwin.northbound.mqtt.publication import MOST_ENTRIES, UNKNOWN, Batch, Publication, WriteRequest
from fieldtwin.northbound.mqtt.served_tags import ServedTag
from fieldtwin.northbound.mqtt.sparkplug_metrics import metric_name, metric_of, properties_of
from fieldtwin.twin.site.servers.serving_mqtt import SparkplugConfig
from fieldtwin.twin.thread.mqtt.message import MqttMessage
from fieldtwin.twin.thread.sparkplug_payloads import (
    Metric,
    MetricType,
    Payload,
    decode_payload,
    encode_payload,
    host_state,
    state_topic,
    topic,
)

NODE = ""
"""The key of the node itself among the devices."""
BD_SEQ, REBIRTH = "bdSeq", "Node Control/Rebirth"
AWAY = frozenset(
    (
        Reason.NEVER_READ, Reason.TIMEOUT, Reason.UNREACHABLE, Reason.STALE, Reason.HEARTBEAT_LOST, Reason.WRONG_DEVICE,
        Reason.GATEWAY_DEAD,
    )
)  # fmt: skip
"""The reasons of a bad value that say that the device does not answer, or was not asked yet."""


class SparkplugPublication(Publication):
    """The messages of an edge node. `config` names group, node and primary host application."""

    def __init__(self, config: SparkplugConfig, tags: Iterable[ServedTag], backlog: Backlog, now_ms: int) -> None:
        super().__init__(tags, backlog, now_ms)
        self._config = config
        self._aliases = {name: number for number, name in enumerate(self.tags, 1)}
        self._by_alias = {number: name for name, number in self._aliases.items()}
        self._tags_of: dict[str, list[ServedTag]] = {NODE: []}
        for tag in self.tags.values():
            self._tags_of.setdefault(tag.device, []).append(tag)
        self._state = state_topic(config.host) if config.host else ""
        commands = (self._topic("NCMD"), self._topic("DCMD", "+"))
        self.subscriptions = (*commands, self._state) if self._state else commands
        self._seq = self._bd_seq = 0
        self._born: dict[str, int] = {}
        """Each device that is born in this session (`NODE` for the node), with the last entry that its birth made historical."""
        self._host_online = not config.host
        self._host_ms = 0
        """The time of the host application's latest state; an older state is ignored."""
        self._must_end = False

    @property
    def place(self) -> str:
        """Return group and node."""
        return f"Sparkplug {self._config.group}/{self._config.node}"

    @property
    def is_ready(self) -> bool:
        """Return whether the primary host application is online."""
        return self._host_online

    @property
    def must_end(self) -> bool:
        """Return whether the primary host application went offline after the node's birth."""
        return self._must_end

    def begin(self, bd_seq: int, now_ms: int) -> MqttMessage:
        self._bd_seq = bd_seq & 0xFF
        self._born.clear()
        self._needs_all = True
        self._must_end = False
        self._host_online = not self._config.host
        return MqttMessage(
            self._topic("NDEATH"), encode_payload(Payload(now_ms, (self._bd_seq_metric(now_ms),))), qos=1
        )

    def _bd_seq_metric(self, now_ms: int) -> Metric:
        return Metric(BD_SEQ, None, now_ms, MetricType.INT64, self._bd_seq)

    def _topic(self, kind: str, device: str = "") -> str:
        if device == "+":  # a subscription to the commands of all devices
            return f"{topic(self._config.group, kind, self._config.node)}/+"
        return topic(self._config.group, kind, self._config.node, device)

    def _message(self, kind: str, metrics: Sequence[Metric], now_ms: int, device: str = NODE) -> MqttMessage:
        seq, self._seq = self._seq, (self._seq + 1) & 0xFF
        return MqttMessage(self._topic(kind, device), encode_payload(Payload(now_ms, tuple(metrics), seq)))

    def next_batch(self, now_ms: int) -> Batch | None:
        """Return births and deaths first, then the samples of each device that is born."""
        if self._needs_all:
            return self._births(now_ms)
        for device in self._devices():
            if self._is_away(device) == (device in self._born):
                return self._death(device, now_ms) if device in self._born else self._device_birth(device, now_ms)
        for device in self._born:
            if entries := self.backlog.first(device, MOST_ENTRIES):
                return self._data(device, entries, now_ms)
        return self._births(now_ms) if self.has_lost else None

    def _devices(self) -> list[str]:
        return [device for device in self._tags_of if device != NODE]

    def _is_away(self, device: str) -> bool:
        latest = (self.latest[tag.name] for tag in self._tags_of[device])
        return all(entry.quality is Quality.BAD and entry.reason in AWAY for entry in latest)

    def _births(self, now_ms: int) -> Batch:
        """Return the births of the node and of every device that answers."""
        self._all_published()
        self._seq = 0
        self._born.clear()
        self.counters["births"] += 1
        own, entries = self._born_metrics(NODE, now_ms)
        first = (self._bd_seq_metric(now_ms), Metric(REBIRTH, None, now_ms, MetricType.BOOLEAN, 0))
        messages = [self._message("NBIRTH", (*first, *own), now_ms)]
        for device in self._devices():
            if not self._is_away(device):
                batch = self._device_birth(device, now_ms)
                messages += batch.messages
                entries += batch.entries
        return Batch(messages, entries)

    def _device_birth(self, device: str, now_ms: int) -> Batch:
        metrics, entries = self._born_metrics(device, now_ms)
        return Batch([self._message("DBIRTH", metrics, now_ms, device)], entries)

    def _born_metrics(self, device: str, now_ms: int) -> tuple[list[Metric], list[Entry]]:
        """Return metrics and entries of a birth. The entries that wait for the device are historical from now on."""
        self._born[device] = self.backlog.last
        entries = [self.latest[tag.name] for tag in self._tags_of[device]]
        metrics = [
            metric_of(
                entry, self._aliases[entry.tag.name], name=metric_name(entry.tag), properties=properties_of(entry)
            )
            for entry in entries
        ]
        return metrics, entries

    def _death(self, device: str, now_ms: int) -> Batch:
        del self._born[device]
        return Batch([self._message("DDEATH", (), now_ms, device)])

    def _data(self, device: str, entries: list[Entry], now_ms: int) -> Batch:
        metrics = [
            metric_of(entry, self._aliases[entry.tag.name], historical=entry.number <= self._born[device])
            for entry in entries
        ]
        return Batch([self._message("DDATA" if device else "NDATA", metrics, now_ms, device)], entries)

    def receive(self, topic: str, payload: bytes) -> list[WriteRequest]:
        if topic == self._state:
            self._take_state(payload)
            return []
        metrics = decode_payload(payload).metrics
        device = "" if topic == self.subscriptions[0] else topic.rpartition("/")[2]
        if not device and any(metric.name == REBIRTH and metric.value for metric in metrics):
            self._needs_all = True
        return [self._request(metric, device) for metric in metrics if metric.name != REBIRTH]

    def _take_state(self, payload: bytes) -> None:
        """Take a state of the primary host application (3.0.0, 5.4 and 5.5). An older state than the latest one is ignored."""
        state = host_state(payload)
        if state is None or state.t_ms < self._host_ms:
            return
        self._host_ms = state.t_ms
        self._must_end = bool(self._born) and not state.online
        self._host_online = state.online

    def _request(self, metric: Metric, device: str) -> WriteRequest:
        """Return the write that a metric of a command requests."""
        name = self._by_alias.get(metric.alias or 0, f"{device}.{metric.name}" if device else metric.name)
        tag = self.tags.get(name)
        if tag is None or tag.device != device or not device:
            return WriteRequest(UNKNOWN, None, "the command names no tag of a device")
        if not self._config.writes:
            return WriteRequest(name, None, "the server does not accept commands (`writes: true`)")
        value = metric.value
        if isinstance(value, int) and tag.data_type in ("SByte", "Int16", "Int32") and value >> 31 == 1:
            value -= 1 << 32  # a command need not have a type, without which the decoder does not know the sign
        if not isinstance(value, int | float):
            return WriteRequest(name, None, "only numbers can be written")
        return WriteRequest(name, float(value))
