"""The ledger of virtual hours: one line per finished run, so that the hours of several nights add up and no run is repeated.

A line belongs to a fingerprint of system and prototype file, version, virtual time and faults. Only lines with the same
fingerprint mark a seed as done.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import msgspec

from fieldtwin.__about__ import __version__
from fieldtwin.gateway.core.errors import FileInvalid, Unreachable
from fieldtwin.gateway.core.files.input_file import read_input
from fieldtwin.run.campaigns.many_seeds import SeedResult


class LedgerEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """One finished run. `what` is the fingerprint that `many_seeds.what_runs` returns; `wrong` of the `checked` values were
    never held by their device. `sha256` is the hash of the trace: the same seed has the same hash on every computer. It is empty
    if no process could finish the run; the seed then runs again when the campaign is resumed.

    `system`: the name of the system. `reproduce`: for a failed run, the command that repeats it. For `ended_s`, `took_s` and
    `worker` see `many_seeds.Made`; on a cluster, `worker` is the name of the cluster's worker. For `coverage` see
    `coverage.Coverage`. Ledgers of older versions lack these six. The last three are for the run of a scenario, whose checks
    `checked` and `wrong` count.
    """

    what: str
    version: str
    seed: int
    hours: float
    ok: bool
    checked: int
    wrong: int
    sha256: str
    errors: tuple[str, ...] = ()
    system: str = ""
    reproduce: str = ""
    ended_s: float = 0.0
    took_s: float = 0.0
    worker: str = ""
    coverage: str = ""
    verdict: str = ""
    judged: tuple[str, ...] = ()
    """The numbers of the scenario's rules that the run checked, such as ``within 1``."""
    struck: int = 0
    """How often random faults took effect."""
    places: str = ""
    """The places of the programs in Structured Text. Only the first of several runs with the same places has them."""
    executed: str = ""
    """Which of these places the run executed (`fieldtwin.plc.st.coverage.compact`); empty if this was not measured."""

    @property
    def finished(self) -> bool:
        return bool(self.sha256)

    @property
    def result(self) -> tuple[object, ...]:
        """Return what every computer must get for the same run; when and where the run was made is left out."""
        return (
            *(self.what, self.version, self.seed, self.hours, self.ok),
            *(self.checked, self.wrong, self.sha256, self.errors, self.verdict),
        )


def entry_of(
    what: str, hours: float, result: SeedResult, system: str = "", reproduce: str = "", worker: str = ""
) -> LedgerEntry:
    """Return the entry of a run by this version; `reproduce` is kept for a failed run only. `worker`: the worker of a cluster
    that made the run, if there is one.
    """
    return LedgerEntry(
        what,
        __version__,
        result.seed,
        hours if result.sha256 else 0.0,
        result.ok,
        result.checked,
        result.wrong,
        result.sha256,
        result.errors,
        system,
        "" if result.ok else reproduce,
        round(result.made.ended_s, 3),
        round(result.made.took_s, 3),
        worker or result.made.worker,
        result.coverage,
        places=result.programs.places,
        executed=result.programs.executed,
    )


class FirstPlaces:
    """Keep the places of programs in the first entry that has them, because they are equal for all runs of a campaign."""

    def __init__(self, entries: Iterable[LedgerEntry]) -> None:
        self._known = {entry.places for entry in entries}

    def once(self, entry: LedgerEntry) -> LedgerEntry:
        """Return the entry, without its places if an earlier entry has them."""
        if entry.places in self._known:
            return msgspec.structs.replace(entry, places="")
        self._known.add(entry.places)
        return entry


def differing(entries: Iterable[LedgerEntry]) -> set[int]:
    """Return the seeds with different results in these entries, which are of one fingerprint and version: a run was not
    reproduced, which is a defect.
    """
    results: dict[int, set[tuple[object, ...]]] = {}
    for entry in entries:
        if entry.finished:
            results.setdefault(entry.seed, set()).add(entry.result)
    return {seed for seed, different in results.items() if len(different) > 1}


