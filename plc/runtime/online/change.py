"""Replaces programs in Structured Text while the PLC runs: between two scans, with the values of their variables.

`prepare` compares new versions with the programs that run, and creates their instances. `OnlineChange.commit` then replaces all
of them in one step, or raises an error and changes nothing. The process image, forces and start conditions stay as they are. The
file of retained variables is replaced in the same step if they differ.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.plc.binding import BoundProgram
from fieldtwin.plc.runtime.interface import fitted
from fieldtwin.plc.runtime.online.compiling import Version
from fieldtwin.plc.runtime.retain import layout_hash
from fieldtwin.plc.runtime.runner import TaskRunner
from fieldtwin.plc.runtime.sources import ProgramSource
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.online.carry import Carrying, Differences, Move
from fieldtwin.plc.st.program import StProgram
from fieldtwin.plc.st.resource import Together


class ChangeRefused(FieldtwinError):
    """The running programs cannot be replaced now; nothing was changed."""

    exit_code = 1


@dataclass(frozen=True, slots=True)
class ProgramChange:
    """The effects of a change on one program. `path` is the first file that differs; `refused` has the reasons against it."""

    program: str
    path: str
    differences: Differences
    refused: list[str]

    def __str__(self) -> str:
        named = [("new", self.differences.new), ("removed", self.differences.removed)]
        named.append(("with their initial values, because their declaration changed", self.differences.changed))
        kept = self.differences.kept
        parts = [f"{kept} variable{' keeps its value' if kept == 1 else 's keep their values'}"]
        parts += [f"{what}: {', '.join(names)}" for what, names in named if names]
        return "; ".join(self.refused or parts)


@dataclass(frozen=True, slots=True)
class _Replacement:
    """A program that runs, its present class and files, and the new instance, whose values `move` takes over."""

    bound: BoundProgram
    running: Version
    new: StProgram
    new_sources: tuple[ProgramSource, ...]
    move: Move


@dataclass(slots=True)
class OnlineChange:
    """A prepared change with its effects on each program. If `refused`, it cannot be carried out."""

    runner: TaskRunner
    changes: list[ProgramChange] = field(default_factory=list)
    _programs: list[BoundProgram] = field(default_factory=list)
    _replacements: list[_Replacement] = field(default_factory=list)
    _globals: list[tuple[StProgram, StProgram, Move]] = field(default_factory=list)
    """For each resource that is replaced, one of its programs: as it runs, and as it will."""
    _retention: bool = False
    """Whether the retained variables differ."""

    @property
    def refused(self) -> bool:
        return any(change.refused for change in self.changes)

    @property
    def before(self) -> dict[str, Version]:
        """Return the versions that the change replaces, by program."""
        return {r.bound.name: r.running for r in self._replacements}

    def commit(self) -> None:
        """Replace the programs. Call it between two scans, in the thread that executes them.

        Raises `ChangeRefused`, `StepRemoved` for an active step that the new version does not have, or `Unreachable` if the file
        of retained variables cannot be created; nothing is changed then.
        """
        self._check()
        for running, new, move in self._globals:
            move(running.st_resource.globals, new.st_resource.globals)
        for r in self._replacements:
            r.move(r.bound.program.st_body, r.new.st_body)  # type: ignore[attr-defined]
        if self._retention:
            later = {r.bound.name: BoundProgram(r.bound.name, r.new) for r in self._replacements}
            programs = self.runner.programs
            self.runner.retained.prepared(programs, [later.get(p.name, p) for p in programs])()
        for r in self._replacements:
            r.bound.program.st_become(r.new)  # type: ignore[attr-defined]
        self.runner.programs_changed([source for r in self._replacements for source in r.new_sources])

    def _check(self) -> None:
        if self.refused:
            raise ChangeRefused("; ".join(f"program {c.program}: {c}" for c in self.changes if c.refused))
        if self.runner.halted:
            raise ChangeRefused(
                "the PLC has stopped", hint="`fieldtwin plc restart` starts it with the present programs"
            )
        running = [r for r in self._replacements if type(r.bound.program) is r.running.made]
        if self.runner.programs is not self._programs or len(running) < len(self._replacements):
            raise ChangeRefused("the programs were replaced in the meantime", hint="repeat the command")
        for r in self._replacements:
            tags = {tag: v.name for v, tag in r.bound.published()}
            for tag in self.runner.forces.outputs:
                if tag in tags and tags[tag] not in r.new.st_variables:
                    raise ChangeRefused(f"{tag} is forced, and would not exist any more", hint="remove the force first")


def prepare(runner: TaskRunner, versions: Mapping[str, Version]) -> OnlineChange:
    """Prepare the replacement of programs, by name, with other versions. The programs continue to run.

    Programs of one file share global variables, so the versions of all of them have to be given together.
    """
    found = OnlineChange(runner, _programs=runner.programs)
    readers = runner.readers()
    together: Together = {}
    carrying: dict[tuple[int, int], Carrying] = {}
    """By the two units of a resource: the values that the new one takes over."""
    owners: dict[str, Carrying] = {}
    for bound in runner.programs:
        version, running = versions.get(bound.name), bound.program
        if version is None or not isinstance(running, StProgram):
            continue
        made, reasons = fitted(version.made, bound, readers)
        new = made(together)
        new.bound_as(bound.name)
        units = running.st_unit, new.st_unit
        key = id(units[0]), id(units[1])
        if key not in carrying:
            carrying[key] = owners[bound.name] = Carrying(*units)
            found._globals.append((running, new, carrying[key].globals))
        move, own = carrying[key].program(running.st_declared, new.st_declared)
        if _tasks(units[0]) != _tasks(units[1]):
            reasons.append(
                "the tasks of its CONFIGURATION change, which the PLC takes at its start: keep them, or restart the run"
            )
        found._retention |= layout_hash([bound]) != layout_hash([BoundProgram(bound.name, new)])
        sources = tuple(source for source in runner.sources if source.program == bound.name)
        found.changes.append(ProgramChange(bound.name, _first_changed(sources, version), own, reasons))
        found._replacements.append(_Replacement(bound, Version(type(running), sources), new, version.sources, move))
    for change in found.changes:
        if change.program in owners:  # the first program of a resource also reports what the programs share
            change.differences.add(owners[change.program].shared)
        if names := change.differences.references:
            many = len(names) > 1
            change.refused.append(
                f"{', '.join(names)}: {'references refer to variables' if many else 'a reference refers to a variable'} of the "
                "version that runs and cannot be taken over: restart the programs with `fieldtwin plc restart`"
            )
    return found


def _tasks(unit: CompiledUnit) -> dict[str, tuple[int, int, str] | None]:
    """Return interval (ns), priority and trigger of the tasks of the programs that a CONFIGURATION runs."""
    return {
        one.name.lower(): (one.task.interval_ns, one.task.priority, one.task.single) if one.task is not None else None
        for one in unit.instances
    }


def _first_changed(sources: tuple[ProgramSource, ...], version: Version) -> str:
    before = {source.path: source.digest for source in sources}
    after = {source.path: source.digest for source in version.sources}
    changed = (path for path in (*after, *before) if before.get(path) != after.get(path))
    return next(changed, next(iter(after), ""))
