"""The retained data of variables, as data for JSON, and its size (IEC 61131-3:2013, 6.5.6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.blocks import FunctionBlock
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.runtime.layouts import Union
from fieldtwin.plc.st.runtime.references import REFERENCES, Instance

Members = Mapping[str, Sequence[tuple[str, ty.Type]]]
"""By the name of a function block or class in lower case: its variables, with their types."""


def described(kind: ty.Type, value: Any, members: Members) -> Any:
    """Return a description of the type of a retained value by the names and elementary types of its parts, as data for JSON.

    The description does not include variables of VAR NON_RETAIN. Retained values of a different description cannot be restored.
    """
    if isinstance(kind, ty.Array):
        return [kind.ranges, described(kind.of, _first(value), members)]
    if isinstance(kind, ty.Struct):
        if kind.union:
            fields = [[name, described(of, None, members)] for name, (_, of) in kind.fields.items()]
            return {"union": fields, "packed": kind.packed}
        return [[n, described(of, getattr(value, f"m_{n}", None), members)] for n, (_, of) in kind.fields.items()]
    if isinstance(kind, ty.Block):
        without = getattr(value, "non_retain", ())
        parts = [(name, of) for name, of in _members(kind, members) if f"v_{name.lower()}" not in without]
        named = [[name.lower(), described(of, _member(value, name), members)] for name, of in parts]
        return [kind.name.lower(), named]
    if isinstance(kind, ty.Enum):
        return [kind.name.lower(), sorted(kind.values.items())]
    return str(kind)


def described_part(kind: ty.Type, value: Any, members: Members) -> Any:
    """Return a description of the variables in a value that are RETAIN in their function block; None if it has none."""
    found: list[Any] = []
    if isinstance(kind, ty.Array):
        part = described_part(kind.of, _first(value), members)
        return None if part is None else [kind.ranges, part]
    if isinstance(kind, ty.Struct) and not kind.union:
        for name, (_, of) in kind.fields.items():
            part = described_part(of, getattr(value, f"m_{name}", None), members)
            found += [[name, part]] if part is not None else []
    elif isinstance(kind, ty.Block):
        whole = getattr(value, "retain", ())
        for name, of in _members(kind, members):
            describe = described if f"v_{name.lower()}" in whole else described_part
            part = describe(of, _member(value, name), members)
            found += [[name.lower(), part]] if part is not None else []
    return found or None


def _members(kind: ty.Block, members: Members) -> Sequence[tuple[str, ty.Type]]:
    """Return the variables of a function block; those of a block of the standard are its inputs and outputs."""
    return members.get(kind.name.lower()) or [*kind.inputs.values(), *kind.outputs.values()]


def _member(value: Any, name: str) -> Any:
    return getattr(value, f"v_{name.lower()}", None)


def _first(value: Any) -> Any:
    """Return the first element of an array, which has the type of the others."""
    while isinstance(value, list):
        value = value[0] if value else None
    return value


def most_bytes(kind: ty.Type, now: Any) -> int:
    """Return the largest size in bytes that a value can have as MessagePack. `now` is the present data of the value."""
    if isinstance(kind, ty.String):
        return 5 + 3 * kind.length
    if isinstance(now, str):  # a character, or the bytes of a union
        return 5 + 3 * len(now)
    if isinstance(now, list):
        of = kind.of if isinstance(kind, ty.Array) else kind
        return 5 + len(now) * max((most_bytes(of, item) for item in now[:1]), default=0)
    if isinstance(now, dict):
        fields = kind.fields if isinstance(kind, ty.Struct) else {}
        inside = sum(
            5 + len(n) + most_bytes(fields[n[2:]][1] if n[2:] in fields else ty.LINT, v) for n, v in now.items()
        )
        return 5 + inside + (256 * kind.elements if isinstance(kind, ty.Block) else 0)
    return 9


def dump(value: Any) -> Any:
    """Return the plain data of a value: objects by their slots (`_own`), unions by their bytes, references as None."""
    if isinstance(value, REFERENCES):
        return None
    if isinstance(value, Union):
        return value.content.hex()
    if isinstance(value, list):
        return [dump(v) for v in value]
    slots = getattr(value, "__slots__", None)
    if slots is None or isinstance(value, str | int | float):
        return value
    return {name: dump(getattr(value, name)) for name in _own(value)}


def retained_part(value: Any) -> Any:
    """Return the plain data of the variables in a value that are RETAIN in their function block; None if it has none."""
    if isinstance(value, list):
        parts = [retained_part(v) for v in value]
        return parts if any(part is not None for part in parts) else None
    if isinstance(value, (*REFERENCES, Instance, FunctionBlock, Union, str)) or not hasattr(value, "__slots__"):
        return None
    found = {}
    whole = getattr(value, "retain", ())
    for name in _own(value):
        part = getattr(value, name)
        kept = dump(part) if name in whole else retained_part(part)
        if name in whole or kept is not None:
            found[name] = kept
    return found or None


def _own(value: Any) -> list[str]:
    """Return the slots to be saved.

    The times of a timer, which have no meaning after a restart, references of VAR_IN_OUTs, and VAR NON_RETAIN are not saved.
    """
    others = {*getattr(value, "in_outs", ()), *getattr(value, "non_retain", ())}
    return [name for name in value.__slots__ if name not in others and not (name[0] == "_" and name.endswith("_ns"))]


def load(into: Any, kept: Any) -> Any:
    """Return `kept` in the form of `into`; raises `FileInvalid` if the forms differ. References stay as they are."""
    if isinstance(into, REFERENCES):
        return into
    if isinstance(into, Union) and isinstance(kept, str):
        into.content = bytes.fromhex(kept)
        return into
    if isinstance(into, list) and isinstance(kept, list) and len(into) == len(kept):
        return [load(a, b) for a, b in zip(into, kept, strict=True)]
    slots = getattr(into, "__slots__", None)
    if slots is not None and isinstance(kept, dict):
        for name in _own(into):
            if name in kept:
                setattr(into, name, load(getattr(into, name), kept[name]))
        return into
    # an attribute of a block that had no value at first
    if into is None and isinstance(kept, bool | int | float | str | None):
        return kept
    if type(into) is type(kept) or (isinstance(into, float) and isinstance(kept, int)):
        return float(kept) if isinstance(into, float) else kept
    raise FileInvalid("a retained value of another form", expected=type(into).__name__, got=type(kept).__name__)
