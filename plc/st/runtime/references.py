"""References at run time: for VAR_IN_OUTs of elementary types, for REF_TO, POINTER TO and REFERENCE TO, and for variables of an
interface type.

Reading and writing `v` reads and writes the variable immediately. So two references to one variable always have the same value,
and so does the variable itself (IEC 61131-3, 6.5.3.1). As VAR_IN_OUTs, arrays, structures and blocks are passed directly.

A reference never leads outside its variable: a pointer that was moved past the end of its array, and NULL, raise `LogicError`
where the program uses them. `key` identifies the variable: references with equal keys refer to one variable.
"""

from __future__ import annotations

from typing import Any, Protocol

from fieldtwin.plc.st.runtime.layouts import Overlay, Row, Stored
from fieldtwin.plc.st.runtime.lines import NO_LINES, Record, RowLines, WholeLines, noted
from fieldtwin.plc.st.runtime.logic_error import LogicError
from fieldtwin.plc.st.runtime.memory import Memory, place_in_memory

Key = tuple[Any, ...]
"""The identity of a variable: the id of the Python object that holds it, and where it is in that object."""


class Reference(Protocol):
    """A reference to a variable, whose value is `v`."""

    v: Any

    @property
    def lines(self) -> Any:
        """Return the records of the elements, if the variable is an array."""

    def key(self) -> Key: ...

    def assign(self, value: Any, record: Record) -> None:
        """Assign the variable, and record the line."""


class Cell:
    """A function's own variable to which references exist."""

    __slots__ = ("v",)
    lines: Any = NO_LINES

    def __init__(self, value: Any) -> None:
        self.v = value

    def key(self) -> Key:
        return (id(self),)

    def assign(self, value: Any, record: Record) -> None:
        self.v = value


class Whole(Cell):
    """A reference to an array, a structure or a block, which always stays the same Python object."""

    __slots__ = ("lines",)

    def __init__(self, value: Any, lines: Any = NO_LINES) -> None:
        super().__init__(value)
        self.lines = lines

    def key(self) -> Key:
        return self.v.key() if isinstance(self.v, Characters | Memory | Stored) else (id(self.v),)


class MemberReference:
    """A reference to an attribute: a variable of a program or block, a global variable, or a member of a structure."""

    __slots__ = ("name", "owner")
    lines = NO_LINES

    def __init__(self, owner: Any, name: str) -> None:
        self.owner, self.name = owner, name

    def key(self) -> Key:
        if isinstance(self.owner, Overlay):
            return id(self.owner.memory), self.owner.at + self.owner.offsets[self.name]
        return id(self.owner), self.name

    @property
    def v(self) -> Any:
        return getattr(self.owner, self.name)

    @v.setter
    def v(self, value: Any) -> None:
        setattr(self.owner, self.name, value)
        noted(self.owner, self.name, ())  # the line of this assignment is not known here

    def assign(self, value: Any, record: Record) -> None:
        setattr(self.owner, self.name, value)
        noted(self.owner, self.name, record)


class Element:
    """A reference to an element of an array: the element that the index selected when the call began.

    A pointer may be moved to any place `at`. It raises `LogicError` when it is used outside the array.
    """

    __slots__ = ("at", "of_array", "owner")

    def __init__(self, owner: Any, at: int, lines: Any = NO_LINES) -> None:
        self.owner, self.at = owner, at
        self.of_array = lines
        """The records of the elements of its array."""

    def key(self) -> Key:
        if isinstance(self.owner, Row):
            return id(self.owner.memory), self.owner.at + self.owner.offset(self.at)
        named = isinstance(self.owner, Single | Characters | Letters | Memory)
        owner = self.owner.key() if named else (id(self.owner),)
        return *owner, self.at

    @property
    def v(self) -> Any:
        if not 0 <= self.at < len(self.owner):
            self._fail()
        return self.owner[self.at]

    @v.setter
    def v(self, value: Any) -> None:
        if not 0 <= self.at < len(self.owner):
            self._fail()
        self.owner[self.at] = value
        self.of_array.assigned(self.at, ())

    @property
    def lines(self) -> RowLines:
        """Return the records of the elements of the element, if that is an array."""
        return RowLines(self.of_array, self.at)

    def assign(self, value: Any, record: Record) -> None:
        self.v = value
        self.of_array.assigned(self.at, record)

    def _fail(self) -> None:
        expected = f"element 1 to {len(self.owner)}"
        raise LogicError("a pointer outside the variable to which it pointed", expected=expected, got=str(self.at + 1))


