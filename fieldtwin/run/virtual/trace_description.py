"""Describe the trace of a virtual run, so that it can be shown without the run and without its programs."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import msgspec

from fieldtwin.gateway.runtime.gateway import stale_limits
from fieldtwin.plc.runtime.about import describe_programs
from fieldtwin.results.model import CheckResult
from fieldtwin.results.trace_about import VERSION, CheckAbout, ProgramAbout, TraceAbout, write_about
from fieldtwin.run.virtual.group_kinds import VirtualSystems
from fieldtwin.twin.prototype.group import SystemGroup


def begin_description(
    trace: Path,
    group: SystemGroup,
    running: VirtualSystems,
    *,
    seed: int,
    profiles: Iterable[Path] = (),
    title: str = "",
) -> TraceAbout | None:
    """Write the description of a run that begins, and return it. None for several systems, whose tags have other names.

    Raises `FileInvalid`.
    """
    if group.kind:
        return None
    [bench] = running.systems.values()
    system = bench.system
    about = TraceAbout(
        version=VERSION,
        run=os.urandom(8).hex(),
        system=system.name,
        system_path=str(system.path.absolute()),
        system_hash=system.hash,
        profiles=[str(folder.absolute()) for folder in profiles],
        title=title,
        target=bench.target,
        seed=seed,
        programs=msgspec.convert(
            describe_programs(bench.run.plc.programs, bench.run.plc.sources), dict[str, ProgramAbout]
        ),
        stale_after_ms={
            tag: limit for driver in bench.run.gateway.drivers.values() for tag, limit in stale_limits(driver).items()
        },
    )
    write_about(trace, about)
    return about


def described_checks(checks: Iterable[CheckResult]) -> list[CheckAbout]:
    """Return the results of checks in the form in which a description contains them."""
    return [
        CheckAbout(
            number=c.number, text=c.text, verdict=c.verdict.value, t_ns=c.t_ns, since_ns=c.since_ns, expected=c.expected,
            got=c.got, reason=c.reason, where=c.where, names=list(c.names),
        )
        for c in checks
    ]  # fmt: skip
