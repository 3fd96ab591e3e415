"""The data of a report: results of scenarios with their traces, and the systems that they ran against."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fieldtwin.results.trace import TraceEvent

# imported for types only, because verdicts and results are also created where the modules that read systems are not
# installed
if TYPE_CHECKING:
    from fieldtwin.plc.st.coverage.compact import CompactCoverage
    from fieldtwin.plc.st.coverage.places import Coverage
    from fieldtwin.twin.site.system import System


class Verdict(Enum):
    """The verdict on a test case or a scenario. Only PASSED is a pass. The values are the words that users see."""

    PASSED = "passed"
    FAILED = "failed"
    ERROR = "error"
    INCONCLUSIVE = "inconclusive"
    SKIPPED = "skipped"

    @property
    def bad(self) -> bool:
        """Return whether the verdict needs the attention of a user: FAILED and ERROR do."""
        return self in (Verdict.FAILED, Verdict.ERROR)


@dataclass(frozen=True, slots=True)
class CheckResult:
    """A step, an expectation or an always-on check of a scenario.

    `number` identifies it in reports (``3``, ``always 1``), `where` is its place (file:line). `since_ns` to `t_ns` is
    the time that it checked, in ns since the run's start; `t_ns` is when it was decided, None if it was not reached.
    `names` are the tags, variables and devices that it is about: the diagram shows these.
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
    """Whether the check had nothing to check, because the event that it is about did not occur in this run. The event may
    occur in another run.
    """


@dataclass(frozen=True, slots=True)
class Struck:
    """A fault that was injected: its device or bus, how often it took effect, and whether it may have no effect (`optional`)."""

    id: str
    name: str
    on: str
    struck: int
    optional: bool = False

    @property
    def is_set(self) -> bool:
        """Return whether this is not a fault but a value that a step has set. A set value takes effect when the device sends
        it.
        """
        return self.id == f"set {self.on}"

    @property
    def text(self) -> str:
        times = (
            "never took effect"
            if not self.struck
            else f"took effect {'once' if self.struck == 1 else f'{self.struck} times'}"
        )
        return f"{self.id} ({self.name} on {self.on}): {times}{', optional' if self.optional else ''}"


@dataclass
class AccessCounts:
    """The counts of accesses to devices, of refusals, and of states. The keys of `touched` and `refused` are (device, access,
    table, address, count, subindex).
    """

    services: Counter[tuple[str, str]] = field(default_factory=Counter)
    problems: Counter[tuple[str, str]] = field(default_factory=Counter)
    exceptions: Counter[tuple[str, int]] = field(default_factory=Counter)
    aborts: Counter[tuple[str, int]] = field(default_factory=Counter)
    touched: Counter[tuple[str, str, str, int, int, int]] = field(default_factory=Counter)
    refused: Counter[tuple[str, str, str, int, int, int]] = field(default_factory=Counter)
    transitions: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    pairs: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    """How often a fault was active in a state, by (fault's name, PROGRAM.VARIABLE, state)."""

    def add(self, other: AccessCounts) -> None:
        """Add the counts of another run."""
        for each in fields(self):
            getattr(self, each.name).update(getattr(other, each.name))