class Cut:
    """A reference to a string with another length than the variable: its value is cut to `length` characters."""

    __slots__ = ("_length", "_of")
    lines = NO_LINES

    def __init__(self, of: Any, length: int) -> None:
        self._of, self._length = of, length

    def key(self) -> Key:
        return self._of.key()  # type: ignore[no-any-return]

    @property
    def v(self) -> str:
        text: str = self._of.v
        return text[: self._length]

    @v.setter
    def v(self, value: str) -> None:
        self._of.v = value[: self._length]

    def assign(self, value: str, record: Record) -> None:
        self._of.assign(value[: self._length], record)


class Instance:
    """The value of a variable of an interface type: a reference to an instance. The value NULL is None."""

    __slots__ = ("of",)

    def __init__(self, of: Any) -> None:
        self.of = of

    def key(self) -> Key:
        return (id(self.of),)


def instance(reference: Instance | None, name: str) -> Any:
    """Return the instance to which the variable `name` refers. Raises `LogicError` if it is NULL."""
    if reference is None:
        raise LogicError(f"{name} is NULL", expected="an instance, which an assignment stores in it before it is used")
    return reference.of


class _Parts:
    """An array whose elements are those of the variable to which the reference `of` refers."""

    __slots__ = ("_of",)

    def __init__(self, of: Reference) -> None:
        self._of = of

    def key(self) -> Key:
        return self._of.key()


class Single(_Parts):
    """A variable as an array with one element, because a pointer to it was moved."""

    __slots__ = ()

    def __len__(self) -> int:
        return 1

    def __getitem__(self, at: int) -> Any:
        return self._of.v

    def __setitem__(self, at: int, value: Any) -> None:
        self._of.v = value


class Characters(_Parts):
    """A string as an array of its bytes. The byte after its last character, and those after that one, are 0.

    An assigned 0 ends the string. A character can be assigned up to the end of the string; one that would be after the end
    raises `LogicError`, because a string has no bytes there.
    """

    __slots__ = ("_length",)

    def __init__(self, of: Reference, length: int) -> None:
        super().__init__(of)
        self._length = length

    def __len__(self) -> int:
        return self._length + 1

    def __getitem__(self, at: int) -> int:
        text: str = self._of.v
        return ord(text[at]) if at < len(text) else 0

    def __setitem__(self, at: int, value: int) -> None:
        text: str = self._of.v
        if value == 0:
            self._of.v = text[:at]
        elif at > len(text) or at == self._length:
            raise LogicError(
                "a character after the end of its string", expected=f"position 1 to {len(text) + 1}", got=str(at + 1)
            )
        else:
            self._of.v = text[:at] + chr(value) + text[at + 1 :]


class Letters(_Parts):
    """A string as an array of its characters (IEC 61131-3:2013, 6.4.2). Raises `LogicError` for one after its end."""

    __slots__ = ()

    def __len__(self) -> int:
        return len(self._of.v)

    def __getitem__(self, at: int) -> str:
        text: str = self._of.v
        return text[self._inside(at, text)]

    def __setitem__(self, at: int, value: str) -> None:
        text: str = self._of.v
        self._inside(at, text)
        self._of.v = text[:at] + value + text[at + 1 :]

    @staticmethod
    def _inside(at: int, text: str) -> int:
        if at < len(text):
            return at
        raise LogicError(
            "a character after the end of its string", expected=f"position 1 to {len(text)}", got=str(at + 1)
        )


