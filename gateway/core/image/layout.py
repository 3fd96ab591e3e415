"""The contents of a process image: tags, regions, and the positions in bytes that follow from them.

This module only describes the layout. It must not depend on the memory, the process that maps it, or the meaning of a tag.

A region (one writer, any number of readers) lies in memory as

    published counter, u64, alone in its 64 bytes
    4 slots           check sum, counter, time, flags, then every tag's time, value, quality and reason
    ring per MESSAGE  2 x depth records of sequence, time, length, check sum, payload

All numbers are little endian. A ring has twice the depth because a writer that dies between writing new messages and
publishing them has then overwritten none of the last `depth` published ones.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

from fieldtwin.gateway.core.errors import FileInvalid

SLOTS = 4
LINE = 64
"""Alignment of regions and slots: a cache line, so that writers of two regions do not slow each other."""

MAX_TAGS = 100_000
MAX_MESSAGE_BYTES = 65_535
MAX_DEPTH = 4_096

CHECK = struct.Struct("<I4x")
"""CRC-32 of the slot from byte 8 on."""
RECORD_HEAD = struct.Struct("<QqII")
"""A message record: sequence, time in ns, length, CRC-32 of sequence, time, length and payload."""


class TagKind(Enum):
    """The type of a tag's value, which has eight bytes. For a MESSAGE the value is the sequence of its last message."""

    REAL = "real"
    INT = "int"
    BOOL = "bool"
    MESSAGE = "message"


@dataclass(frozen=True, slots=True)
class TagSpec:
    """One tag: name (``device.tag`` or ``program.variable``), kind, unit, limits, and names for its values.

    The limits are the smallest and largest value that the tag may have; None stands for the limit of its kind. `words`
    are the names of a program's enumeration, such as a state, and stand for its numbers. `value_names` are the names that a
    device's profile gives to some numbers, which programs and tests use as numbers. A MESSAGE has payloads of at most `max_bytes`
    and keeps the last `depth` of them. Raises `FileInvalid` for a size that makes no sense.
    """

    name: str
    kind: TagKind
    unit: str = ""
    max_bytes: int = 0
    depth: int = 0
    limits: tuple[float, float] | None = None
    words: tuple[tuple[int, str], ...] = ()
    value_names: tuple[tuple[int, str], ...] = ()

    def __post_init__(self) -> None:
        if not self.name:
            raise FileInvalid("a tag without a name", expected="device.tag or program.variable")
        if self.limits is not None and not self.limits[0] <= self.limits[1]:
            raise FileInvalid(f"limits of tag {self.name}", expected="low, high", got=str(self.limits))
        if self.kind is TagKind.MESSAGE:
            if not (1 <= self.max_bytes <= MAX_MESSAGE_BYTES and 1 <= self.depth <= MAX_DEPTH):
                raise FileInvalid(
                    f"message tag {self.name} has an impossible size",
                    expected=f"1 to {MAX_MESSAGE_BYTES} bytes, depth 1 to {MAX_DEPTH}",
                    got=f"{self.max_bytes} bytes, depth {self.depth}",
                )
        elif self.max_bytes or self.depth:
            raise FileInvalid(f"tag {self.name} is not a message and has no bytes or depth", got=self.kind.value)

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able description; the inverse of `from_description`."""
        text: dict[str, Any] = {"name": self.name, "kind": self.kind.value, "unit": self.unit}
        if self.kind is TagKind.MESSAGE:
            text |= {"max_bytes": self.max_bytes, "depth": self.depth}
        if self.limits is not None:
            text["limits"] = [float(limit) for limit in self.limits]  # 0 and 0.0 give the same layout
        if self.words:
            text["words"] = [list(word) for word in self.words]
        if self.value_names:
            text["value_names"] = [list(name) for name in self.value_names]
        return text

    @classmethod
    def from_description(cls, text: Mapping[str, Any]) -> TagSpec:
        """Return the tag of a description. Raises `FileInvalid` if the description is invalid."""
        try:
            return cls(
                str(text["name"]),
                TagKind(text["kind"]),
                str(text.get("unit", "")),
                int(text.get("max_bytes", 0)),
                int(text.get("depth", 0)),
                None if text.get("limits") is None else _pair(*text["limits"]),
                tuple((int(code), str(word)) for code, word in text.get("words", ())),
                tuple((int(code), str(name)) for code, name in text.get("value_names", ())),
            )
        except (KeyError, ValueError, TypeError, AttributeError) as e:
            raise FileInvalid("not the description of a tag", expected="name, kind, unit", got=str(text)) from e


def _pair(low: float, high: float) -> tuple[float, float]:
    return float(low), float(high)


def message_tag(name: str, max_bytes: int, depth: int) -> TagSpec:
    """Return a MESSAGE tag that keeps the last `depth` payloads of up to `max_bytes` each."""
    return TagSpec(name, TagKind.MESSAGE, max_bytes=max_bytes, depth=depth)


@dataclass(frozen=True, slots=True)
class RegionLayout:
    """The tags of one writer, in the order in which it publishes them. Names are unique within the region."""

    name: str
    tags: tuple[TagSpec, ...]

    def __post_init__(self) -> None:
        names = {tag.name for tag in self.tags}
        if len(names) != len(self.tags):
            twice = sorted({t.name for t in self.tags if sum(o.name == t.name for o in self.tags) > 1})
            raise FileInvalid(f"tags twice in region {self.name}", got=", ".join(twice))
        if len(self.tags) > MAX_TAGS:
            raise FileInvalid(f"too many tags in region {self.name}", expected=f"at most {MAX_TAGS}")

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able description; the inverse of `from_description`."""
        return {"name": self.name, "tags": [tag.describe() for tag in self.tags]}

    @classmethod
    def from_description(cls, text: Mapping[str, Any]) -> RegionLayout:
        """Return the region of a description. Raises `FileInvalid` if the description is invalid."""
        try:
            return cls(str(text["name"]), tuple(TagSpec.from_description(tag) for tag in text["tags"]))
        except (KeyError, TypeError) as e:
            raise FileInvalid("not the description of a region", expected="name and tags", got=str(text)) from e


