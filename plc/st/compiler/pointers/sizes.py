"""The sizes of variables in bytes, as SIZEOF and the arithmetic of pointers count them in the dialects of CODESYS.

A member of a structure begins at a multiple of the size of its type, and a structure ends at a multiple of its largest member, as
in CODESYS 3 and TwinCAT 3; ``{attribute 'pack_mode' := '1'}`` before the type leaves no gaps. TIME and the dates have 4 bytes
there, although they have 8 in this PLC.
"""

from __future__ import annotations

from math import prod

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.scope import Environment
from fieldtwin.plc.st.syntax.tree import Pos

_SHORT = ("TIME", "DATE", "TIME_OF_DAY", "DATE_AND_TIME")
_BYTES_SHORT = 4


def size_of(env: Environment, kind: ty.Type, pos: Pos) -> int:
    """Return the size of a variable of a type in bytes. Raises `FileInvalid` for a type whose size depends on the controller."""
    return _layout(env, kind, pos)[0]


def _layout(env: Environment, kind: ty.Type, pos: Pos) -> tuple[int, int]:
    """Return the size of a type and the multiple of bytes at which its variables begin."""
    kind = ty.plain(kind)
    if isinstance(kind, ty.Elementary):
        size = _BYTES_SHORT if kind.name in _SHORT else max(1, kind.bits // 8)
        return size, size
    if isinstance(kind, ty.Enum):
        return kind.bits // 8, kind.bits // 8
    if isinstance(kind, ty.String):
        width = 2 if kind.wide else 1
        return (kind.length + 1) * width, width
    if isinstance(kind, ty.Array):
        size, step = _layout(env, kind.of, pos)
        return size * prod(high - low + 1 for low, high in kind.ranges), step
    if isinstance(kind, ty.Struct):
        size, step, _ = places_of(env, kind, pos)
        return size, step
    raise env.error(pos, f"the size of a {kind} depends on the controller and is not supported")


Place = tuple[int, int]
"""The first byte of a member, and the number of its bit in this byte if its type is BIT, else 0."""


def places_of(env: Environment, kind: ty.Struct, pos: Pos) -> tuple[int, int, dict[str, Place]]:
    """Return the size of a structure or union, the multiple of bytes at which it begins, and the places of its members.

    Successive members of the type BIT share bytes.
    """
    end, used, widest, bits = 0, 0, 1, 0
    places: dict[str, Place] = {}
    for name, (_, of) in kind.fields.items():
        if of == ty.BIT and bits % 8:
            places[name] = end - 1, bits % 8
            bits += 1
            continue
        bits = 1 if of == ty.BIT else 0
        size, step = _layout(env, of, pos)
        step = min(step, kind.packed)
        places[name] = 0 if kind.union else -(-end // step) * step, 0
        end = places[name][0] + size
        used, widest = max(used, end), max(widest, step)
    return -(-used // widest) * widest, widest, places
