"""Which values a new version of a unit takes over from the version that runs, decided from the declarations of both.

A variable keeps its value if its name (in any case of letters), its kind of block (VAR_INPUT, VAR_OUTPUT or another) and its
type are the same. Structures and function blocks are compared member by member, so a member that is added or removed does not
affect the others; a union keeps its memory if all its members are the same. A block of the standard, such as a timer, is taken
over as it is, with its hidden state. The value of an enumeration is taken over by its name, because a value that is inserted
changes the numbers of those after it.

IEC 61131-3 does not define online changes; these are the rules that other PLC systems document.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.charts.translate import STEP, is_hidden
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.compiler.pous.programs import CompiledProgram

Move = Callable[[Any, Any], Any]
"""Returns the value of a variable from the value that it has now, and its initial value, which may be changed."""


class StepRemoved(FieldtwinError):
    """The new version does not have an active step of a sequential function chart, which could not continue."""

    exit_code = 1


@dataclass(slots=True)
class Differences:
    """The effects of a change on the variables of a program or a unit.

    Members are named with their type, such as ``Pump.hours``.
    """

    kept: int = 0
    """How many variables keep their values; a variable with members counts as one."""
    new: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    references: list[str] = field(default_factory=list)
    """The variables that refer to others. They cannot be taken over, because they refer to variables of the version that runs."""
    changed: list[str] = field(default_factory=list)
    """The variables that begin with their initial values, because their declaration changed, each with the change."""

    def add(self, other: Differences) -> None:
        self.kept += other.kept
        self.new += other.new
        self.removed += other.removed
        self.changed += other.changed
        self.references += other.references


@dataclass(frozen=True, slots=True)
class _Declared:
    """A variable or a member: its name, its kind of block, its type, and the attribute that holds its value."""

    name: str
    block: str
    kind: ty.Type
    attribute: str

    def __str__(self) -> str:
        return f"{self.block} {self.kind}".strip()


_Members = Mapping[str, _Declared]
"""Variables or members by their names in lower case."""


class Carrying:
    """The values that the unit `new` takes over from the unit `old`.

    `shared` has the differences of global variables, and of the members of structures and function blocks.
    """

    def __init__(self, old: CompiledUnit, new: CompiledUnit) -> None:
        self.shared = Differences()
        self._units = old, new
        self._types: dict[tuple[str, str], Move] = {}
        """The moves of structures and function blocks, by the kind of type and its name in lower case."""
        before, after = (
            {key: _Declared(v.name, "", v.kind, v.attribute) for key, v in u.globals.items()} for u in self._units
        )
        self.globals: Move = self._moves(before, after, "", self.shared)
        """Moves the global variables, from the object that holds them to a new one."""

    def program(self, old: CompiledProgram, new: CompiledProgram) -> tuple[Move, Differences]:
        """Return the move of a program's own variables between the objects that hold them, and the differences."""
        found = Differences()
        return self._moves(_of_program(old), _of_program(new), "", found), found

    def _moves(self, old: _Members, new: _Members, of: str, found: Differences) -> Move:
        """Return the move of the variables of an object, and add the differences to `found`, with `of` before their names."""
        moves: list[tuple[str, str, Move]] = []
        for key, after in new.items():
            before = old.get(key)
            move = None
            if before is not None and _refers(before.kind) and _refers(after.kind):
                _note(found.references, of, after)
                continue
            if before is not None and before.block == after.block:
                move = self._move(before.kind, after.kind)
            if move is not None and before is not None:
                moves.append((before.attribute, after.attribute, move))
                found.kept += not is_hidden(after.name)
            elif before is None:
                _note(found.new, of, after)
            else:
                change = f"{before} -> {after}" if str(before) != str(after) else f"the members of {after.kind} differ"
                _note(found.changed, of, after, f" ({change})")
        removed = [before for key, before in old.items() if key not in new]
        for before in removed:
            _note(found.removed, of, before)
        steps = [step for step in removed if isinstance(step.kind, ty.Block) and step.kind.name == STEP]

        def moved(present: Any, initial: Any) -> Any:
            for step in steps:
                if getattr(present, step.attribute).v_x:
                    raise StepRemoved(f"step {of}{step.name} is active, and the new version does not have it")
            for source, target, move in moves:
                setattr(initial, target, move(getattr(present, source), getattr(initial, target)))
            return initial

        return moved

    def _move(self, old: ty.Type, new: ty.Type) -> Move | None:
        """Return the move between two types; None if values cannot be taken over."""
        if isinstance(old, ty.Enum) and isinstance(new, ty.Enum):
            return _enumerated(old, new) if old.name.lower() == new.name.lower() else None
        if isinstance(old, ty.Array) and isinstance(new, ty.Array):
            return self._array(old, new) if old.ranges == new.ranges else None
        if isinstance(old, ty.Struct) and isinstance(new, ty.Struct):
            if old.union or new.union:
                return _same_memory if old == new else None
            return self._members("structure", old, new)
        if isinstance(old, ty.Block) and isinstance(new, ty.Block):
            if old.standard is not None or new.standard is not None:
                return _taken if old.standard is new.standard else None
            return self._members("function block", old, new)
        if isinstance(old, ty.MessagesIn | ty.MessagesOut):
            return None
        return _taken if old == new else None

    def _array(self, old: ty.Array, new: ty.Array) -> Move | None:
        move = self._move(old.of, new.of)
        if move is None or move is _taken:
            return move
        each = move

        def elements(present: list[Any], initial: list[Any], dimensions: int) -> list[Any]:
            pairs = zip(present, initial, strict=True)
            if dimensions == 1:
                return [each(a, b) for a, b in pairs]
            return [elements(a, b, dimensions - 1) for a, b in pairs]

        return lambda present, initial: elements(present, initial, len(old.ranges))

    def _members(self, what: str, old: ty.Struct | ty.Block, new: ty.Struct | ty.Block) -> Move | None:
        key = what, new.name.lower()
        if old.name.lower() != key[1]:
            return None
        if key not in self._types:
            before, after = (_members_of(kind, unit) for kind, unit in zip((old, new), self._units, strict=True))
            found = Differences()
            self._types[key] = self._moves(before, after, f"{new.name}.", found)
            found.kept = 0  # a variable with members counts as one
            self.shared.add(found)
        return self._types[key]


