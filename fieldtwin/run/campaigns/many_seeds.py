"""Run a system in virtual time once for each seed, in several processes, and report which seeds fail and why."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.plc.st.coverage.compact import CompactCoverage
from fieldtwin.run.campaigns.coverage_collector import CoverageCollector
from fieldtwin.run.places.bundle import files_of, profile_folders, relative
from fieldtwin.run.virtual.program_coverage import ProgramCoverage
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun
from fieldtwin.twin.site.data_files import find_recording

_ERRORS_SHOWN = 5


@dataclass(frozen=True, slots=True)
class Made:
    """When and where a run was made: its end in seconds since 1970 (UTC), its wall time in seconds, and its worker as HOST:PID.

    The values are 0 and empty if they are not known, as in a ledger of an older version.
    """

    ended_s: float = 0.0
    took_s: float = 0.0
    worker: str = ""


@dataclass(frozen=True, slots=True)
class SeedResult:
    """The result of one seed's run. `checked` is the number of published values that were compared with the devices' values;
    `wrong` of them were never held by the device. `made` is not compared, because the same seed gives the same result on every
    worker.
    """

    seed: int
    ok: bool
    errors: tuple[str, ...]
    checked: int
    wrong: int
    events: int
    sha256: str
    faults: tuple[tuple[str, int, int], ...] = ()
    """For each name of a fault: how many were injected, and how often they took effect."""
    made: Made = field(default=Made(), compare=False)
    coverage: str = ""
    """The situations that the run reached: the text of a `fieldtwin.run.campaigns.coverage.Coverage`."""
    programs: CompactCoverage = field(default=CompactCoverage())
    """The coverage of Structured Text, if it was measured."""


def fingerprint(*parts: str) -> str:
    """Return a fingerprint of a run: the same texts (files, options) give the same fingerprint."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8, "big") + part.encode())
    return digest.hexdigest()[:16]


def what_runs(options: VirtualOptions) -> str:
    """Return a fingerprint of these options without the seed, from the contents of the files and the command-line options."""
    run = VirtualRun(options)
    anyhow = replace(
        options, seed=None, trace=None, profiles=(), prototype_file=None, fault_file=None, faults=run.given_faults
    )
    return fingerprint(*run.files, repr(anyhow))


def run_seed(options: VirtualOptions, *, measures: bool = False) -> SeedResult:
    """Make one complete run with the seed in `options`. `measures`: also measure the coverage of Structured Text."""
    clock = WallClock()
    began_ns = clock.monotonic_ns()
    collector, programs = CoverageCollector(), ProgramCoverage(wanted=measures)
    with programs.active():
        run = VirtualRun(options)
        run.run(watch=collector.listen)
    summary = run.summary()
    systems: dict[str, dict[str, Any]] = summary.get("systems", {})
    errors = summary["errors"] + [f"{name}: {error}" for name, one in systems.items() for error in one["errors"]]
    published = [one["published"] for one in systems.values() or [summary]]
    return SeedResult(
        run.seed,
        summary["ok"],
        tuple(errors[:_ERRORS_SHOWN]),
        sum(one["checked"] for one in published),
        sum(one["wrong"] for one in published),
        summary["trace"]["events"],
        summary["trace"]["sha256"],
        _by_name([one for part in [summary, *systems.values()] for one in part.get("faults", ())]),
        Made(clock.utc_ns() / 1e9, (clock.monotonic_ns() - began_ns) / 1e9, f"{platform.node()}:{os.getpid()}"),
        collector.coverage.text(),
        programs.compact(),
    )


def _by_name(faults: Sequence[dict[str, Any]]) -> tuple[tuple[str, int, int], ...]:
    names = sorted({fault["name"] for fault in faults})
    of = {name: [fault["struck"] for fault in faults if fault["name"] == name] for name in names}
    return tuple((name, len(struck), sum(struck)) for name, struck in of.items())


def _known_faults(options: VirtualOptions, seed: int) -> VirtualRun:
    """Return a run with this seed whose `faults` are complete: with guided faults it is made again, because they are known only
    afterwards.
    """
    run = VirtualRun(replace(options, seed=seed))
    if options.random_faults is not None and options.random_faults.guided:
        run.run()
    return run


@dataclass(frozen=True, slots=True)
class SeedRuns:
    """Runs of a system with many seeds, as work for a place. `options` has no seed and no trace file. `measures`: the runs
    measure the coverage of Structured Text, which does not change them.
    """

    options: VirtualOptions
    measures: bool = False

    @property
    def virtual_s(self) -> float:
        return self.options.duration_s

    def run(self, seed: int) -> SeedResult:
        return run_seed(replace(self.options, seed=seed), measures=self.measures)

    def run_traced(self, seed: int, trace: Path, most_bytes: int) -> SeedResult:
        return run_seed(replace(self.options, seed=seed, trace=trace, most_trace_bytes=most_bytes))

    def faults_of(self, seed: int) -> Sequence[dict[str, Any]]:
        return _known_faults(self.options, seed).faults

    def run_with(self, seed: int, faults: Sequence[dict[str, Any]]) -> SeedResult:
        return run_seed(replace(self.options, seed=seed, random_faults=None, fault_file=None, faults=tuple(faults)))

    def errors_of(self, result: SeedResult) -> Sequence[str]:
        return result.errors

    def unfinished(self, seed: int, reason: str) -> SeedResult:
        return SeedResult(seed, False, (f"the run did not finish: {reason}",), 0, 0, 0, "")

    def hash_of(self, result: SeedResult) -> str:
        return result.sha256

    def portable(self) -> tuple[SeedRuns, tuple[Path, ...]]:
        options = self.options
        run = VirtualRun(options)
        recordings = {device: find_recording(name) for device, name in options.recordings.items()}
        moved = replace(
            options,
            system=str(relative(Path(options.system))),
            profiles=profile_folders(options.profiles),
            prototype_file=options.prototype_file and relative(options.prototype_file),
            recordings={device: str(relative(path)) for device, path in recordings.items()},
            faults=run.given_faults,
            fault_file=None,
        )
        return SeedRuns(moved, self.measures), (*files_of(run.group, options.profiles), *recordings.values())
