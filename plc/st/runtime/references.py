"""References for VAR_IN_OUTs of elementary types at run time: each object refers to a variable of the caller.

Reading and writing `v` reads and writes that variable immediately. So two VAR_IN_OUTs that refer to one variable always have
the same value, and so does the variable itself (IEC 61131-3, 6.5.3.1). Arrays, structures and blocks are passed directly.
"""

from __future__ import annotations

from typing import Any


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
