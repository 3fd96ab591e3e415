"""Arrays of variable length at run time: the array that a caller passes, with its limits (IEC 61131-3:2013, 6.5.3)."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

from fieldtwin.plc.st.runtime.lines import NO_LINES
from fieldtwin.plc.st.runtime.logic_error import LogicError

Ranges = tuple[tuple[int, int], ...]
"""The first and the last index of each dimension."""


class OpenArray:
    """An argument for a parameter of type ``ARRAY[*]``: the `items` of the caller's array, its `ranges`, and the records of
    the assignments of its elements (`lines`).
    """

    __slots__ = ("items", "lines", "ranges")

    def __init__(self, items: list[Any], ranges: Ranges, lines: Any = NO_LINES) -> None:
        self.items, self.ranges, self.lines = items, ranges, lines

    def copied(self) -> OpenArray:
        """Return an array with copies of the items, for a parameter that is an input."""
        return OpenArray(copy.deepcopy(self.items), self.ranges)

    def fresh(self, made: Callable[[], Any]) -> OpenArray:
        """Return an array with the same limits, for a parameter that is an output. `made` returns the initial value of an
        element.
        """

        def row(sizes: Sequence[int]) -> list[Any]:
            return [row(sizes[1:]) if len(sizes) > 1 else made() for _ in range(sizes[0])]

        return OpenArray(row([high - low + 1 for low, high in self.ranges]), self.ranges)


def bound(ranges: Ranges, dimension: int, end: int) -> int:
    """Return the first (`end` 0) or the last index (`end` 1) of a dimension, which counts from 1. Raises `LogicError`."""
    if not 1 <= dimension <= len(ranges):
        raise LogicError("a dimension that the array does not have", expected=f"1 to {len(ranges)}", got=str(dimension))
    return ranges[dimension - 1][end]
