"""The POUs on the call stack of a stopped program, and their variables."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from types import FrameType
from typing import Any

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.compiler.scope import Symbol
from fieldtwin.plc.st.inspection import Inspection, elements, first_name, literal

MAX_ELEMENTS = 1000
"""How many elements of an array are listed."""
_POU = re.compile(r"(?:f|B|P)_(\w+)")


@dataclass(frozen=True, slots=True)
class Variable:
    """A variable, or a part of one, of a stopped program."""

    name: str
    type: ty.Type
    value: Any

    @property
    def has_parts(self) -> bool:
        return isinstance(self.type, ty.Struct | ty.Block | ty.Array)

    @property
    def text(self) -> str:
        """Return the value as in the source; for a variable with parts its type."""
        return (
            str(self.type) if self.has_parts and not isinstance(self.type, ty.Array) else literal(self.type, self.value)
        )


class Units:
    """The compiled units of a session, by the names of their files."""

    def __init__(self, units: Sequence[CompiledUnit], names: Mapping[str, str]) -> None:
        """`names` are the names to show of POUs that the source does not name, such as tests, in lower case."""
        self._by_file = {file: unit for unit in units for file in unit.files}
        self._inspections = {file: Inspection(unit, ()) for unit in units for file in unit.files}
        self._names = names

    def of(self, frame: FrameType) -> CompiledUnit | None:
        return self._by_file.get(frame.f_code.co_filename)

    def title(self, frame: FrameType) -> str:
        """Return the name of the POU that a frame executes."""
        key, _, inner = _key(frame).partition(".")
        unit = self.of(frame)
        name = self._names.get(key) or (unit.names.get(key, key) if unit is not None else key)
        if not inner or inner == "execute":
            return name
        own = unit.names.get(f"{key}.{inner[2:]}", inner[2:]) if unit is not None else inner[2:]
        return f"{name}.{own}"

    def variables(self, frame: FrameType) -> list[Variable]:
        """Return the variables of the POU that a frame executes, without global ones."""
        return [
            found
            for symbol in self._symbols(frame)
            if not symbol.code.startswith("_G.")
            for found in _read(symbol, frame)
        ]

    def global_variables(self, frame: FrameType) -> list[Variable]:
        """Return the global variables of the unit of a frame."""
        unit = self.of(frame)
        return [found for symbol in unit.global_symbols for found in _read(symbol, frame)] if unit is not None else []

    def parts(self, variable: Variable, frame: FrameType) -> list[Variable]:
        """Return the members or elements of a variable; at most `MAX_ELEMENTS` of an array."""
        kind, value, inspection = variable.type, variable.value, self._inspections.get(frame.f_code.co_filename)
        if isinstance(kind, ty.Array):
            return [Variable(index, kind.of, one) for index, one in islice(elements(kind, value), MAX_ELEMENTS)]
        if isinstance(kind, ty.Struct | ty.Block) and inspection is not None:
            return [Variable(*member) for member in inspection.members(kind, value)]
        return []

    def find(self, path: str, frame: FrameType) -> Variable | None:
        """Return the variable with this path, such as ``levels[3]`` or ``timer.ET``, in any case of letters; None without one."""
        name, rest = first_name(path)
        known = [*self.variables(frame), *self.global_variables(frame)]
        top = next((one for one in known if one.name.lower() == name.strip().lower()), None)
        inspection = self._inspections.get(frame.f_code.co_filename)
        if top is None or inspection is None:
            return None
        found = inspection.within((top.type, top.value), rest)
        return Variable(path, *found) if found is not None else None

    def _symbols(self, frame: FrameType) -> list[Symbol]:
        """Return the variables that a frame sees, without global ones."""
        unit = self.of(frame)
        if unit is None:
            return []
        pou, _, inner = _key(frame).partition(".")
        return list(unit.symbols.get(f"{pou}.{inner.removeprefix('m_')}") or unit.symbols.get(pou, ()))


def _key(frame: FrameType) -> str:
    """Return the name of the POU in lower case, with the name of the Python method after it."""
    return _POU.sub(r"\1", frame.f_code.co_qualname, count=1)


def _read(symbol: Symbol, frame: FrameType) -> Iterator[Variable]:
    """Yield the variable of a symbol, if it has a value at this place. The compiler wrote the expression that is evaluated."""
    if symbol.name[:1].isdigit():  # of the translation of charts and drawings
        return
    try:
        value = eval(symbol.code, frame.f_globals, frame.f_locals)
    except (NameError, AttributeError):
        return
    yield Variable(symbol.name, symbol.type, value)
