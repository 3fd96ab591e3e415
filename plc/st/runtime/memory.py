"""The memory of numbers and bit strings as values of another type: the bits of a REAL, the bytes of an array of INT.

The first byte is the least significant one, as in the controllers of CODESYS and TwinCAT. A value can be read and written only as
a whole, and only inside the variable or array.
"""

from __future__ import annotations

import struct
from typing import Any

from fieldtwin.plc.st.runtime.logic_error import LogicError


class Memory:
    """A variable or an array as an array of values of another type.

    `owner` holds the values, each in the format `held` of `struct`; they are seen in the format `shown`.
    """

    __slots__ = ("_held", "_owner", "_shown", "_size", "_step")

    def __init__(self, owner: Any, held: str, shown: str) -> None:
        self._owner, self._held, self._shown = owner, held, shown
        self._step, self._size = struct.calcsize(f"<{held}"), struct.calcsize(f"<{shown}")

    def key(self) -> tuple[Any, ...]:
        owner = self._owner
        return (*((id(owner),) if isinstance(owner, list) else owner.key()), self._shown)

    def __len__(self) -> int:
        return len(self._owner) * self._step // self._size

    def _touched(self, at: int) -> tuple[range, int]:
        """Return the values of the owner that hold the value `at`, and the byte in the first of them where it begins."""
        first, last = at * self._size, at * self._size + self._size - 1
        return range(first // self._step, last // self._step + 1), first % self._step

    def __getitem__(self, at: int) -> Any:
        touched, begin = self._touched(at)
        return struct.unpack_from(f"<{self._shown}", self._bytes(touched), begin)[0]

    def __setitem__(self, at: int, value: Any) -> None:
        touched, begin = self._touched(at)
        data = bytearray(self._bytes(touched))
        struct.pack_into(f"<{self._shown}", data, begin, value)
        for i, new in zip(touched, struct.unpack(f"<{len(touched)}{self._held}", data), strict=True):
            self._owner[i] = new

    def _bytes(self, touched: range) -> bytes:
        return struct.pack(f"<{len(touched)}{self._held}", *(self._owner[i] for i in touched))


def place_in_memory(at: int, held: str, shown: str) -> int:
    """Return the number of the value in the format `shown` that begins where the value `at` in the format `held` begins.

    Raises `LogicError` if it would begin in the middle of a value.
    """
    size = struct.calcsize(f"<{shown}")
    found, rest = divmod(at * struct.calcsize(f"<{held}"), size)
    if rest:
        raise LogicError(
            "a pointer into the middle of a value",
            expected=f"a multiple of {size} bytes from the beginning of the array",
        )
    return found
