"""Collect the coverage of the programs that a run loads, such as those of a scenario in virtual time.

While a `Recording` is active in a context (`active`), `fieldtwin.plc.st.program.load_source` compiles programs with probes. The
probes do not count as steps of a scan and change no variable, so the run has the same trace as without them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from fieldtwin.plc.st.compiler.compile import CompiledUnit, compile_unit
from fieldtwin.plc.st.coverage.places import Place
from fieldtwin.plc.st.coverage.probes import Probes
from fieldtwin.plc.st.dialects import Dialect
from fieldtwin.plc.st.project import Texts, read_with, source_texts


class Recording:
    """The programs that were compiled with probes, and the probes that were executed. Each source is compiled once."""

    def __init__(self) -> None:
        self._units: dict[tuple[Path, Dialect, tuple[Path, ...]], tuple[CompiledUnit, Probes, set[Any]]] = {}

    @contextmanager
    def active(self) -> Iterator[None]:
        """Compile the programs that this context loads with probes, until the block ends."""
        token = _active.set(self)
        try:
            yield
        finally:
            _active.reset(token)

    def compiled(self, path: Path, dialect: Dialect, libraries: tuple[Path, ...]) -> CompiledUnit:
        """Return a program with probes in its own files, but not in those of its libraries. Raises `FileInvalid`."""
        key = path, dialect, libraries
        if key not in self._units:
            recorded: set[Any] = set()
            compiled, probes = _compiled(source_texts((path,)), source_texts(libraries), path, dialect, libraries)
            self._units[key] = replace(compiled, record=recorded.add), probes, recorded
        return self._units[key][0]

    def coverage(self) -> Mapping[Place, bool]:
        """Return each place of the programs, and whether it was executed."""
        found: dict[Place, bool] = {}
        for unit, probes, recorded in self._units.values():
            for place, executed in probes.result(recorded, unit.probed).items():
                found[place] = executed or found.get(place, False)
        return found


@lru_cache(maxsize=32)
def _compiled(
    texts: Texts, library_texts: Texts, path: Path, dialect: Dialect, libraries: tuple[Path, ...]
) -> tuple[CompiledUnit, Probes]:
    """Return a program with its probes, from a cache, because the runs of a campaign load the same programs. The texts are those
    of the files, so that a changed file is compiled again.
    """
    probes = Probes()
    unit, _ = read_with(path, (), libraries, dialect, lambda read: read)
    left_out = {file for file, _ in library_texts}
    used = {declared.pos.path for declared in (*unit.types, *unit.globals, *unit.pous)}
    files = (*(file for file, _ in texts), *sorted(used & left_out))
    compiled = compile_unit(probes.insert(unit, left_out), str(path), tuple(dict.fromkeys(files)), dialect)
    return replace(compiled, source=unit), probes


_active: ContextVar[Recording | None] = ContextVar("_active", default=None)


def active_recording() -> Recording | None:
    """Return the recording that is active in this context."""
    return _active.get()
