"""The variables of a program by their paths, with the global variables of its unit: ``delay.ET``, ``levels[3]``, ``valves.open``.

A path without the name of a variable of the program names a global one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from fieldtwin.plc.program import InternalVariable
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.classes.instance_variables import shown_name
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.compiler.pous.programs import CompiledProgram, ProgramVariable
from fieldtwin.plc.st.compiler.pous.variables import GlobalVariable
from fieldtwin.plc.st.inspection import Inspection, Place, Typed, code_of, first_name, shown_value

Read = Callable[[Any, Any], Any]
"""Reads a variable from the object of the program and that of the global variables."""


class VariablePaths:
    """The paths of one program. `hidden` are its variables that are not tags."""

    def __init__(self, unit: CompiledUnit, program: CompiledProgram, hidden: Sequence[ProgramVariable]) -> None:
        self._hidden = Inspection(unit, [(v.name, v.kind) for v in hidden])
        self._every = Inspection(unit, [(v.name, v.kind) for v in program.variables if not v.shared and not v.steps])
        self._shared = {v.name.lower(): v for v in program.variables if v.shared and not v.steps}
        self._own = {shown_name(v.name).lower(): v for v in program.variables if not v.steps}
        self._globals = _globals_of(unit, program)

    def internal_names(self, body: Any, shared: Any) -> Iterator[str]:
        """Return the paths of the variables that are not tags. `shared` is the object that holds the global ones."""
        yield from self._hidden.names(body)
        for name, of in self._globals.values():
            yield from self._hidden.below(name, of.kind, getattr(shared, of.attribute))

    def internal(self, path: str, body: Any, shared: Any) -> InternalVariable | None:
        """Return a variable that is not a tag by its path; None for a path that names no such variable, or one with members."""
        own = self._hidden.find(body, path)
        found = self._global(path) if own is None else None
        if found is None:
            return own
        of, rest = found
        part = self._hidden.within((of.kind, getattr(shared, of.attribute)), rest)
        if part is None or isinstance(part[0], ty.Struct | ty.Block):
            return None
        return InternalVariable(path, str(part[0]), shown_value(*part))

    def reading(self, path: str) -> tuple[ty.Type, Read] | None:
        """Return the type of a variable, also of one that is a tag, and what reads it; None for a path as in `internal`."""
        found = self.place(path)
        if found is None or isinstance(found[0].kind, ty.Struct | ty.Block | ty.MessagesIn | ty.MessagesOut):
            return None
        owner = "shared" if found[1] else "body"
        code = f"lambda body, shared: {owner}{code_of(found[0].keys)}"  # names of declarations, and numbers
        return found[0].kind, eval(code)

    def typed(self, path: str, body: Any, shared: Any) -> Typed | None:
        """Return the type and the value of any variable, also of a structure or block; None for a path that names none."""
        name, rest = self._every.first(path)
        of = self._own.get(name.lower())
        if of is not None:  # without steps, the attribute is a name
            return self.within((of.kind, getattr(shared if of.shared else body, str(of.attribute))), rest)
        found = self._global(path)
        return (
            self.within((found[0].kind, getattr(shared, found[0].attribute)), found[1]) if found is not None else None
        )

    def within(self, found: Typed, rest: str) -> Typed | None:
        """Return the part of a variable that the `rest` of a path selects, such as ``.ET``; None for any other."""
        return self._every.within(found, rest)

    def place(self, path: str) -> tuple[Place, bool] | None:
        """Return the place of any variable, and whether it is a global one or a part of one; None for an unknown path."""
        name, rest = first_name(path)
        shared = self._shared.get(name.lower())
        if shared is not None:
            top = Place(shared.name, (shared.attribute,), shared.kind)
            return _with(self._every.place_within(top, rest), shared=True)
        own = self._every.place(path)
        if own is not None:
            return own, False
        found = self._global(path)
        if found is None:
            return None
        of, rest = found
        of_list = next((shown for shown, one in self._globals.values() if one is of), of.name)
        declared = of_list if len(of_list) == len(path) - len(rest) else of.name
        top = Place(declared, (of.attribute,), of.kind)
        return _with(self._every.place_within(top, rest), shared=True)

    def _global(self, path: str) -> tuple[GlobalVariable, str] | None:
        """Return the global variable with which a path begins, and the rest of the path."""
        name, rest = first_name(path)
        if name.lower() not in self._globals and rest[:1] == ".":  # a variable of a list, such as valves.open
            second, rest = first_name(rest[1:])
            name = f"{name}.{second}"
        found = self._globals.get(name.lower()) or self._only(name.lower())
        return (found[1], rest) if found is not None else None

    def _only(self, name: str) -> tuple[str, GlobalVariable] | None:
        """Return the variable with this name if exactly one list has it."""
        found = [one for key, one in self._globals.items() if key.rpartition(".")[2] == name]
        return found[0] if len(found) == 1 else None


def _with(place: Place | None, *, shared: bool) -> tuple[Place, bool] | None:
    return (place, shared) if place is not None else None


def _globals_of(unit: CompiledUnit, program: CompiledProgram) -> dict[str, tuple[str, GlobalVariable]]:
    """Return the global variables that are not tags, and that no variable of the program hides, by name in lower case."""
    own = {v.name.lower() for v in program.variables}
    shared = {v.attribute for v in program.variables if v.shared and not v.steps}
    found = {}
    for key, of in unit.globals.items():
        of_list = key.rpartition(".")[0]
        if of.attribute not in shared and (of_list or key) not in own and not of.name.startswith("%"):
            found[key] = (f"{of_list}.{of.name}" if of_list else of.name, of)
    return found
