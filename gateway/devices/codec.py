"""The driver's value codec: registers or object bytes to engineering values and back.

The emulator has its own codec and shares no code with this one, because the tests could not find a bug in a shared codec.
Registers have 16 bits and are sent in big-endian order (Modbus AP 4.2). `order` is the byte order of a value longer than one
register: ABCD big endian, CDAB words swapped, BADC bytes swapped within words, DCBA little endian.
"""

from __future__ import annotations

import math
import struct

from msgspec.structs import replace

from fieldtwin.gateway.core.errors import NotAllowed, OutOfLimits
from fieldtwin.gateway.core.files.profile import REGISTERS_OF, Tag
from fieldtwin.gateway.core.values import Quality, Reason, Scalar, TagValue

_FORMATS = {
    "int8": ">b", "uint8": ">B", "int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "int64": ">q",
    "uint64": ">Q", "float32": ">f", "float64": ">d",
}  # fmt: skip
_UNPACK = {kind: struct.Struct(form).unpack for kind, form in _FORMATS.items()}
_GOOD, _NO_REASON = Quality.GOOD, Reason.NONE  # local names, because looking up an Enum's members is slow


def reorder(data: bytes, order: str) -> bytes:
    """Convert the bytes of one value to big-endian order, or back: every order is its own inverse."""
    if order == "ABCD" or len(data) < 2:
        return data
    words = [data[i : i + 2] for i in range(0, len(data), 2)]
    if order in ("BADC", "DCBA"):
        words = [w[::-1] for w in words]
    if order in ("CDAB", "DCBA"):
        words.reverse()
    return b"".join(words)


def decode(tag: Tag, data: bytes, t_ns: int) -> TagValue:
    """Return the value of `tag` from its register bytes as received.

    Text ends at the first NUL. `order` never changes the sequence of a text's registers; the bytes within them are swapped if
    `order` says so. NaN, an invalid digit and a sentinel are bad values, never good ones; a value outside the profile's range is
    uncertain.
    """
    if tag.type == "string":
        swapped = tag.order in ("BADC", "DCBA")  # characters are swapped within a register; registers are never swapped
        text = (
            (reorder(data, "BADC") if swapped else data).split(b"\0", 1)[0].decode("ascii", errors="replace").rstrip()
        )
        return TagValue(text, _GOOD, _NO_REASON, t_ns, data)
    if tag.type == "bytes":
        return TagValue(data, _GOOD, _NO_REASON, t_ns, data)
    if tag.type == "bool":
        held = int.from_bytes(data) if tag.bits is None else _odd_number(tag, reorder(data, tag.order))
        return TagValue(bool(held), _GOOD, _NO_REASON, t_ns, data)
    return _decode_number(tag, reorder(data, tag.order), data, t_ns)


def _decode_number(tag: Tag, ordered: bytes, data: bytes, t_ns: int) -> TagValue:
    """Return the value that `ordered` holds: the received bytes `data` in big-endian order."""
    if tag.sentinels and int.from_bytes(ordered) in tag.sentinels:
        return TagValue(None, Quality.BAD, Reason.SENTINEL, t_ns, data)
    unpack = _UNPACK.get(tag.type) if tag.bits is None else None
    number = unpack(ordered)[0] if unpack is not None else _odd_number(tag, ordered)
    if number is None or not math.isfinite(number):
        return TagValue(None, Quality.BAD, Reason.NOT_A_NUMBER, t_ns, data)
    value = (
        number if tag.scale == 1.0 and tag.offset == 0.0 else number * tag.scale + tag.offset
    )  # an integer stays an integer
    if tag.range is not None and not tag.range[0] <= value <= tag.range[1]:
        return TagValue(value, Quality.UNCERTAIN, Reason.OUT_OF_RANGE, t_ns, data)
    return TagValue(value, _GOOD, _NO_REASON, t_ns, data)


def _odd_number(tag: Tag, ordered: bytes) -> int | None:
    """Return the number that the big-endian bytes `ordered` hold as BCD digits or in a part of their bits. Return None if a BCD
    digit is above 9.
    """
    if tag.type.startswith("bcd"):
        digits = ordered.hex()
        return int(digits) if digits.isdigit() else None
    assert tag.bits is not None
    low, high = tag.bits
    return int.from_bytes(ordered) >> low & (1 << (high - low + 1)) - 1


def apply_scale(tag: Tag, value: TagValue, exponent: TagValue | None) -> TagValue:
    """Return `value` times ten to the power of its scale-factor register (SunSpec). Without a valid factor the value is bad."""
    if not isinstance(value.value, int | float):
        return value
    if exponent is None or not isinstance(exponent.value, int) or not -10 <= exponent.value <= 10:
        return replace(value, value=None, quality=Quality.BAD, reason=Reason.SENTINEL)
    return replace(value, value=value.value * 10.0**exponent.value, quality=max(value.quality, exponent.quality))


def decode_little(tag: Tag, data: bytes, t_ns: int) -> TagValue:
    """Return the value of `tag` from a CANopen object's bytes, which are little endian (CiA 301, 7.1.4)."""
    if tag.type in _FORMATS:
        return _decode_number(tag, data[::-1], data, t_ns)
    return decode(tag, data, t_ns)


def encode(tag: Tag, value: Scalar) -> bytes:
    """Return the register bytes of an engineering value. Raises `NotAllowed` for a value that the tag cannot hold."""
    if isinstance(value, str | bytes) or tag.type in ("string", "bytes"):
        raise NotAllowed(f"{tag.name}: text cannot be written", expected=f"a number for {tag.type}", got=repr(value))
    low_high = tag.limits
    if not math.isfinite(value) or (low_high is not None and not low_high[0] <= value <= low_high[1]):
        expected = f"{low_high[0]:g} to {low_high[1]:g} {tag.unit}".rstrip() if low_high else "a finite number"
        raise OutOfLimits(f"{tag.name}: the value is outside its limits", expected=expected, got=f"{value:g}")
    if tag.type == "bool":
        return int(bool(value)).to_bytes(2)
    if tag.bits is not None or tag.scale_by is not None:
        raise NotAllowed(f"{tag.name}: part of a register, or scaled by another one, cannot be written")
    number = value if tag.scale == 1.0 and tag.offset == 0.0 else (value - tag.offset) / tag.scale
    try:
        return reorder(_packed(tag.type, number), tag.order)
    # a `range` wider than the type, or a float that is too large
    except (struct.error, OverflowError, ValueError) as e:
        raise OutOfLimits(
            f"{tag.name}: the value is outside its limits", expected=f"what a {tag.type} can hold", got=f"{value:g}"
        ) from e


def _packed(kind: str, number: float) -> bytes:
    """Return the big-endian bytes of a raw number. Raises `struct.error`, `OverflowError` or `ValueError` if it does
    not fit."""
    if kind.startswith("bcd"):
        digits = f"{round(number):0{4 * REGISTERS_OF[kind]}d}"
        if len(digits) > 4 * REGISTERS_OF[kind]:
            raise OverflowError(number)
        return bytes.fromhex(digits)  # a negative number raises ValueError, because its sign is not a digit
    if kind.startswith("float"):
        packed = struct.pack(_FORMATS[kind], number)
        if not math.isfinite(struct.unpack(_FORMATS[kind], packed)[0]):
            raise OverflowError(number)
        return packed
    return struct.pack(_FORMATS[kind], round(number))
