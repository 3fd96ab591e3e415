"""The traces of failed runs of a campaign, as files on the computer of the user.

A run is repeated for its trace, because the runs of a campaign write none. The hash of the trace shows that the repetition is the
same run.
"""

from __future__ import annotations

import os
import tempfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import msgspec

from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.results.trace_about import TraceAbout, about_path, read_about, write_about
from fieldtwin.run.places.place import Ended, Place, SeedWork, run_units

RESULT = TypeVar("RESULT")
MOST_TRACES = 8
"""Largest number of traces that a campaign keeps."""
MAX_TRACE_BYTES = 32 << 20
"""Largest size of the file of a trace, in bytes."""
MAX_TOTAL_BYTES = 128 << 20
"""Largest size of all traces that a campaign keeps, in bytes."""
MAX_PACKED_BYTES = 3 << 20
"""Largest size of a compressed trace, in bytes, so that it fits into the result of a unit with its description."""
TOO_LARGE = (
    f"its trace is larger than {MAX_TRACE_BYTES >> 20} MiB, or than {MAX_PACKED_BYTES >> 20} MiB after compression"
)
TOO_MANY_BYTES = f"the traces of a campaign have at most {MAX_TOTAL_BYTES >> 20} MiB in total"
NOT_REPRODUCED = (
    "a second run with this seed has a different trace, which is a defect: the same seed must give the same run"
)


class TracedWork(SeedWork[RESULT], Protocol[RESULT]):
    """Work whose runs can write their trace."""

    def run_traced(self, seed: int, trace: Path, most_bytes: int) -> RESULT:
        """Run the unit of this seed, and write its trace and the description of the trace. `most_bytes` limits the trace."""


@dataclass(frozen=True, slots=True)
class PackedTrace:
    """The trace of a run, compressed, with the hash of the run and the description of the trace. If it is empty, `reason` states
    why.
    """

    sha256: str = ""
    packed: bytes = b""
    about: TraceAbout | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class TraceRuns(Generic[RESULT]):
    """Repetitions of runs for their traces, as work for a place."""

    work: TracedWork[RESULT]

    @property
    def virtual_s(self) -> float:
        return self.work.virtual_s

    def run(self, seed: int) -> PackedTrace:
        with tempfile.TemporaryDirectory(prefix="ft-trace-") as folder:
            trace = Path(folder) / "trace.jsonl"
            result = self.work.run_traced(seed, trace, MAX_TRACE_BYTES)
            if trace.stat().st_size > MAX_TRACE_BYTES:
                return PackedTrace(reason=TOO_LARGE)
            packed = zlib.compress(trace.read_bytes())
            about = read_about(trace)
        if len(packed) > MAX_PACKED_BYTES:
            return PackedTrace(reason=TOO_LARGE)
        return PackedTrace(self.work.hash_of(result), packed, about and _with_paths(about, os.path.relpath))

    def unfinished(self, seed: int, reason: str) -> PackedTrace:
        return PackedTrace(reason=f"its run for the trace did not finish: {reason}")

    def hash_of(self, result: PackedTrace) -> str:
        return result.sha256

    def portable(self) -> tuple[TraceRuns[RESULT], tuple[Path, ...]]:
        work, files = self.work.portable()
        return TraceRuns(work), files


def _with_paths(about: TraceAbout, changed: Callable[[str], str]) -> TraceAbout:
    return msgspec.structs.replace(
        about, system_path=changed(about.system_path), profiles=[changed(folder) for folder in about.profiles]
    )


@dataclass(slots=True)
class KeptTraces:
    """The files of the traces that were kept, by seed, and for each failed seed without a trace the reason."""

    files: dict[int, Path] = field(default_factory=dict)
    missing: dict[int, str] = field(default_factory=dict)
    bytes: int = 0
    """The size of all files, in bytes."""

    def plain(self) -> dict[int, str]:
        """Return the files by seed as text, in the order of the seeds."""
        return {seed: path.as_posix() for seed, path in sorted(self.files.items())}

    def keep(self, seed: int, sha256: str, trace: PackedTrace, path: Path) -> None:
        """Write the trace to `path`, or note why that is not possible. `sha256` is the hash of the run in the campaign."""
        reason = trace.reason or (NOT_REPRODUCED if trace.sha256 != sha256 else self._not_written(trace, path))
        if reason:
            self.missing[seed] = reason
        else:
            self.files[seed] = path

    def _not_written(self, trace: PackedTrace, path: Path) -> str:
        """Write the trace. Return an empty text, or the reason why it was not written."""
        lines = zlib.decompress(trace.packed)
        if self.bytes + len(lines) > MAX_TOTAL_BYTES:
            return TOO_MANY_BYTES
        try:
            about_path(path).unlink(missing_ok=True)
            path.write_bytes(lines)
            if trace.about is not None:
                write_about(path, _with_paths(trace.about, os.path.abspath))
        except OSError as e:
            return f"cannot write {path}: {e.strerror or e}"
        except FieldtwinError as e:
            return str(e)
        self.bytes += len(lines)
        return ""


def choose(failed: Sequence[int], first: Sequence[int]) -> list[int]:
    """Return the failed seeds whose traces are kept: those of `first`, then the others, at most `MOST_TRACES`."""
    return list(dict.fromkeys([*first, *failed]))[:MOST_TRACES]


def fetch(
    place: Place, work: TracedWork[RESULT], hashes: Mapping[int, str], folder: Path, stem: str, kept: KeptTraces
) -> None:
    """Run these seeds again and write their traces as ``STEM-seedN.jsonl`` into `folder`. `hashes` are those of their runs.

    `kept` gets each trace when its run ends, so that an interruption loses only the later ones. An error of the place is the
    reason of the traces that are missing.
    """

    def ended(one: Ended[int, PackedTrace]) -> None:
        kept.keep(one.unit, hashes[one.unit], one.result, folder / f"{stem}-seed{one.unit}.jsonl")

    again = TraceRuns(work)
    try:
        run_units(place, again, list(hashes), ended)
    except FieldtwinError as e:
        kept.missing |= {seed: str(e) for seed in hashes if seed not in kept.files and seed not in kept.missing}
