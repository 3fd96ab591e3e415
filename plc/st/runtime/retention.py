"""The retained data of variables, as data for JSON, and its size (IEC 61131-3:2013, 6.5.6)."""

from __future__ import annotations

from typing import Any

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.blocks import FunctionBlock
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.runtime.layouts import Union
from fieldtwin.plc.st.runtime.references import REFERENCES, Instance


def described(kind: ty.Type) -> Any:
    """Return a description of a type by the names and elementary types of its values, as data for JSON."""
    if isinstance(kind, ty.Array):
        return [kind.ranges, described(kind.of)]
    if isinstance(kind, ty.Struct):
        fields = [[name, described(of)] for name, (_, of) in kind.fields.items()]
        return {"union": fields, "packed": kind.packed} if kind.union else fields
    if isinstance(kind, ty.Block):
        members = {**kind.inputs, **kind.outputs}
        return [kind.name.lower(), [[name, described(of)] for name, (_, of) in members.items()]]
    if isinstance(kind, ty.Enum):
        return [kind.name.lower(), sorted(kind.values.items())]
    return str(kind)


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
