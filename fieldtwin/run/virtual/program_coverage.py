"""Measure which statements, branches and transitions of Structured Text a virtual run executes, for the ledger of a campaign."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path

from fieldtwin.plc.st.coverage.compact import CompactCoverage, compact
from fieldtwin.plc.st.coverage.places import Coverage
from fieldtwin.plc.st.coverage.recording import Recording
from fieldtwin.twin.site.data_files import data_root


class ProgramCoverage:
    """The coverage of the programs of one run. Without `wanted`, nothing is measured."""

    def __init__(self, *, wanted: bool) -> None:
        self._recording = Recording() if wanted else None

    def active(self) -> AbstractContextManager[None]:
        """Return the context in which the run loads its programs and takes place."""
        return nullcontext() if self._recording is None else self._recording.active()

    def compact(self) -> CompactCoverage:
        """Return what was measured. Files have the same names on every computer: relative to the working directory, or to the
        data of fieldtwin for a shipped file. Raises `UsageError` for too many places.
        """
        if self._recording is None:
            return CompactCoverage()
        found = Coverage()
        found.add(self._recording.coverage())
        root = data_root()
        names = {path: _name(Path(path), root) for path in found.paths}
        return compact({replace(place, path=names[place.path]): done for place, done in found.executed.items()})


def _name(path: Path, root: Path) -> str:
    return str(path.relative_to(root)) if path.is_relative_to(root) else str(path)