def _of_program(program: CompiledProgram) -> dict[str, _Declared]:
    """Return the variables of a program, without those that are global or carry messages, which are bound from outside."""
    return {
        v.name.lower(): _Declared(
            v.name, {"input": "VAR_INPUT", "output": "VAR_OUTPUT"}.get(v.role, "VAR"), v.kind, str(v.attribute)
        )
        for v in program.variables
        if not v.shared and not v.steps and not isinstance(v.kind, ty.MessagesIn | ty.MessagesOut)
    }


def _members_of(kind: ty.Struct | ty.Block, unit: CompiledUnit) -> dict[str, _Declared]:
    if isinstance(kind, ty.Struct):
        return {key: _Declared(name, "", of, f"m_{key}") for key, (name, of) in kind.fields.items()}
    blocks = {**dict.fromkeys(kind.inputs, "VAR_INPUT"), **dict.fromkeys(kind.outputs, "VAR_OUTPUT")}
    return {
        name.lower(): _Declared(name, blocks.get(name.lower(), "VAR"), of, f"v_{name.lower()}")
        for name, of in unit.blocks[kind.name.lower()]
    }


def _refers(kind: ty.Type) -> bool:
    """Return whether a value of this type is a reference, or an array of them. Members of structures are asked separately."""
    if isinstance(kind, ty.Array):
        return _refers(kind.of)
    return isinstance(kind, ty.Pointer | ty.Interface)


def _note(names: list[str], of: str, declared: _Declared, more: str = "") -> None:
    if not is_hidden(declared.name) and not is_hidden(of):
        names.append(f"{of}{declared.name}{more}")


def _taken(present: Any, initial: Any) -> Any:
    """Take over a value of the same type: the object itself, because the old version is not executed again."""
    return present


def _same_memory(present: Any, initial: Any) -> Any:
    """Take over the bytes of a union whose members are the same."""
    initial.assign(present)
    return initial


def _enumerated(old: ty.Enum, new: ty.Enum) -> Move:
    if old.values == new.values:
        return _taken
    numbers = {name.lower(): number for name, number in new.values.items()}
    by_number = {number: numbers[name.lower()] for name, number in old.values.items() if name.lower() in numbers}
    return lambda present, initial: by_number.get(present, initial)
