"""One complete publication of a region, as a reader of a process image receives it.

This module only holds values. It must not depend on the memory or on the process that wrote it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntFlag

import msgspec

from fieldtwin.gateway.core.image.layout import RegionShape
from fieldtwin.gateway.core.values import Quality, Reason, Scalar, TagValue

_QUALITIES = {int(quality): quality for quality in Quality}
_REASONS = {int(reason): reason for reason in Reason}


class RegionFlag(IntFlag):
    """Flags that a writer sets for its whole region."""

    NONE = 0
    STOPPED = 1
    """The writer stopped, intentionally or by its watchdog: the values of the region must not be acted upon."""


_UNFLAGGED = RegionFlag.NONE  # an Enum's members are slow to look up


class Message(msgspec.Struct, frozen=True, gc=False):
    """One message of a MESSAGE tag. `seq` counts from 1 without gaps; `t_ns` is the source's monotonic time."""

    seq: int
    t_ns: int
    data: bytes


class Snapshot(msgspec.Struct, frozen=True, gc=False):
    """One complete publication of a region. `counter` counts publications from 1; 0 means that nothing was published
    yet.

    `values`, `qualities`, `reasons` and `stamps` are columns in the order of the region's tags; `value` joins them for
    one tag. A MESSAGE tag's value is the sequence of its last message. `messages` holds, by tag, the messages that are
    new since the reader's last snapshot, in order; a tag without new messages has no entry. As long as no value, quality
    or reason changes, snapshots share those columns.

    Times are computed when the caller requests them, which is rare: that of a tag in `renewed` is `t_ns`, and `packed`
    holds those of the other tags.
    """

    shape: RegionShape
    counter: int
    t_ns: int
    flags: RegionFlag
    values: tuple[Scalar | None, ...]
    qualities: bytes
    reasons: bytes
    packed: bytes
    messages: Mapping[str, tuple[Message, ...]]
    renewed: Sequence[int] = ()

    def value(self, tag: str | int) -> TagValue:
        """Return the value of a tag by name or index; its `raw` is empty. Raises KeyError or IndexError."""
        i = self.shape.index[tag] if isinstance(tag, str) else tag
        return TagValue(self.values[i], _QUALITIES[self.qualities[i]], _REASONS[self.reasons[i]], self.time_ns(i))

    def time_ns(self, index: int) -> int:
        """Return the time that the source gave for the tag at `index` (monotonic, ns)."""
        if index in self.renewed:
            return self.t_ns
        return int.from_bytes(self.packed[8 * index : 8 * index + 8], "little", signed=True)

    @property
    def stamps(self) -> bytes:
        """Return the packed times of all tags, in the order of the region's tags."""
        return with_renewed(self.packed, self.renewed, self.t_ns)

    def all(self) -> dict[str, TagValue]:
        """Return the value of every tag, by name."""
        return {name: self.value(i) for name, i in self.shape.index.items()}

    @property
    def stopped(self) -> bool:
        return self.flags is not _UNFLAGGED and bool(self.flags & RegionFlag.STOPPED)

    def age_ns(self, now_ns: int) -> float:
        """Return the time since the writer published this (its heartbeat); infinite if it never published."""
        return now_ns - self.t_ns if self.counter else float("inf")


def with_renewed(packed: bytes, renewed: Sequence[int], t_ns: int) -> bytes:
    """Return the packed times with `t_ns` as the time of the tags with the indexes `renewed`."""
    if not renewed:
        return packed
    mixed, stamp = bytearray(packed), t_ns.to_bytes(8, "little", signed=True)
    for index in renewed:
        mixed[8 * index : 8 * index + 8] = stamp
    return bytes(mixed)
