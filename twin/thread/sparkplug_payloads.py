"""Payloads and topics of Sparkplug B (Eclipse Sparkplug 3.0.0, chapters 4 and 6), which third-party hosts understand.

The protocol buffers of a payload are encoded and decoded here without generated code, as far as a thread uses them. Unknown
fields are skipped. This module uses no MQTT client and no clock.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from enum import IntEnum

from fieldtwin.gateway.core.errors import Desync, UsageError
from fieldtwin.gateway.store.event import Value
from fieldtwin.twin.thread.frames import Reader, varint

NAMESPACE = "spBv1.0"
MAX_PAYLOAD = 1 << 20
MAX_METRICS = 10_000
GOOD_QUALITY, BAD_QUALITY, STALE_QUALITY = 192, 0, 500
"""Values of the property `Quality` (6.4.18)."""
Property = int | float | str


class MetricType(IntEnum):
    """Types of metrics and properties (6.4.16)."""

    INT8, INT16, INT32, INT64 = 1, 2, 3, 4
    UINT8, UINT16, UINT32, UINT64 = 5, 6, 7, 8
    FLOAT, DOUBLE, BOOLEAN, STRING, DATETIME, TEXT = 9, 10, 11, 12, 13, 14
    BYTES = 17


_SIGNED = {MetricType.INT8: 32, MetricType.INT16: 32, MetricType.INT32: 32, MetricType.INT64: 64}
_SHORT = frozenset(
    (MetricType.INT8, MetricType.INT16, MetricType.INT32, MetricType.UINT8, MetricType.UINT16, MetricType.UINT32)
)
"""The types whose values are in `int_value`."""


@dataclass(frozen=True, slots=True)
class Metric:
    """A metric. In data it has a name or an alias; `datatype` 0 means the type of the birth.

    With `typed` False the message does not contain the `datatype`, which only determines how the value is encoded.
    """

    name: str = ""
    alias: int | None = None
    t_ms: int = 0
    datatype: int = 0
    value: Value = None
    historical: bool = False
    properties: tuple[tuple[str, Property], ...] = ()
    typed: bool = True


@dataclass(frozen=True, slots=True)
class Payload:
    """A payload. `seq` counts from 0 to 255 and wraps around; None in messages without it (NDEATH, NCMD)."""

    t_ms: int
    metrics: tuple[Metric, ...]
    seq: int | None = None


@dataclass(frozen=True, slots=True)
class HostState:
    """A state that a host application has published, with the time at which its session began (UTC, ms)."""

    online: bool
    t_ms: int


def topic(group: str, message: str, node: str, device: str = "") -> str:
    """Return the topic of a message, such as ``spBv1.0/GROUP/NDATA/NODE`` or, with a device, ``spBv1.0/GROUP/DDATA/NODE/DEVICE``.

    Raises `UsageError` for a name that MQTT would read as a pattern.
    """
    names = (group, node, device) if device else (group, node)
    for part in names:
        if not part or any(c in part for c in "+#/") or not part.isprintable():
            raise UsageError("a name in Sparkplug", expected="a word without + # /", got=repr(part))
    return "/".join((NAMESPACE, group, message, *names[1:]))


def state_topic(host: str) -> str:
    """Return the topic on which a host application reports whether it is online."""
    topic(host, "STATE", host)
    return f"{NAMESPACE}/STATE/{host}"


def host_state(data: bytes) -> HostState | None:
    """Return the state in a message of a host application, or None if the message is not a state of Sparkplug 3."""
    try:
        state = json.loads(data)
    except (ValueError, RecursionError):  # neither JSON nor UTF-8
        return None
    if not isinstance(state, dict) or not isinstance(state.get("online"), bool):
        return None
    t_ms = state.get("timestamp")
    return HostState(state["online"], t_ms) if isinstance(t_ms, int) and not isinstance(t_ms, bool) else None


def type_of(value: Value) -> MetricType:
    """Return the metric type that represents a value exactly."""
    if isinstance(value, int):
        return MetricType.INT64
    if isinstance(value, float):
        return MetricType.DOUBLE
    return MetricType.BYTES if isinstance(value, bytes) else MetricType.STRING


# -- writing: field number << 3 | wire type (0 varint, 1 64 bits, 2 length and bytes, 5 32 bits) -----------------------------


def _number(field: int, value: int) -> bytes:
    return varint(field << 3) + varint(value)


def _bytes(field: int, value: bytes) -> bytes:
    return varint(field << 3 | 2) + varint(len(value)) + value


def _value(value: Value, datatype: int) -> bytes:
    """Encode the value of a metric in the field that belongs to its type, or to the type of the value if that is not known."""
    if value is None:
        return _number(7, 1)
    if datatype == MetricType.BOOLEAN:
        return _number(14, int(bool(value)))
    if isinstance(value, int):
        return _number(10, value & 0xFFFF_FFFF) if datatype in _SHORT else _number(11, value & 0xFFFF_FFFF_FFFF_FFFF)
    if isinstance(value, float):
        if datatype == MetricType.FLOAT:
            return varint(12 << 3 | 5) + struct.pack("<f", value)
        return varint(13 << 3 | 1) + struct.pack("<d", value)
    return _bytes(16, value) if isinstance(value, bytes) else _bytes(15, value.encode())


def _property(value: Property) -> bytes:
    """Encode the value of a property: a 32-bit integer, a double or a text."""
    if isinstance(value, int):
        return _number(1, MetricType.INT32) + _number(3, value)
    if isinstance(value, float):
        return _number(1, MetricType.DOUBLE) + varint(6 << 3 | 1) + struct.pack("<d", value)
    return _number(1, MetricType.STRING) + _bytes(8, value.encode())


def _properties(properties: tuple[tuple[str, Property], ...]) -> bytes:
    if not properties:
        return b""
    keys = b"".join(_bytes(1, name.encode()) for name, _ in properties)
    values = b"".join(_bytes(2, _property(value)) for _, value in properties)
    return _bytes(9, keys + values)


def encode_metric(metric: Metric) -> bytes:
    """Encode one metric, without its field header in a payload."""
    out = _bytes(1, metric.name.encode()) if metric.name else b""
    if metric.alias is not None:
        out += _number(2, metric.alias)
    out += _number(3, metric.t_ms)
    if metric.datatype and metric.typed:
        out += _number(4, metric.datatype)
    if metric.historical:
        out += _number(5, 1)
    return out + _properties(metric.properties) + _value(metric.value, metric.datatype)


def encode_payload(payload: Payload) -> bytes:
    out = _number(1, payload.t_ms) + b"".join(_bytes(2, encode_metric(metric)) for metric in payload.metrics)
    return out + (_number(3, payload.seq) if payload.seq is not None else b"")


# -- reading -----------------------------------------------------------------------------------------------------------------


def _fields(data: bytes) -> list[tuple[int, int | bytes]]:
    """Return numbers and contents of the fields of a message, in order."""
    reader, out = Reader(data), list[tuple[int, int | bytes]]()
    while not reader.done:
        key = _varint(reader)
        kind = key & 7
        if kind == 0:
            out.append((key >> 3, _varint(reader)))
        elif kind in (1, 5):
            out.append((key >> 3, reader.take(8 if kind == 1 else 4)))
        elif kind == 2:
            out.append((key >> 3, reader.take(_varint(reader))))
        else:
            raise Desync("a protocol buffer", expected="wire type 0, 1, 2 or 5", got=str(kind))
    return out


def _varint(reader: Reader) -> int:
    """Read a varint. Protocol buffers use up to ten bytes, of which 64 bits count."""
    number = shift = 0
    while True:
        byte = reader.take(1)[0]
        number |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return number & 0xFFFF_FFFF_FFFF_FFFF
        if shift >= 70:
            raise Desync("a number in a protocol buffer", expected="at most ten bytes")


def _int(value: int | bytes) -> int:
    if isinstance(value, bytes):
        raise Desync("a number in a Sparkplug payload", got="bytes")
    return value


def _raw(value: int | bytes) -> bytes:
    if isinstance(value, int):
        raise Desync("bytes in a Sparkplug payload", got="a number")
    return value


def _text(value: int | bytes) -> str:
    try:
        return _raw(value).decode()
    except UnicodeDecodeError as e:
        raise Desync("a text in a Sparkplug payload", expected="UTF-8") from e


def _decode_properties(data: bytes) -> tuple[tuple[str, Property], ...]:
    keys: list[str] = []
    values: list[Property] = []
    for number, content in _fields(data):
        if number == 1:
            keys.append(_text(content))
        elif number == 2:
            values.append(_decode_property(_raw(content)))
    return tuple(zip(keys, values, strict=False))


def _decode_property(data: bytes) -> Property:
    """Decode the value of a property. A property of a type that is not read here has the value 0."""
    inner = dict(_fields(data))
    if 6 in inner and len(_raw(inner[6])) == 8:
        return float(struct.unpack("<d", _raw(inner[6]))[0])
    if 8 in inner:
        return _text(inner[8])
    held = inner.get(3, inner.get(4, 0))
    return held if isinstance(held, int) else 0


def _decode_metric(data: bytes) -> Metric:
    name, alias, t_ms, datatype, historical, null = "", None, 0, 0, False, False
    value: Value = None
    properties: tuple[tuple[str, Property], ...] = ()
    for number, content in _fields(data):
        if number == 1:
            name = _text(content)
        elif number == 2:
            alias = _int(content)
        elif number == 3:
            t_ms = _int(content)
        elif number == 4:
            datatype = _int(content)
        elif number == 5:
            historical = bool(content)
        elif number == 7:
            null = bool(content)
        elif number == 9:
            properties = _decode_properties(_raw(content))
        elif 10 <= number <= 16:
            value = _decode_value(number, content)
    bits = _SIGNED.get(MetricType(datatype)) if datatype in MetricType._value2member_map_ else 64
    if bits and isinstance(value, int) and value >> (bits - 1) == 1:
        value -= 1 << bits
    return Metric(name, alias, t_ms, datatype, None if null else value, historical, properties)


def _decode_value(number: int, content: int | bytes) -> Value:
    if number in (10, 11):
        return _int(content)
    if number == 12 and len(_raw(content)) == 4:
        return float(struct.unpack("<f", _raw(content))[0])
    if number == 13 and len(_raw(content)) == 8:
        return float(struct.unpack("<d", _raw(content))[0])
    if number == 14:
        return int(bool(content))
    if number == 15:
        return _text(content)
    if number == 16:
        return _raw(content)
    raise Desync("the value of a metric", expected="4 bytes of a float, or 8 of a double")


def decode_payload(data: bytes) -> Payload:
    """Decode a payload. Raises `Desync` for data that is not a payload of Sparkplug B, or too large for a thread."""
    if len(data) > MAX_PAYLOAD:
        raise Desync("a Sparkplug payload", expected=f"at most {MAX_PAYLOAD} bytes", got=str(len(data)))
    t_ms, seq = 0, None
    metrics: list[Metric] = []
    for number, content in _fields(data):
        if number == 1:
            t_ms = _int(content)
        elif number == 2:
            metrics.append(_decode_metric(_raw(content)))
            if len(metrics) > MAX_METRICS:
                raise Desync("a Sparkplug payload", expected=f"at most {MAX_METRICS} metrics")
        elif number == 3:
            seq = _int(content)
    return Payload(t_ms, tuple(metrics), seq)
