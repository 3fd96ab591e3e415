"""The variables of a running program that are not tags, by their paths: members of blocks and structures, arrays, strings.

A path is written as in the source: ``delay.ET``, ``levels[3]``, ``pumps[2].hours``, in any case of letters. The VAR_INST ``n`` of
a method ``Next`` is ``pump.Next.n``, in an instance of the method's owner.
Nothing is changed, and only the wanted variables are read, because this happens between two scans.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice, product
from typing import Any

from fieldtwin.gateway.core.values import Scalar
from fieldtwin.plc.program import InternalVariable
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st import values
from fieldtwin.plc.st.classes.instance_variables import is_instance_variable, own_name, shown_name
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.runtime.parts import Key

SHOWN_ELEMENTS = 6
"""How many elements of an array are shown in one text."""
_STEP = re.compile(r"\.(\w+)|\[\s*(-?\d+(?:\s*,\s*-?\d+)*)\s*\]")
_MEMBER = re.compile(r"\.(\w+)")
_DATES: dict[str, Callable[[int], str]] = {
    "date": values.date_text,
    "tod": values.tod_text,
    "dt": values.moment_text,
}

Typed = tuple[ty.Type, Any]
"""A type and a value of it."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a variable is: its `path` as declared, the attributes and elements that lead to it from the program, and its type."""

    path: str
    keys: tuple[Key, ...]
    kind: ty.Type


def code_of(keys: Sequence[Key]) -> str:
    """Return the Python code of attributes and elements, such as ``.v_levels[2]``."""
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys)


