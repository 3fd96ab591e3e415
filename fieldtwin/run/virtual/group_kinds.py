"""The interface of a kind of file that describes several systems, for runs, scenarios and commands.

The kinds are registered in `fieldtwin.twin.site.groups`. A system alone runs in virtual time by the same
interface (`virtual_kind`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.results.model import ScenarioResult
from fieldtwin.results.trace import Trace
from fieldtwin.run.benches.virtual_bench import VirtualBench
from fieldtwin.run.processes.topside import Scripted, TopsideController
from fieldtwin.run.virtual import one_system
from fieldtwin.run.virtual.system_check import SystemCheck
from fieldtwin.scenarios.bench import Bench
from fieldtwin.scenarios.language.form import Scenario
from fieldtwin.scenarios.language.probe_form import ScenarioProbe
from fieldtwin.twin.prototype.group import SystemGroup
from fieldtwin.twin.site.groups import group_module


class VirtualSystems(Protocol):
    """Running systems in virtual time: the bench of a scenario for all of them, and the bench of each."""

    @property
    def bench(self) -> Bench: ...

    @property
    def systems(self) -> Mapping[str, VirtualBench]: ...

    @property
    def topside(self) -> TopsideController | None:
        """Return the topside controller that the systems share; None if they share none."""

    def results(self) -> dict[str, Any]:
        """Return the part of the summary that is about the resources that the systems share."""


@dataclass(frozen=True)
class Drawing:
    """A drawing of the group: as JSON data, as text, and as a function that returns SVG."""

    data: dict[str, Any]
    text: str
    svg: Callable[[], str]


@dataclass(frozen=True)
class LiveRequest:
    """A run of a group on this host. `duration_s` 0: until stopped; `commands` None: the usual commands of the kind."""

    group: SystemGroup
    duration_s: float = 0.0
    instance: str = ""
    profiles: tuple[Path, ...] = ()
    commands: tuple[int, ...] | None = None
    faults: tuple[dict[str, Any], ...] = ()
    thread: str = ""
    cold: bool = False


class VirtualKind(Protocol):
    """The functions with which a group runs in virtual time."""

    def scripted(self, group: SystemGroup, commands: tuple[int, ...] | None, duration_s: float) -> list[Scripted]:
        """Return the commands of a run. None stands for the usual commands of such a group."""

    def virtual(
        self,
        group: SystemGroup,
        loop: VirtualLoop,
        folder: Path,
        trace: Trace,
        seed: int,
        commands: Sequence[Scripted] | None,
        probes: Sequence[ScenarioProbe] = (),
    ) -> AbstractAsyncContextManager[VirtualSystems]:
        """Return the running systems, which write their files into `folder`. `commands` is None in a scenario, which sends its
        own commands.
        """

    def summary(
        self,
        group: SystemGroup,
        systems: Mapping[str, SystemCheck],
        shared: dict[str, Any],
        errors: Sequence[str],
        elapsed_s: float,
    ) -> dict[str, Any]:
        """Return the summary of a run from the checks of its systems and what `VirtualSystems.results` returned."""


class GroupKind(VirtualKind, Protocol):
    """The functions of a kind's module."""

    def load(self, path: Path, profiles: Iterable[Path]) -> SystemGroup:
        """Read a file of this kind. Raises `FileInvalid`."""

    def schema(self) -> dict[str, Any]:
        """Return the JSON schema of such a file."""

    def drawing(self, group: SystemGroup) -> Drawing: ...

    def introduce(self, group: SystemGroup) -> None:
        """Print the systems and their shared resources on stderr, at the start of a run."""

    def print_summary(self, summary: dict[str, Any]) -> None:
        """Print a summary on stdout, with the verdict."""

    async def run_scenario(self, scenario: Scenario, seed: int | None, trace: Trace) -> ScenarioResult:
        """Run a scenario on the target `local`, with processes on this host."""

    def run_live(self, request: LiveRequest, *, as_json: bool) -> int:
        """Run the systems as processes on this host, show them, print the summary, and return the exit status."""


def kind_named(kind: str) -> GroupKind:
    """Return the registered kind of this name."""
    return cast(GroupKind, group_module(kind))


def virtual_kind(group: SystemGroup) -> VirtualKind:
    """Return the functions with which `group` runs in virtual time."""
    return kind_named(group.kind) if group.kind else one_system
