"""The POUs on the call stack of a stopped program, their variables, and new values for these."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from types import CodeType
from typing import Any

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.debug.expressions import Expression, compile_expression, instance_variables, known_part
from fieldtwin.plc.debug.tracer import StoppedFrame, pou_key
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.compiler.scope import Symbol
from fieldtwin.plc.st.inspection import Inspection, elements, first_name, last_step, literal

MAX_ELEMENTS = 1000
"""How many elements of an array are listed."""
Assign = Callable[[Any], None]


@dataclass(frozen=True, slots=True)
class Variable:
    """A variable, or a part of one, of a stopped program. `assign` gives it a new value; None if it cannot have one.

    `path` is an expression for it in the source, such as ``timer.ET`` or ``levels[3]``.
    """

    name: str
    path: str
    type: ty.Type
    value: Any
    assign: Assign | None = field(default=None, compare=False)

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

    def of(self, code: CodeType) -> CompiledUnit | None:
        return self._by_file.get(code.co_filename)

    def title(self, code: CodeType) -> str:
        """Return the name of the POU to which code belongs, such as ``Tank.Fill`` for a method."""
        key, unit = pou_key(code), self.of(code)
        names = {**(unit.names if unit is not None else {}), **self._names}
        found = known_part(key, names)
        owner = found.rpartition(".")[0]
        own = names.get(found, key)
        return f"{names[owner]}.{own}" if owner in names else own

    def variables(self, frame: StoppedFrame) -> list[Variable]:
        """Return the variables of the POU that a frame executes, without global ones."""
        return [
            found
            for symbol in self._symbols(frame.code)
            if not symbol.code.startswith("_G.")
            for found in _read(symbol, frame)
        ]

    def global_variables(self, frame: StoppedFrame) -> list[Variable]:
        """Return the global variables of the unit of a frame."""
        unit = self.of(frame.code)
        return [found for symbol in unit.global_symbols for found in _read(symbol, frame)] if unit is not None else []

    def parts(self, variable: Variable, frame: StoppedFrame) -> list[Variable]:
        """Return the members or elements of a variable; at most `MAX_ELEMENTS` of an array."""
        kind, value, inspection = variable.type, variable.value, self._inspections.get(frame.code.co_filename)
        if inspection is None:
            return []
        if isinstance(kind, ty.Array):
            return [
                Variable(index, f"{variable.path}{index}", kind.of, one, inspection.assigning((kind, value), index))
                for index, one in islice(elements(kind, value), MAX_ELEMENTS)
            ]
        if isinstance(kind, ty.Struct | ty.Block):
            return [
                Variable(name, f"{variable.path}.{name}", of, inside, inspection.assigning((kind, value), f".{name}"))
                for name, of, inside in inspection.members(kind, value)
            ]
        return []

    def find(self, path: str, frame: StoppedFrame) -> Variable | None:
        """Return the variable with this path, such as ``levels[3]`` or ``timer.ET``, in any case of letters; None without one."""
        name, rest = first_name(path)
        known = [*self.variables(frame), *self.global_variables(frame)]
        top = next((one for one in known if one.name.lower() == name.strip().lower()), None)
        inspection = self._inspections.get(frame.code.co_filename)
        if top is None or inspection is None or not rest:
            return top
        found = inspection.within((top.type, top.value), rest)
        before, step = last_step(rest)
        owner = inspection.within((top.type, top.value), before) if step else None
        if found is None or owner is None:
            return None
        return Variable(path, path, *found, inspection.assigning(owner, step))

    def evaluate(self, text: str, frame: StoppedFrame) -> Variable:
        """Return the variable with the path `text`, else the value of the expression `text`. Raises `UsageError`."""
        found = self.find(text, frame)
        if found is not None:
            return found
        expression = self.expression(frame.code, text)
        return Variable(text, text, expression.type, expression.value(frame.space, frame.local))

    def assign(self, variable: Variable, text: str, frame: StoppedFrame) -> Variable:
        """Give a variable the value of the expression `text`, and return it with that value. Raises `UsageError`."""
        if variable.has_parts:
            raise UsageError(f"{variable.name} has parts", expected="a member or an element of it")
        if variable.assign is None:
            raise UsageError(f"{variable.name} cannot be set here")
        value = self.expression(frame.code, text, variable.type).value(frame.space, frame.local)
        variable.assign(value)
        return replace(variable, value=value)

    def expression(self, code: CodeType, text: str, wanted: ty.Type | None = None) -> Expression:
        """Compile an expression in the scope of the POU to which code belongs. Raises `UsageError`."""
        unit = self.of(code)
        if unit is None:
            raise UsageError("an expression outside of the program")
        return compile_expression(unit, pou_key(code), text, wanted)

    def _symbols(self, code: CodeType) -> list[Symbol]:
        """Return the variables that code sees, without global ones."""
        unit = self.of(code)
        pou = pou_key(code)
        found = unit.symbols.get(known_part(pou, unit.symbols), ()) if unit is not None else ()
        return [*found, *instance_variables(pou, found)]


def _read(symbol: Symbol, frame: StoppedFrame) -> Iterator[Variable]:
    """Yield the variable of a symbol, if it has a value at this place. The compiler wrote the expression that is evaluated."""
    if symbol.name[:1].isdigit():  # of the translation of charts and drawings
        return
    try:
        value = eval(symbol.code, frame.space, frame.local)
    except (NameError, AttributeError):
        return
    yield Variable(symbol.name, symbol.name, symbol.type, value, _assigning(symbol, frame))


def _assigning(symbol: Symbol, frame: StoppedFrame) -> Assign | None:
    """Return the function that assigns the variable of a symbol; None for a constant and for a reference."""
    if symbol.is_constant or isinstance(symbol.type, ty.Pointer | ty.Interface | ty.MessagesIn | ty.MessagesOut):
        return None
    owner, _, attribute = symbol.code.rpartition(".")

    def assign(value: Any) -> None:
        if owner:
            setattr(eval(owner, frame.space, frame.local), attribute, value)
        elif frame.settable:
            frame.changes[symbol.code] = value
        else:
            what = f"the local variable {symbol.name} can be set only in the POU that has stopped at a line"
            raise UsageError(what, hint="step to a line of its POU first")

    return assign
