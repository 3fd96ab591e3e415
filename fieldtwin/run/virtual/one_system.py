"""A system alone in virtual time: the implementation of `fieldtwin.run.virtual.group_kinds.VirtualKind` for a group of one
system.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.results.trace import Trace
from fieldtwin.run.benches.virtual_bench import VirtualBench
from fieldtwin.run.processes.topside import DEFAULT_SCRIPT, Scripted, TopsideController, script
from fieldtwin.run.virtual.system_check import SystemCheck
from fieldtwin.scenarios.language.probe_form import ScenarioProbe
from fieldtwin.twin.prototype.group import SystemGroup


class OneRunning:
    """A single running system, as a group whose only member has an empty name."""

    def __init__(self, bench: VirtualBench) -> None:
        self.bench = bench

    @property
    def systems(self) -> Mapping[str, VirtualBench]:
        return {"": self.bench}

    @property
    def topside(self) -> TopsideController | None:
        return self.bench.topside

    def results(self) -> dict[str, Any]:
        return {}


@asynccontextmanager
async def virtual(
    group: SystemGroup,
    loop: VirtualLoop,
    folder: Path,
    trace: Trace,
    seed: int,
    commands: Sequence[Scripted] | None,
    probes: Sequence[ScenarioProbe] = (),
) -> AsyncIterator[OneRunning]:
    """Run the only system of `group`."""
    [member] = group.members.values()
    async with VirtualBench(
        member.system, member.prototype, loop, folder, trace,
        seed=seed, commands=list(commands or ()), has_topside=commands is None or bool(commands), probes=probes,
    ) as bench:  # fmt: skip
        yield OneRunning(bench)


def scripted(group: SystemGroup, commands: tuple[int, ...] | None, duration_s: float) -> list[Scripted]:
    """Return the remote client's commands; none if the prototype has no link for them."""
    [member] = group.members.values()
    commands = DEFAULT_SCRIPT if commands is None else commands
    if not commands or all(device.form.far is None for device in member.prototype.devices.values()):
        return []
    return script(commands, duration_s)


def summary(
    group: SystemGroup,
    systems: Mapping[str, SystemCheck],
    shared: dict[str, Any],
    errors: Sequence[str],
    elapsed_s: float,
) -> dict[str, Any]:
    """Return the summary of the system."""
    [check] = systems.values()
    return check.summary(errors)
