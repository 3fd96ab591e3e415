"""Describe the trace of a virtual run, so that it can be shown without the run and without its programs."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import msgspec

from fieldtwin.gateway.runtime.gateway import stale_limits
from fieldtwin.plc.runtime.about import describe_programs
from fieldtwin.plc.runtime.variable_trace import TracedVariable
from fieldtwin.results.model import CheckResult
from fieldtwin.results.trace_about import VERSION, CheckAbout, ProgramAbout, TraceAbout, VariableAbout, write_about
from fieldtwin.run.benches.virtual_bench import VirtualBench
from fieldtwin.run.virtual.group_kinds import VirtualSystems
from fieldtwin.twin.prototype.group import SystemGroup
from fieldtwin.twin.site.system import System


def begin_description(
    trace: Path,
    group: SystemGroup,
    running: VirtualSystems,
    *,
    seed: int,
    profiles: Iterable[Path] = (),
    title: str = "",
    recorded: Iterable[TracedVariable] = (),
) -> TraceAbout:
    """Write the description of a run that begins, and return it. Several systems are described as one, under the group's names.
    `recorded` are variables that are in the trace and are not tags.

    Raises `FileInvalid`.
    """
    system = group.whole
    systems = {group.members[name].prefix: bench for name, bench in running.systems.items()}
    target = next(iter(systems.values())).target
    bare = begin_bare_description(trace, system, target=target, seed=seed, profiles=profiles, title=title)
    about = msgspec.structs.replace(
        bare,
        programs={
            f"{prefix}{name}": _under(prefix, program)
            for prefix, bench in systems.items()
            for name, program in _programs(bench).items()
        },
        stale_after_ms={
            f"{prefix}{tag}": limit
            for prefix, bench in systems.items()
            for driver in bench.run.gateway.drivers.values()
            for tag, limit in stale_limits(driver).items()
        },
    )
    for one in recorded:
        program, _, path = one.name.partition(".")
        variable = VariableAbout(tag=one.name, role="internal", kind=one.type, unit=one.unit, type=one.type)
        about.programs[program].variables[path] = variable
    write_about(trace, about)
    return about


def begin_bare_description(
    trace: Path, system: System, *, target: str, seed: int | None, profiles: Iterable[Path], title: str
) -> TraceAbout:
    """Write the description of a run whose gateway and PLC are other processes: without programs and age limits.

    Raises `FileInvalid`.
    """
    about = TraceAbout(
        version=VERSION,
        run=os.urandom(8).hex(),
        system=system.name,
        system_path=str(system.path.absolute()),
        system_hash=system.hash,
        profiles=[str(folder.absolute()) for folder in profiles],
        title=title,
        target=target,
        seed=seed,
    )
    write_about(trace, about)
    return about


def _programs(bench: VirtualBench) -> dict[str, ProgramAbout]:
    return msgspec.convert(describe_programs(bench.run.plc.programs, bench.run.plc.sources), dict[str, ProgramAbout])


def _under(prefix: str, program: ProgramAbout) -> ProgramAbout:
    """Return the description of a program whose tags have a prefix."""
    variables = {
        name: msgspec.structs.replace(variable, tag=f"{prefix}{variable.tag}") if variable.tag else variable
        for name, variable in program.variables.items()
    }
    return msgspec.structs.replace(program, variables=variables)


def described_checks(checks: Iterable[CheckResult]) -> list[CheckAbout]:
    """Return the results of checks in the form in which a description contains them."""
    return [
        CheckAbout(
            number=c.number, text=c.text, verdict=c.verdict.value, t_ns=c.t_ns, since_ns=c.since_ns, expected=c.expected,
            got=c.got, reason=c.reason, where=c.where, names=list(c.names),
        )
        for c in checks
    ]  # fmt: skip
