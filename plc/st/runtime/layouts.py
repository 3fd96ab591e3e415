"""Variables in the memory of a controller: the members of unions, and the layouts by which MEMCPY reads and writes variables.

A layout states how many bytes a value has, and reads and writes it at a place in a `bytearray`, the least significant byte first.
Arrays and structures in such a memory are objects that refer to it (`Stored`), so all members of a union have the same bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from copy import deepcopy
from functools import cache
from typing import Any, Protocol

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.runtime.lines import NO_LINES, MemoryLines, Record, is_line
from fieldtwin.plc.st.runtime.logic_error import LogicError

Key = tuple[Any, ...]


class Layout(Protocol):
    """The layout of the values of a type."""

    size: int
    """The size of a value in bytes."""

    def read(self, memory: bytearray, at: int) -> Any: ...

    def write(self, memory: bytearray, at: int, value: Any) -> None: ...


class Number:
    """The layout of a number or a bit string in a format of `struct`."""

    def __init__(self, code: str) -> None:
        self._struct = struct.Struct(f"<{code}")
        self.size = self._struct.size

    def read(self, memory: bytearray, at: int) -> Any:
        return self._struct.unpack_from(memory, at)[0]

    def write(self, memory: bytearray, at: int, value: Any) -> None:
        self._struct.pack_into(memory, at, value)


class Truth:
    """The layout of a BOOL, which has a byte. Every value but 0 is read as TRUE."""

    size = 1

    def read(self, memory: bytearray, at: int) -> bool:
        return memory[at] != 0

    def write(self, memory: bytearray, at: int, value: bool) -> None:
        memory[at] = value


class Bit:
    """The layout of a BIT, which is the bit `number` of a byte. The other bits of this byte belong to other members."""

    size = 1

    def __init__(self, number: int) -> None:
        self._mask = 1 << number

    def read(self, memory: bytearray, at: int) -> bool:
        return bool(memory[at] & self._mask)

    def write(self, memory: bytearray, at: int, value: bool) -> None:
        memory[at] = memory[at] | self._mask if value else memory[at] & ~self._mask


class Time:
    """The layout of a TIME or a date: a number of 4 bytes without a sign that counts units of `unit_ns`."""

    size = 4

    def __init__(self, unit_ns: int) -> None:
        self._unit_ns = unit_ns

    def read(self, memory: bytearray, at: int) -> int:
        return int.from_bytes(memory[at : at + self.size], "little") * self._unit_ns

    def write(self, memory: bytearray, at: int, value: int) -> None:
        count = value // self._unit_ns
        if not 0 <= count < 2**32:
            unit = "ms" if self._unit_ns < 10**9 else "s since 1970"
            raise LogicError("a time that does not fit its memory", expected=f"0 to {2**32 - 1} {unit}", got=f"{count}")
        memory[at : at + self.size] = count.to_bytes(self.size, "little")


class Letter:
    """The layout of a CHAR, or of a WCHAR, which has 2 bytes."""

    def __init__(self, size: int) -> None:
        self.size = size

    def read(self, memory: bytearray, at: int) -> str:
        return chr(int.from_bytes(memory[at : at + self.size], "little"))

    def write(self, memory: bytearray, at: int, value: str) -> None:
        memory[at : at + self.size] = _code(value, self.size)


class Text:
    """The layout of a STRING with `length` characters of `width` bytes, and a 0 after them.

    A text ends at the first 0. The bytes after the 0 keep their values when a shorter text is written.
    """

    def __init__(self, length: int, width: int) -> None:
        self._length, self._width = length, width
        self.size = (length + 1) * width

    def read(self, memory: bytearray, at: int) -> str:
        width = self._width
        codes = (int.from_bytes(memory[i : i + width], "little") for i in range(at, at + self._length * width, width))
        found = []
        for code in codes:
            if not code:
                break
            found.append(chr(code))
        return "".join(found)

    def write(self, memory: bytearray, at: int, value: str) -> None:
        data = b"".join(_code(letter, self._width) for letter in f"{value[: self._length]}\0")
        memory[at : at + len(data)] = data


class Rows:
    """The layout of an array of `count` elements, which may be arrays again."""

    def __init__(self, count: int, of: Layout) -> None:
        self.count, self.of = count, of
        self.size = count * of.size

    def read(self, memory: bytearray, at: int) -> Row:
        return Row(memory, at, self)

    def write(self, memory: bytearray, at: int, value: Iterable[Any]) -> None:
        for i, one in enumerate(value):
            self.of.write(memory, at + i * self.of.size, one)


class Members:
    """The layout of a structure or union, whose values in memory are instances of `kind`."""

    def __init__(self, kind: type[Overlay], size: int) -> None:
        self._kind, self.size = kind, size

    def read(self, memory: bytearray, at: int) -> Overlay:
        return self._kind(memory, at)

    def write(self, memory: bytearray, at: int, value: Any) -> None:
        self._kind(memory, at).assign(value)


def _code(letter: str, size: int) -> bytes:
    return (ord(letter) & (1 << 8 * size) - 1).to_bytes(size, "little")


TRUTH = Truth()
bit = cache(Bit)
number = cache(Number)
time = cache(Time)
letter = cache(Letter)
text = cache(Text)


# -- arrays, structures and unions in memory ------------------------------------------------------------------------------


class UnionMemory(bytearray):
    """The memory of a union, with the record of the statement that wrote it last."""

    __slots__ = ("record",)
    record: Record

    def __init__(self, content: int | bytes) -> None:
        super().__init__(content)
        self.record = ()

    def __deepcopy__(self, memo: dict[int, Any]) -> UnionMemory:
        new = memo[id(self)] = UnionMemory(bytes(self))
        new.record = deepcopy(self.record, memo)
        return new


class Stored:
    """An array, a structure or a union that is `size` bytes of `memory` from `at` on."""

    __slots__ = ("at", "memory")

    def __init__(self, memory: bytearray, at: int) -> None:
        self.memory, self.at = memory, at

    def key(self) -> Key:
        return id(self.memory), self.at

    def copy(self) -> Any:
        raise NotImplementedError

    def assign(self, source: Any) -> None:
        raise NotImplementedError

    def within(self, memory: bytearray) -> Stored:
        """Return the object that has the same place in a different memory."""
        return type(self)(memory, self.at)

    def __deepcopy__(self, memo: dict[int, Any]) -> Stored:
        return self.within(deepcopy(self.memory, memo))  # all that share a memory share its copy


class Row(Stored):
    """An array in memory. Its indices are those of a list."""

    __slots__ = ("_layout",)

    def __init__(self, memory: bytearray, at: int, layout: Rows) -> None:
        super().__init__(memory, at)
        self._layout = layout

    def within(self, memory: bytearray) -> Row:
        return Row(memory, self.at, self._layout)

    def __len__(self) -> int:
        return self._layout.count

    def __iter__(self) -> Iterator[Any]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, i: int) -> Any:
        return self._layout.of.read(self.memory, self.at + self.offset(i))

    def __setitem__(self, i: int, value: Any) -> None:
        self._layout.of.write(self.memory, self.at + self.offset(i), value)

    def offset(self, i: int) -> int:
        return i * self._layout.of.size

    def copy(self) -> list[Any]:
        return [one.copy() if isinstance(one, Stored) else one for one in self]

    def assign(self, source: Iterable[Any]) -> None:
        self._layout.write(self.memory, self.at, source)


class Overlay(Stored):
    """A structure or a union in memory. Each member is an attribute, and `offsets` has the place of its first byte."""

    __slots__ = ()
    offsets: dict[str, int]
    layout: Members

    def __setattr__(self, name: str, value: Any) -> None:
        if not is_line(name):
            super().__setattr__(name, value)
        else:  # an assignment of one member changes others
            self.written(value)

    def __getattr__(self, name: str) -> Any:
        if is_line(name):
            memory = self.memory
            return MemoryLines(memory) if isinstance(memory, UnionMemory) else NO_LINES
        raise AttributeError(name)

    def written(self, record: Record) -> None:
        """Note the statement that wrote the memory last."""
        memory = self.memory
        if isinstance(memory, UnionMemory):
            memory.record = record


class StructureInMemory(Overlay):
    """A structure that is a member of a union. A copy is an ordinary structure."""

    __slots__ = ()
    ordinary: Any
    """The class of the structures that are not in memory."""

    def copy(self) -> Any:
        new = self.ordinary.__new__(self.ordinary)
        for name in self.offsets:
            value = getattr(self, name)
            setattr(new, name, value.copy() if isinstance(value, Stored) else value)
        return new

    def assign(self, source: Any) -> None:
        for name in self.offsets:
            setattr(self, name, getattr(source, name))


class Union(Overlay):
    """A union. Without arguments, a union has its own memory, with the initial values of the members."""

    __slots__ = ()

    def __init__(self, memory: bytearray | None = None, at: int = 0) -> None:
        super().__init__(UnionMemory(self.layout.size) if memory is None else memory, at)
        if memory is None:
            self.initialise()

    def initialise(self) -> None:
        """Assign the initial values that members state. The compiler overrides this."""

    def copy(self) -> Union:
        return type(self)(UnionMemory(self.content), 0)

    def assign(self, source: Union) -> None:
        self.content = source.content

    @property
    def content(self) -> bytes:
        return bytes(self.memory[self.at : self.at + self.layout.size])

    @content.setter
    def content(self, data: bytes) -> None:
        if len(data) != self.layout.size:
            expected = f"{self.layout.size} bytes"
            raise FileInvalid("a retained union of another size", expected=expected, got=str(len(data)))
        self.memory[self.at : self.at + len(data)] = data


Placed = tuple[str, int, Layout]
"""The attribute, the first byte, and the layout of a member."""


def union(name: str, size: int, *members: Placed) -> type[Union]:
    """Return the class of a union of `size` bytes."""
    made: type[Union] = type(name, (Union,), _namespace(members))
    made.layout = Members(made, size)
    return made


def in_memory(ordinary: Any, size: int, *members: Placed) -> Layout:
    """Return the layout of a structure of `size` bytes. `ordinary` is its class, which keeps the layout."""
    found: Layout | None = getattr(ordinary, "layout", None)
    if found is None:
        namespace = {**_namespace(members), "ordinary": ordinary}
        made: type[Overlay] = type(ordinary.__name__, (StructureInMemory,), namespace)
        made.layout = found = ordinary.layout = Members(made, size)
    return found


def _namespace(members: Iterable[Placed]) -> dict[str, Any]:
    found: dict[str, Any] = {"__slots__": (), "offsets": {}}
    for name, offset, layout in members:
        found[name] = _member(offset, layout.read, layout.write)
        found["offsets"][name] = offset
    return found


def _member(
    offset: int, read: Callable[[bytearray, int], Any], write: Callable[[bytearray, int, Any], None]
) -> property:
    def get(self: Overlay) -> Any:
        return read(self.memory, self.at + offset)

    def put(self: Overlay, value: Any) -> None:
        write(self.memory, self.at + offset, value)

    return property(get, put)
