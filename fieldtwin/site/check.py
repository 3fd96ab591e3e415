"""Checks all files of a site and every reference between them, without a connection and without a run.

Only the constructors of the site's own Python code are called: programs and simulations.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fieldtwin.conformance.clients.canopen.cases import CASES as CANOPEN_MASTER_CASES
from fieldtwin.conformance.clients.modbus.cases import CASES as MODBUS_CLIENT_CASES
from fieldtwin.conformance.core.case import About
from fieldtwin.conformance.core.waivers import load_waivers
from fieldtwin.conformance.devices.canopen.cases import CASES as CANOPEN_DEVICE_CASES
from fieldtwin.conformance.devices.modbus.cases import CASES as MODBUS_DEVICE_CASES
from fieldtwin.emulators.faults.schema import FaultSpec, load_faults
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.yaml_file import load
from fieldtwin.gateway.devices.data_sheet import check_data_sheet
from fieldtwin.run.shadow.rules import load_planner
from fieldtwin.scenarios.judging.waiving import ids_of
from fieldtwin.scenarios.language.form import load_scenario
from fieldtwin.scenarios.language.names import invariants_of
from fieldtwin.site.compose.check import CommandLines, ComposeCheck
from fieldtwin.site.compose.service import is_compose
from fieldtwin.twin.plant.physical import alarms_of, image_layout, program_warnings
from fieldtwin.twin.prototype.fault_aims import target
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.group import read_group
from fieldtwin.twin.prototype.simulations import Simulations
from fieldtwin.twin.site.groups import GROUP_KINDS, kind_of
from fieldtwin.twin.site.system import System, load_system

MAX_FILES = 10_000
"""The most YAML files that one check reads."""
_KINDS = ("scenario", "prototype_of", "waivers", "rules", "faults", "system", "device")
_SKIPPED_FOLDERS = ("node_modules", "venv", "__pycache__")


@dataclass
class SiteCheck:
    """The result: the checked files with their kinds, relative to `folder`, and the errors and warnings found."""

    folder: Path
    files: dict[str, str] = field(default_factory=dict)
    errors: list[FileInvalid] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def check_site(folder: Path, profiles: tuple[Path, ...] = (), command_lines: CommandLines | None = None) -> SiteCheck:
    """Check every file of a site. `profiles` are folders searched for profiles before the usual ones.

    Of compose files, the services that run fieldtwin are checked; `command_lines` checks their command lines. YAML files of
    other programs are left out. Raises `UsageError` if the folder holds no file of fieldtwin.
    """
    found = SiteCheck(folder)
    collector = ErrorCollector()
    by_kind: dict[str, list[Path]] = {}
    for path in _yaml_files(folder):
        with collector.collect():
            file = load(path)
            kind = _kind(path, file.data) or ("compose" if is_compose(file.data) else "")
            if kind:
                by_kind.setdefault(kind, []).append(path)
                found.files[str(path.relative_to(folder))] = kind
    if not by_kind.keys() - {"compose"} and not collector.errors:
        raise UsageError(
            "no file of fieldtwin in this folder",
            where=str(folder),
            expected="a system file, and its prototype and scenarios",
            hint="`fieldtwin new DIR` writes a site",
        )
    site = _Site(by_kind, profiles, collector, found)
    site.check()
    if command_lines is not None:
        site.check_compose(command_lines)
    found.errors = sorted(collector.errors, key=lambda e: (e.path, e.line, e.column))
    return found


def _yaml_files(folder: Path) -> Iterator[Path]:
    """Return the YAML files in a folder and its folders, except hidden ones and those of installed packages."""
    count = 0
    for where, folders, names in os.walk(folder):
        folders[:] = sorted(f for f in folders if not f.startswith(".") and f not in _SKIPPED_FOLDERS)
        for name in sorted(names):
            if name.endswith((".yaml", ".yml")) and not name.startswith("."):
                count += 1
                if count > MAX_FILES:
                    raise UsageError("too many YAML files", where=str(folder), expected=f"at most {MAX_FILES}")
                yield Path(where) / name


def _kind(path: Path, data: Mapping[str, Any]) -> str:
    """Return the kind of a file by its keys, or by its name where a key is missing; empty for a file of another program."""
    if kind := kind_of(data):
        return kind
    for kind in _KINDS:
        if kind in data:
            return kind.removesuffix("_of")
    named = next((kind for kind in ("scenario", "prototype") if f".{kind}." in path.name), "")
    return named or ("system" if "fieldtwin" in data and "devices" in data else "")


class _Site:
    """One check of a site. Each step adds its errors to `errors`, and continues with the parts that have no errors."""

    def __init__(
        self, by_kind: Mapping[str, list[Path]], profiles: tuple[Path, ...], errors: ErrorCollector, found: SiteCheck
    ) -> None:
        self._by_kind = by_kind
        self._profiles = profiles
        self._errors = errors
        self._found = found
        self._systems: dict[Path, System] = {}

    def check(self) -> None:
        for path in self._of("device"):
            with self._errors.collect():
                check_data_sheet(load_profile(path))
        for path in self._of("system"):
            self._check_system(path)
        for path in self._of("prototype"):
            with self._errors.collect():
                self._check_prototype(path)
        for kind in GROUP_KINDS:
            for path in self._of(kind):
                with self._errors_of(path):
                    read_group(kind, path, self._profiles)
        ids = _case_ids()
        for path in self._of("scenario"):
            with self._errors_of(path):
                scenario = load_scenario(path, self._profiles, self._errors)
                ids += ids_of(path, scenario.form.scenario)
        for path in self._of("waivers"):
            with self._errors_of(path):
                load_waivers(path, ids)
        only = next(iter(self._systems.values())) if len(self._systems) == 1 else None
        for path in self._of("faults"):
            with self._errors_of(path):
                load_faults(path, _aims_in(only))
        for path in self._of("rules"):
            with self._errors_of(path):
                if only is not None:
                    load_planner(str(path), only)

    def check_compose(self, command_lines: CommandLines) -> None:
        """Check the compose files, after the systems that their services name."""
        for path in self._of("compose"):
            with self._errors.collect():
                check = ComposeCheck(
                    load(path, merges=True), self._profiles, self._systems, self._of("system"), command_lines
                )
                for error in check.errors():
                    self._errors.add(error)

    def _of(self, kind: str) -> list[Path]:
        return self._by_kind.get(kind, [])

    @contextmanager
    def _errors_of(self, path: Path) -> Iterator[None]:
        """Collect the errors of the block. A `UsageError` without a place becomes an error of the file."""
        with self._errors.collect():
            try:
                yield
            except UsageError as e:
                raise FileInvalid(e.message, path=str(path), expected=e.expected, got=e.got, hint=e.hint) from e

    def _check_system(self, path: Path) -> None:
        with self._errors_of(path):
            before = len(self._errors.errors)
            system = load_system(str(path), self._profiles, self._errors)
            self._systems[path] = system
            invariants_of(system, errors=self._errors)
            alarms_of(system, self._errors)
            complete = system.devices.keys() == system.file.section("devices").keys()  # else a device has an error
            if complete and len(self._errors.errors) == before:
                self._found.warnings += system.warnings
                image_layout(system)
                self._found.warnings += program_warnings(system)

    def _check_prototype(self, path: Path) -> None:
        file = load(path)
        named = path.parent / Path(str(file.data.get("prototype_of", ""))).name
        system = self._systems.get(named)
        if system is None:
            if named in self._of("system"):
                return  # the system file could not be read at all, which is an error already
            names = [one.name for one in self._of("system") if one.parent == path.parent]
            raise file.error(
                ("prototype_of",),
                f"no system file {named.name!r} in this folder",
                expected=", ".join(names) or "the name of a system file",
                hint=did_you_mean(named.name, names),
            )
        before = len(self._errors.errors)
        prototype = load_prototype(system, path, self._errors)
        if len(self._errors.errors) == before:
            simulations = Simulations(
                prototype.file, prototype.form, system, 0, lambda name, error: None
            )  # takes no step
            for device in prototype.devices.values():
                if device.form.simulation is not None:
                    simulations.signals_of(device.name, device.form, device.profile)


def _aims_in(system: System | None) -> Callable[[FaultSpec], object] | None:
    """Return a function that checks whether a fault's target exists in `system`.

    Return None without a system: targets cannot be checked then, because a fault file does not name its system.
    """
    return None if system is None else lambda spec: target(system, spec)


def _case_ids() -> list[str]:
    """Return the IDs that waivers may name: those of all conformance cases, with and without their final letters."""
    cases: list[About] = [*MODBUS_DEVICE_CASES, *CANOPEN_DEVICE_CASES]
    cases += [case.about for case in MODBUS_CLIENT_CASES]
    cases += [case.about for case in CANOPEN_MASTER_CASES]
    return [name for case in cases for name in (case.id, case.row)]
