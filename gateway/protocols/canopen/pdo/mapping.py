"""PDO mappings (CiA 301, 7.5.2.36 and 7.5.2.38): the positions of objects in the 8 bytes of a PDO.

This module reads mapping entries in the form of 1A00h and divides the data of a PDO into objects. It leaves each object as
bytes; `eds.datatypes` converts them to values.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import accumulate

from fieldtwin.gateway.core.errors import Desync, UsageError, WireError

PDO_BITS = 64
MAX_ENTRIES = 64


class PdoLengthMismatch(WireError):
    """The number of bytes of a received PDO differs from that of its mapping."""


@dataclass(frozen=True, slots=True)
class PdoEntry:
    """One mapped object: `bits` of index:subindex."""

    index: int
    subindex: int
    bits: int

    @classmethod
    def from_word(cls, word: int) -> PdoEntry:
        """Return the entry that a mapping record holds as UNSIGNED32.

        Bits 31 to 16 are the index, 15 to 8 the subindex, 7 to 0 the length in bits.
        """
        return cls(word >> 16 & 0xFFFF, word >> 8 & 0xFF, word & 0xFF)

    @property
    def word(self) -> int:
        return self.index << 16 | self.subindex << 8 | self.bits

    def __str__(self) -> str:
        return f"{self.index:04X}h:{self.subindex:02X}/{self.bits}"


@dataclass(frozen=True, slots=True)
class PdoMapping:
    """The mapped objects in order. Raises `UsageError` if they have more than 64 bits together.

    `bits` is the total number of bits, `length` the number of bytes of the PDO.
    """

    entries: tuple[PdoEntry, ...]
    bits: int = field(init=False, repr=False, compare=False)
    length: int = field(init=False, repr=False, compare=False)
    _cuts: tuple[tuple[int, int, int], ...] = field(init=False, repr=False, compare=False)
    """For each object, the position of its first bit, a mask of its bits, and the number of bytes that it takes."""

    def __post_init__(self) -> None:
        starts = tuple(accumulate((entry.bits for entry in self.entries), initial=0))
        object.__setattr__(self, "bits", starts[-1])
        object.__setattr__(self, "length", (self.bits + 7) // 8)
        bad = [e for e in self.entries if not (0 < e.bits <= PDO_BITS and e.index <= 0xFFFF and e.subindex <= 0xFF)]
        if bad or len(self.entries) > MAX_ENTRIES or self.bits > PDO_BITS:
            raise UsageError(
                "not a PDO mapping", expected=f"entries of 1 to 64 bits, {PDO_BITS} bits together", got=str(self)
            )
        cuts = tuple((at, (1 << e.bits) - 1, (e.bits + 7) // 8) for at, e in zip(starts, self.entries, strict=False))
        object.__setattr__(self, "_cuts", cuts)

    @classmethod
    def from_words(cls, words: Iterable[int]) -> PdoMapping:
        """Return the mapping for entries 1 to n of a mapping record (1600h, 1A00h...) that was read from a node.

        Raises `Desync` if they are invalid.
        """
        try:
            return cls(tuple(PdoEntry.from_word(word) for word in words))
        except UsageError as e:
            raise Desync(e.message, expected=e.expected, got=e.got) from e

    @classmethod
    def of(cls, objects: Iterable[tuple[int, int, int]]) -> PdoMapping:
        """Return the mapping for tuples (index, subindex, bits)."""
        return cls(tuple(PdoEntry(*triple) for triple in objects))

    def unpack(self, data: bytes, *, exact: bool = False) -> tuple[bytes, ...]:
        """Return the bytes of each object in order, little-endian; the last byte of each is padded with zero bits.

        Raises `PdoLengthMismatch` if `data` is too short, because then none of it may be used (CO-043). If it is too long, the
        first bytes are used, as the standard requires of receivers; with `exact` this is also an error.
        """
        if len(data) < self.length or (exact and len(data) > self.length):
            raise PdoLengthMismatch(
                f"a PDO of {self}", expected=f"{self.length} bytes", got=f"{len(data)} ({data.hex()})"
            )
        word = int.from_bytes(data, "little")
        return tuple([(word >> at & mask).to_bytes(size, "little") for at, mask, size in self._cuts])

    def pack(self, values: Sequence[bytes]) -> bytes:
        """Return the PDO's data from the bytes of each object: the inverse of `unpack`."""
        if len(values) != len(self.entries):
            raise UsageError(f"values for a PDO of {self}", expected=f"{len(self.entries)}", got=f"{len(values)}")
        word = shift = 0
        for entry, value in zip(self.entries, values, strict=True):
            number = int.from_bytes(value, "little")
            if number >> entry.bits:
                raise UsageError(f"a value of {entry} in a PDO", expected=f"{entry.bits} bits", got=value.hex())
            word |= number << shift
            shift += entry.bits
        return word.to_bytes(self.length, "little")

    def __str__(self) -> str:
        return " ".join(str(entry) for entry in self.entries) or "nothing"
