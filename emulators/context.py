"""The paper's virtual context: a collection of recordings from which an emulator answers (SPEC row Emulator).

Ordered, time-stamped, duplicates kept, bounded (rulings 2 and 3): of what was recorded for a command, the oldest is
returned first and removed. Pure; it knows neither protocols nor files. `fieldtwin.emulators.replay` stands on it and makes a
command of each register that a request asks for.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from enum import Enum

import msgspec

from fieldtwin.gateway.core.errors import Bug, FileInvalid, UnknownCommand, UsageError
from fieldtwin.gateway.core.values import COMMAND, RECORDING

MAX_ENTRIES = 500_000
"""Recordings that a context keeps: about 100 MB at most."""


class WhenUsedUp(Enum):
    """What an emulator does when its recording has nothing left (SPEC ruling 3); named in the prototype file."""

    HOLD = "hold"
    LOOP = "loop"
    ERROR = "error"

    @classmethod
    def parse(cls, text: str) -> WhenUsedUp:
        """The policy of that name; raises `UsageError`."""
        try:
            return cls(text)
        except ValueError:
            expected = ", ".join(policy.value for policy in cls)
            raise UsageError("unknown policy for the end of a recording", expected=expected, got=repr(text)) from None


class UsedUp(FileInvalid):
    """The recording has nothing left, and the prototype file says that this is an error."""


class Recorded(msgspec.Struct, frozen=True):
    """A recorded response, when it was recorded (seconds since the recording's start) and how long it had taken.

    A struct and not a dataclass: for long recordings they are made when they are asked for.
    """

    t_s: float
    response: RECORDING
    latency_s: float = 0.0


RELEASE_AT = 512
"""Taken recordings of a command that are still in memory before they are let go together: removing each by itself from the
head of a list would cost as many steps as there are behind it."""


class _Series:
    """What was recorded for one command, how far it was taken, and the last one taken. The list may be another's, too.

    `whole`: it was given as it is, and nothing is added to it or dropped from it.
    """

    __slots__ = ("at", "last", "recorded", "shared", "skip", "when_used_up", "whole")

    def __init__(
        self, when_used_up: WhenUsedUp, recorded: Sequence[Recorded] | None = None, *, whole: bool = False
    ) -> None:
        self.recorded: Sequence[Recorded] = [] if recorded is None else recorded
        self.shared = recorded is not None
        self.whole = whole
        self.at = 0
        self.last: Recorded | None = None
        self.skip = 0  # taken since, and still in the context's order of arrival
        self.when_used_up = when_used_up

    @property
    def left(self) -> int:
        return len(self.recorded) - self.at

    def take(self) -> Recorded:
        """The oldest that is left, removed."""
        recorded = self.last = self.recorded[self.at]
        self.at += 1
        wanted_again = self.shared or self.when_used_up is WhenUsedUp.LOOP
        if self.at >= RELEASE_AT and 2 * self.at >= len(self.recorded) and not wanted_again:
            del _own(self)[: self.at]
            self.at = 0
        return recorded


def _own(series: _Series) -> list[Recorded]:
    """The list of a series that is nobody else's."""
    assert isinstance(series.recorded, list)
    return series.recorded


class VirtualContext:
    """Recordings by command. `taken` counts what was removed by being returned, `dropped` what had no room.

    With `commands`, that list is fixed and its items are what `take` accepts, with or without recordings. Without, it is
    derived from what is added (ruling 12). A full context drops its oldest entry.

    `copy` gives another one that begins where this one began; many devices of one recording have one each.
    """

    def __init__(
        self,
        commands: Iterable[COMMAND] | None = None,
        recordings: Iterable[tuple[COMMAND, Recorded]] = (),
        *,
        when_used_up: WhenUsedUp = WhenUsedUp.HOLD,
        max_entries: int = MAX_ENTRIES,
    ) -> None:
        self.when_used_up = when_used_up
        self.max_entries = max_entries
        self.taken = 0
        self.dropped = 0
        self._left = 0
        self._held = 0  # of those left the ones that were added one by one: their number is bounded
        self._fixed = commands is not None
        self._series: dict[bytes, _Series] = {command.data: _Series(when_used_up) for command in commands or ()}
        self._order: deque[_Series] = deque()  # one entry for each added and not yet known to be gone
        self._origin: Mapping[bytes, _Series] | None = None
        for command, recorded in recordings:
            self.add(command, recorded)

    def copy(self) -> VirtualContext:
        """A context with the same recordings, which nothing can be added to any more, here or there. This one must not
        have been taken from. The recordings are in memory once, and a command costs some when it is first asked for."""
        if self.taken:
            raise Bug("a context was copied after something was taken from it")
        other = VirtualContext(when_used_up=self.when_used_up, max_entries=self.max_entries)
        other.dropped, other._left = self.dropped, self._left
        other._origin = self._series if self._origin is None else self._origin
        for series in self._series.values():
            series.shared = True
        return other

    def __len__(self) -> int:
        """How many recordings are left."""
        return self._left

    @property
    def command_list(self) -> tuple[COMMAND, ...]:
        """The commands that `take` accepts, in the order in which they came."""
        return tuple(COMMAND(data) for data in (self._series if self._origin is None else self._origin))

    def left(self, command: COMMAND) -> int:
        """How many recordings are left for `command`."""
        series = self._find(command)
        return series.left if series else 0

    def _find(self, command: COMMAND) -> _Series | None:
        series = self._series.get(command.data)
        if series is None and self._origin is not None and (there := self._origin.get(command.data)) is not None:
            series = self._series[command.data] = _Series(there.when_used_up, there.recorded, whole=there.whole)
        return series

    def add(self, command: COMMAND, recorded: Recorded) -> None:
        """Append to what was recorded for `command`; raises `UnknownCommand` where the list is fixed."""
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
        """All that was recorded for a command of which nothing was added: whoever gives it bounds it, and it does not count
        for `max_entries`. It may make its items when they are asked for."""
        if self._origin is not None or self._fixed or command.data in self._series:
            raise Bug("a series for a command that is there, or of a context that is fixed")
        if len(self._series) >= self.max_entries:
            raise FileInvalid("the recording holds too many different requests", expected=str(self.max_entries))
        self._series[command.data] = _Series(self.when_used_up, recorded, whole=True)
        self._left += len(recorded)

    def set_policies(self, policies: Mapping[bytes, WhenUsedUp]) -> None:
        """Other policies for single commands, which must be in the list."""
        for data, policy in policies.items():
            if data not in self._series:
                raise self._unknown(COMMAND(data))
            self._series[data].when_used_up = policy

    def peek(self, command: COMMAND) -> Recorded | None:
        """What was returned last for a command or, before that, what will be; None where there is nothing."""
        series = self._find(command)
        if series is None:
            return None
        return series.last or (series.recorded[series.at] if series.left else None)

    def take(self, command: COMMAND) -> RECORDING:
        """SPEC: the command must be in the list; a recording of the context is returned and removed.

        Used up: `HOLD` returns the last one again, `LOOP` starts over, `ERROR` raises `UsedUp`, and so do the
        others where nothing was ever recorded. Raises `UnknownCommand`.
        """
        return self.take_recorded(command).response

    def take_recorded(self, command: COMMAND) -> Recorded:
        """As `take`, with time and latency."""
        series = self._find(command)
        if series is None:
            raise self._unknown(command)
        if not series.left and series.at and series.when_used_up is WhenUsedUp.LOOP:
            self._left += series.at
            if self._origin is None and not series.whole:
                self._held += series.at
                self._order.extend([series] * series.at)
            series.at = 0
        if series.left:
            return self._remove(series)
        if series.last is not None and series.when_used_up is WhenUsedUp.HOLD:
            return series.last
        raise UsedUp(f"nothing is left of what was recorded for command {command.data.hex(' ')}")

    def _remove(self, series: _Series) -> Recorded:
        recorded = series.take()
        self._left -= 1
        self.taken += 1
        if self._origin is not None or series.whole:
            return recorded  # nothing is added, so nobody asks for the order
        self._held -= 1
        series.skip += 1
        while self._order and self._order[0].skip:  # forget the order of those that are gone
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