def unfinished_left(entries: Iterable[LedgerEntry]) -> list[LedgerEntry]:
    """Return the entries without those of unfinished runs whose seed finished in a different run."""
    entries = list(entries)
    finished = {(e.what, e.version, e.seed) for e in entries if e.finished}
    return [e for e in entries if e.finished or (e.what, e.version, e.seed) not in finished]


MAX_BYTES = 256 * 1024 * 1024


def read_entries(path: Path) -> tuple[list[LedgerEntry], int]:
    """Return the entries of a ledger, and the number of bytes of an incomplete last line, which a kill leaves.

    Raises `FileInvalid`, `Unreachable`.
    """
    entries: list[LedgerEntry] = []
    *lines, rest = read_input(path, MAX_BYTES).split(b"\n")
    for number, line in enumerate(lines, 1):
        try:
            entries.append(msgspec.json.decode(line, type=LedgerEntry))
        except msgspec.DecodeError as e:
            raise FileInvalid(f"not a line of a ledger: {e}", path=str(path), line=number) from e
    return entries, len(rest)


def write_entries(path: Path, entries: Iterable[LedgerEntry]) -> None:
    """Write a new ledger with these entries. Raises `OSError`."""
    path.write_bytes(b"".join(msgspec.json.encode(entry) + b"\n" for entry in entries))


class Ledger:
    """A file of entries, appended to. A last line that a kill truncated is removed. Raises `FileInvalid`, `Unreachable`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.entries: list[LedgerEntry] = []
        if path.exists():
            self.entries, incomplete = read_entries(path)
            if incomplete:
                os.truncate(path, path.stat().st_size - incomplete)

    def done(self, what: str) -> set[int]:
        """Return the seeds with which this version has finished a run of `what`."""
        return {e.seed for e in self._of(what) if e.finished}

    def add(self, what: str, hours: float, result: SeedResult, system: str = "", reproduce: str = "") -> None:
        """Add a result and write it to disk."""
        self.record(entry_of(what, hours, result, system, reproduce))

    def record(self, entry: LedgerEntry) -> None:
        """Add an entry and write it to disk. Raises `Unreachable`."""
        try:
            with self.path.open("ab") as file:
                file.write(msgspec.json.encode(entry) + b"\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as e:
            raise Unreachable(f"cannot write the ledger: {e.strerror}", where=str(self.path)) from e
        self.entries.append(entry)

    def _of(self, what: str) -> list[LedgerEntry]:
        return [e for e in self.entries if e.what == what and e.version == __version__]

    def entries_of(self, what: str, seeds: range) -> list[LedgerEntry]:
        """Return the runs of these seeds that this version made with this fingerprint. The first one gets the places of the
        programs if only a run of a different seed has them.
        """
        every = self._of(what)
        found = [e for e in every if e.seed in seeds]
        if found and not any(e.places for e in found):
            found[0] = msgspec.structs.replace(found[0], places=next((e.places for e in every if e.places), ""))
        return found

    def recorded(self, what: str, seeds: range) -> list[LedgerEntry]:
        """Return the finished runs of these seeds by this version with this fingerprint, each seed once."""
        return list({e.seed: e for e in self.entries_of(what, seeds) if e.finished}.values())

    def different_of(self, what: str, seeds: range) -> set[int]:
        """Return which of these seeds have different results in this ledger."""
        return differing(self.entries_of(what, seeds))

    def failed_of(self, what: str, seeds: range) -> set[int]:
        """Return which of these seeds failed when this version ran them with this fingerprint."""
        return {e.seed for e in unfinished_left(self.entries_of(what, seeds)) if not e.ok}

    @property
    def hours(self) -> float:
        """Return the sum of all virtual hours in the ledger."""
        return sum(e.hours for e in self.entries)

    @property
    def wrong(self) -> int:
        return sum(e.wrong for e in self.entries)

    @property
    def failed(self) -> list[LedgerEntry]:
        """Return the runs that failed."""
        return [e for e in unfinished_left(self.entries) if not e.ok]
