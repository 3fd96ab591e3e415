"""Compiles programs in Structured Text, and collects their errors, warnings and findings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fieldtwin.cli.plc.sources import StSource, st_tasks
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.source_files import source_files
from fieldtwin.plc.st.dialects import StWarning

if TYPE_CHECKING:
    from fieldtwin.plc.st.compiler.compile import CompiledUnit
    from fieldtwin.plc.st.findings.waivers import Waiver
    from fieldtwin.plc.st.syntax.tree import Missing
    from fieldtwin.twin.site.system import System


@dataclass(frozen=True)
class Checked:
    """The compiled units, the errors in those that cannot be compiled, and warnings, also those that count as errors."""

    units: list[CompiledUnit]
    errors: list[FileInvalid]
    warnings: list[StWarning]
    waived: list[tuple[StWarning, Waiver]]

    def missing(self) -> list[Missing]:
        """Return the declarations that were not imported and that no program uses."""
        return [each for unit in self.units for each in unit.missing]


def checked(programs: Mapping[StSource, Mapping[str, str]], as_errors: frozenset[str]) -> Checked:
    """Check each source, with the tasks of its programs (`st_tasks`). The warnings `as_errors` (ids) become errors."""
    from fieldtwin.plc.st.findings.find import findings
    from fieldtwin.plc.st.findings.tasks import written_by_several_tasks
    from fieldtwin.plc.st.findings.waivers import waivers_of, without_waived
    from fieldtwin.plc.st.project import compile_source

    found = Checked([], [], [], [])
    for (path, dialect, libraries), tasks in programs.items():
        try:
            unit = compile_source(path, dialect, libraries)
        except FileInvalid as e:
            found.errors.extend((e, *e.others))
            continue
        found.units.append(unit)
        own = {str(file) for file in source_files(path)}
        about = [
            one for one in (*findings(unit.source), *written_by_several_tasks(unit.source, tasks)) if one.path in own
        ]
        waivers = [waiver for file in sorted(own) for waiver in waivers_of(file)]
        warnings, waived = without_waived((*unit.warnings, *about), waivers)
        warnings.sort(key=lambda one: (one.path, one.line, one.column, one.id))
        found.waived.extend(waived)
        found.errors.extend(warning.as_error() for warning in warnings if warning.id in as_errors)
        found.warnings.extend(warning for warning in warnings if warning.id not in as_errors)
    return found


def warnings_of(systems: Iterable[System]) -> list[str]:
    """Return the warnings and findings about the programs of systems, each once, without their errors."""
    found = [warning for system in systems for warning in checked(st_tasks(system), frozenset()).warnings]
    return list(dict.fromkeys(map(str, found)))
