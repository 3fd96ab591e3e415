"""The file kind `network`, for files that begin with `network:` (an implementation of the protocol
`fieldtwin.run.virtual.group_kinds.GroupKind`).

Every other part of fieldtwin reaches the acoustic network through this module (`fieldtwin.twin.site.groups`).
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, cast

from fieldtwin.acoustic.network import Network, load_network
from fieldtwin.acoustic.schema import NetworkForm
from fieldtwin.acoustic.ship import scripted_commands
from fieldtwin.acoustic.summary import summarise_network
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.results.model import ScenarioResult
from fieldtwin.results.trace import Trace
from fieldtwin.run.processes.topside import Scripted
from fieldtwin.run.virtual.group_kinds import Drawing, LiveRequest, VirtualSystems
from fieldtwin.run.virtual.system_check import SystemCheck
from fieldtwin.scenarios.language.form import Scenario
from fieldtwin.scenarios.language.probe_form import ScenarioProbe
from fieldtwin.twin.prototype.group import SystemGroup


def load(path: Path, profiles: Iterable[Path]) -> Network:
    return load_network(path, profiles)


def schema() -> dict[str, Any]:
    return NetworkForm.model_json_schema()


def drawing(group: SystemGroup) -> Drawing:
    from fieldtwin.acoustic.map import network_map, svg, text

    drawn = network_map(_network(group))
    return Drawing(drawn.as_data(), text(drawn), lambda: svg(drawn))


def introduce(group: SystemGroup) -> None:
    from fieldtwin.acoustic.view import introduce

    introduce(_network(group))


def scripted(group: SystemGroup, commands: tuple[int, ...] | None, duration_s: float) -> list[Scripted]:
    return scripted_commands(_network(group), commands, duration_s)


@asynccontextmanager
async def virtual(
    group: SystemGroup,
    loop: VirtualLoop,
    folder: Path,
    trace: Trace,
    seed: int,
    commands: Sequence[Scripted] | None,
    probes: Sequence[ScenarioProbe] = (),
) -> AsyncIterator[VirtualSystems]:
    from fieldtwin.acoustic.virtual import VirtualNetwork

    assert not probes  # the scenario language refuses these keys for a group of systems
    async with VirtualNetwork(_network(group), loop, folder, trace, seed=seed, commands=commands or ()) as running:
        yield running


def summary(
    group: SystemGroup,
    systems: Mapping[str, SystemCheck],
    shared: dict[str, Any],
    errors: Sequence[str],
    elapsed_s: float,
) -> dict[str, Any]:
    each = {name: check.summary() for name, check in systems.items()}
    return summarise_network(group.name, each, shared, errors, elapsed_s)


def print_summary(summary: dict[str, Any]) -> None:
    from fieldtwin.acoustic.view import print_network_summary

    print_network_summary(summary)


async def run_scenario(scenario: Scenario, seed: int | None, trace: Trace) -> ScenarioResult:
    from fieldtwin.acoustic.local_target import run_network

    return await run_network(scenario, seed, trace)


def run_live(request: LiveRequest, *, as_json: bool) -> int:
    from fieldtwin.acoustic.view import run_live

    return run_live(_network(request.group), request, as_json=as_json)


def _network(group: SystemGroup) -> Network:
    return cast(Network, group)
