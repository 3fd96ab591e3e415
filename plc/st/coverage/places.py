"""The places of a program whose execution is recorded, and how many of them were executed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path


class Kind(Enum):
    """The kind of a place. The values are the words that users see."""

    STATEMENT = "statements"
    BRANCH = "branches"
    TRANSITION = "transitions"


@dataclass(frozen=True, slots=True)
class Place:
    """A statement, a branch of an IF or CASE, or a transition between two states, at a line of a file.

    `name` names a branch ("THEN 1", "ELSE") or a transition ("Pump.state IDLE -> FILLING"), and is empty for a statement.
    """

    path: str
    line: int
    column: int
    kind: Kind
    name: str
    pou: str


@dataclass
class Coverage:
    """For each place, whether it was executed. Coverages of several tests and scenarios are added to each other.

    The names of files are relative to the working directory if they are in it, and absolute otherwise.
    """

    executed: dict[Place, bool] = field(default_factory=dict)

    def add(self, places: Mapping[Place, bool]) -> None:
        """Add places. A place counts as executed if it was executed at least once."""
        names = {path: _file_name(path) for path in {place.path for place in places}}
        for place, found in places.items():
            named = replace(place, path=names[place.path])
            self.executed[named] = found or self.executed.get(named, False)

    def of(self, path: str) -> Coverage:
        """Return the coverage of one file."""
        return Coverage({place: found for place, found in self.executed.items() if place.path == path})

    @property
    def paths(self) -> list[str]:
        return sorted({place.path for place in self.executed})

    def count(self, kind: Kind) -> tuple[int, int]:
        """Return how many places of a kind were executed, and how many there are."""
        found = [executed for place, executed in self.executed.items() if place.kind is kind]
        return sum(found), len(found)

    def missed(self, kind: Kind) -> list[Place]:
        """Return the places of a kind that were not executed, in the order of the source."""
        found = (place for place, executed in self.executed.items() if place.kind is kind and not executed)
        return sorted(found, key=lambda place: (place.path, place.line, place.column, place.name, place.pou))


def _file_name(path: str) -> str:
    """Return one name for a file that tests and systems name in different ways."""
    found = Path(path).resolve()
    return str(found.relative_to(Path.cwd())) if found.is_relative_to(Path.cwd()) else str(found)


def line_ranges(lines: Iterable[int]) -> str:
    """Return line numbers as a text such as ``3, 7-9``."""
    ranges: list[list[int]] = []
    for line in sorted(set(lines)):
        if ranges and line == ranges[-1][1] + 1:
            ranges[-1][1] = line
        else:
            ranges.append([line, line])
    return ", ".join(str(low) if low == high else f"{low}-{high}" for low, high in ranges)