@dataclass(frozen=True)
class ScenarioResult:
    """One scenario against one target with one seed.

    `case` is its id, `role` the role under test (controller, master, device), `impact` its impact level (observe, read,
    write, disrupt), `basis` the reason for a conformance case (standard, robustness, field problem), `clause` its
    source.

    `faults` states how often each fault of the scenario took effect.

    `reproduce` is the command that runs it again. `simulated_s` is the run's own time, `took_s` the host's. `trace` are
    the events that are still in memory, `dropped` the number of those that are not; `trace_hash` is over all. `counts`
    are the counts of a `Collector` that listened to the run; without them the report counts the events in `trace`.
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
    trace: Sequence[TraceEvent] = ()
    trace_hash: str = ""
    trace_file: str = ""
    """The file with all events, if Studio can show it (`fieldtwin studio FILE`)."""
    dropped: int = 0
    counts: AccessCounts | None = None
    earlier: tuple[str, ...] = ()
    """The reasons of the attempts before this one, each of which was INCONCLUSIVE (`--retry-inconclusive`)."""
    case: str = ""
    role: str = ""
    impact: str = ""
    basis: str = ""
    clause: str = ""
    faults: Sequence[Struck] = ()
    evidence: Sequence[str] = ()
    """Lines about the traffic on the bus: before the failed check, or if the traffic is not in `trace`."""
    system: System | None = None
    """The system that it ran against; None: the system of its report."""
    coverage: str = ""
    """The situations that a run of a campaign reached: the text of a `fieldtwin.run.campaigns.coverage.Coverage`."""
    programs: CompactCoverage | None = None
    """The coverage of Structured Text by a run of a campaign, None if it was not measured."""

    @property
    def why(self) -> str:
        """Return the reason of the verdict, with the actual value of the check that decided it."""
        got = next((check.got for check in self.checks if check.verdict is self.verdict and check.got), "")
        return f"{self.reason}: {got}" if got and got not in self.reason else self.reason

    @property
    def attempts(self) -> int:
        """Return the number of times that the scenario ran."""
        return len(self.earlier) + 1

    @property
    def title(self) -> str:
        """Return the name, with the seed if there is one, to distinguish several runs of a scenario."""
        return f"{self.name} [seed {self.seed}]" if self.seed is not None else self.name


@dataclass(frozen=True)
class Machine:
    """A program's state variable (``PROGRAM.VARIABLE``): its states in the order of their codes, and its possible
    transitions.
    """

    variable: str
    states: tuple[str, ...]
    transitions: tuple[tuple[str, str], ...] = ()

    def name_of(self, value: Any) -> str:
        """Return the state's name for its code; a value that is not a code is returned as text."""
        if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < len(self.states):
            return self.states[value]
        return str(value)


SystemKey = tuple[Path, str]


def key_of(system: System) -> SystemKey:
    """Return a key that identifies a system file with the content that was read."""
    return system.path, system.hash


@dataclass(frozen=True)
class Report:
    """A run of one or many scenarios.

    `requirements` are those to be covered, id to text; ids that only scenarios name are added. `versions` are the versions of
    fieldtwin and Python, and the platform. `started` is ISO 8601.
    """

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
    """The names of the available faults; the report adds those that were injected."""
    framings: Mapping[str, str] = field(default_factory=dict)
    """The framing of each bus in the traces that is not a bus of the system: rtu, ascii, mbap, udp or can."""
    served: Sequence[str] = ()
    """The buses on which a remote client sends the requests, so that the received frames are the requests."""
    machines_of: Mapping[SystemKey, Sequence[Machine]] = field(default_factory=dict)
    """The state machines of the systems of scenarios, for scenarios whose system is not `system`."""
    logic: Coverage | None = None
    """The coverage of Structured Text by unit tests; None for a run without unit tests."""

    def part_of(self, scenario: ScenarioResult) -> Report:
        """Return the part of the report that concerns the system of one scenario, with the names, secrets and state machines
        of that system.
        """
        system = scenario.system
        if system is None or (self.system is not None and key_of(system) == key_of(self.system)):
            return self
        return replace(self, system=system, machines=self.machines_of.get(key_of(system), ()))

    @property
    def systems(self) -> list[System]:
        """Return the systems of all scenarios, each once; `system` first."""
        every = [self.system, *(scenario.system for scenario in self.scenarios)]
        found: dict[SystemKey, System] = {}
        for one in every:
            if one is not None:
                found.setdefault(key_of(one), one)
        return list(found.values())

    @property
    def counts(self) -> dict[Verdict, int]:
        """Return the number of scenarios with each verdict."""
        return {v: sum(s.verdict is v for s in self.scenarios) for v in Verdict}

    @property
    def verdict(self) -> Verdict:
        """Return the worst verdict of all scenarios; a run without scenarios is inconclusive."""
        found = {s.verdict for s in self.scenarios}
        for verdict in (Verdict.ERROR, Verdict.FAILED, Verdict.INCONCLUSIVE, Verdict.SKIPPED):
            if verdict in found:
                return verdict
        return Verdict.PASSED if found else Verdict.INCONCLUSIVE