class Inspection:
    """The types of a unit's function blocks, and the variables of a program: its top level, by the name as declared."""

    def __init__(self, unit: CompiledUnit, variables: Sequence[tuple[str, ty.Type]]) -> None:
        self._blocks = {name: _declared(of) for name, of in unit.blocks.items()}
        self._variables = _declared(variables)

    def names(self, body: Any) -> Iterator[str]:
        """Return the path of every variable of `body`; an array of simple values has one path."""
        for name, kind in self._variables:
            yield from self.below(name, kind, _of(body, name))

    def find(self, body: Any, path: str) -> InternalVariable | None:
        """Return the variable with this path in `body`, and None for a path that names no variable, or one with members."""
        name, rest = self.first(path)
        top = next((found for found in self._variables if found[0].lower() == name.lower()), None)
        if top is None:
            return None
        found = self.within((top[1], _of(body, top[0])), rest)
        if found is None or isinstance(found[0], ty.Struct | ty.Block):
            return None
        return InternalVariable(path, str(found[0]), shown_value(*found))

    def within(self, found: Typed | None, rest: str) -> Typed | None:
        """Return the part of a variable that the `rest` of a path selects, such as ``.ET`` or ``[3]``; None for any other."""
        at = 0
        while found is not None and at < len(rest):
            step = _STEP.match(rest, at)
            if step is None:
                return None
            member, at = self._with_method(found[0], step, rest)
            found = self._member(found, member) if member else _element(found, step[2])
        return found

    def first(self, path: str) -> tuple[str, str]:
        """Return the name of the variable with which a path begins, also that of a VAR_INST, and the rest."""
        name, rest = first_name(path)
        name, at = _joined(name, rest, 0, self._variables)
        return name, rest[at:]

    def _with_method(self, kind: ty.Type, step: re.Match[str], rest: str) -> tuple[str, int]:
        """Return the member that a step selects, with the name of its method if it is a VAR_INST, and where the step ends."""
        declared = self._blocks.get(kind.name.lower(), ()) if isinstance(kind, ty.Block) else ()
        return _joined(step[1], rest, step.end(), declared) if step[1] else ("", step.end())

    def assigning(self, owner: Typed, step: str) -> Callable[[Any], None] | None:
        """Return the function that assigns a part of `owner`, such as ``.PT`` or ``[3]``.

        Return None for a part that only its block may set, such as ``.Q`` of a timer, and for a reference.
        """
        kind, value = owner
        found = self.within(owner, step)
        if found is None or isinstance(found[0], ty.Pointer | ty.Interface | ty.MessagesIn | ty.MessagesOut):
            return None
        if isinstance(kind, ty.Array):
            *outer, last = _indices(kind, step.strip("[]"))
            holder = _at(kind, value, outer)
            return lambda new: holder.__setitem__(last - kind.ranges[len(outer)][0], new)
        if isinstance(kind, ty.Block) and kind.standard is not None and step[1:].lower() not in kind.inputs:
            return None
        attribute = self.member_attribute(kind, step[1:])
        return (lambda new: setattr(value, attribute[0], new)) if attribute is not None else None

    def attribute(self, path: str) -> tuple[str, ty.Type] | None:
        """Return the Python attributes of a path without indices, such as ``v_delay.ET``, and the type of its value.

        None for other paths, and for a variable with members.
        """
        found = self.code(path) if "[" not in path else None
        return None if found is None or isinstance(found[1], ty.Struct | ty.Block | ty.Array) else found

    def code(self, path: str) -> tuple[str, ty.Type] | None:
        """Return the Python attributes and indices of a path, such as ``v_levels[2]``, and its type; None for an unknown path."""
        found = self.place(path)
        return (code_of(found.keys).removeprefix("."), found.kind) if found is not None else None

    def code_within(self, code: str, kind: ty.Type, rest: str) -> tuple[str, ty.Type] | None:
        """Return the Python code and the type of a part of a variable, whose own `code` and `kind` are given, as `code`
        does.
        """
        found = self.place_within(Place("", (), kind), rest)
        return (f"{code}{code_of(found.keys)}", found.kind) if found is not None else None

    def place(self, path: str) -> Place | None:
        """Return the place of a variable of the program; None for an unknown path."""
        name, rest = self.first(path)
        top = next((found for found in self._variables if found[0].lower() == name.lower()), None)
        if top is None:
            return None
        return self.place_within(Place(top[0], (f"v_{own_name(top[0]).lower()}",), top[1]), rest)

    def place_within(self, found: Place, rest: str) -> Place | None:
        """Return the place of a part of the variable `found`, such as ``.ET`` or ``[3]``; None for an unknown part."""
        at = 0
        while at < len(rest):
            step = _STEP.match(rest, at)
            if step is None:
                return None
            kind = found.kind
            named, at = self._with_method(kind, step, rest)
            if named:
                member = self.member_attribute(kind, named)
                if member is None:
                    return None
                found = Place(f"{found.path}.{self._declared_member(kind, named)}", (*found.keys, member[0]), member[1])
            else:
                indices = _indices(kind, step[2])
                if not isinstance(kind, ty.Array) or not indices:
                    return None
                keys = (i - low for i, (low, _) in zip(indices, kind.ranges, strict=True))
                index = ",".join(map(str, indices))
                found = Place(f"{found.path}[{index}]", (*found.keys, *keys), kind.of)
        return found

    def _declared_member(self, kind: ty.Type, member: str) -> str:
        """Return the name of a member as it is declared."""
        if isinstance(kind, ty.Struct):
            return kind.fields[member.lower()][0]
        if isinstance(kind, ty.Block) and kind.standard is not None:
            return {**kind.inputs, **kind.outputs}[member.lower()][0]
        assert isinstance(kind, ty.Block)
        return next(name for name, _ in self._blocks[kind.name.lower()] if name.lower() == member.lower())

    def member_attribute(self, kind: ty.Type, member: str) -> tuple[str, ty.Type] | None:
        """Return the attribute of a member of a structure or block, and its type; None for others."""
        key = member.lower()
        if isinstance(kind, ty.Struct):
            return (f"m_{key}", kind.fields[key][1]) if key in kind.fields else None
        if not isinstance(kind, ty.Block):
            return None
        if kind.standard is not None:
            return {**kind.inputs, **kind.outputs}.get(key)
        own = own_name(key)
        return next(((f"v_{own}", of) for name, of in self._blocks[kind.name.lower()] if name.lower() == key), None)

    def variables_of(self, kind: ty.Block) -> Sequence[tuple[str, ty.Type]]:
        """Return the variables of a function block of the user, with their types."""
        return self._blocks.get(kind.name.lower(), ())

    def below(self, name: str, kind: ty.Type, value: Any) -> Iterator[str]:
        """Return the path of a variable, or of each of its parts."""
        if isinstance(kind, ty.Struct | ty.Block):
            for member, of, inside in self.members(kind, value):
                yield from self.below(f"{name}.{member}", of, inside)
        elif isinstance(kind, ty.Array) and isinstance(kind.of, ty.Struct | ty.Block | ty.Array):
            for index, element in elements(kind, value):
                yield from self.below(f"{name}{index}", kind.of, element)
        else:
            yield name

    def members(self, kind: ty.Struct | ty.Block, value: Any) -> Iterator[tuple[str, ty.Type, Any]]:
        """Return the name, type and value of each member of a structure or block."""
        if isinstance(kind, ty.Struct):
            for field, (name, of) in kind.fields.items():
                yield name, of, getattr(value, f"m_{field}")
        elif kind.standard is not None:
            for name, of in (*kind.inputs.values(), *kind.outputs.values()):
                yield name, of, getattr(value, name)
        else:
            for name, of in self._blocks[kind.name.lower()]:
                yield name, of, _of(value, name)

    def _member(self, found: Typed, name: str) -> Typed | None:
        kind, value = found
        if not isinstance(kind, ty.Struct | ty.Block):
            return None
        members = self.members(kind, value)
        return next(((of, inside) for member, of, inside in members if member.lower() == name.lower()), None)


