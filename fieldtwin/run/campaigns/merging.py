"""Join ledgers of virtual hours that several computers wrote, for example one for each shard of a campaign.

Joining is commutative and idempotent: the order of the ledgers has no effect, and a run that several of them contain counts once,
also if several computers made it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from fieldtwin.plc.st.coverage.compact import CompactCoverage, joined_coverage
from fieldtwin.plc.st.coverage.places import Coverage as STCoverage
from fieldtwin.run.campaigns.coverage import Coverage, joined
from fieldtwin.run.campaigns.ledger import LedgerEntry, differing, unfinished_left


@dataclass(frozen=True, slots=True)
class Runs:
    """All recorded runs of the same system with the same files, options and version: `what` is their fingerprint."""

    what: str
    version: str
    entries: tuple[LedgerEntry, ...]

    @property
    def seeds(self) -> frozenset[int]:
        return frozenset(entry.seed for entry in self.entries)

    @property
    def failed(self) -> list[LedgerEntry]:
        """Return the runs that failed, by seed."""
        return [entry for entry in unfinished_left(self.entries) if not entry.ok]

    @property
    def hours(self) -> float:
        """Return the virtual hours; a seed counts once."""
        longest: dict[int, float] = {}
        for entry in self.entries:
            longest[entry.seed] = max(entry.hours, longest.get(entry.seed, 0.0))
        return sum(longest.values())

    @property
    def coverage(self) -> Coverage:
        """Return what all runs together have seen. Raises `FileInvalid`."""
        return joined(entry.coverage for entry in self.entries)

    @property
    def programs(self) -> tuple[STCoverage, int]:
        """Return the coverage of Structured Text by all runs, and the number of seeds that measured it. Raises `FileInvalid`."""
        every = joined_coverage(CompactCoverage(entry.places, entry.executed) for entry in self.entries)
        return every, len({entry.seed for entry in self.entries if entry.executed})

    @property
    def different(self) -> list[int]:
        """Return the seeds that have different results: a run was not reproduced, which is a defect."""
        return sorted(differing(self.entries))


def merged(ledgers: Iterable[Iterable[LedgerEntry]]) -> list[LedgerEntry]:
    """Return each different result of all ledgers once, in an order that depends on the entries only."""
    found = {entry for ledger in ledgers for entry in ledger}
    ordered = sorted(found, key=lambda entry: (*_place(entry), *_lacks(entry), repr(entry)))
    unique: dict[tuple[object, ...], LedgerEntry] = {}
    for entry in ordered:
        unique.setdefault(entry.result, entry)
    return list(unique.values())


def _place(entry: LedgerEntry) -> tuple[str, str, int]:
    return entry.what, entry.version, entry.seed


def _lacks(entry: LedgerEntry) -> tuple[bool, ...]:
    """Return an order that prefers the entry with more information about the same run."""
    return not entry.places, not entry.executed, not entry.coverage


def by_fingerprint(entries: Iterable[LedgerEntry]) -> list[Runs]:
    """Return the runs by fingerprint and version, in this order."""
    groups: dict[tuple[str, str], list[LedgerEntry]] = {}
    for entry in entries:
        groups.setdefault((entry.what, entry.version), []).append(entry)
    return [Runs(*key, tuple(groups[key])) for key in sorted(groups)]
