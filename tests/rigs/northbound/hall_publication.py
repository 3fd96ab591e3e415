"""Publications of a small hall without a run: two devices and a program whose samples a test states."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from support import eventually

from fieldtwin.gateway.core.values import Quality, Reason, Scalar
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.northbound.mqtt.backlog import Backlog
from fieldtwin.northbound.mqtt.json_topics import JsonPublication
from fieldtwin.northbound.mqtt.publication import Publication, WriteRequest
from fieldtwin.northbound.mqtt.publisher import Publisher
from fieldtwin.northbound.mqtt.served_tags import ServedTag
from fieldtwin.northbound.mqtt.session_numbers import SessionNumbers
from fieldtwin.northbound.mqtt.sparkplug import SparkplugPublication
from fieldtwin.northbound.samples import Sample
from fieldtwin.twin.site.servers.broker_url import BrokerUrl
from fieldtwin.twin.site.servers.serving_mqtt import JsonConfig, SparkplugConfig

TAGS = [
    ServedTag("sensor", "sensor", "temperature", "sensor.temperature", "Float", "degC", (-20.0, 60.0)),
    ServedTag("sensor", "sensor", "offset", "sensor.offset", "Int16"),
    ServedTag("sensor", "sensor", "ticks", "sensor.ticks", "UInt32"),
    ServedTag("sensor", "sensor", "serial", "sensor.serial", "String"),
    ServedTag("fan", "fan", "mode", "fan.mode", "UInt16", words=((0, "OFF"), (7, "FAULT"))),
    ServedTag("fan", "fan", "lamp", "fan.lamp", "Boolean"),
    ServedTag("", "control", "total", "control.total", "Int64"),
]
GOOD = {
    "sensor.temperature": 20.5, "sensor.offset": -5, "sensor.ticks": 4_000_000_000, "sensor.serial": "SN-1", "fan.mode": 7,
    "fan.lamp": True, "control.total": 12,
}  # fmt: skip
LIMIT, BYTES = 1000, 1 << 20


def edge_node(*, host: str = "", writes: bool = False, limit: int = LIMIT, now_ms: int = 1000) -> SparkplugPublication:
    """Return the publication of the edge node ``plant/hall``."""
    return SparkplugPublication(SparkplugConfig("plant", "hall", host, writes), TAGS, Backlog(limit, BYTES), now_ms)


def json_messages(config: JsonConfig, limit: int = LIMIT) -> JsonPublication:
    """Return the publication in JSON."""
    return JsonPublication(config, "hall", TAGS, Backlog(limit, BYTES), 1000)


def note(publication: Publication, t_ms: int, **values: Scalar | Reason) -> None:
    """Note samples at a time. The names have ``__`` for the dot; a `Reason` stands for a bad value."""
    for name, value in values.items():
        if isinstance(value, Reason):
            sample = Sample(None, Quality.BAD, value, 0)
        else:
            sample = Sample(value, Quality.GOOD, Reason.NONE, 0)
        publication.note(name.replace("__", "."), sample, t_ms)
    publication.end_look()


def note_all(publication: Publication, t_ms: int) -> None:
    """Note a good value of every tag."""
    note(publication, t_ms, **GOOD)


def silent(publication: Publication, device: str, t_ms: int, reason: Reason = Reason.TIMEOUT) -> None:
    """Note that a device does not answer."""
    note(publication, t_ms, **{name: reason for name, tag in publication.tags.items() if tag.device == device})


async def _refuse(request: WriteRequest) -> bool:
    return False


@asynccontextmanager
async def published(
    publication: Publication,
    url: BrokerUrl,
    folder: Path,
    decide: Callable[[WriteRequest], Awaitable[bool]] = _refuse,
) -> AsyncIterator[Publisher]:
    """A running publisher, which is stopped as in a run at the end."""
    publisher = Publisher(url, publication, WallClock(), SessionNumbers(folder / "session").next, decide)
    task = asyncio.ensure_future(publisher.run())
    try:
        yield publisher
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def connected(publisher: Publisher) -> None:
    """Wait until the publisher has a session and nothing waits."""

    def is_idle() -> bool:
        publisher.wake()
        publication = publisher.publication
        all_sent = publication.backlog.waiting == 0 or all(
            not publication.backlog.first(d, 1) for d in ("", "sensor", "fan")
        )
        return publisher.is_connected and not publisher.error and publication.counters["births"] > 0 and all_sent

    await eventually(is_idle, within_s=40, what="a session")
