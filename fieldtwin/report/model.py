"""What a report is made of: results of scenarios with their traces, and what they were run against. Plain values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fieldtwin.scenarios.trace import Event

if TYPE_CHECKING:  # verdicts and results are also made where no system can be read
    from fieldtwin.twin.site.system import System


class Verdict(Enum):
    """How something ended. Only the first one is a pass. The values are the words that users see."""

    PASSED = "passed"
    FAILED = "failed"
    ERROR = "error"
    INCONCLUSIVE = "inconclusive"
    SKIPPED = "skipped"

    @property
    def bad(self) -> bool:
        """Whether somebody has to look: FAILED and ERROR."""
        return self in (Verdict.FAILED, Verdict.ERROR)


@dataclass(frozen=True, slots=True)
class CheckResult:
    """A step, an expectation or an always-on check of a scenario.

    `number` is how people find it again (``3``, ``always 1``), `where` its place (file:line). `since_ns` to `t_ns` is the
    time that it looked at, ns since the run's start, `t_ns` when it was decided; None where it was not reached. `names` are the
    tags, variables and devices that it is about: the diagram shows these.
    """

    number: str
    text: str
    verdict: Verdict
    t_ns: int | None = None
    since_ns: int | None = None
    expected: str = ""
    got: str = ""
    reason: str = ""
    where: str = ""
    names: tuple[str, ...] = ()
    vacuous: bool = False
    """Nothing came up that this check could have judged; another run of the scenario may judge it."""


@dataclass(frozen=True, slots=True)
class Struck:
    """A fault that was put in: on which device or bus, how often it struck, and whether it need not strike (`optional`)."""

    id: str
    name: str
    on: str
    struck: int
    optional: bool = False

    @property
    def is_set(self) -> bool:
        """Whether it is no fault, but a value that a step has set; it strikes when the device gives it away."""
        return self.id == f"set {self.on}"

    @property
    def text(self) -> str:
        times = (
            "never struck" if not self.struck else f"struck {'once' if self.struck == 1 else f'{self.struck} times'}"
        )
        return f"{self.id} ({self.name} on {self.on}): {times}{', optional' if self.optional else ''}"


@dataclass
class Counts:
    """What was touched, how often. `touched` and `refused`: (device, access, table, address, count, subindex)."""

    services: Counter[tuple[str, str]] = field(default_factory=Counter)
    problems: Counter[tuple[str, str]] = field(default_factory=Counter)
    exceptions: Counter[tuple[str, int]] = field(default_factory=Counter)
    aborts: Counter[tuple[str, int]] = field(default_factory=Counter)
    touched: Counter[tuple[str, str, str, int, int, int]] = field(default_factory=Counter)
    refused: Counter[tuple[str, str, str, int, int, int]] = field(default_factory=Counter)
    transitions: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    pairs: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    """(fault's name, PROGRAM.VARIABLE, state)."""

    def add(self, other: Counts) -> None:
        """Add another run's."""
        for each in fields(self):
            getattr(self, each.name).update(getattr(other, each.name))


@dataclass(frozen=True)
class ScenarioResult:
    """One scenario against one target with one seed.

    `case` is the id that it goes by, `role` whom it judges (controller, master, device), `danger` what it may do to what is there
    (observe, read, write, disrupt), `basis` why a conformance case asks what it asks (standard, robustness, field problem),
    `clause` its source.

    `faults` says how often each fault struck that the scenario put in.

    `reproduce` is the one line that runs it again. `simulated_s` is the run's own time, `took_s` the host's. `trace` are
    the events that are still in memory, `dropped` how many are not; `trace_hash` is over all. `counts` is what a `Collector` that
    listened to the run has counted; without them the report counts what is in `trace`.
    """

    name: str
    verdict: Verdict
    checks: Sequence[CheckResult] = ()
    requirements: tuple[str, ...] = ()
    file: str = ""
    line: int = 0
    target: str = ""
    seed: int | None = None
    reason: str = ""
    reproduce: str = ""
    simulated_s: float = 0.0
    took_s: float = 0.0
    trace: Sequence[Event] = ()
    trace_hash: str = ""
    dropped: int = 0
    counts: Counts | None = None
    earlier: tuple[str, ...] = ()
    """The reasons of the attempts before this one, each of which was INCONCLUSIVE (`--retry-inconclusive`)."""
    case: str = ""
    role: str = ""
    danger: str = ""
    basis: str = ""
    clause: str = ""
    faults: Sequence[Struck] = ()
    evidence: Sequence[str] = ()
    """Lines of what was on the wire: before the check that failed, or where that is not in `trace`."""
    system: System | None = None
    """What it ran against; None: the system of its report."""

    @property
    def why(self) -> str:
        """The reason with what the deciding check saw."""
        got = next((check.got for check in self.checks if check.verdict is self.verdict and check.got), "")
        return f"{self.reason}: {got}" if got and got not in self.reason else self.reason

    @property
    def attempts(self) -> int:
        """How often it ran."""
        return len(self.earlier) + 1

    @property
    def title(self) -> str:
        """The name, with the seed where several runs of a scenario need telling apart."""
        return f"{self.name} [seed {self.seed}]" if self.seed is not None else self.name


@dataclass(frozen=True)
class Machine:
    """A program's state variable (``PROGRAM.VARIABLE``): its states in the order of their codes, and what can follow what."""

    variable: str
    states: tuple[str, ...]
    transitions: tuple[tuple[str, str], ...] = ()

    def name_of(self, value: Any) -> str:
        """The state's name for its code; what is none is shown as it is."""
        if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < len(self.states):
            return self.states[value]
        return str(value)


SystemKey = tuple[Path, str]


def key_of(system: System) -> SystemKey:
    """Return what tells one system file, as it was read, from another."""
    return system.path, system.hash


@dataclass(frozen=True)
class Report:
    """A run: one or many scenarios. `requirements` are those that are to be covered, id to text; ids that only scenarios name are
    added. `versions` is anything worth knowing: fieldtwin, Python, platform. `started` is ISO 8601."""

    title: str
    scenarios: Sequence[ScenarioResult]
    system: System | None = None
    target: str = ""
    seed: int | None = None
    started: str = ""
    reproduce: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    requirements: Mapping[str, str] = field(default_factory=dict)
    machines: Sequence[Machine] = ()
    faults: Sequence[str] = ()
    """The faults that there are to be injected, by name; those that ran are added."""
    framings: Mapping[str, str] = field(default_factory=dict)
    """What is spoken on wires in the traces that are no bus of the system: rtu, ascii, mbap, udp or can."""
    served: Sequence[str] = ()
    """The wires on which the far end asks."""
    machines_of: Mapping[SystemKey, Sequence[Machine]] = field(default_factory=dict)
    """The state machines of the systems of scenarios, where these are not `system`."""

    def part_of(self, scenario: ScenarioResult) -> Report:
        """Return the report as it is for the system of one scenario: with its names, secrets and state machines."""
        system = scenario.system
        if system is None or (self.system is not None and key_of(system) == key_of(self.system)):
            return self
        return replace(self, system=system, machines=self.machines_of.get(key_of(system), ()))

    @property
    def systems(self) -> list[System]:
        """The systems of all scenarios, each once; `system` first."""
        every = [self.system, *(scenario.system for scenario in self.scenarios)]
        found: dict[SystemKey, System] = {}
        for one in every:
            if one is not None:
                found.setdefault(key_of(one), one)
        return list(found.values())

    @property
    def counts(self) -> dict[Verdict, int]:
        """How many scenarios ended how."""
        return {v: sum(s.verdict is v for s in self.scenarios) for v in Verdict}

    @property
    def verdict(self) -> Verdict:
        """The worst of all scenarios; a run of none is inconclusive."""
        found = {s.verdict for s in self.scenarios}
        for verdict in (Verdict.ERROR, Verdict.FAILED, Verdict.INCONCLUSIVE, Verdict.SKIPPED):
            if verdict in found:
                return verdict
        return Verdict.PASSED if found else Verdict.INCONCLUSIVE