REFERENCES = (Cell, MemberReference, Element, Cut)
"""The classes of references that variables may hold; `Whole` is a `Cell`."""


def pointed(reference: Reference | None) -> Reference:
    """Return a reference that is used. Raises `LogicError` for NULL."""
    if reference is None:
        raise LogicError("a reference that is NULL is used", expected="a test such as IF r <> NULL before it")
    return reference


def same(a: Reference | None, b: Reference | None) -> bool:
    """Return whether two references refer to one variable, or are both NULL."""
    if a is None or b is None:
        return a is b
    return a.key() == b.key()


def first(reference: Reference | None) -> Reference | None:
    """Return a pointer to the first element of the array to which `reference` refers."""
    return None if reference is None else Element(reference.v, 0, reference.lines)


def cut(reference: Reference | None, length: int) -> Reference | None:
    """Return a reference to a string that reads and writes at most `length` characters."""
    return None if reference is None else Cut(reference, length)


def characters(reference: Reference | None, length: int) -> Reference | None:
    """Return a reference to the bytes of the string to which `reference` refers."""
    return None if reference is None else Whole(Characters(reference, length))


def memory(reference: Reference | None, held: str, shown: str, *, array: bool) -> Reference | None:
    """Return a pointer to the memory of a number, of an element, or of an `array` of numbers, as values of another type.

    `held` and `shown` are the formats of `struct` of the numbers and of the other type.
    """
    if reference is None:
        return None
    if array:
        owner, at, lines = reference.v, 0, reference.lines
    elif isinstance(reference, Element):
        owner, at, lines = reference.owner, reference.at, reference.of_array
    else:
        owner, at, lines = Single(reference), 0, NO_LINES
    return Element(Memory(owner, held, shown), place_in_memory(at, held, shown), WholeLines(lines))


def from_beginning(reference: Reference | None) -> Reference | None:
    """Return the whole memory to which a pointer points. Raises `LogicError` if it does not point to the beginning."""
    if reference is None:
        return None
    assert isinstance(reference, Element)
    if reference.at:
        raise LogicError("a pointer to an array that begins in the middle of another one", expected="the first element")
    return Whole(reference.owner, reference.of_array)


def moved(reference: Reference | None, amount: int, size: int) -> Reference:
    """Return a pointer that was moved by `amount` bytes, where an element has `size` bytes.

    Raises `LogicError` for NULL, and for an amount that leads into the middle of an element.
    """
    at, rest = divmod(amount, size)
    if rest:
        raise LogicError(
            "a pointer into the middle of a value", expected=f"a multiple of {size} bytes", got=str(amount)
        )
    held = pointed(reference)
    if isinstance(held, Element):
        return Element(held.owner, held.at + at, held.of_array)
    return Element(Single(held), at)


def view(array: Any, i: int, low: int, high: int) -> int:
    """Return where the element `i` of a pointer's array ``low..high`` is in the array to which it points.

    Raises `LogicError` outside of either array.
    """
    most = min(high, low + len(array) - 1)
    if low <= i <= most:
        return i - low
    raise LogicError("an index outside the array to which a pointer points", expected=f"{low} to {most}", got=str(i))


def whole(array: Any, size: int) -> Any:
    """Return the array to which a pointer points. Raises `LogicError` if it has another number of elements."""
    if len(array) != size or isinstance(array, Characters | Memory):
        raise LogicError(
            "a pointer to an array of another size is used as a whole", expected=f"{size} elements", got=str(len(array))
        )
    return array


def queried(reference: Instance | None, interface: str) -> Instance | None:
    """Return `reference` if its instance implements the interface with this name in lower case, otherwise NULL."""
    return reference if reference is not None and interface in reference.of.kinds else None


def attempted(reference: Reference | None, block: str) -> Reference | None:
    """Return `reference` if it refers to a `block`, or to one that extends it, otherwise NULL (the assignment attempt ``?=``).

    `block` is a name in lower case.
    """
    return reference if reference is not None and block in reference.v.kinds else None
