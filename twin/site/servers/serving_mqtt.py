"""The servers of kind `mqtt` in the `serve` section of a system file, resolved: the broker, and what is published there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from string import Formatter

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile
from fieldtwin.twin.site.serve_forms import JsonTopicsForm, MqttServeForm, SparkplugForm
from fieldtwin.twin.site.servers.broker_url import BrokerUrl, parse_broker_url

URL = "mqtt://[USER@]HOST[:PORT], or mqtts:// with TLS"
PER_TAG = ("system", "device", "tag")
"""The names that the topic of a tag may contain in braces."""
PER_SYSTEM = ("system",)
"""The names that the topic of the status may contain in braces."""


@dataclass(frozen=True)
class SparkplugConfig:
    """A Sparkplug edge node. It publishes only while the host application `host` is online; "" if it waits for no host."""

    group: str
    node: str
    host: str = ""
    writes: bool = False


@dataclass(frozen=True)
class JsonConfig:
    """Messages in JSON: the topic of a tag and the topic of the server's status, both as templates."""

    topic: str
    status: str
    retain: bool = True
    qos: int = 1
    interval: bool = False
    """Whether every tag is published in each interval, not only when it changes."""
    history: bool = False
    """Whether values that changed while the broker was not connected are published later."""


@dataclass(frozen=True)
class MqttServeConfig:
    """The configuration of one server of kind `mqtt`. Exactly one of `sparkplug` and `json` is set."""

    name: str
    broker: BrokerUrl
    sparkplug: SparkplugConfig | None = None
    json: JsonConfig | None = None
    every_ms: int = 1000
    buffer_samples: int = 10_000
    buffer_bytes: int = 4096 * 1024
    prototype: bool = False
    """Whether the server belongs to a prototype, whose topics differ from those of the plant."""
    kind: str = "mqtt"

    @property
    def url(self) -> str:
        """Return the address of the broker."""
        return str(self.broker)

    @property
    def place(self) -> str:
        """Return what the server publishes, in a few words."""
        if self.sparkplug is not None:
            return f"Sparkplug edge node {self.sparkplug.group}/{self.sparkplug.node}"
        assert self.json is not None
        return f"JSON on {self.json.topic}"

    def for_prototype(self) -> MqttServeConfig:
        """Return the same server as a prototype runs it: its topics differ from those of the plant."""
        return replace(self, prototype=True)


def resolve_mqtt(file: YamlFile, name: str, form: MqttServeForm) -> MqttServeConfig:
    """Resolve and check one server. Raises `FileInvalid` with the place of the error."""
    loc: tuple[Key, ...] = ("serve", name)
    if (form.sparkplug is None) == (form.json_topics is None):
        raise file.error(loc, "the server does not know what to publish", expected="either `sparkplug` or `json`")
    try:
        broker = parse_broker_url(form.url, URL)
        if broker.path:
            raise UsageError("the URL of a broker has no path here", expected=URL, got=form.url)
    except UsageError as e:
        raise file.error((*loc, "url"), e.message, expected=e.expected, got=e.got, hint=e.hint) from e
    folder = Path(file.path).resolve().parent
    files = {key: str(folder / value) for key, value in broker.files.items()}
    return MqttServeConfig(
        name,
        replace(broker, files=files),
        _sparkplug(file, (*loc, "sparkplug"), form.sparkplug) if form.sparkplug is not None else None,
        _json(file, (*loc, "json"), form.json_topics) if form.json_topics is not None else None,
        form.every_ms,
        form.buffer_samples,
        form.buffer_kb * 1024,
    )


def _sparkplug(file: YamlFile, loc: tuple[Key, ...], form: SparkplugForm) -> SparkplugConfig:
    config = SparkplugConfig(form.group, form.node or str(file.data["system"]), form.host or "", form.writes)
    for key, text in (("group", config.group), ("node", config.node), ("host", config.host)):
        if any(c in text for c in "+#/") or not text.isprintable():
            raise file.error((*loc, key), "a name in Sparkplug", expected="a word without + # /", got=repr(text))
    return config


def _json(file: YamlFile, loc: tuple[Key, ...], form: JsonTopicsForm) -> JsonConfig:
    _check_topic(file, (*loc, "topic"), form.topic, PER_TAG, required=("device", "tag"))
    _check_topic(file, (*loc, "status"), form.status, PER_SYSTEM)
    return JsonConfig(form.topic, form.status, form.retain, form.qos, form.publish == "interval", form.history)


def _check_topic(
    file: YamlFile, loc: tuple[Key, ...], text: str, known: tuple[str, ...], required: tuple[str, ...] = ()
) -> None:
    """Raise `FileInvalid` if a template is not the topic of a message (MQTT 4.7), or names something unknown in braces."""
    expected = "a topic that may contain " + ", ".join(f"{{{name}}}" for name in known)
    try:
        parts = [
            (field, spec, conversion) for _, field, spec, conversion in Formatter().parse(text) if field is not None
        ]
    except ValueError as e:
        raise file.error(loc, f"not a topic: {e}", expected=expected, got=repr(text)) from e
    for field, spec, conversion in parts:
        if field not in known or spec or conversion:
            raise file.error(
                loc, f"{{{field}}} is not known in this topic", expected=expected, hint=did_you_mean(field, known)
            )
    used = {field for field, _, _ in parts}
    if missing := [name for name in required if name not in used]:
        raise file.error(loc, f"the topic has no {{{missing[0]}}}, so two tags would share it", got=repr(text))
    if not text or any(c in text for c in "+#") or text.startswith("$") or not text.isprintable():
        raise file.error(
            loc, "not a topic", expected="printable text without + and #, not beginning with $", got=repr(text)
        )
