"""Find the tags of a profile in a range of registers or in an object, and decode their values in engineering units.

Values are decoded with the driver's codec (fieldtwin.gateway.devices.codec), so a report shows the values that the gateway
read from the same bytes. The module does no I/O.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from fieldtwin.capture.decoding.exchange import SECRET, TouchedSpan
from fieldtwin.gateway.core.files.profile import Box, DeviceProfile, Tag
from fieldtwin.gateway.core.values import Scalar, TagValue
from fieldtwin.gateway.devices.codec import apply_scale, decode, decode_little

_KEPT_PLANS = 1024
"""Maximum number of spans of a device whose tags are cached, so that a scan of all addresses does not fill the memory."""


@dataclass(frozen=True, slots=True)
class _Plan:
    """The content of a span: tags with their offset and size in registers (or bits), messages, and mailboxes."""

    tags: tuple[tuple[Tag, int, int], ...]
    blocks: tuple[tuple[str, int, int], ...]
    boxes: tuple[tuple[Box, int], ...]


class TagMap:
    """The tags of one device. It stores the scale factors, because they may be read before the values that they scale."""

    def __init__(self, profile: DeviceProfile) -> None:
        self.profile = profile
        self.by_object = {t.object: t for t in profile.tags.values() if t.object is not None}
        self._plans: dict[TouchedSpan, _Plan] = {}
        self._exponents: dict[str, TagValue] = {}
        self._secrets = [t for t in profile.tags.values() if t.secret]
        self._scales = {t.scale_by for t in profile.tags.values() if t.scale_by}

    def names(self, span: TouchedSpan) -> list[str]:
        """Return the tags, messages and mailboxes that lie completely in `span`, and objects by name."""
        if span.table == "object":
            tag = self.by_object.get((span.address, span.subindex))
            return [tag.name] if tag else []
        plan = self._plan(span)
        return [t.name for t, *_ in plan.tags] + [n for n, *_ in plan.blocks] + [b.name for b, _ in plan.boxes]

    @property
    def has_secrets(self) -> bool:
        """Return whether the device has any secret tag, so that a frame of unknown content may hold one."""
        return bool(self._secrets)

    def secret(self, span: TouchedSpan) -> bool:
        """Return whether any part of `span` is secret."""
        return any(_touches(tag, span) for tag in self._secrets)

    def secrets(self, spans: Iterable[TouchedSpan]) -> frozenset[str]:
        """Return the secret tags of an exchange that touches `spans`, for `DecodedExchange.secrets`."""
        if not self._secrets:
            return frozenset()
        found = {tag.name for span in spans for tag in self._secrets if _touches(tag, span)}
        return frozenset(found | {""}) if found else frozenset()

    def of_registers(self, span: TouchedSpan, data: bytes, t_ns: int) -> dict[str, Scalar | None]:
        """Return values by name from the register bytes of `span`, as on the bus; bits as one byte each (0 or 1).

        Messages and the payloads of mailboxes are shown in hex. A value that is not a number, or is a sentinel, is
        None.
        """
        plan, size = self._plan(span), 1 if span.table in ("coil", "discrete") else 2
        read = {tag.name: decode(tag, data[at * size : (at + n) * size], t_ns) for tag, at, n in plan.tags}
        self._exponents |= {name: read[name] for name in self._scales if name in read}
        values: dict[str, Scalar | None] = {tag.name: self._scaled(tag, read[tag.name]) for tag, *_ in plan.tags}
        values |= {name: data[at * 2 : (at + n) * 2].hex() for name, at, n in plan.blocks}
        for box, at in plan.boxes:
            length = int.from_bytes(data[at * 2 + 2 : at * 2 + 4])
            values[box.name] = data[at * 2 + 4 : at * 2 + 4 + length].hex()
        return values

    def of_object(self, index: int, subindex: int, data: bytes, t_ns: int) -> dict[str, Scalar | None]:
        """Return the value of a CANopen object by its tag's name; nothing if it is not a tag or its size is wrong."""
        tag = self.by_object.get((index, subindex))
        if tag is None or (not tag.is_text and len(data) != _OBJECT_BYTES.get(tag.type, len(data))):
            return {}
        return {tag.name: self._scaled(tag, decode_little(tag, data, t_ns))}

    def show(self, values: dict[str, Scalar | None]) -> str:
        """Return a text such as ``pressure 12.5 dbar, state 1 (sampling)``."""
        return ", ".join(f"{name} {self._show(name, value)}" for name, value in values.items())

    def _show(self, name: str, value: Scalar | None) -> str:
        tag = self.profile.tags.get(name)
        if tag is None:  # a message or a mailbox's payload, in hex
            return str(value) if value not in (None, "") else "empty"
        if tag.secret:
            return SECRET
        word = dict(tag.values).get(value) if isinstance(value, int) else None
        return f"{show_value(value)} {tag.unit}".rstrip() + (f" ({word})" if word else "")

    def _scaled(self, tag: Tag, value: TagValue) -> Scalar | None:
        if tag.scale_by is not None:
            value = apply_scale(tag, value, self._exponents.get(tag.scale_by))
        return value.value.hex() if isinstance(value.value, bytes) else value.value

    def _plan(self, span: TouchedSpan) -> _Plan:
        if span not in self._plans:
            if len(self._plans) >= _KEPT_PLANS:
                self._plans.clear()
            self._plans[span] = self._make_plan(span)
        return self._plans[span]

    def _make_plan(self, span: TouchedSpan) -> _Plan:
        profile = self.profile

        def inside(table: str, address: int, count: int) -> bool:
            return table == span.table and span.address <= address and address + count <= span.address + span.count

        tags = [t for t in profile.tags.values() if t.at and inside(t.at.table, t.at.address, t.at.count)]
        blocks = [(m.name, m.at) for m in profile.messages.values() if inside(m.at.table, m.at.address, m.at.count)]
        boxes = [b for b in (profile.inbox, profile.outbox) if b and inside(b.at.table, b.at.address, 2)]
        acks = [(f"{b.name}_ack", b.ack) for b in (profile.inbox, profile.outbox) if b]
        blocks += [(name, at) for name, at in acks if inside(at.table, at.address, 1)]
        return _Plan(
            tuple((t, t.registers.address - span.address, t.registers.count) for t in tags),
            tuple((name, at.address - span.address, at.count) for name, at in blocks),
            tuple((b, b.at.address - span.address) for b in boxes),
        )


def _touches(tag: Tag, span: TouchedSpan) -> bool:
    if span.table == "object":
        return tag.object == (span.address, span.subindex)
    at = tag.at
    return (
        at is not None and at.table == span.table and at.address < span.address + span.count and span.address < at.end
    )


_OBJECT_BYTES = {
    "bool": 1, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "int64": 8, "uint64": 8,
    "float32": 4, "float64": 8,
}  # fmt: skip


def show_value(value: object, digits: int = 7) -> str:
    """Format a value: numbers to `digits` significant digits, text in quotes, ``none`` for a missing value."""
    if value is None:
        return "none"
    if isinstance(value, float):
        return f"{value:.{digits}g}" if math.isfinite(value) else str(value)
    return f"'{value}'" if isinstance(value, str) else str(value)
