"""References at run time: those for VAR_IN_OUTs of elementary types refer to a variable of the caller, and those in variables of
an interface type to an instance.

Reading and writing `v` reads and writes that variable immediately. So two VAR_IN_OUTs that refer to one variable always have
the same value, and so does the variable itself (IEC 61131-3, 6.5.3.1). Arrays, structures and blocks are passed directly.
"""

from __future__ import annotations

from typing import Any

from fieldtwin.plc.st.runtime.logic_error import LogicError


class Cell:
    """A reference to a function's own variable, for the duration of a call."""

    __slots__ = ("v",)

    def __init__(self, value: Any) -> None:
        self.v = value


class MemberReference:
    """A reference to an attribute: a variable of a program or block, a global variable, or a member of a structure."""

    __slots__ = ("_name", "_owner")

    def __init__(self, owner: Any, name: str) -> None:
        self._owner, self._name = owner, name

    @property
    def v(self) -> Any:
        return getattr(self._owner, self._name)

    @v.setter
    def v(self, value: Any) -> None:
        setattr(self._owner, self._name, value)


class Element:
    """A reference to an element of an array: the element that the index selected when the call began."""

    __slots__ = ("_at", "_owner")

    def __init__(self, owner: list[Any], at: int) -> None:
        self._owner, self._at = owner, at

    @property
    def v(self) -> Any:
        return self._owner[self._at]

    @v.setter
    def v(self, value: Any) -> None:
        self._owner[self._at] = value


class Cut:
    """A reference to a string that is shorter than the VAR_IN_OUT: an assigned value is cut to `length` characters."""

    __slots__ = ("_length", "_of")

    def __init__(self, of: Any, length: int) -> None:
        self._of, self._length = of, length

    @property
    def v(self) -> Any:
        return self._of.v

    @v.setter
    def v(self, value: str) -> None:
        self._of.v = value[: self._length]


class Instance:
    """The value of a variable of an interface type: a reference to an instance. The value NULL is None."""

    __slots__ = ("of",)

    def __init__(self, of: Any) -> None:
        self.of = of


def instance(reference: Instance | None, name: str) -> Any:
    """Return the instance to which the variable `name` refers. Raises `LogicError` if it is NULL."""
    if reference is None:
        raise LogicError(f"{name} is NULL", expected="an instance, which an assignment stores in it before it is used")
    return reference.of


def same(a: Instance | None, b: Instance | None) -> bool:
    """Return whether two variables refer to the same instance, or are both NULL."""
    return a is b or (a is not None and b is not None and a.of is b.of)
