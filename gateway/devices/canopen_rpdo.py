"""The process data that a node receives: the contents of each RPDO, and which of its RPDOs the gateway may send.

An RPDO carries all of its objects each time. So it may be used only if each of them may be written, and it is filled
with what the node held when it was brought up. This module must not know a bus, a master or the time of sending.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.protocols.canopen.configure import PdoConfig
from fieldtwin.gateway.protocols.canopen.pdo import PdoEntry, PdoMapping

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
    """One RPDO. `held` is what was last sent to the node, object by object; `repeat_ms` 0: sent only when a value
    changes."""

    number: int
    cob_id: int
    mapping: PdoMapping
    tags: tuple[str, ...]
    held: list[bytes]
    synchronous: bool = False
    repeat_ms: int = 0

    def frame(self, values: Mapping[str, bytes]) -> CanFrame:
        """Return the frame with `values` (tag: bytes, little endian) in place of what is held."""
        return CanFrame(self.cob_id, self.mapping.pack(self._with(values)))

    def sent(self, values: Mapping[str, bytes]) -> None:
        """Note that `frame(values)` was sent: these are the values that the node holds."""
        self.held = self._with(values)

    def _with(self, values: Mapping[str, bytes]) -> list[bytes]:
        return [values.get(tag, held) for tag, held in zip(self.tags, self.held, strict=True)]


def is_gap(entry: PdoEntry) -> bool:
    """Return whether a mapped entry is a gap and not an object."""
    return entry.index <= DUMMY_MAX


def tags_in(mapping: PdoMapping, by_object: ObjectTags) -> tuple[str, ...]:
    """Return the tag of each mapped object; "" for a gap and for an object without a tag of this size."""
    return tuple(_tag_of(entry, by_object) for entry in mapping.entries)


def _tag_of(entry: PdoEntry, by_object: ObjectTags) -> str:
    tag = by_object.get((entry.index, entry.subindex))
    if tag is None or (entry.bits != BITS.get(tag.type) and (tag.type, entry.bits) != ("bool", 1)):
        return ""
    return tag.name


def usable(
    held: Collection[PdoConfig], by_object: ObjectTags, writable: Collection[str], taken: Collection[str] = ()
) -> list[PdoConfig]:
    """Return those of a node's RPDOs that we may send: enabled, each object in `writable`, and no tag in two of them.

    `taken` are tags that another RPDO carries already: a second RPDO would restore the value that the first changed.
    The RPDO with the most tags comes first, so that related values go in one frame.
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
