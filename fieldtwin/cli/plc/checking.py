"""Compiles programs in Structured Text, and collects their errors, warnings and findings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fieldtwin.cli.plc.sources import StSources, st_tasks
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

    def add(self, warnings: list[StWarning], waivers: list[Waiver], as_errors: frozenset[str]) -> None:
        """Add warnings of files whose waivers are `waivers`. Those in `as_errors` (ids) are errors."""
        from fieldtwin.plc.st.findings.waivers import without_waived

        left, waived = without_waived(warnings, waivers)
        left.sort(key=lambda one: (one.path, one.line, one.column, one.id))
        self.waived.extend(waived)
        self.errors.extend(warning.as_error() for warning in left if warning.id in as_errors)
        self.warnings.extend(warning for warning in left if warning.id not in as_errors)

    def as_data(self) -> dict[str, object]:
        """Return data for JSON."""
        return {
            "kind": "fieldtwin plc check",
            "version": 1,
            "files": sorted({file for unit in self.units for file in unit.files}),
            "not_imported": [
                {"kind": m.kind, "name": m.name, "reason": m.reason, "path": m.pos.path, "line": m.pos.line}
                for m in self.missing()
            ],
            "errors": [error.as_data() for error in self.errors],
            "warnings": [warning.as_data() for warning in self.warnings],
            "waived": [{**warning.as_data(), "reason": waiver.reason} for warning, waiver in self.waived],
        }


def checked(
    programs: Mapping[StSources, Mapping[str, str]], as_errors: frozenset[str], systems: Iterable[System] = ()
) -> Checked:
    """Check each source, with the tasks of its programs (`st_tasks`), and the bindings of the programs of `systems`.

    The warnings `as_errors` (ids) become errors.
    """
    from fieldtwin.cli.plc.bindings import findings_about_bindings
    from fieldtwin.plc.st.findings.find import findings
    from fieldtwin.plc.st.findings.tasks import written_by_several_tasks
    from fieldtwin.plc.st.findings.waivers import waivers_in_yaml, waivers_of
    from fieldtwin.plc.st.project import compile_source

    found = Checked([], [], [], [])
    for (path, dialect, libraries), tasks in programs.items():
        try:
            unit = compile_source(path, dialect, libraries)
        except FileInvalid as e:
            found.errors.extend((e, *e.others))
            continue
        found.units.append(unit)
        paths = path if isinstance(path, tuple) else (path,)
        own = {str(file) for each in paths for file in source_files(each)}
        about = [
            one for one in (*findings(unit.source), *written_by_several_tasks(unit.source, tasks)) if one.path in own
        ]
        waivers = [waiver for file in sorted(own) for waiver in waivers_of(file)]
        found.add([*unit.warnings, *about], waivers, as_errors)
    for system in systems:
        found.add(list(findings_about_bindings(system)), waivers_in_yaml(system.file.path), as_errors)
    return found


def checked_systems(systems: Iterable[System], as_errors: frozenset[str]) -> Checked:
    """Check the programs of systems and their bindings, each source and each system file once."""
    by_file = {system.file.path: system for system in systems}
    programs: dict[StSources, dict[str, str]] = {}
    for system in by_file.values():
        for source, tasks in st_tasks(system).items():
            programs.setdefault(source, {}).update(tasks)
    return checked(programs, as_errors, by_file.values())
