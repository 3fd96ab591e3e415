"""The attributes that keep the lines of the last assignments of variables, and the record of one assignment."""

from __future__ import annotations

import copy
from typing import Any

_PREFIX = "line_"
MEMBER = "m_"
"""The beginning of the attributes that hold the members of structures."""
_INDICES = "at_"

RECORD_HEAD = 3
"""The length of the first part of a record: scan, source and object."""
SOURCE = 2
"""The length of the first part of a source: file and line."""

Record = tuple[Any, ...]
"""A record of an assignment: the number of the scan, the source, the object of the program or function block whose statement it
was, and the values of variables in indices and of pointers. The source has the file, the line and the Python code of these
variables. A function has no object (None). Empty for an assignment whose line is not known."""
Key = int | tuple[int | None, ...] | None
"""The place of an element in its array, from 0: a number, or one for each dimension. None stands for the whole array, and as
the last number for a whole row."""


def line_of(attribute: str) -> str:
    """Return the attribute that keeps the line of the last assignment of `attribute`."""
    return f"{_PREFIX}{attribute}"


def indices_of(attribute: str) -> str:
    """Return the attribute that keeps the values that indices had in the last assignment of `attribute`, after its line."""
    return f"{_PREFIX}{_INDICES}{attribute}"


def is_line(attribute: str) -> bool:
    """Return whether an attribute keeps a line. Lines are not part of a program's state, because no scan depends on them."""
    return attribute.startswith(_PREFIX)


class ElementLines(dict[Key, Record]):
    """The records of the last assignments of the elements of one array. There is at most one for each element and row."""

    __slots__ = ()

    def __deepcopy__(self, memo: dict[int, Any]) -> ElementLines:
        return type(self)({key: copy.deepcopy(record, memo) for key, record in self.items()})

    def assigned(self, key: Key, record: Record) -> None:
        """Note the assignment of an element, or of a whole row or array, whose elements have no other records afterwards."""
        if key is None:
            self.clear()
        elif isinstance(key, tuple) and key[-1] is None:
            row = key[:-1]
            for each in [one for one in self if isinstance(one, tuple) and one[: len(row)] == row]:
                del self[each]
        self[key] = record

    def of(self, at: tuple[int, ...]) -> Record:
        """Return the newest record of the element `at`; empty without one. Its own record is newer than that of its row."""
        keys: list[Key] = [at[0] if len(at) == 1 else at, *((*at[:n], None) for n in range(len(at) - 1, 0, -1)), None]
        return next((self[key] for key in keys if key in self), ())


class RowLines:
    """The records of the rows or elements of an array that are an array themselves, as they are handed to a VAR_IN_OUT."""

    __slots__ = ("_lines", "_row")

    def __init__(self, lines: Any, *row: int) -> None:
        self._lines, self._row = lines, row

    def __setitem__(self, at: Key, record: Record) -> None:
        self.assigned(at, record)

    def assigned(self, key: Key, record: Record) -> None:
        self._lines.assigned((*self._row, *(key if isinstance(key, tuple) else (key,))), record)

    def of(self, at: tuple[int, ...]) -> Record:
        found: Record = self._lines.of((*self._row, *at))
        return found


class WholeLines:
    """The records of an array that is written through a pointer to its memory: each write notes the whole array."""

    __slots__ = ("_lines",)

    def __init__(self, lines: Any) -> None:
        self._lines = lines

    def __setitem__(self, at: Key, record: Record) -> None:
        self._lines.assigned(None, record)

    def assigned(self, key: Key, record: Record) -> None:
        self._lines.assigned(None, record)


_OF_ELEMENTS = (ElementLines, RowLines)


class MemoryLines:
    """The record of the last write to the memory of a union, which is that of all its members, because they share the memory."""

    __slots__ = ("_memory",)

    def __init__(self, memory: Any) -> None:
        self._memory = memory

    def __setitem__(self, at: Key, record: Record) -> None:
        self._memory.record = record

    def assigned(self, key: Key, record: Record) -> None:
        self._memory.record = record

    def of(self, at: tuple[int, ...]) -> Record:
        found: Record = self._memory.record
        return found


