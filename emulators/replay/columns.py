"""The recorded results of one repeated read: kept in columns, and decoded on access.

A recording of a day contains the same few reads a million times. An `OutcomeColumn` holds the replies to one of these reads in
one situation (`replay.situation`), as consecutive bytes. `Outcomes` presents a column as a sequence for a virtual context.
`CellValues` presents the values of one cell from all columns that contain it, in recorded order. A recording therefore needs only
its bytes in memory, and is usable as soon as it has been read. This module performs no I/O.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from array import array
from collections.abc import Sequence
from typing import overload

from fieldtwin.emulators.context import Recorded
from fieldtwin.emulators.replay.requests import CellRequest
from fieldtwin.gateway.core.files.recording import RecordedExchange
from fieldtwin.gateway.core.values import RECORDING

EXCHANGE_OVERHEAD_BYTES = 32
"""The memory in bytes that an exchange needs in addition to its reply."""

_WORDS: dict[bytes, RECORDING] = {}
"""One shared object for each content of a cell that was ever requested: at most 65,536."""


class OutcomeColumn:
    """The outcomes of `request` while the unit was in `situation`.

    `odd` holds by position the outcomes that are not a normal reply (b"" for silence); every other outcome has `stride` bytes in
    `replies`. `orders` are the positions in the whole recording.
    """

    __slots__ = ("head", "latencies", "odd", "orders", "replies", "request", "situation", "stride", "times")

    def __init__(self, request: CellRequest, situation: int) -> None:
        size = (request.count + 7) // 8 if request.function <= 2 else 2 * request.count
        self.request = request
        self.situation = situation
        self.head = bytes((request.function, size))
        self.stride = 2 + size
        self.replies = bytearray()
        self.odd: dict[int, RECORDING] = {}
        self.orders = array("Q")
        self.times = array("d")
        self.latencies = array("d")

    def __len__(self) -> int:
        return len(self.orders)

    def add(self, order: int, exchange: RecordedExchange) -> bool:
        """Add an outcome. Return whether it is a normal reply."""
        reply = exchange.reply
        normal = reply is not None and len(reply) == self.stride and reply.startswith(self.head)
        if normal:
            self.replies += reply  # type: ignore[arg-type]
        else:
            self.odd[len(self.orders)] = RECORDING(reply or b"")
            self.replies += bytes(self.stride)
        self.orders.append(order)
        self.times.append(exchange.t_s)
        self.latencies.append(exchange.latency_s)
        return normal

    @property
    def normal(self) -> Sequence[int]:
        """Return the positions of normal replies."""
        return [i for i in range(len(self.orders)) if i not in self.odd] if self.odd else range(len(self.orders))

    def drop_before(self, order: int) -> int:
        """Drop the outcomes before this position in the recording, and return their number."""
        count = next((i for i, o in enumerate(self.orders) if o >= order), len(self.orders))
        del self.replies[: count * self.stride], self.orders[:count], self.times[:count], self.latencies[:count]
        self.odd = {i - count: reply for i, reply in self.odd.items() if i >= count}
        return count

    def outcome(self, i: int) -> Recorded:
        """Return the whole reply at position `i`, with its time and latency."""
        reply = self.odd.get(i)
        if reply is None:
            reply = RECORDING(bytes(self.replies[i * self.stride : (i + 1) * self.stride]))
        return Recorded(self.times[i], reply, self.latencies[i])

    def cell(self, i: int, offset: int) -> Recorded:
        """Return the value of the cell at `offset` from the first one, at position `i`: two bytes."""
        at = i * self.stride + 2
        if self.request.function <= 2:
            word = bytes((0, self.replies[at + offset // 8] >> offset % 8 & 1))
        else:
            at += 2 * offset
            word = bytes(self.replies[at : at + 2])
        known = _WORDS.get(word)
        if known is None:
            known = _WORDS[word] = RECORDING(word)
        return Recorded(self.times[i], known)


class _View(Sequence[Recorded], ABC):
    """A sequence of recorded items that are created on access, by position."""

    @overload
    def __getitem__(self, i: int) -> Recorded: ...
    @overload
    def __getitem__(self, i: slice) -> list[Recorded]: ...
    def __getitem__(self, i: int | slice) -> Recorded | list[Recorded]:
        if isinstance(i, int):
            return self._at(i if i >= 0 else i + len(self))
        return [self._at(k) for k in range(*i.indices(len(self)))]

    @abstractmethod
    def _at(self, i: int) -> Recorded:
        """Return the item at position `i`, which exists."""


class Outcomes(_View):
    """A sequence of all outcomes of a column's request, silence included."""

    def __init__(self, column: OutcomeColumn) -> None:
        self._column = column

    def __len__(self) -> int:
        return len(self._column)

    def _at(self, i: int) -> Recorded:
        return self._column.outcome(i)


class Merged:
    """The normal replies of several columns in recorded order: number -> (column, position).

    The order is computed on first access, once for all cells that these columns contain.
    """

    def __init__(self, columns: Sequence[OutcomeColumn]) -> None:
        self.columns = columns
        self.size = sum(len(c) - len(c.odd) for c in columns)
        self._which: array[int] | None = None
        self._places: Sequence[int] = ()

    def at(self, i: int) -> tuple[int, int]:
        """Return the number of the column that holds the normal reply `i`, and the position of the reply in that column."""
        which = self._which
        if which is None:
            which = self._sort()
        return (which[i] if which else 0), self._places[i]

    def _sort(self) -> array[int]:
        if len(self.columns) == 1:
            self._which, self._places = array("L"), self.columns[0].normal
            return self._which
        every = sorted((c.orders[i], number, i) for number, c in enumerate(self.columns) for i in c.normal)
        self._which = array("L", (number for _, number, _ in every))
        self._places = array("Q", (i for _, _, i in every))
        return self._which


class CellValues(_View):
    """The values of one cell; `offsets` gives its offset in each of the columns."""

    def __init__(self, merged: Merged, offsets: Sequence[int]) -> None:
        self._merged = merged
        self._offsets = offsets
        columns = merged.columns
        self._only = columns[0] if len(columns) == 1 and not columns[0].odd else None

    def __len__(self) -> int:
        return self._merged.size

    def _at(self, i: int) -> Recorded:
        if self._only is not None:
            return self._only.cell(i, self._offsets[0])
        number, place = self._merged.at(i)
        return self._merged.columns[number].cell(place, self._offsets[number])
