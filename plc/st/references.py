"""What a VAR_IN_OUT of an elementary type is while a POU runs: an object that stands for a variable of the caller.

Reading and writing `v` reads and writes that variable at once, so that two VAR_IN_OUT of one variable, or one and a global
variable, are the same (IEC 61131-3, 6.5.3.1). Arrays, structures and blocks are handed over as they are. Pure.
"""

from __future__ import annotations

from typing import Any


class Cell:
    """Stands for a variable of a function's own, for the length of a call."""

    __slots__ = ("v",)

    def __init__(self, value: Any) -> None:
        self.v = value


class Member:
    """Stands for an attribute: a variable of a program or block, a global variable, a member of a structure."""

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
    """Stands for an element of an array: the one that the index named when the call began."""

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
    """Stands for a string that is shorter than the VAR_IN_OUT: what is assigned is cut to `length` characters."""

    __slots__ = ("_length", "_of")

    def __init__(self, of: Any, length: int) -> None:
        self._of, self._length = of, length

    @property
    def v(self) -> Any:
        return self._of.v

    @v.setter
    def v(self, value: str) -> None:
        self._of.v = value[: self._length]
