"""One region of the process image: its only writer, and a reader.

The writer fills the slot that was published longest ago and then stores the counter: an aligned eight-byte store, so a
reader sees the old number or the new one. A reader copies the slot that the counter names. It accepts the copy only if
the check sum is right and the slot carries the same number; otherwise it tries again, a limited number of times, and
then returns its last snapshot, which is counted. A writer that is killed at any instant leaves the last publication
whole, because it was writing into another slot. There is no lock, and neither writer nor readers wait.

This module must not depend on the process that maps the memory, on a clock, or on the meaning of a value.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Mapping, Sequence
from types import MappingProxyType

from msgspec.structs import replace

from fieldtwin.gateway.core.errors import Bug, FileInvalid
from fieldtwin.gateway.core.image.layout import CHECK, RECORD_HEAD, SLOTS, RegionShape, RingShape, TagKind
from fieldtwin.gateway.core.image.snapshot import Message, RegionFlag, Snapshot, with_renewed
from fieldtwin.gateway.core.values import Quality, Reason, Scalar, TagValue

MAX_LOOKS = 16
"""The number of attempts after which a reader returns its last snapshot. With four slots, a read needed 0.0015 further attempts
on average.
"""

_NO_VALUE = 0x80  # in the quality byte: the tag has a quality but no value
_WITHOUT_VALUE = re.compile(rb"[\x80-\xff]")
"""Finds the quality bytes that have `_NO_VALUE`."""
_NO_MESSAGES: Mapping[str, tuple[Message, ...]] = MappingProxyType({})
_UNFLAGGED = RegionFlag.NONE  # an Enum's members are slow to look up
_QUALITY_OF = bytes(mark & ~_NO_VALUE for mark in range(256))


class NotEncodable(Bug):
    """A value does not fit its tag. `tag` names the tag."""

    def __init__(self, tag: str, message: str, *, expected: str = "", got: str = "") -> None:
        self.tag = tag
        super().__init__(message, expected=expected, got=got, where=tag)


class Heartbeat:
    """The latest publication of a region that only one process uses, if it repeats the values of the one in the memory.

    Most publications change only the counter and times. If writer and readers share this object, such a publication is passed on
    here, and the memory stays as it was: packing, check sum and unpacking took 20 % of a cycle in virtual time.
    """

    __slots__ = ("counter", "in_memory", "packed", "renewed", "t_ns")

    def __init__(self) -> None:
        self.counter = 0
        self.in_memory = 0
        """The counter of the publication in the memory."""
        self.t_ns = 0
        self.packed = b""
        self.renewed: Sequence[int] = ()
        """The indexes of the tags whose time is `t_ns`; `packed` holds the times of the others, see `Snapshot`."""

    @property
    def stamps(self) -> bytes:
        """Return the packed times of the tags of the latest publication."""
        return with_renewed(self.packed, self.renewed, self.t_ns)


class _Region:
    """The base of writer and reader: views into the memory of a region. `release` releases them."""

    def __init__(self, memory: memoryview, shape: RegionShape, heartbeat: Heartbeat | None = None) -> None:
        self.shape = shape
        self._heartbeat = heartbeat
        self._memory = memory[: shape.size]
        self._words = self._memory[:8].cast("Q")
        self._rings = {ring.spec.name: ring for ring in shape.rings}
        self._slots = tuple(shape.slot_offset(n) for n in range(SLOTS))
        self._slot_bytes = CHECK.size + shape.body.size

    def release(self) -> None:
        """Release the memory, so that its map can be closed. The object cannot be used afterwards."""
        self._words.release()
        self._memory.release()

    def _slot(self, counter: int) -> bytes | None:
        """Return the slot of publication `counter` without its check sum, or None if the memory does not hold that publication
        intact.
        """
        at = self._slots[counter % SLOTS]
        (check,) = CHECK.unpack_from(
            self._memory, at
        )  # if overwritten between this line and the next, they do not match
        body = self._memory[at + CHECK.size : at + self._slot_bytes].tobytes()
        if zlib.crc32(body) != check or int.from_bytes(body[:8], "little") != counter:
            return None
        return body


class RegionWriter(_Region):
    """The only writer of a region.

    Attaching to a region that has been published before continues its counters, so a restarted process never repeats a
    sequence. Raises `FileInvalid` if the region's content is damaged.
    """

    def __init__(self, memory: memoryview, shape: RegionShape, heartbeat: Heartbeat | None = None) -> None:
        super().__init__(memory, shape, heartbeat)
        self._copy = bytearray(CHECK.size + shape.body.size)
        self._body = memoryview(self._copy)[CHECK.size :]
        self._all = range(shape.count)
        self._packed = False
        """True if `_body` holds the values, qualities and reasons of the last publication."""
        self._flags = 0
        self._last = {ring.spec.name: 0 for ring in shape.rings}
        self.counter = int(self._words[0])
        if self.counter:
            body = self._slot(self.counter)
            if body is None:
                self.release()
                raise FileInvalid("a damaged process image", expected="a whole last publication", got=shape.layout.name)
            fields = shape.body.unpack(body)
            self._last = {r.spec.name: int(fields[4 + shape.count + r.index]) for r in shape.rings}

    def last_sequence(self, tag: str) -> int:
        """Return the sequence of the last message published on `tag`, or 0 if none was published."""
        return self._last[tag]

    def publish(
        self,
        values: Sequence[TagValue],
        now_ns: int,
        messages: Mapping[str, Sequence[tuple[int, bytes]]] | None = None,
        flags: RegionFlag = RegionFlag.NONE,
    ) -> int:
        """Publish all tags together and return the publication's counter.

        `values` has one entry per tag in the layout's order; of a MESSAGE's entry only quality, reason and time count. `messages`
        maps a MESSAGE tag to its new messages as (source time in ns, payload), at most `depth` of them. `now_ns` is the time of
        the publication, the heartbeat of the writer. Raises `NotEncodable` and publishes nothing if a value or message does not
        fit.
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
        *,
        same: bool = False,
    ) -> int:
        """Publish from columns that have one entry per tag in the layout's order.

        `same` says that values, qualities and reasons are unchanged since the caller last published them, as in most cycles.
        Those columns are then not examined, which saves 10 to 19 % of the time of a PLC scan. Times may have changed.
        """
        stamps = self._stamps(times_ns)
        if same and not messages and self._packed:
            return self._repeat(stamps, now_ns)
        return self._publish(values, qualities, reasons, stamps, now_ns, messages, _UNFLAGGED)

    def publish_columns(
        self,
        values: Sequence[Scalar | None],
        quality: Quality,
        reason: Reason,
        now_ns: int,
        messages: Mapping[str, Sequence[tuple[int, bytes]]] | None = None,
        flags: RegionFlag = RegionFlag.NONE,
        but: Mapping[int, Quality] | None = None,
        *,
        same: bool = False,
        missing: Mapping[int, Reason] | None = None,
    ) -> int:
        """Publish values that all have one quality and time (the outputs of a PLC scan), without creating an object per tag.

        `but` holds the quality of the few tags that differ, by index. A value of None is published as BAD, with the reason that
        `missing` holds for its index, else NEVER_READ. `same` says that `values`, `quality`, `reason` and `but` are unchanged
        since the last publication; they are then not examined.
        """
        if same and not messages and self._packed:
            if self.repeats and not flags:
                self.skip(1, now_ns)
                return self.counter
            return self._commit(self._same_stamps(now_ns), now_ns, flags)
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
            if missing:
                mixed = bytearray(reasons)
                for index, other_reason in missing.items():
                    mixed[index] = other_reason if values[index] is None else mixed[index]
                reasons = bytes(mixed)
        return self._publish(values, marks, reasons, self._same_stamps(now_ns), now_ns, messages, flags)

    def _same_stamps(self, t_ns: int) -> bytes:
        return t_ns.to_bytes(8, "little", signed=True) * self.shape.count

    def _stamps(self, times_ns: Sequence[int]) -> bytes:
        try:
            return self.shape.times.pack(*times_ns)
        except struct.error as e:
            where = f"region {self.shape.layout.name}"
            if len(times_ns) != self.shape.count:
                raise Bug(
                    "the number of values is not the number of tags",
                    expected=str(self.shape.count),
                    got=str(len(times_ns)),
                    where=where,
                ) from e
            raise Bug("a time stamp that does not fit into 64 bits", where=where) from e

    def _publish(
        self,
        values: Sequence[Scalar | None],
        marks: bytes | bytearray,
        reasons: bytes | bytearray,
        stamps: bytes,
        now_ns: int,
        messages: Mapping[str, Sequence[tuple[int, bytes]]] | None,
        flags: RegionFlag,
    ) -> int:
        shape = self.shape
        if len(values) != shape.count:
            raise Bug(
                "the number of values is not the number of tags",
                expected=str(shape.count),
                got=str(len(values)),
                where=f"region {shape.layout.name}",
            )
        last = self._check_messages(messages) if messages else self._last
        self._packed = False  # in case packing fails
        self._pack(values, last, marks, reasons)
        self._packed = True
        if messages:
            self._write_messages(messages)
            self._last = last
        return self._commit(stamps, now_ns, flags)

    def _repeat(self, stamps: bytes, now_ns: int) -> int:
        """Publish the columns packed in `_body` again, which differ from the last publication only in their times."""
        beat = self._heartbeat
        if beat is None or self._flags:
            return self._commit(stamps, now_ns, _UNFLAGGED)
        self.counter = beat.counter = self.counter + 1
        beat.t_ns, beat.packed, beat.renewed = now_ns, stamps, ()
        return self.counter

    @property
    def repeats(self) -> bool:
        """Return whether a publication of the same values stays outside of the memory, so that `skip` can count it."""
        return self._heartbeat is not None and self._packed and not self._flags

    def skip(self, count: int, last_ns: int, renewed: Sequence[int] | None = None) -> None:
        """Count `count` publications that repeat the values of the last one. The last of them was made at `last_ns`, which is
        also the time of the tags with the indexes `renewed`; None: of all tags. `repeats` must be true.
        """
        beat = self._heartbeat
        assert beat is not None
        wanted = self._all if renewed is None else renewed
        if beat.renewed is not wanted:
            beat.packed, beat.renewed = beat.stamps, wanted
        self.counter = beat.counter = self.counter + count
        beat.t_ns = last_ns

    def _commit(self, stamps: bytes, now_ns: int, flags: int) -> int:
        """Publish the columns packed in `_body`. `stamps` holds the packed time of each tag, `now_ns` is the heartbeat."""
        self._store(self.counter + 1, stamps, now_ns, flags)
        if self._heartbeat is not None:
            self._heartbeat.counter = self._heartbeat.in_memory = self.counter
            self._heartbeat.packed, self._heartbeat.renewed = stamps, ()
        return self.counter

    def _store(self, counter: int, stamps: bytes, now_ns: int, flags: int) -> None:
        shape, body = self.shape, self._body
        body[shape.times_at : shape.columns_at] = stamps
        shape.head.pack_into(body, 0, counter, now_ns, flags)
        CHECK.pack_into(self._copy, 0, zlib.crc32(body))
        at = self._slots[counter % SLOTS]
        self._memory[at : at + len(self._copy)] = self._copy
        self._words[0] = counter
        self.counter, self._flags = counter, flags

    def _pack(
        self,
        values: Sequence[Scalar | None],
        last: Mapping[str, int],
        marks: bytes | bytearray,
        reasons: bytes | bytearray,
    ) -> None:
        """Pack the columns into `_body`. `marks` are the qualities; `last` holds the last sequence of each MESSAGE tag."""
        shape, plain = self.shape, list(values)
        for ring in shape.rings:
            plain[ring.index] = last[ring.spec.name]
        if None in plain:
            marks, at = bytearray(marks), -1
            for _ in range(plain.count(None)):
                at = plain.index(None, at + 1)
                plain[at] = 0
                marks[at] |= _NO_VALUE
        try:
            shape.columns.pack_into(self._body, shape.columns_at, *plain, marks, reasons)
        except (struct.error, TypeError, OverflowError) as e:
            raise self._not_encodable(plain) from e

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
        """Return an error that names the tag whose value did not fit. Called only after packing failed."""
        for spec, value in zip(self.shape.layout.tags, values, strict=True):
            try:
                struct.pack("<d" if spec.kind is TagKind.REAL else "<q", 0 if value is None else value)
            except (struct.error, TypeError, OverflowError):
                return NotEncodable(
                    spec.name, "a value that the tag cannot hold", expected=spec.kind.value, got=repr(value)
                )
        return Bug("values that do not fit their region", where=f"region {self.shape.layout.name}")

    def release(self) -> None:
        beat, self._heartbeat = self._heartbeat, None  # a second release finds nothing to store
        if beat is not None and beat.counter > beat.in_memory:  # the next writer continues from the memory
            self._store(beat.counter, beat.stamps, beat.t_ns, self._flags)
            beat.in_memory = beat.counter
        self._body.release()
        super().release()


