"""The process data that a node receives: the contents of each RPDO, and which of its RPDOs the gateway may send.

An RPDO always carries all of its objects. So it may be used only if each of them may be written, and the gateway first fills it
with the values that the node holds when it connects. This module must not depend on a bus, a master or the time of sending.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.protocols.canopen.configure import PdoConfig
from fieldtwin.gateway.protocols.canopen.pdo.mapping import PdoEntry, PdoMapping

BITS = {
    "bool": 8, "int8": 8, "uint8": 8, "int16": 16, "uint16": 16, "int32": 32, "uint32": 32, "int64": 64, "uint64": 64,
    "float32": 32, "float64": 64,
}  # fmt: skip
"""The size in bits of a tag's object; a BOOLEAN object may also be mapped with 1 bit."""

DUMMY_MAX = 0x1F
"""Objects up to this index are data types: in a mapping they are gaps (7.4.8)."""

ObjectTags = Mapping[tuple[int, int] | None, Tag]


@dataclass(eq=False)
class Rpdo:
    """One RPDO. `held` is the value of each mapped object as the node holds it, in bytes as sent.

    `repeat_ms` is the period in which the RPDO is repeated; 0: it is sent only when a value changes."""

    number: int
    cob_id: int
    mapping: PdoMapping
    tags: tuple[str, ...]
    held: list[bytes]
    synchronous: bool = False
    repeat_ms: int = 0

    def frame(self, values: Mapping[str, bytes]) -> CanFrame:
        """Return the frame with `values` (tag: bytes, little endian), and the held bytes for all other objects."""
        return CanFrame(self.cob_id, self.mapping.pack(self._with(values)))

    def sent(self, values: Mapping[str, bytes]) -> None:
        """Note that `frame(values)` was sent, so that the node now holds these values."""
        self.held = self._with(values)

    def _with(self, values: Mapping[str, bytes]) -> list[bytes]:
        return [values.get(tag, held) for tag, held in zip(self.tags, self.held, strict=True)]


def is_gap(entry: PdoEntry) -> bool:
    """Return whether a mapped entry is a dummy entry that only fills a gap."""
    return entry.index <= DUMMY_MAX


def tags_in(mapping: PdoMapping, by_object: ObjectTags) -> tuple[str, ...]:
    """Return the tag of each mapped object, or "" for a gap and for an object that has no tag of this size."""
    found = (mapped_tag(entry, by_object) for entry in mapping.entries)
    return tuple("" if tag is None else tag.name for tag in found)


def mapped_tag(entry: PdoEntry, by_object: ObjectTags) -> Tag | None:
    """Return the tag of a mapped object; None for a gap and for an object that has no tag of this size."""
    tag = by_object.get((entry.index, entry.subindex))
    if tag is None or (entry.bits != BITS.get(tag.type) and (tag.type, entry.bits) != ("bool", 1)):
        return None
    return tag


def usable(
    held: Collection[PdoConfig], by_object: ObjectTags, writable: Collection[str], taken: Collection[str] = ()
) -> list[PdoConfig]:
    """Return the RPDOs of a node that the gateway may send.

    Such an RPDO is enabled, each of its objects is in `writable`, and no tag is in two RPDOs: the second one would restore the
    value that the first one changed. `taken` are tags that another RPDO already carries. The RPDO with the most tags comes first,
    so that related values are sent in one frame.
    """
    candidates = []
    for config in held:
        named = zip(tags_in(config.mapping, by_object), config.mapping.entries, strict=True)
        tags = [tag for tag, entry in named if not is_gap(entry)]
        if config.enabled and tags and all(tag in writable for tag in tags):
            candidates.append((config, tags))
    found, seen = [], set(taken)
    for config, tags in sorted(candidates, key=lambda c: (-len(c[1]), c[0].number)):
        if not seen.intersection(tags) and len(set(tags)) == len(tags):
            seen.update(tags)
            found.append(config)
    return found