def _declared(variables: Sequence[tuple[str, ty.Type]]) -> list[tuple[str, ty.Type]]:
    """Return the variables that a source declares. The compiler adds blocks for drawn edges, whose names begin with a number."""
    return [(shown_name(name), kind) for name, kind in variables if not name[0].isdigit() or is_instance_variable(name)]


def _joined(name: str, rest: str, at: int, declared: Sequence[tuple[str, ty.Type]]) -> tuple[str, int]:
    """Return a name with the members after it, from `at` on, that belong to the name of a VAR_INST, and where these end."""
    while any(known.lower().startswith(f"{name.lower()}.") for known, _ in declared):
        following = _MEMBER.match(rest, at)
        if following is None:
            break
        name, at = f"{name}.{following[1]}", following.end()
    return name, at


def first_name(path: str) -> tuple[str, str]:
    """Return the name with which a path begins, and the rest."""
    end = next((at for at, letter in enumerate(path) if letter in ".["), len(path))
    return path[:end], path[end:]


def last_step(rest: str) -> tuple[str, str]:
    """Return the rest of a path without its last member or index, and this; both empty if it is not the rest of a path."""
    steps = list(_STEP.finditer(rest))
    return (rest[: steps[-1].start()], steps[-1][0]) if steps else ("", "")


def _of(body: Any, name: str) -> Any:
    return getattr(body, f"v_{own_name(name).lower()}")


def _element(found: Typed, index: str) -> Typed | None:
    kind, value = found
    at = _indices(kind, index)
    return (kind.of, _at(kind, value, at)) if isinstance(kind, ty.Array) and at else None


def _indices(kind: ty.Type, index: str) -> tuple[int, ...]:
    """Return the indices of an element; empty for those that the array does not have."""
    at = tuple(int(part) for part in index.split(","))
    if not isinstance(kind, ty.Array) or len(at) != len(kind.ranges):
        return ()
    inside = all(low <= i <= high for i, (low, high) in zip(at, kind.ranges, strict=True))
    return at if inside else ()


def elements(kind: ty.Array, value: Any) -> Iterator[tuple[str, Any]]:
    """Return each element of an array with its index, such as ``[3]`` or ``[1,2]``."""
    for at in product(*(range(low, high + 1) for low, high in kind.ranges)):
        yield f"[{','.join(map(str, at))}]", _at(kind, value, at)


def _at(kind: ty.Array, value: Any, at: Sequence[int]) -> Any:
    for i, (low, _) in zip(at, kind.ranges, strict=False):
        value = value[i - low]
    return value


def shown_value(kind: ty.Type, value: Any) -> Scalar | str:
    """Return a value for display: an enumerated value by its name, a date as a literal, an array with its first elements.

    Of a variable of an interface type, the type of the instance is shown.
    """
    if isinstance(kind, ty.Array):
        return _elements(kind, value)
    if isinstance(kind, ty.Interface):
        return "NULL" if value is None else f"an instance of {value.of.name}"
    if isinstance(kind, ty.Enum):
        return next((word for word, number in kind.values.items() if number == value), str(value))
    if isinstance(kind, ty.Pointer):
        return "NULL" if value is None else "a reference"
    if isinstance(kind, ty.String) or ty.is_kind(kind, "char"):
        return f"'{value}'"
    if isinstance(kind, ty.Elementary) and kind.kind in _DATES:
        return _DATES[kind.kind](value)
    return value if isinstance(value, bool | int | float | str) else str(value)


def literal(kind: ty.Type, value: Any) -> str:
    """Return a value as it is written in the source, with 12 digits of a REAL."""
    if isinstance(value, bool):
        return str(value).upper()
    if ty.is_kind(ty.plain(kind), "duration"):
        return values.duration_text(value, "T")
    found = shown_value(kind, value)
    return values.real_text(found, 12) if isinstance(found, float) else str(found)


def _elements(kind: ty.Array, value: list[Any]) -> str:
    count = ty.elements(ty.Array(kind.ranges, ty.INT))
    texts = [_text(shown_value(kind.of, one)) for _, one in islice(elements(kind, value), SHOWN_ELEMENTS)]
    return f"[{', '.join(texts)}{f', ... {count} elements' if count > SHOWN_ELEMENTS else ''}]"


def _text(value: Scalar | str) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
