"""One region of the process image: its only writer, and a reader.

The writer fills the slot that was published longest ago and then stores the counter: an aligned eight-byte store, so a
reader sees the old number or the new one. A reader copies the slot that the counter names and believes it only if the
check sum fits and the slot carries that very number; otherwise it looks again, a bounded number of times, and then
answers with its last snapshot, counted. A writer killed at any instant leaves the last publication whole: it was
writing into another slot. Nobody waits for anybody; there is no lock.

It must never know who maps the memory, what time it is, or what is done with a value.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence

from gateway.core.errors import Bug, FileInvalid
from gateway.core.image_layout import CHECK, RECORD_HEAD, RegionShape, RingShape, TagKind
from gateway.core.image_snapshot import Message, RegionFlag, Snapshot
from gateway.core.values import Quality, Reason, Scalar, TagValue

MAX_LOOKS = 16
"""How often a reader looks before it gives up for now. Trying four slots gave 0.0015 retries a read (DESIGN.md)."""

_NO_VALUE = 0x80  # in the quality byte: the tag has a quality and no value


class NotEncodable(Bug):
    """A value that its tag cannot hold. `tag` names it."""

    def __init__(self, tag: str, message: str, *, expected: str = "", got: str = "") -> None:
        self.tag = tag
        super().__init__(message, expected=expected, got=got, where=tag)


class _Region:
    """Views into the memory of a region, shared by writer and reader. `release` gives them back."""

    def __init__(self, memory: memoryview, shape: RegionShape) -> None:
        self.shape = shape
        self._memory = memory[: shape.size]
        self._words = self._memory[:8].cast("Q")
        self._rings = {ring.spec.name: ring for ring in shape.rings}

    def release(self) -> None:
        """Let go of the memory, so that a map can be closed. Afterwards the object is of no use."""
        self._words.release()
        self._memory.release()

    def _slot(self, counter: int) -> bytes | None:
        """Publication `counter`, verified, without its check sum; None if it is not, or no longer, there."""
        at = self.shape.slot_offset(counter)
        copy = bytes(self._memory[at : at + CHECK.size + self.shape.body.size])
        body = memoryview(copy)[CHECK.size :]
        (check,) = CHECK.unpack_from(copy)
        if zlib.crc32(body) != check or int.from_bytes(copy[8:16], "little") != counter:
            return None
        return copy


class RegionWriter(_Region):
    """The one writer of a region. Attaching to a region that has been published before continues its counters, so a
    restarted process never repeats a sequence. Raises `FileInvalid` when what is there is damaged."""

    def __init__(self, memory: memoryview, shape: RegionShape) -> None:
        super().__init__(memory, shape)
        self._copy = bytearray(CHECK.size + shape.body.size)
        self._body = memoryview(self._copy)[CHECK.size :]
        self._packed: tuple[list[Scalar | None], bytes, bytes] | None = None
        self._last = {ring.spec.name: 0 for ring in shape.rings}
        self.counter = int(self._words[0])
        if self.counter:
            copy = self._slot(self.counter)
            if copy is None:
                self.release()
                raise FileInvalid("a damaged process image", expected="a whole last publication", got=shape.layout.name)
            fields = shape.body.unpack_from(copy, CHECK.size)
            self._last = {r.spec.name: int(fields[4 + shape.count + r.index]) for r in shape.rings}

    def last_sequence(self, tag: str) -> int:
        """The sequence of the last message published on `tag`, 0 if none."""
        return self._last[tag]

    def publish(
        self,
        values: Sequence[TagValue],
        now_ns: int,
        messages: Mapping[str, Sequence[tuple[int, bytes]]] | None = None,
        flags: RegionFlag = RegionFlag.NONE,
    ) -> int:
        """Publish all tags at once; returns the publication's counter.

        `values` has one entry a tag in the layout's order; of a MESSAGE's entry only quality, reason and time count.
        `messages` maps a MESSAGE tag to its new messages as (source time in ns, payload), at most `depth` of them.
        `now_ns` is the heartbeat. Raises `NotEncodable` and publishes nothing when something does not fit.
        """
        return self._publish(
            [v.value for v in values],
            bytes([v.quality for v in values]),
            bytes([v.reason for v in values]),
            self._stamps([v.t_ns for v in values]),
            now_ns,
            messages,
            flags,
        )

    def publish_mixed(
        self,
        values: list[Scalar | None],
        qualities: bytes | bytearray,
        reasons: bytes | bytearray,
        times_ns: list[int],
        now_ns: int,
        messages: Mapping[str, Sequence[tuple[int, bytes]]] | None = None,
    ) -> int:
        """`publish` for a writer that keeps columns, one entry a tag in the layout's order."""
        stamps = self._stamps(times_ns)
        return self._publish(list(values), bytes(qualities), bytes(reasons), stamps, now_ns, messages, RegionFlag.NONE)

    def publish_columns(
        self,
        values: Sequence[Scalar | None],
        quality: Quality,
        reason: Reason,
        now_ns: int,
        messages: Mapping[str, Sequence[tuple[int, bytes]]] | None = None,
        flags: RegionFlag = RegionFlag.NONE,
        but: Mapping[int, Quality] | None = None,
    ) -> int:
        """`publish` for a writer whose values are all of one quality and instant (a scan): no object a tag is made.

        `but` has the quality of the few tags, by index, that differ. A None has no value and is BAD, NEVER_READ.
        """
        count = len(values)
        marks, reasons = bytes([quality]) * count, bytes([reason]) * count
        if but:
            mixed = bytearray(marks)
            for index, other in but.items():
                mixed[index] = other
            marks = bytes(mixed)
        if None in values:
            marks = bytes([Quality.BAD if v is None else m for v, m in zip(values, marks, strict=True)])
            reasons = bytes([Reason.NEVER_READ if v is None else reason for v in values])
        stamps = now_ns.to_bytes(8, "little", signed=True) * count
        return self._publish(list(values), marks, reasons, stamps, now_ns, messages, flags)

    def _stamps(self, times_ns: Sequence[int]) -> bytes:
        try:
            return self.shape.times.pack(*times_ns)
        except struct.error as e:
            where = f"region {self.shape.layout.name}"
            if len(times_ns) != self.shape.count:
                raise Bug(
                    "not one value a tag", expected=str(self.shape.count), got=str(len(times_ns)), where=where
                ) from e
            raise Bug("a time stamp that does not fit into 64 bits", where=where) from e

    def _publish(
        self,
        values: list[Scalar | None],
        marks: bytes,
        reasons: bytes,
        stamps: bytes,
        now_ns: int,
        messages: Mapping[str, Sequence[tuple[int, bytes]]] | None,
        flags: RegionFlag,
    ) -> int:
        shape = self.shape
        if len(values) != shape.count:
            raise Bug(
                "not one value a tag",
                expected=str(shape.count),
                got=str(len(values)),
                where=f"region {shape.layout.name}",
            )
        last = self._check_messages(messages) if messages else self._last
        for ring in shape.rings:
            values[ring.index] = last[ring.spec.name]
        columns = (values, marks, reasons)
        if columns != self._packed:  # as a rule nothing changed: what was packed stands
            self._packed = None
            self._pack(values, marks, reasons)
            self._packed = columns
        body, counter = self._body, self.counter + 1
        body[shape.times_at : shape.columns_at] = stamps
        shape.head.pack_into(body, 0, counter, now_ns, flags)
        CHECK.pack_into(self._copy, 0, zlib.crc32(body))
        if messages:
            self._write_messages(messages)
            self._last = last
        at = shape.slot_offset(counter)
        self._memory[at : at + len(self._copy)] = self._copy
        self._words[0] = counter
        self.counter = counter
        return counter

    def _pack(self, values: list[Scalar | None], marks: bytes, reasons: bytes) -> None:
        plain = values
        if None in values:
            plain = [0 if v is None else v for v in values]
            marks = bytes([m if v is not None else m | _NO_VALUE for m, v in zip(marks, values, strict=True)])
        try:
            self.shape.columns.pack_into(self._body, self.shape.columns_at, *plain, marks, reasons)
        except (struct.error, TypeError, OverflowError) as e:
            raise self._not_encodable(values) from e

    def _check_messages(self, messages: Mapping[str, Sequence[tuple[int, bytes]]]) -> dict[str, int]:
        last = dict(self._last)
        for tag, new in messages.items():
            ring = self._rings.get(tag)
            if ring is None:
                raise NotEncodable(
                    tag, "a message for a tag that takes none", expected=", ".join(self._rings) or "none"
                )
            spec = ring.spec
            if len(new) > spec.depth:
                raise NotEncodable(tag, "too many messages at once", expected=f"{spec.depth}", got=f"{len(new)}")
            for _, data in new:
                if len(data) > spec.max_bytes:
                    raise NotEncodable(tag, "message too long", expected=f"{spec.max_bytes} bytes", got=f"{len(data)}")
            last[tag] += len(new)
        return last

    def _write_messages(self, messages: Mapping[str, Sequence[tuple[int, bytes]]]) -> None:
        for tag, new in messages.items():
            ring = self._rings[tag]
            for seq, (t_ns, data) in enumerate(new, self._last[tag] + 1):
                at = ring.record_offset(seq)
                record = RECORD_HEAD.pack(seq, t_ns, len(data), _record_check(seq, t_ns, data)) + data
                self._memory[at : at + len(record)] = record

    def _not_encodable(self, values: Sequence[Scalar | None]) -> Bug:
        """Find the tag that did not fit; only on the way out."""
        for spec, value in zip(self.shape.layout.tags, values, strict=True):
            try:
                struct.pack("<d" if spec.kind is TagKind.REAL else "<q", 0 if value is None else value)
            except (struct.error, TypeError, OverflowError):
                return NotEncodable(
                    spec.name, "a value that the tag cannot hold", expected=spec.kind.value, got=repr(value)
                )
        return Bug("values that do not fit their region", where=f"region {self.shape.layout.name}")

    def release(self) -> None:
        self._body.release()
        super().release()


