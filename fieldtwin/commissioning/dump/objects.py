"""Explore a node's object dictionary over SDO: index by index, or entry by entry of an EDS.

The sweeps are generators without I/O, as in `sweep`. Nothing is written; a write-only object is never requested.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass

from fieldtwin.commissioning.dump.coverage import coarse_to_fine
from fieldtwin.commissioning.dump.sweep import MOST_SILENT, Invalid, Outcome, RefusedRead, Silent, Taken
from fieldtwin.gateway.protocols.canopen.eds.dictionary import ObjectDictionary

NO_OBJECT, NO_SUBINDEX = 0x0602_0000, 0x0609_0011
MOST_MISSING = 8
"""Number of consecutive missing subindices after which the rest of an array is skipped, for any value of its subindex 0."""
LEVELS = ((0x1000,), (0x100, 0x800), (0x40,), (0x10,))
"""Steps at which profiles usually begin groups of objects, the likeliest first."""
EVERYTHING = ((0x1000, 0x9FFF),)
"""The whole range of indices: communication, manufacturer and device profile area (CiA 301, 7.4.1)."""

Asking = Generator["ObjectKey", Outcome, None]


@dataclass(frozen=True, slots=True)
class ObjectKey:
    """The address of an object of a node: index and subindex."""

    index: int
    subindex: int

    def __str__(self) -> str:
        return f"{self.index:04X}h:{self.subindex:02X}"

    @classmethod
    def parse(cls, text: str) -> ObjectKey:
        """Return the object that `text` names, such as ``1018h:01``. Raises `ValueError`."""
        index, colon, sub = text.partition(":")
        if not colon:
            raise ValueError(text)
        return cls(int(index.removesuffix("h"), 16), int(sub, 16))


class _Patience:
    """The decision how long to query a silent node. `budget_us`: the total time in us that requests without a result may
    take.
    """

    def __init__(self, budget_us: int | None) -> None:
        self.stopped = ""
        self.patient = True
        self._budget_us = budget_us
        self._spent_us = self._silent = 0
        self._heard = False

    @property
    def lost(self) -> bool:
        """Return whether the node was silent for the last `MOST_SILENT` requests."""
        return self._silent >= MOST_SILENT

    def note(self, outcome: Outcome) -> None:
        """Record the outcome of a request, to know whether the node is silent."""
        self._silent = self._silent + 1 if isinstance(outcome, Silent) else 0
        self._heard |= not isinstance(outcome, Silent)
        self._spent_us += outcome.us if isinstance(outcome, Silent | Invalid) else 0
        self.patient = not self.lost
        if self.lost and not self._heard:
            self.stopped = f"no reply {MOST_SILENT} times in a row"
        elif self._budget_us is not None and self._spent_us > self._budget_us:
            self.stopped = f"the time budget of {self._budget_us / 1e6:g} s for requests without a result is used up"


class ObjectSweep(_Patience):
    """A sweep over every index of `ranges` (both ends included): subindex 0 first, then the others of existing objects.

    After `MOST_SILENT` consecutive requests without a reply, only some of the other indices are tried, round numbers first.
    Where the node answers again, the sweep continues from there.
    """

    def __init__(self, ranges: Sequence[tuple[int, int]] = EVERYTHING, budget_us: int | None = None) -> None:
        super().__init__(budget_us)
        self.ranges = ranges
        self._asked: set[int] = set()

    def asking(self) -> Asking:
        for first, last in self.ranges:
            yield from self._walk(first, last)
            for index in coarse_to_fine(first, last + 1, 1, LEVELS):
                if self.stopped:
                    return
                if index not in self._asked:
                    yield from self._one(index)
                    if not self.lost:
                        yield from self._walk(index + 1, last)

    def _walk(self, first: int, last: int) -> Asking:
        for index in range(first, last + 1):
            if self.stopped or self.lost:
                return
            if index not in self._asked:
                yield from self._one(index)

    def _one(self, index: int) -> Asking:
        self._asked.add(index)
        outcome = yield from self._ask(index, 0)
        if isinstance(outcome, Taken) and len(outcome.raw) == 1 and outcome.raw[0]:
            yield from self._members(index, outcome.raw[0])
        elif isinstance(outcome, RefusedRead) and outcome.code == NO_SUBINDEX:
            yield from self._members(index, 1)

    def _members(self, index: int, count: int) -> Generator[ObjectKey, Outcome, None]:
        """Read the other subindices. If subindex 0 is a small number, it may be their count, which subindex 1 confirms."""
        missing = 0
        for sub in range(1, min(count, 254) + 1):
            outcome = yield from self._ask(index, sub)
            missing = (
                missing + 1 if isinstance(outcome, RefusedRead) and outcome.code in (NO_SUBINDEX, NO_OBJECT) else 0
            )
            if self.stopped or self.lost or missing >= MOST_MISSING or (missing and sub == 1):
                return

    def _ask(self, index: int, sub: int) -> Generator[ObjectKey, Outcome, Outcome]:
        outcome = yield ObjectKey(index, sub)
        self.note(outcome)
        return outcome


class ListedObjects(_Patience):
    """A sweep that reads `keys` in their order, without retries while the node is silent."""

    def __init__(self, keys: Iterable[ObjectKey], budget_us: int | None = None) -> None:
        super().__init__(budget_us)
        self.keys = list(keys)

    def asking(self) -> Asking:
        for key in self.keys:
            self.note((yield key))
            if self.stopped:
                return


def of_dictionary(dictionary: ObjectDictionary, budget_us: int | None = None) -> ListedObjects:
    """Return a sweep of every entry of the EDS that can be read."""
    return ListedObjects((ObjectKey(e.index, e.subindex) for e in dictionary if e.readable), budget_us)
