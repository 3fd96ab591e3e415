"""The Sparkplug metric of a tag: name, type, value, quality, and the properties of its birth."""

from __future__ import annotations

from collections.abc import Iterator

from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.northbound.mqtt.backlog import Entry
from fieldtwin.northbound.mqtt.served_tags import ServedTag
from fieldtwin.twin.thread.sparkplug_payloads import (
    BAD_QUALITY,
    GOOD_QUALITY,
    STALE_QUALITY,
    Metric,
    MetricType,
    Property,
)

_TYPES = {
    "Boolean": MetricType.BOOLEAN, "SByte": MetricType.INT8, "Byte": MetricType.UINT8, "Int16": MetricType.INT16,
    "UInt16": MetricType.UINT16, "Int32": MetricType.INT32, "UInt32": MetricType.UINT32, "Int64": MetricType.INT64,
    "UInt64": MetricType.UINT64, "Float": MetricType.FLOAT, "Double": MetricType.DOUBLE, "String": MetricType.STRING,
    "ByteString": MetricType.BYTES,
}  # fmt: skip
_STALE = frozenset((Reason.STALE, Reason.HEARTBEAT_LOST, Reason.GATEWAY_DEAD))
"""The reasons of a bad value whose source has stopped reporting."""


def metric_type(tag: ServedTag) -> MetricType:
    """Return the type of a tag's metric (3.0.0, 6.4.16)."""
    return _TYPES[tag.data_type]


def metric_name(tag: ServedTag) -> str:
    """Return the name of a tag's metric: that of the tag within its device, or PROGRAM/VARIABLE."""
    return tag.local if tag.device else f"{tag.owner}/{tag.local}"


def quality_code(quality: Quality, reason: Reason) -> int:
    """Return the value of the property `Quality`, for which Sparkplug has three numbers (3.0.0, 6.4.18).

    A value that is uncertain, substituted or simulated is STALE: it has a value that a host must not take for the present one.
    """
    if quality is Quality.GOOD:
        return GOOD_QUALITY
    return BAD_QUALITY if quality is Quality.BAD and reason not in _STALE else STALE_QUALITY


def quality_table() -> Iterator[tuple[str, str, int, str]]:
    """Return the rows of the table in the reference: quality, reason, number, and whether the metric has a value."""
    yield str(Quality.GOOD), "", GOOD_QUALITY, "value"
    for quality in (Quality.SUBSTITUTED, Quality.SIMULATED, Quality.UNCERTAIN):
        yield str(quality), "any", quality_code(quality, Reason.NONE), "value"
    for reason in sorted(_STALE):
        yield str(Quality.BAD), str(reason), STALE_QUALITY, "null"
    yield str(Quality.BAD), "any other", BAD_QUALITY, "null"


def metric_of(
    entry: Entry,
    alias: int,
    *,
    name: str = "",
    historical: bool = False,
    properties: tuple[tuple[str, Property], ...] = (),
) -> Metric:
    """Return a sample as a metric. With `name` it is one of a birth, which also has the type and `properties`."""
    value = entry.value
    return Metric(
        name, alias, entry.t_ms, metric_type(entry.tag), int(value) if isinstance(value, bool) else value, historical,
        (*_quality_of(entry), *properties), typed=bool(name),
    )  # fmt: skip


def _quality_of(entry: Entry) -> Iterator[tuple[str, Property]]:
    """Yield the property `Quality`, and for a value that is not good the property `Reason`."""
    yield "Quality", quality_code(entry.quality, entry.reason)
    if entry.quality is not Quality.GOOD:
        yield "Reason", f"{entry.quality}: {entry.reason}"


def properties_of(entry: Entry) -> tuple[tuple[str, Property], ...]:
    """Return unit and range of the tag, under the names that SCADA systems use for them."""
    found: list[tuple[str, Property]] = []
    if entry.tag.unit:
        found.append(("engUnit", entry.tag.unit))
    if entry.tag.limits is not None:
        found += [("engLow", float(entry.tag.limits[0])), ("engHigh", float(entry.tag.limits[1]))]
    return tuple(found)