class RegionReader(_Region):
    """A reader of a region. A region may have any number of readers, each with its own position in every message ring.

    `retries` counts failed attempts, `gave_up` the snapshots that repeated the last one, and `missed` the messages, by
    tag, that were overwritten before this reader read them.
    """

    def __init__(self, memory: memoryview, shape: RegionShape, heartbeat: Heartbeat | None = None) -> None:
        super().__init__(memory, shape, heartbeat)
        self.retries = 0
        self.gave_up = 0
        self.missed = {ring.spec.name: 0 for ring in shape.rings}
        self._seen = {ring.spec.name: 0 for ring in shape.rings}
        count = shape.count
        self.latest = Snapshot(
            shape,
            0,
            0,
            RegionFlag.NONE,
            (None,) * count,
            bytes([Quality.BAD]) * count,
            bytes([Reason.NEVER_READ]) * count,
            bytes(shape.times.size),
            _NO_MESSAGES,
        )
        """The result of the last `snapshot`; its counter is 0 before the first."""
        self._columns = b""
        """The packed columns of the latest snapshot."""

    def resume(self, tag: str, seq: int) -> None:
        """Continue with message `seq` + 1 of `tag`. Message `seq` was handled before the reader was restarted."""
        self._seen[tag] = seq
        self._columns = b""  # the same columns may now stand for other new messages

    def seen(self, tag: str) -> int:
        """Return the sequence of the last message of `tag` that a snapshot carried or counted as missed."""
        return self._seen[tag]

    @property
    def repeats(self) -> bool:
        """Return whether the last snapshot has all values that were published since; only counter and times may be newer."""
        return self._heartbeat is not None and bool(self._columns) and self.latest.counter >= self._heartbeat.in_memory

    def snapshot(self) -> Snapshot:
        """Return the latest complete publication. Never waits: after at most `MAX_LOOKS` attempts, it returns the last
        snapshot again.
        """
        beat = self._heartbeat
        if beat is not None and beat.counter > beat.in_memory:
            return self._beaten(beat)
        return self._from_memory()

    def _from_memory(self) -> Snapshot:
        for _ in range(MAX_LOOKS):
            counter = self._words[0]
            if counter == self.latest.counter:
                return self._again()
            body = self._slot(counter)
            if body is not None:
                self.latest = snapshot = self._decode(body)
                return snapshot
            self.retries += 1
        self.gave_up += 1
        return self._again()

    def _beaten(self, beat: Heartbeat) -> Snapshot:
        """Return the publication of `beat`: the one in the memory with a new counter and new times."""
        s = self.latest
        if s.counter == beat.counter:
            return self._again()
        messages = _NO_MESSAGES
        if s.counter < beat.in_memory or not self._columns:
            s = self._from_memory()
            messages = s.messages
        self.latest = Snapshot(
            s.shape,
            beat.counter,
            beat.t_ns,
            s.flags,
            s.values,
            s.qualities,
            s.reasons,
            beat.packed,
            messages,
            beat.renewed,
        )
        return self.latest

    def _again(self) -> Snapshot:
        """Return the last snapshot without its messages, which were returned before."""
        s = self.latest
        if s.messages:
            s = self.latest = replace(s, messages=_NO_MESSAGES)
        return s

    def _decode(self, body: bytes) -> Snapshot:
        shape, latest = self.shape, self.latest
        counter, t_ns, flags = shape.head.unpack_from(body)
        named = RegionFlag(flags) if flags else _UNFLAGGED
        columns, stamps = body[shape.columns_at :], body[shape.times_at : shape.columns_at]
        if columns == self._columns:  # most scans change no value: saves 5 to 7 % of a scan
            return Snapshot(
                shape, counter, t_ns, named, latest.values, latest.qualities, latest.reasons, stamps, _NO_MESSAGES
            )
        values, marks, reasons = self._decode_columns(columns)
        messages: Mapping[str, tuple[Message, ...]] = _NO_MESSAGES
        for ring in shape.rings:
            last = values[ring.index]
            if isinstance(last, int) and last > self._seen[ring.spec.name]:
                messages = {**messages, ring.spec.name: self._drain(ring, last)}
        self._columns = columns
        return Snapshot(shape, counter, t_ns, named, values, marks, reasons, stamps, messages)

    def _decode_columns(self, columns: bytes) -> tuple[tuple[Scalar | None, ...], bytes, bytes]:
        """Unpack a snapshot's columns; return values, qualities and reasons."""
        values = list(self.shape.columns.unpack(columns))
        reasons, marks = values.pop(), values.pop()
        for i in self.shape.bool_indexes:
            values[i] = bool(values[i])
        for marked in _WITHOUT_VALUE.finditer(marks):
            values[marked.start()] = None
        return tuple(values), marks.translate(_QUALITY_OF), reasons

    def _drain(self, ring: RingShape, last: int) -> tuple[Message, ...]:
        """Return the messages from the first unseen one to `last`, and count those that were overwritten."""
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
            else:  # the writer published more than `depth` messages since the counter was read
                self.missed[tag] += 1
        return tuple(found)


def _record_check(seq: int, t_ns: int, data: bytes) -> int:
    return zlib.crc32(data, zlib.crc32(struct.pack("<QqI", seq, t_ns, len(data))))
