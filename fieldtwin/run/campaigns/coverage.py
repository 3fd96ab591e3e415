"""The coverage of runs as a set of numbers: bounded, small enough for a line of a ledger, and joined by `|`.

An element is a kind and a 16-bit hash of its names. Two elements can share a number, so a count is a lower limit. The same
element has the same number on every computer. Joining is commutative and idempotent.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from enum import IntEnum
from functools import reduce
from operator import or_
from zlib import crc32

from fieldtwin.gateway.core.errors import FileInvalid

_HASH_BITS = 16
MOST_OF_KIND = 4096
"""Largest number of elements of one kind that one run adds."""


class Kind(IntEnum):
    """The kinds of elements. A fault is its name and its target, or no fault.

    STATE       a program's variable with its value, during a fault
    TRANSITION  a program's variable with two values that follow each other, during a fault
    BEGIN       a fault that begins or ends while a variable has a value, by the order of magnitude of the value's age
    TAG         a tag with its quality, either during a fault or while a variable has a value
    """

    STATE = 0
    TRANSITION = 1
    BEGIN = 2
    TAG = 3


MAX_NUMBER = (len(Kind) << _HASH_BITS) - 1
MAX_TEXT = 4 * (MAX_NUMBER + 3) // 3
"""Largest number of characters of a coverage as text: with all possible numbers, each takes one byte."""


def element(kind: Kind, *names: Hashable) -> int:
    """Return the number of an element, which depends on the kind and on the texts of the names only."""
    text = "\0".join(map(str, names))
    return kind << _HASH_BITS | (crc32(text.encode()) & ((1 << _HASH_BITS) - 1))


@dataclass(frozen=True, slots=True)
class Coverage:
    """A set of elements. `text` is its short form, and `parse` reads it."""

    elements: frozenset[int] = frozenset()

    def __or__(self, other: Coverage) -> Coverage:
        return Coverage(self.elements | other.elements)

    def __sub__(self, other: Coverage) -> Coverage:
        return Coverage(self.elements - other.elements)

    def __len__(self) -> int:
        return len(self.elements)

    def counts(self) -> dict[str, int]:
        """Return the number of elements of each kind, by the kind's name in lower case."""
        return {kind.name.lower(): sum(one >> _HASH_BITS == kind for one in self.elements) for kind in Kind}

    def text(self) -> str:
        """Return the set as base64 text of the distances between the sorted numbers, each in as few bytes as needed (LEB128)."""
        data, last = bytearray(), -1
        for one in sorted(self.elements):
            rest = one - last - 1
            while rest > 0x7F:
                data.append(rest & 0x7F | 0x80)
                rest >>= 7
            data.append(rest)
            last = one
        return base64.b64encode(data).decode()

    @classmethod
    def parse(cls, text: str) -> Coverage:
        """Return the set that `text` wrote. Raises `FileInvalid`."""
        if len(text) > MAX_TEXT:
            raise FileInvalid("not a coverage", path="coverage", expected=f"at most {MAX_TEXT} characters")
        elements, last, rest, shift = set(), -1, 0, 0
        try:
            data = base64.b64decode(text, validate=True)
        except (binascii.Error, ValueError) as e:
            raise FileInvalid(f"not a coverage in base64: {e}", path="coverage") from e
        for byte in data:
            rest |= (byte & 0x7F) << shift
            shift += 7
            if byte & 0x80 and shift <= 2 * 7:
                continue
            last += rest + 1
            if byte & 0x80 or last > MAX_NUMBER:
                raise FileInvalid("not a coverage: a number is too large", path="coverage")
            elements.add(last)
            rest = shift = 0
        if shift:
            raise FileInvalid("not a coverage: the last number is incomplete", path="coverage")
        return cls(frozenset(elements))


def joined(texts: Iterable[str]) -> Coverage:
    """Return the coverage of several runs from their texts. An empty text, as in a ledger of an older version, adds nothing.

    Raises `FileInvalid`.
    """
    return reduce(or_, map(Coverage.parse, texts), Coverage())