@dataclass(frozen=True, slots=True)
class RingShape:
    """The position of one MESSAGE tag's ring, in bytes from the start of its region."""

    spec: TagSpec
    index: int
    offset: int
    record_size: int

    @property
    def records(self) -> int:
        return 2 * self.spec.depth

    def record_offset(self, sequence: int) -> int:
        """Return the position of message `sequence`."""
        return self.offset + (sequence % self.records) * self.record_size


class RegionShape:
    """The geometry of a region, computed once and shared by its writer and readers in a process."""

    def __init__(self, layout: RegionLayout) -> None:
        count = len(layout.tags)
        self.layout = layout
        self.count = count
        self.index = {tag.name: i for i, tag in enumerate(layout.tags)}
        self.bool_indexes = tuple(i for i, tag in enumerate(layout.tags) if tag.kind is TagKind.BOOL)
        values = "".join("d" if tag.kind is TagKind.REAL else "q" for tag in layout.tags)
        # counter, time, flags, spare; times; values; qualities; reasons
        self.body = struct.Struct(f"<QqII{count}q{values}{count}s{count}s")
        self.head = struct.Struct("<QqI")
        self.times = struct.Struct(f"<{count}q")
        self.times_at = struct.calcsize("<QqII")
        self.columns = struct.Struct(f"<{values}{count}s{count}s")
        self.columns_at = self.times_at + self.times.size
        self.slot_size = _aligned(CHECK.size + self.body.size, LINE)
        offset = LINE + SLOTS * self.slot_size
        rings = []
        for i, tag in enumerate(layout.tags):
            if tag.kind is TagKind.MESSAGE:
                ring = RingShape(tag, i, offset, _aligned(RECORD_HEAD.size + tag.max_bytes, 8))
                rings.append(ring)
                offset += ring.records * ring.record_size
        self.rings = tuple(rings)
        self.size = _aligned(offset, LINE)

    def slot_offset(self, counter: int) -> int:
        """Return the position of publication `counter`."""
        return LINE + (counter % SLOTS) * self.slot_size


def _aligned(size: int, to: int) -> int:
    return -(-size // to) * to
