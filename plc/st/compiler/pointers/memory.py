"""The layouts of types in the memory of a controller, as Python expressions (`fieldtwin.plc.st.runtime.layouts`)."""

from __future__ import annotations

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.pointers.sizes import places_of
from fieldtwin.plc.st.compiler.scope import Environment, identifier
from fieldtwin.plc.st.syntax.tree import Pos

_NUMBERS = {
    "SINT": "b", "INT": "h", "DINT": "i", "LINT": "q", "USINT": "B", "UINT": "H", "UDINT": "I", "ULINT": "Q",
    "BYTE": "B", "WORD": "H", "DWORD": "I", "LWORD": "Q", "REAL": "f", "LREAL": "d", "LTIME": "q",
}  # fmt: skip
"""The formats of `struct` of numbers."""
_UNITS_NS = {"TIME": NS_PER_MS, "TIME_OF_DAY": NS_PER_MS, "DATE": NS_PER_S, "DATE_AND_TIME": NS_PER_S}
"""The units in which CODESYS counts times and dates in 4 bytes."""
_OF_ENUM = {8: "b", 16: "h", 32: "i", 64: "q"}


def layout(env: Environment, kind: ty.Type, pos: Pos, what: str) -> str:
    """Return the layout of a type as a Python expression.

    Raises `FileInvalid` for a type without a known layout, such as a function block or a reference; `what` names its variable.
    """
    kind = ty.plain(kind)
    if isinstance(kind, ty.Elementary):
        return _elementary(kind)
    if isinstance(kind, ty.Enum):
        signed = any(value < 0 for value in kind.values.values())
        code = _OF_ENUM[kind.bits] if signed else _OF_ENUM[kind.bits].upper()
        return f"_v.layouts.number({code!r})"
    if isinstance(kind, ty.String):
        return f"_v.layouts.text({kind.length}, {2 if kind.wide else 1})"
    if isinstance(kind, ty.Array):
        code = layout(env, kind.of, pos, what)
        for low, high in reversed(kind.ranges):
            code = f"_v.layouts.Rows({high - low + 1}, {code})"
        return code
    if isinstance(kind, ty.Struct):
        name = f"S_{identifier(kind.name)}"
        return f"{name}.layout" if kind.union else f"_v.layouts.in_memory({name}, {members(env, kind, pos, what)})"
    hint = "a FUNCTION_BLOCK, a reference and an interface have no bytes here"
    raise env.error(pos, f"{what} has the type {kind}, whose memory is not known", hint=hint)


def members(env: Environment, kind: ty.Struct, pos: Pos, what: str) -> str:
    """Return the size of a structure or union and the places of its members, as the arguments of a Python call."""
    layouts = {name: layout(env, of, pos, f"{what}.{field}") for name, (field, of) in kind.fields.items()}
    size, _, places = places_of(env, kind, pos)
    found = [str(size)]
    for name, (_, of) in kind.fields.items():
        at, bit = places[name]
        code = f"_v.layouts.bit({bit})" if of == ty.BIT else layouts[name]
        found.append(f"({f'm_{name}'!r}, {at}, {code})")
    return ", ".join(found)


def _elementary(kind: ty.Elementary) -> str:
    if kind.kind == "bool":
        return "_v.layouts.TRUTH"
    if kind.kind == "char":
        return f"_v.layouts.letter({kind.bits // 8})"
    unit = _UNITS_NS.get(kind.name)
    return f"_v.layouts.time({unit})" if unit else f"_v.layouts.number({_NUMBERS[kind.name]!r})"
