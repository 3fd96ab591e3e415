"""Write one value with care: read the old value, write, read back and compare.

A write that can be refused without the device is refused before anything is sent. This module must never repeat a write: each
write wears a memory with limited write cycles, and a lost reply does not show whether the device executed the write.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from fieldtwin.commissioning.access.address import AUTO
from fieldtwin.commissioning.access.point import ModbusPoint, Point, PointValue, encoded
from fieldtwin.gateway.core.errors import CheckFailed, NotAllowed, UsageError, VerifyFailed
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.core.values import Scalar

_TRUE, _FALSE = ("true", "on", "yes"), ("false", "off", "no")


@dataclass(frozen=True, slots=True)
class Write:
    """A write that no rule forbids, as far as this can be checked without the device. `warnings` are shown when the user is
    asked.
    """

    tag: Tag
    value: Scalar
    data: bytes
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Written:
    """The result of a write.

    `before` and `after` are the raw bytes as read; None where the value cannot be read (write-only, broadcast). `same`:
    the device held the value already and nothing was sent.
    """

    write: Write
    before: bytes | None
    after: bytes | None
    same: bool = False
    restored: bool = False


def plan_write(tag: Tag, text: str, *, i_know: bool = False, restore: bool = False) -> Write:
    """Return the write of `text` (a number, the name of a profile's value, ``on``, ``hex:0102``) to `tag`.

    Raises `NotAllowed` for a write that the profile forbids: read-only, outside the limits; dangerous without `i_know`;
    a nonvolatile value that is to be restored at once, because this takes two writes and each write wears the memory.
    """
    if not tag.writable:
        raise NotAllowed(f"{tag.name} is read-only", hint="the profile's `access` defines what may be written")
    if tag.danger and not i_know:
        raise NotAllowed(f"{tag.name}: writing it {_does(tag.danger)}", expected="--i-know")
    if tag.nonvolatile and restore and not i_know:
        raise NotAllowed(
            f"{tag.name} is kept in memory with limited write cycles: restoring it is a second write",
            expected="no --restore",
        )
    value = parse_value(tag, text)
    if tag.type == AUTO and not isinstance(value, bytes):
        raise UsageError(f"{tag.name}: the type is not known", expected="--type, --eds FILE, or hex:BYTES")
    data = encoded(tag, value)
    if tag.at is not None and isinstance(value, bytes):
        width = 1 if tag.at.table == "coil" else 2 * tag.at.count
        if len(data) != width:
            raise NotAllowed(f"{tag.name}: the bytes do not fit", expected=f"{width} bytes", got=str(len(data)))
    warnings: tuple[str, ...] = ()
    if tag.nonvolatile:
        warnings = ("kept in memory with limited write cycles: written once, and only if it differs",)
    if tag.danger:
        warnings += (f"it {_does(tag.danger)}",)
    return Write(tag, value, data, warnings)


def plan_writes(pairs: list[tuple[Tag, str]], *, i_know: bool = False, restore: bool = False) -> list[Write]:
    """Return several writes, in order. Raises the errors of `plan_write`, and `NotAllowed` for a nonvolatile tag that occurs
    twice.
    """
    seen: set[str] = set()
    for tag, _ in pairs:
        if tag.name in seen and tag.nonvolatile:
            raise NotAllowed(f"{tag.name} has limited write cycles and is given twice", expected="one value for it")
        seen.add(tag.name)
    return [plan_write(tag, text, i_know=i_know, restore=restore) for tag, text in pairs]


def parse_value(tag: Tag, text: str) -> Scalar:
    """Parse a value in the user's notation. Raises `UsageError`."""
    named = {name: number for number, name in tag.values}
    if text in named:
        return named[text]
    if text.lower().startswith("hex:"):
        try:
            return bytes.fromhex(text[4:])
        except ValueError as e:
            raise UsageError(f"{tag.name}: not bytes in hex", got=text) from e
    if tag.type == "string":
        return text
    lower = text.lower()
    if tag.type == "bool" and lower in (*_TRUE, *_FALSE):
        return lower in _TRUE
    try:
        number = int(text, 0)
        return bool(number) if tag.type == "bool" and number in (0, 1) else number
    except ValueError:
        pass
    try:
        value = float(text)
    except ValueError as e:
        names = ", ".join(named)
        raise UsageError(
            f"{tag.name}: no value", expected=f"a number{', or ' + names if names else ''}", got=text
        ) from e
    exact = tag.is_integer or tag.type == "bool"
    if not math.isfinite(value) or (exact and value != int(value)):
        raise UsageError(f"{tag.name}: no value", expected="a whole number" if exact else "a finite number", got=text)
    return int(value) if exact else value


def check_broadcast(point: Point, *, i_know: bool) -> None:
    """Raise `NotAllowed` for unit 0 of a serial line without `i_know`: every unit would execute the write."""
    if isinstance(point, ModbusPoint) and point.is_broadcast and not i_know:
        raise NotAllowed("unit 0 is a broadcast to all units of the line, and no unit answers it", expected="--i-know")


async def before(point: Point, write: Write) -> PointValue | None:
    """Return the device's current value; None if it cannot be read (a write-only tag, or a broadcast).

    Raises `CheckFailed` if the device refuses or does not answer: without the old value a write cannot be undone.
    """
    if not write.tag.readable or _broadcasts(point):
        return None
    answer = (await point.read([write.tag]))[write.tag.name]
    if answer.problem:
        raise CheckFailed(
            f"{write.tag.name}: its present value cannot be read, so nothing is written: {answer.problem}",
            where=point.where,
            hint="--blind writes without reading the present value first",
        )
    return answer


async def carry_out(point: Point, write: Write, old: PointValue | None) -> Written:
    """Write the value, read it back, and compare. A nonvolatile value is not written if the device holds it already.

    Raises `VerifyFailed` when the device acknowledged the write but holds a different value, and the errors of connection and
    device.
    """
    held = old.value.raw if old is not None else None
    if write.tag.nonvolatile and held is not None and _same(write, held):
        return Written(write, held, held, same=True)
    await point.write(write.tag, write.data)
    if not write.tag.readable or _broadcasts(point):
        return Written(write, held, None)
    return Written(write, held, await _verify(point, write, write.data))


async def restore(point: Point, done: Written) -> Written:
    """Restore the value from before the write, and read it back. If the device holds it already, nothing is written.

    Raises `NotAllowed` if the old value is not known, otherwise the same errors as `carry_out`.
    """
    tag = done.write.tag
    if done.before is None:
        raise NotAllowed(f"{tag.name} cannot be restored: its old value was not read")
    answer = (await point.read([tag]))[tag.name]
    if not answer.problem and _equal(tag, done.before, answer.value.raw):
        return Written(done.write, done.before, done.before, same=True, restored=True)
    await point.write(tag, done.before)
    return Written(done.write, done.before, await _verify(point, done.write, done.before), restored=True)


async def _verify(point: Point, write: Write, data: bytes) -> bytes:
    answer = (await point.read([write.tag]))[write.tag.name]
    if answer.problem:
        raise VerifyFailed(
            f"{write.tag.name}: written, but it cannot be read back: {answer.problem}", where=point.where
        )
    if not _equal(write.tag, data, answer.value.raw):
        raise VerifyFailed(
            f"{write.tag.name}: the device acknowledged the write, but holds a different value",
            expected=data.hex(" "),
            got=answer.value.raw.hex(" "),
            where=point.where,
        )
    return answer.value.raw


def _same(write: Write, held: bytes) -> bool:
    return _equal(write.tag, write.data, held)


def _equal(tag: Tag, data: bytes, held: bytes) -> bool:
    """Return whether `held`, as read from the device, is the value `data`. A coil is read as one byte; other values are
    compared byte by byte.
    """
    if tag.type == "bool":
        return bool(int.from_bytes(data)) == bool(int.from_bytes(held))
    return data == held


def _broadcasts(point: Point) -> bool:
    return isinstance(point, ModbusPoint) and point.is_broadcast


def _does(danger: str) -> str:
    return danger.replace("-", " ")
