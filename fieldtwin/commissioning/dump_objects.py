"""How a node's object dictionary is found out over SDO: index by index, or entry by entry of an EDS.

Pure, and a generator as `dump_sweep` is. Nothing is written; a write-only object is never asked for.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass

from fieldtwin.commissioning.dump_sweep import MOST_SILENT, Outcome, Refused, Silent, Taken
from gateway.protocols.canopen.dictionary import ObjectDictionary

NO_OBJECT, NO_SUBINDEX = 0x0602_0000, 0x0609_0011
MOST_MISSING = 8
"""After so many subindices in a row that do not exist an array has ended, whatever its subindex 0 says."""
EVERYTHING = ((0x1000, 0x9FFF),)
"""Communication, manufacturer and device profile area (CiA 301, 7.4.1)."""

Asking = Generator["ObjectKey", Outcome, None]


@dataclass(frozen=True, slots=True)
class ObjectKey:
    """An object of a node."""

    index: int
    subindex: int

    def __str__(self) -> str:
        return f"{self.index:04X}h:{self.subindex:02X}"

    @classmethod
    def parse(cls, text: str) -> ObjectKey:
        """Raises ValueError."""
        index, colon, sub = text.partition(":")
        if not colon:
            raise ValueError(text)
        return cls(int(index.removesuffix("h"), 16), int(sub, 16))


class ObjectSweep:
    """Asks every index of `ranges` (both ends included) for subindex 0, and what it finds for the others."""

    def __init__(self, ranges: Sequence[tuple[int, int]] = EVERYTHING) -> None:
        self.ranges = ranges
        self.given_up = ""
        self._silent = 0

    def asking(self) -> Asking:
        for first, last in self.ranges:
            for index in range(first, last + 1):
                outcome = yield from self._ask(index, 0)
                if self.given_up:
                    return
                if isinstance(outcome, Taken) and len(outcome.raw) == 1 and outcome.raw[0]:
                    yield from self._members(index, outcome.raw[0])
                elif isinstance(outcome, Refused) and outcome.code == NO_SUBINDEX:
                    yield from self._members(index, 1)

    def _members(self, index: int, count: int) -> Generator[ObjectKey, Outcome, None]:
        """Where subindex 0 is a small number it may count the others: subindex 1 tells."""
        missing = 0
        for sub in range(1, min(count, 254) + 1):
            outcome = yield from self._ask(index, sub)
            missing = missing + 1 if isinstance(outcome, Refused) and outcome.code in (NO_SUBINDEX, NO_OBJECT) else 0
            if self.given_up or missing >= MOST_MISSING or (missing and sub == 1):
                return

    def _ask(self, index: int, sub: int) -> Generator[ObjectKey, Outcome, Outcome]:
        outcome = yield ObjectKey(index, sub)
        self._silent = self._silent + 1 if isinstance(outcome, Silent) else 0
        if self._silent >= MOST_SILENT:
            self.given_up = f"no reply {MOST_SILENT} times in a row"
        return outcome


class ListedObjects:
    """Asks for `keys`, one after the other."""

    def __init__(self, keys: Iterable[ObjectKey]) -> None:
        self.keys = list(keys)
        self.given_up = ""

    def asking(self) -> Asking:
        silent = 0
        for key in self.keys:
            outcome = yield key
            silent = silent + 1 if isinstance(outcome, Silent) else 0
            if silent >= MOST_SILENT:
                self.given_up = f"no reply {MOST_SILENT} times in a row"
                return


def of_dictionary(dictionary: ObjectDictionary) -> ListedObjects:
    """Every entry that can be read."""
    return ListedObjects(ObjectKey(e.index, e.subindex) for e in dictionary if e.readable)