class _NoLines:
    """The records of an array that has none, such as a local variable of a function."""

    __slots__ = ()

    def __setitem__(self, at: Key, record: Record) -> None:
        pass

    def assigned(self, key: Key, record: Record) -> None:
        pass

    def of(self, at: tuple[int, ...]) -> Record:
        return ()

    def __deepcopy__(self, memo: dict[int, Any]) -> _NoLines:
        return self


NO_LINES = _NoLines()


def lines_in(owner: Any, attribute: str) -> Any:
    """Return the records of the elements of the array that is an attribute of `owner`."""
    name = line_of(attribute)
    found = getattr(owner, name, None)
    if not isinstance(getattr(owner, attribute, None), list):
        return NO_LINES
    if found is None:
        try:
            found = ElementLines()
            setattr(owner, name, found)
        except AttributeError:  # a class of which no lines are kept
            return NO_LINES
    return found


def noted(owner: Any, attribute: str, record: Record) -> None:
    """Note the assignment of a variable or member through a reference."""
    line = line_of(attribute)
    if attribute.startswith(MEMBER):
        setattr(owner, line, record)
    elif record or getattr(owner, line, None):
        try:
            setattr(owner, line, record[1][:SOURCE] if record else 0)
            setattr(owner, indices_of(attribute), record)
        except AttributeError:  # a variable of which no lines are kept
            return


def record_of(owner: Any, attribute: str, at: tuple[int, ...], path: str) -> Record:
    """Return the record of the last assignment of an attribute of `owner`, or of the element `at` of the array that it is;
    empty if that is not known. The number of the scan is None if it was not recorded. `path` is the file of the program.
    """
    line = getattr(owner, line_of(attribute), ())
    if not line:
        return ()
    if type(line) is int:
        place = (path, line)
    elif type(line) is not tuple:
        return line.of(at) if isinstance(line, MemoryLines) or (at and isinstance(line, _OF_ELEMENTS)) else ()
    elif len(line) >= RECORD_HEAD:
        return line
    else:
        place = line
    more: Record = getattr(owner, indices_of(attribute), ())
    return more if more and more[1][:SOURCE] == place else (None, place, owner)


def forget(owner: Any, attribute: str, at: tuple[int, ...]) -> None:
    """Remove the record of the last assignment of an attribute, or of the element `at`, which was set from outside."""
    line = getattr(owner, line_of(attribute), None)
    if isinstance(line, ElementLines):
        line.assigned(at[0] if len(at) == 1 else at, ())
    else:
        setattr(owner, line_of(attribute), 0)


def assigned_whole(target: Any, record: Record) -> None:
    """Note the assignment of a structure or a union: each of its members was assigned."""
    written = getattr(target, "written", None)
    if written is not None:
        written(record)
    for name in target.__slots__:
        held = getattr(target, name)
        if isinstance(held, list):
            assigned_array(held, lines_in(target, name), record)
        elif hasattr(held, "copy"):
            assigned_whole(held, record)
        else:
            setattr(target, line_of(name), record)


def assigned_array(held: list[Any], lines: Any, record: Record) -> None:
    """Note the assignment of an array, whose elements may be structures."""
    lines.assigned(None, record)
    for element in held:
        if isinstance(element, list):
            if not element or not (isinstance(element[0], list) or hasattr(element[0], "copy")):
                return
            assigned_array(element, NO_LINES, record)
        elif hasattr(element, "copy"):
            assigned_whole(element, record)
        else:
            return


def assigned_elements(held: list[Any], touched: range, lines: Any, record: Record) -> None:
    """Note the assignment of some elements of an array."""
    if len(touched) == len(held):
        assigned_array(held, lines, record)
        return
    for i in touched:
        element = held[i]
        if isinstance(element, list):
            assigned_array(element, RowLines(lines, i), record)
        elif hasattr(element, "copy"):
            assigned_whole(element, record)
        else:
            lines.assigned(i, record)


def lent(array: Any, lines: Any, record: Record) -> Any:
    """Return an array that a function or method receives as VAR_IN_OUT, and note that it may be assigned there."""
    lines.assigned(None, record)
    return array


def hand_lines(instance: Any, attribute: str, lines: Any) -> None:
    """Hand the records of an array to an instance together with the array, if `attribute` is a VAR_IN_OUT of the instance."""
    if attribute in instance.in_outs and hasattr(instance, line_of(attribute)):
        setattr(instance, line_of(attribute), lines)
