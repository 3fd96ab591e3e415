"""The publication of a server of kind `mqtt`: a Sparkplug edge node, or messages in JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fieldtwin.northbound.mqtt.backlog import SIZE, Backlog
from fieldtwin.northbound.mqtt.json_topics import JsonPublication
from fieldtwin.northbound.mqtt.publication import Publication
from fieldtwin.northbound.mqtt.served_tags import ServedTag
from fieldtwin.northbound.mqtt.sparkplug import SparkplugPublication
from fieldtwin.twin.site.servers.serving_mqtt import MqttServeConfig


def publication_of(
    config: MqttServeConfig, system: str, instance: str, tags: Sequence[ServedTag], now_ms: int
) -> Publication:
    """Return the publication of a server. `instance` names the run.

    A prototype must not be taken for the plant, and two prototypes of a system not for each other. So the name of its edge node
    ends with ``-prototype``, its topics in JSON begin with ``prototype/``, and the name of an instance follows if it has one.
    """
    at_least = 2 * len(tags)  # otherwise a look at which all tags change would overflow
    backlog = Backlog(max(config.buffer_samples, at_least), max(config.buffer_bytes, at_least * SIZE))
    suffix = f"-{instance}" if instance != system else ""
    if config.sparkplug is not None:
        names = config.sparkplug
        if config.prototype:
            names = replace(names, node=f"{names.node}-prototype{suffix}")
        return SparkplugPublication(names, tags, backlog, now_ms)
    assert config.json is not None
    prefix = f"prototype{suffix}/" if config.prototype else ""
    return JsonPublication(config.json, system, tags, backlog, now_ms, prefix)
