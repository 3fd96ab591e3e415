"""The OPC UA data type of a tag. This module does not need the OPC UA library."""

from __future__ import annotations

from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.core.image.layout import TagKind
from fieldtwin.gateway.core.values import Scalar

INTEGERS: dict[str, tuple[int, int]] = {
    "SByte": (-(1 << 7), (1 << 7) - 1),
    "Byte": (0, (1 << 8) - 1),
    "Int16": (-(1 << 15), (1 << 15) - 1),
    "UInt16": (0, (1 << 16) - 1),
    "Int32": (-(1 << 31), (1 << 31) - 1),
    "UInt32": (0, (1 << 32) - 1),
    "Int64": (-(1 << 63), (1 << 63) - 1),
    "UInt64": (0, (1 << 64) - 1),
}
"""The integer types of OPC 10000-6, with the smallest and largest value."""
_OF_PROFILE = {
    "bool": "Boolean", "int8": "SByte", "uint8": "Byte", "int16": "Int16", "uint16": "UInt16", "int32": "Int32",
    "uint32": "UInt32", "int64": "Int64", "uint64": "UInt64", "bcd16": "UInt16", "bcd32": "UInt32", "string": "String",
    "bytes": "ByteString",
}  # fmt: skip
OF_KIND = {TagKind.BOOL: "Boolean", TagKind.INT: "Int64", TagKind.REAL: "Double"}
"""The types of variables of programs, by their kind in the process image."""


def data_type(tag: Tag) -> str:
    """Return the data type of a tag. A scaled value is a Double."""
    if tag.is_text:
        return _OF_PROFILE[tag.type]
    if not tag.is_integer:
        is_plain = tag.type == "float32" and tag.scale == 1.0 and tag.offset == 0.0 and tag.scale_by is None
        return "Float" if is_plain else "Double"
    return _OF_PROFILE[tag.type]


def fitted(value: Scalar, kind: str) -> Scalar | None:
    """Return `value` as a value of the data type `kind`, or None if the type cannot hold it."""
    if kind == "Boolean":
        return bool(value)
    if kind in INTEGERS:
        low, high = INTEGERS[kind]
        return int(value) if isinstance(value, int | float) and low <= value <= high else None
    if kind in ("Float", "Double"):
        return float(value)
    return value
