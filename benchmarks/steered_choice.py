"""The search of benchmarks/steering.py: schedules of random faults that mutate those of runs which reached rare situations.

A run either draws its schedule from its seed, or mutates the schedule of a run of an earlier generation. So the result depends
neither on the number of processes nor on the order in which runs end.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from math import log10
from random import Random
from typing import Any

Fault = dict[str, Any]
Draw = Callable[[int], Sequence[Fault]]
GENERATION = 32
"""Number of runs of a generation, which begins when the one before has ended."""
DRAWN = 0.5
"""The part of the runs whose schedule is drawn from the seed, although parents exist."""
PARENTS = 8
"""Largest number of parents of one element of coverage."""
KINDS = 4
"""Number of kinds of elements, see `fieldtwin.run.campaigns.coverage.Kind`."""
CHANGES = (1, 1, 2, 4)
"""The numbers of changes of one mutation, each equally frequent."""
SHORTEST_S, LONGEST_S = 0.5, 20.0
SMALLEST_SHIFT_S = 0.1


@dataclass(frozen=True, slots=True)
class Planned:
    """A run that will be made: its number, the seed of everything but its faults, and its faults."""

    number: int
    seed: int
    faults: tuple[Fault, ...]


def generations(numbers: range) -> Iterator[range]:
    """Divide the numbers of the runs of a campaign into generations."""
    return (numbers[at : at + GENERATION] for at in range(0, len(numbers), GENERATION))


class Steering:
    """The runs of a campaign by the elements of coverage that they reached.

    `draw` returns the schedule that a seed chooses, and all of its faults end at `last_s` seconds or before.
    """

    def __init__(self, draw: Draw, last_s: float) -> None:
        self._draw, self._last_s = draw, last_s
        self._runs: Counter[int] = Counter()
        self._parents: dict[int, list[Planned]] = {}
        self._choices: list[tuple[list[int], list[float]]] = []

    def add(self, run: Planned, elements: frozenset[int]) -> None:
        """Count a run that has ended. The runs of a generation are added in the order of their numbers."""
        self._runs.update(elements)
        self._choices = []
        random = Random(f"parent {run.number}")
        for one in sorted(elements):
            parents = self._parents.setdefault(one, [])
            if len(parents) < PARENTS:
                parents.append(run)
            else:
                parents[random.randrange(PARENTS)] = run

    def plan(self, number: int) -> Planned:
        """Return the run with this number: with the schedule that its number draws, or with a mutated one."""
        random = Random(f"steering {number}")
        if not self._parents or random.random() < DRAWN:
            return Planned(number, number, tuple(self._draw(number)))
        if not self._choices:
            self._choices = list(self._weighed())
        elements, weights = random.choice(self._choices)
        parent = random.choice(self._parents[random.choices(elements, cum_weights=weights)[0]])
        return Planned(number, parent.seed, mutated(parent.faults, self._draw(number), random, self._last_s))

    def _weighed(self) -> Iterator[tuple[list[int], list[float]]]:
        """Yield the elements of each kind with accumulated weights: an element that few runs reached is preferred."""
        for kind in range(KINDS):
            if found := [one for one in sorted(self._parents) if one >> 16 == kind]:
                yield found, list(accumulate(self._runs[one] ** -2.0 for one in found))


def mutated(faults: Sequence[Fault], donor: Sequence[Fault], random: Random, last_s: float) -> tuple[Fault, ...]:
    """Return the faults after some changes, sorted by begin. `donor` is a schedule for the same system."""
    change = _Change(list(map(dict, faults)), list(map(dict, donor)), random, last_s)
    for _ in range(random.choice(CHANGES)):
        random.choice(change.kinds)()
    ordered = sorted(change.faults, key=lambda fault: float(fault["from"]))
    return tuple(dict(fault, id=f"f{number}") for number, fault in enumerate(ordered, 1))


class _Change:
    """The changes of one mutation. Each method changes `faults` once, or does nothing if the schedule does not allow it."""

    def __init__(self, faults: list[Fault], donor: list[Fault], random: Random, last_s: float) -> None:
        self.faults, self._donor, self._random, self._last_s = faults, donor, random, last_s
        self.kinds: tuple[Callable[[], None], ...] = (
            *(self.move, self.lengthen, self.repeat, self.add),
            *(self.exchange, self.remove, self.continue_differently),
        )

    def move(self) -> None:
        """Move a fault in time."""
        if self.faults:
            fault = self._random.choice(self.faults)
            self._place(fault, fault["from"] + self._shift_s(), _length_s(fault))

    def lengthen(self) -> None:
        """Change the length of a fault by a factor of 1/8 to 8."""
        if self.faults:
            fault = self._random.choice(self.faults)
            self._place(fault, fault["from"], _length_s(fault) * 2 ** self._random.uniform(-3, 3))

    def repeat(self) -> None:
        """Add a fault of the schedule again at a different time."""
        if self.faults:
            fault = self._random.choice(self.faults)
            self._add(fault, fault["from"] + self._shift_s())

    def add(self) -> None:
        """Add a fault of the donor."""
        if self._donor:
            fault = self._random.choice(self._donor)
            self._add(fault, fault["from"])

    def exchange(self) -> None:
        """Replace a fault by one of the donor at the same time."""
        if self.faults and self._donor:
            old = self.faults.pop(self._random.randrange(len(self.faults)))
            self._add(self._random.choice(self._donor), old["from"])

    def remove(self) -> None:
        """Remove a fault."""
        if self.faults:
            self.faults.pop(self._random.randrange(len(self.faults)))

    def continue_differently(self) -> None:
        """Replace all faults after a time by those of the donor."""
        at_s = self._random.uniform(0, self._last_s)
        self.faults[:] = [fault for fault in self.faults if fault["from"] < at_s]
        self.faults += [dict(fault) for fault in self._donor if fault["from"] >= at_s]

    def _shift_s(self) -> float:
        """Return a time in seconds, earlier or later. Each order of magnitude is equally probable."""
        exponent = self._random.uniform(log10(SMALLEST_SHIFT_S), log10(self._last_s))
        return float(self._random.choice((-1, 1)) * 10**exponent)

    def _add(self, fault: Fault, at_s: float) -> None:
        new = dict(fault)
        self._place(new, at_s, _length_s(fault))
        self.faults.append(new)

    def _place(self, fault: Fault, at_s: float, length_s: float) -> None:
        """Set the times of a fault, in seconds; a time outside the part of the run with faults is moved into it."""
        length_s = min(max(length_s, SHORTEST_S), LONGEST_S)
        begin_s = min(max(at_s, 0.0), self._last_s - length_s)
        fault["from"], fault["until"] = round(begin_s, 3), round(begin_s + length_s, 3)


def _length_s(fault: Fault) -> float:
    return float(fault["until"]) - float(fault["from"])
