"""The virtual context of an emulator: the collection of recordings from which it answers (docs/explanation/paper.md).

The collection is ordered, time-stamped and bounded, and keeps duplicates (rulings 2 and 3): the oldest recording of a command
is returned first and removed. This module performs no I/O and does not depend on protocols. `fieldtwin.emulators.replay` uses
it with one command for each register that a request reads.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from enum import Enum

import msgspec

from fieldtwin.gateway.core.errors import Bug, FileInvalid, UnknownCommand, UsageError
from fieldtwin.gateway.core.values import COMMAND, RECORDING

MAX_ENTRIES = 500_000
"""The largest number of recordings that a context keeps: about 100 MB."""


class EndOfRecording(Enum):
    """The behaviour of an emulator at the end of its recording (paper.md, ruling 3), which the prototype file selects."""

    HOLD = "hold"
    LOOP = "loop"
    ERROR = "error"

    @classmethod
    def parse(cls, text: str) -> EndOfRecording:
        """Return the policy named `text`, as a prototype file writes it; raises `UsageError` for an unknown name."""
        try:
            return cls(text)
        except ValueError:
            expected = ", ".join(policy.value for policy in cls)
            raise UsageError("unknown policy for the end of a recording", expected=expected, got=repr(text)) from None


class UsedUp(FileInvalid):
    """A recording has no more entries, and the prototype file says that this is an error."""


class Recorded(msgspec.Struct, frozen=True):
    """A recorded response, the time of recording (seconds since the recording's start) and its latency.

    It is a struct, because it is created at each access to a long recording, and a dataclass takes longer.
    """

    t_s: float
    response: RECORDING
    latency_s: float = 0.0


RELEASE_AT = 512
"""The number of taken recordings of a command after which they are removed together. To remove each one from the head of a
list would take as many steps as there are recordings after it.
"""


class _Series:
    """The recordings of one command, the number of recordings that were taken, and the one that was taken last. The list may
    be shared with copies of the context.

    `whole` says that the series was added as a whole, so nothing is added to it or dropped from it.
    """

    __slots__ = ("at", "last", "recorded", "shared", "skip", "when_used_up", "whole")

    def __init__(
        self, when_used_up: EndOfRecording, recorded: Sequence[Recorded] | None = None, *, whole: bool = False
    ) -> None:
        self.recorded: Sequence[Recorded] = [] if recorded is None else recorded
        self.shared = recorded is not None
        self.whole = whole
        self.at = 0
        self.last: Recorded | None = None
        self.skip = 0  # taken entries that are still in the context's order of arrival
        self.when_used_up = when_used_up

    @property
    def left(self) -> int:
        return len(self.recorded) - self.at

    def take(self) -> Recorded:
        """Remove and return the oldest remaining recording."""
        recorded = self.last = self.recorded[self.at]
        self.at += 1
        wanted_again = self.shared or self.when_used_up is EndOfRecording.LOOP
        if self.at >= RELEASE_AT and 2 * self.at >= len(self.recorded) and not wanted_again:
            del _own(self)[: self.at]
            self.at = 0
        return recorded


def _own(series: _Series) -> list[Recorded]:
    """Return the list of a series, copied if it was shared."""
    assert isinstance(series.recorded, list)
    return series.recorded


class VirtualContext:
    """The recordings by command. `taken` counts the recordings that were returned, `dropped` those that did not fit.

    If `commands` is given, `take` accepts exactly these commands, even those without recordings. Otherwise the list of commands
    is derived from the added recordings (paper.md, ruling 12). A full context drops its oldest entry.

    `copy` returns a context in the initial state of this one; each device of one recording has its own copy.
    """

    def __init__(
        self,
        commands: Iterable[COMMAND] | None = None,
        recordings: Iterable[tuple[COMMAND, Recorded]] = (),
        *,
        when_used_up: EndOfRecording = EndOfRecording.HOLD,
        max_entries: int = MAX_ENTRIES,
    ) -> None:
        self.when_used_up = when_used_up
        self.max_entries = max_entries
        self.taken = 0
        self.dropped = 0
        self._left = 0
        self._held = 0  # number of recordings from `add` that were not replayed yet; at most `max_entries`
        self._fixed = commands is not None
        self._series: dict[bytes, _Series] = {command.data: _Series(when_used_up) for command in commands or ()}
        # one entry for each added recording, unless it is known that the recording was removed
        self._order: deque[_Series] = deque()
        self._origin: Mapping[bytes, _Series] | None = None
        for command, recorded in recordings:
            self.add(command, recorded)

    def copy(self) -> VirtualContext:
        """Return a context with the same recordings. Afterwards nothing can be added to either of them.

        Call it before anything was taken from this context. The recordings are shared in memory; a copy needs memory for each
        command that is used.
        """
        if self.taken:
            raise Bug("a context was copied after something was taken from it")
        other = VirtualContext(when_used_up=self.when_used_up, max_entries=self.max_entries)
        other.dropped, other._left = self.dropped, self._left
        other._origin = self._series if self._origin is None else self._origin
        for series in self._series.values():
            series.shared = True
        return other

    def __len__(self) -> int:
        """Return how many recordings are left."""
        return self._left

    @property
    def command_list(self) -> tuple[COMMAND, ...]:
        """Return the commands that `take` accepts, in the order in which they were added."""
        return tuple(COMMAND(data) for data in (self._series if self._origin is None else self._origin))

    def left(self, command: COMMAND) -> int:
        """Return how many recordings are left for `command`."""
        series = self._find(command)
        return series.left if series else 0

    def _find(self, command: COMMAND) -> _Series | None:
        series = self._series.get(command.data)
        if series is None and self._origin is not None and (there := self._origin.get(command.data)) is not None:
            series = self._series[command.data] = _Series(there.when_used_up, there.recorded, whole=there.whole)
        return series

    def add(self, command: COMMAND, recorded: Recorded) -> None:
        """Append a recording for `command`; raises `UnknownCommand` if the list is fixed."""
        if self._origin is not None:
            raise Bug("something was added to a copied context")
        series = self._series.get(command.data)
        if series is None:
            if self._fixed:
                raise self._unknown(command)
            if len(self._series) >= self.max_entries:
                raise FileInvalid("the recording holds too many different requests", expected=str(self.max_entries))
            series = self._series[command.data] = _Series(self.when_used_up)
        if self._held >= self.max_entries:
            self._drop_oldest()
        if series.shared:
            raise Bug("something was added to a context that was copied")
        _own(series).append(recorded)
        self._order.append(series)
        self._left += 1
        self._held += 1

    def add_series(self, command: COMMAND, recorded: Sequence[Recorded]) -> None:
        """Add all recordings of a command for which nothing was added yet.

        The caller limits their number; they do not count for `max_entries`. The sequence may create its items on
        access.
        """
        if self._origin is not None or self._fixed or command.data in self._series:
            raise Bug("a series for a command that already exists, or in a context that is fixed")
        if len(self._series) >= self.max_entries:
            raise FileInvalid("the recording holds too many different requests", expected=str(self.max_entries))
        self._series[command.data] = _Series(self.when_used_up, recorded, whole=True)
        self._left += len(recorded)

    def set_policies(self, policies: Mapping[bytes, EndOfRecording]) -> None:
        """Set different policies for single commands, which must be in the list."""
        for data, policy in policies.items():
            if data not in self._series:
                raise self._unknown(COMMAND(data))
            self._series[data].when_used_up = policy

    def peek(self, command: COMMAND) -> Recorded | None:
        """Return the recording that was returned last for a command, else the next recording; None if there is no recording."""
        series = self._find(command)
        if series is None:
            return None
        return series.last or (series.recorded[series.at] if series.left else None)

    def take(self, command: COMMAND) -> RECORDING:
        """Remove the next recording of `command` from the context and return it.

        At the end, `HOLD` returns the last recording again, `LOOP` starts over, and `ERROR` raises `UsedUp`. If nothing was ever
        recorded, all of them raise `UsedUp`. Raises `UnknownCommand` if the command is not in the list.
        """
        return self.take_recorded(command).response

    def take_recorded(self, command: COMMAND) -> Recorded:
        """Take a recording as `take` does, and return it with its time and latency."""
        series = self._find(command)
        if series is None:
            raise self._unknown(command)
        if not series.left and series.at and series.when_used_up is EndOfRecording.LOOP:
            self._left += series.at
            if self._origin is None and not series.whole:
                self._held += series.at
                self._order.extend([series] * series.at)
            series.at = 0
        if series.left:
            return self._remove(series)
        if series.last is not None and series.when_used_up is EndOfRecording.HOLD:
            return series.last
        raise UsedUp(f"the recording has no further entry for command {command.data.hex(' ')}")

    def _remove(self, series: _Series) -> Recorded:
        recorded = series.take()
        self._left -= 1
        self.taken += 1
        if self._origin is not None or series.whole:
            return recorded  # nothing is added, so the order is not needed
        self._held -= 1
        series.skip += 1
        while self._order and self._order[0].skip:  # remove taken entries from the order
            self._order.popleft().skip -= 1
        return recorded

    def _drop_oldest(self) -> None:
        while self._order:
            series = self._order.popleft()
            if series.skip:
                series.skip -= 1
                continue
            del _own(series)[series.at]
            self._left -= 1
            self._held -= 1
            self.dropped += 1
            return

    def _unknown(self, command: COMMAND) -> UnknownCommand:
        return UnknownCommand("not in the command list", got=command.data.hex(" ") or "no bytes")
