"""The fields of one frame, explained for a reader who does not know the protocol by heart.

`modbus_fields` and `canopen_fields` create them. These functions never raise, and their spans cover every byte exactly once,
in order. A span of length 0 explains a part that is not among the bytes, such as a CAN identifier. The module does no I/O.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FieldSpan:
    """`length` bytes from `offset`: the name of the field, its value in words, and a note with the clause of the standard."""

    offset: int
    length: int
    name: str
    value: str
    note: str = ""


class FieldReader:
    """Divides bytes into fields from left to right. No byte is skipped or taken twice."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.spans: list[FieldSpan] = []
        self._at = 0

    @property
    def left(self) -> int:
        """Return the number of bytes that no field has taken."""
        return len(self.data) - self._at

    def take(self, size: int, name: str, value: Callable[[bytes], str] | str = "", note: str = "") -> bytes:
        """Make the next `size` bytes a field and return them.

        With fewer bytes left, the value states that the field is incomplete; if no bytes are left, no field is created.
        """
        piece = self.data[self._at : self._at + max(0, size)]
        if len(piece) < size:
            value = f"incomplete: {size} bytes expected"
        if piece:
            self.spans.append(
                FieldSpan(self._at, len(piece), name, value if isinstance(value, str) else value(piece), note)
            )
            self._at += len(piece)
        return piece

    def number(self, size: int, name: str, note: str = "", show: Callable[[int], str] = str) -> int:
        """Take a big-endian number; return -1 if it is not complete."""
        piece = self.take(size, name, lambda raw: show(int.from_bytes(raw)), note)
        return int.from_bytes(piece) if len(piece) == size else -1

    def rest(self, name: str, value: Callable[[bytes], str] | str = "", note: str = "") -> bytes:
        """Make all remaining bytes one field."""
        return self.take(self.left, name, value, note)

    def embed(self, spans: list[FieldSpan], size: int) -> None:
        """Take the next `size` bytes as the given fields, whose offsets are relative to the first of these bytes."""
        self.spans += [FieldSpan(s.offset + self._at, s.length, s.name, s.value, s.note) for s in spans]
        self._at += size
