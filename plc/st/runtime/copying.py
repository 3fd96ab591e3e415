"""MEMCPY, MEMMOVE, MEMSET and MEMCMP of TwinCAT, and their counterparts of CODESYS, over variables whose layout is known.

The bytes are those of the variable to which the pointer points. A pointer to an element also reaches the elements after it.
No access leaves the variable: `LogicError` names the function and what was exceeded.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fieldtwin.plc.st.runtime.layouts import Layout, Rows, Stored
from fieldtwin.plc.st.runtime.lines import Record, assigned_elements, assigned_whole, noted
from fieldtwin.plc.st.runtime.logic_error import LogicError
from fieldtwin.plc.st.runtime.references import Element, MemberReference, Reference, Single, Whole


class _Region:
    """The bytes from the variable on to which `reference` points. `layout` is that of the variable."""

    def __init__(self, reference: Reference, layout: Layout) -> None:
        self._first, self._of, self._reference = 0, layout, reference
        self._items: Any
        if isinstance(reference, Element):
            self._items, self._first = reference.owner, reference.at
        elif isinstance(reference, Whole) and isinstance(layout, Rows):
            self._items, self._of = reference.v, layout.of
        else:
            self._items = Single(reference)
        inside = 0 <= self._first <= len(self._items)
        self.size = (len(self._items) - self._first) * self._of.size if inside else 0

    def read(self, count: int) -> bytes:
        """Return the first `count` bytes."""
        return bytes(self._filled(count)[:count])

    def write(self, data: bytes, record: Record) -> None:
        """Replace the first bytes by `data`, and note the record of the statement."""
        memory = self._filled(len(data))
        memory[: len(data)] = data
        for n, i in enumerate(self._touched(len(data))):
            value = self._of.read(memory, n * self._of.size)
            if isinstance(value, Stored):
                _assign(self._items[i], value)
            else:
                self._items[i] = value
        self._note(self._touched(len(data)), record)

    def _note(self, touched: range, record: Record) -> None:
        reference = self._reference
        lines = reference.of_array if isinstance(reference, Element) else reference.lines
        if isinstance(self._items, list):
            assigned_elements(self._items, touched, lines, record)
        elif isinstance(reference, Element):  # memory that is seen as another type
            lines.assigned(None, record)
        elif isinstance(reference, MemberReference):
            noted(reference.owner, reference.name, record)
        elif hasattr(self._items[0], "copy"):  # a structure or a union
            assigned_whole(self._items[0], record)

    def _touched(self, count: int) -> range:
        return range(self._first, self._first - (-count // self._of.size))

    def _filled(self, count: int) -> bytearray:
        """Return the bytes of all items of which at least one of the first `count` bytes is a part."""
        touched = self._touched(count)
        memory = bytearray(len(touched) * self._of.size)
        for n, i in enumerate(touched):
            self._of.write(memory, n * self._of.size, self._items[i])
        return memory


def _assign(target: Any, source: Any) -> None:
    """Assign an array, a structure or a union in memory to a variable, whose parts stay the same objects."""
    if isinstance(target, Stored):
        target.assign(source)
    elif isinstance(target, list):
        for i, value in enumerate(source):
            if isinstance(value, Stored):
                _assign(target[i], value)
            else:
                target[i] = value
    else:
        for name in source.offsets:
            value = getattr(source, name)
            if isinstance(value, Stored):
                _assign(getattr(target, name), value)
            else:
                setattr(target, name, value)


Place = tuple[Reference | None, Layout]
"""A pointer, and the layout of the variables to which it points."""


def _region(place: Place, count: int, name: str, parameter: str) -> _Region:
    reference, layout = place
    if reference is None:
        raise LogicError(f"{parameter} of {name} is NULL", expected="the address of a variable")
    found = _Region(reference, layout)
    if not 0 <= count <= found.size:
        message = f"{name} exceeds the variable to which {parameter} points"
        raise LogicError(message, expected=f"at most {found.size} bytes from there", got=str(count))
    return found


def copied(name: str, parameters: Sequence[str], target: Place, source: Place, count: int, record: Record = ()) -> int:
    """Copy `count` bytes, also between parts of one variable, and return the number.

    `parameters` are the names of the pointers, and `record` is that of the statement.
    """
    data = _region(source, count, name, parameters[1]).read(count)
    _region(target, count, name, parameters[0]).write(data, record)
    return count


def filled(name: str, parameters: Sequence[str], target: Place, byte: int, count: int, record: Record = ()) -> int:
    """Give `count` bytes the value `byte`, and return the number."""
    _region(target, count, name, parameters[0]).write(bytes([byte]) * count, record)
    return count


def compared(name: str, parameters: Sequence[str], first: Place, second: Place, count: int) -> int:
    """Return 0 if `count` bytes are equal, and -1 or 1 if the first different byte of `first` is less or greater."""
    a, b = (_region(one, count, name, of).read(count) for one, of in zip((first, second), parameters, strict=True))
    return (a > b) - (a < b)
