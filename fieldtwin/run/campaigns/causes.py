"""Group the failed runs of a campaign by cause: the same check fails, and the same kinds of faults on the same targets suffice.

One run of each cause is shrunk. Another run has the same cause if it fails in the same way with those of its faults that have the
kinds and targets of the shrunk schedule, which one further run shows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from fieldtwin.run.campaigns.shrink import FurtherRuns, same_failure

FAILED = TypeVar("FAILED")
SMALL = TypeVar("SMALL")
MOST_CAUSES = 8
"""Largest number of failed runs of a campaign that are shrunk."""
_OF_ONE_RUN = ("id", "from", "until", "probability")
"""Keys of a fault that differ between runs with the same cause."""


@dataclass(frozen=True, slots=True)
class Cause(Generic[FAILED, SMALL]):
    """Failed runs with the same cause, in the order of the campaign. `small` is the shrunk schedule of the first run."""

    small: SMALL
    runs: Sequence[FAILED]


def causes(
    failed: Iterable[FAILED],
    errors_of: Callable[[FAILED], Iterable[str]],
    shrink: Callable[[FAILED], SMALL],
    suffices: Callable[[SMALL, Sequence[FAILED]], Sequence[bool]],
    further: FurtherRuns,
) -> Iterator[Cause[FAILED, SMALL]]:
    """Yield each cause of the failed runs as soon as it is found. The limits `MOST_CAUSES` and `further` leave runs without one.

    `suffices` states for each of several runs whether it fails in the same way with its faults of the shape of a shrunk schedule.
    `shrink` counts its runs in `further`.
    """
    left, found = list(failed), 0
    while left and found < MOST_CAUSES and further.left:
        first, *others = left
        small = shrink(first)
        alike = [n for n, one in enumerate(others) if same_failure(errors_of(first), errors_of(one))]
        alike = alike[: further.left]
        further.used(len(alike))
        same = {n for n, yes in zip(alike, suffices(small, [others[n] for n in alike]), strict=True) if yes}
        found += 1
        left = [one for n, one in enumerate(others) if n not in same]
        yield Cause(small, [first, *(one for n, one in enumerate(others) if n in same)])


def shape_of(faults: Iterable[Mapping[str, Any]]) -> frozenset[str]:
    """Return the kinds and targets of faults, without their number, times and probabilities."""
    return frozenset(map(_shape, faults))


def of_shape(faults: Iterable[dict[str, Any]], shape: frozenset[str]) -> list[dict[str, Any]]:
    """Return the faults whose kind and target are in `shape`."""
    return [fault for fault in faults if _shape(fault) in shape]


def _shape(fault: Mapping[str, Any]) -> str:
    return repr(sorted((key, value) for key, value in fault.items() if key not in _OF_ONE_RUN))


def shape_text(faults: Iterable[Mapping[str, Any]]) -> str:
    """Return the kinds and targets of faults as text, such as ``silence on sensor``."""
    named = {f"{fault['name']} on {_target(fault)}" for fault in faults}
    return ", ".join(sorted(named)) or "no fault"


def _target(fault: Mapping[str, Any]) -> str:
    return ".".join(str(fault[key]) for key in ("device", "register") if fault.get(key)) or "a shared resource"