class RegionReader(_Region):
    """A reader of a region; any number of them, each with its own place in every message ring.

    `retries` counts looks that failed, `gave_up` snapshots that were answered with the last one, `missed` messages that
    were overwritten before this reader came by, by tag.
    """

    def __init__(self, memory: memoryview, shape: RegionShape) -> None:
        super().__init__(memory, shape)
        self.retries = 0
        self.gave_up = 0
        self.missed = {ring.spec.name: 0 for ring in shape.rings}
        self._seen = {ring.spec.name: 0 for ring in shape.rings}
        count = shape.count
        self._latest = Snapshot(
            shape,
            0,
            0,
            RegionFlag.NONE,
            (None,) * count,
            bytes([Quality.BAD]) * count,
            bytes([Reason.NEVER_READ]) * count,
            bytes(shape.times.size),
        )
        self._columns = b""

    def resume(self, tag: str, seq: int) -> None:
        """Message `seq` of `tag` is already dealt with (a reader that was restarted): the next one is `seq` + 1."""
        self._seen[tag] = seq

    def seen(self, tag: str) -> int:
        """The sequence of the last message of `tag` that a snapshot carried or counted as missed."""
        return self._seen[tag]

    @property
    def latest(self) -> Snapshot:
        """What the last `snapshot` answered, without looking again; counter 0 before the first."""
        return self._latest

    def snapshot(self) -> Snapshot:
        """The latest publication, whole. Never waits: at most `MAX_LOOKS` looks, then the last snapshot again."""
        for _ in range(MAX_LOOKS):
            counter = int(self._words[0])
            if counter == self._latest.counter:
                return self._again()
            copy = self._slot(counter)
            if copy is not None:
                self._latest = self._decode(copy)
                return self._latest
            self.retries += 1
        self.gave_up += 1
        return self._again()

    def _again(self) -> Snapshot:
        """The last snapshot; its messages were handed out before."""
        s = self._latest
        if s.messages:
            s = Snapshot(s.shape, s.counter, s.t_ns, s.flags, s.values, s.qualities, s.reasons, s.stamps)
            self._latest = s
        return s

    def _decode(self, copy: bytes) -> Snapshot:
        shape, latest = self.shape, self._latest
        counter, t_ns, flags = shape.head.unpack_from(copy, CHECK.size)
        columns_at = CHECK.size + shape.columns_at
        columns = copy[columns_at : columns_at + shape.columns.size]
        if columns != self._columns:
            values, marks, reasons = self._decode_columns(columns)
            self._columns = columns
        else:  # as a rule: a scan comes by more often than values change
            values, marks, reasons = latest.values, latest.qualities, latest.reasons
        messages: dict[str, tuple[Message, ...]] = {}
        for ring in shape.rings:
            last = values[ring.index]
            if isinstance(last, int) and last > self._seen[ring.spec.name]:
                messages[ring.spec.name] = self._drain(ring, last)
        stamps = copy[CHECK.size + shape.times_at : columns_at]
        named = RegionFlag(flags) if flags else RegionFlag.NONE
        return Snapshot(shape, counter, t_ns, named, values, marks, reasons, stamps, messages)

    def _decode_columns(self, columns: bytes) -> tuple[tuple[Scalar | None, ...], bytes, bytes]:
        """Values, qualities and reasons."""
        fields = self.shape.columns.unpack(columns)
        values: tuple[Scalar | None, ...] = fields[:-2]
        marks: bytes = fields[-2]
        if self.shape.bool_indexes:
            listed = list(values)
            for i in self.shape.bool_indexes:
                listed[i] = bool(listed[i])
            values = tuple(listed)
        if marks and max(marks) >= _NO_VALUE:
            values = tuple(None if mark & _NO_VALUE else v for v, mark in zip(values, marks, strict=True))
            marks = bytes(mark & ~_NO_VALUE for mark in marks)
        return values, marks, fields[-1]

    def _drain(self, ring: RingShape, last: int) -> tuple[Message, ...]:
        """Messages from the first unseen one to `last`; the ones that are overwritten are counted."""
        tag, spec = ring.spec.name, ring.spec
        first = max(self._seen[tag] + 1, last - spec.depth + 1)
        self.missed[tag] += first - self._seen[tag] - 1
        self._seen[tag] = last
        found = []
        for seq in range(first, last + 1):
            at = ring.record_offset(seq)
            copy = bytes(self._memory[at : at + ring.record_size])
            got, t_ns, length, check = RECORD_HEAD.unpack_from(copy)
            data = copy[RECORD_HEAD.size : RECORD_HEAD.size + length]
            if got == seq and length <= spec.max_bytes and _record_check(seq, t_ns, data) == check:
                found.append(Message(seq, t_ns, data))
            else:  # the writer has come round: it published more than `depth` since the counter was read
                self.missed[tag] += 1
        return tuple(found)


def _record_check(seq: int, t_ns: int, data: bytes) -> int:
    return zlib.crc32(data, zlib.crc32(struct.pack("<QqI", seq, t_ns, len(data))))
