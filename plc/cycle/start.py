"""When a program may run for the first time: after each of its inputs has been good once.

A program that runs earlier computes with values that were never read, and the gateway would write the result to the plant. Until
a program starts, its logic is not executed, its timers do not run, and its outputs have no value. The wait has a limit, after
which the program's policy applies. A program that has started stays started: afterwards the input's `if_bad` defines what the
program sees of a bad input.

Inputs that carry messages are events and have no quality, so no program waits for them. An input that is another program's
variable counts as good once that program has executed a scan. If two programs read each other's variables, both wait for the
inputs of both, and the program that runs first sees the initial values of the second one. A program that reads a program in a
SINGLE task also sees initial values at first.

The time is an argument. This module must not depend on a task's cycle or a protocol.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.core.errors import Blame, FieldtwinError
from fieldtwin.gateway.core.image.image import INPUTS, Image, TagKind
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.plc.binding import BoundProgram
from fieldtwin.plc.cycle.forces import Forces
from fieldtwin.plc.program import Role
from fieldtwin.plc.status import WaitingStatus

TIMEOUT_MS = 10_000.0
"""How long a program waits for its inputs before its policy decides, in ms, if the configuration does not set it."""
MAX_NAMED = 8
"""How many missing inputs one message names; it counts the others."""
_UNCERTAIN = int(Quality.UNCERTAIN)

AtTimeout = Literal["wait", "stop", "start_anyway"]


class InputsMissing(FieldtwinError):
    """A program could not start within its time, because inputs that it declares have not been good once."""

    exit_code = 1
    blame = Blame.DEVICE


@dataclass(frozen=True, slots=True)
class StartPolicy:
    """The longest wait of a program for its inputs (`timeout_ms`, at least 0), and the action after it.

    ``wait``: the program continues to wait, and the status shows that it is overdue. ``stop``: the PLC stops, with its outputs
    safe. ``start_anyway``: the program starts with the inputs that it has. With each of these policies, the program then no
    longer waits for an input whose `if_bad` is a number, because the number replaces it.
    """

    timeout_ms: float = TIMEOUT_MS
    at_timeout: AtTimeout = "wait"


class ProgramStart:
    """The start of one program. `started` is true when the program may run, `ran` when it has executed a scan.

    `missing` maps each input tag that has not been good yet to the reason. `without` holds the inputs that were missing when the
    program started.
    """

    __slots__ = (
        "_numbered", "all_producers", "missing", "name", "overdue", "policy", "producers", "ran", "since_ns", "started",
        "without",
    )  # fmt: skip

    def __init__(self, name: str, policy: StartPolicy, inputs: Mapping[str, bool]) -> None:
        """Create the start of a program.

        `inputs` maps each input tag of the plant to whether a number replaces it while it is bad.
        """
        self.name = name
        self.policy = policy
        self.missing: dict[str, Reason] = dict.fromkeys(inputs, Reason.NEVER_READ)
        self.producers: tuple[ProgramStart, ...] = ()
        """The programs that have to execute a scan before this one does."""
        self.all_producers: tuple[ProgramStart, ...] = ()
        """The programs on which this one depends, directly or through others."""
        self.started = self.ran = self.overdue = False
        self.since_ns: int | None = None
        self.without: dict[str, Reason] = {}
        self._numbered = frozenset(tag for tag, numbered in inputs.items() if numbered)

    @property
    def needed(self) -> list[str]:
        """Return the inputs of the plant that the program waits for now."""
        return [tag for tag in self.missing if not (self.overdue and tag in self._numbered)]

    @property
    def waits_for(self) -> list[ProgramStart]:
        """Return the programs that this program waits for now."""
        blocked = [p for p in self.all_producers if not p.started and p.needed]
        return blocked + [p for p in self.producers if not p.ran and p not in blocked]

    def start(self) -> None:
        """Let the program run from now on."""
        self.started, self.without = True, dict(self.missing)

    def reason(self) -> str:
        """Return in words which inputs and programs the program waits for."""
        tags = [f"{tag} ({self.missing[tag]})" for tag in self.needed]
        tags += [f"program {p.name}" for p in self.waits_for]
        more = len(tags) - MAX_NAMED
        return ", ".join(tags[:MAX_NAMED]) + (f" and {more} more" if more > 0 else "")

    def error(self) -> InputsMissing:
        """Return the error to report when the time for the start has passed."""
        return InputsMissing(
            f"program {self.name} has not started: it waits for {self.reason()}",
            expected=f"every input good once within {self.policy.timeout_ms / 1000:g} s",
            hint="repair the input, or change `start:` of the program in the system file; a device that measures only after this "
            "program has commanded it needs `at_timeout: start_anyway`",
        )

    def status(self, now_ns: int) -> WaitingStatus:
        """Return the status of a program that waits."""
        since_ns = now_ns if self.since_ns is None else self.since_ns
        return WaitingStatus(
            inputs={tag: str(self.missing[tag]) for tag in self.needed},
            programs=[p.name for p in self.waits_for],
            reason=self.reason(),
            since_s=(now_ns - since_ns) / NS_PER_S,
            timeout_s=self.policy.timeout_ms / 1000,
            at_timeout=self.policy.at_timeout,
            overdue=self.overdue,
        )


class Starts:
    """The starts of all programs of a PLC. `waiting` are those that have not started."""

    def __init__(
        self,
        image: Image,
        programs: Sequence[tuple[BoundProgram, StartPolicy]],
        forces: Forces,
        heartbeat_limit_ms: float,
        single: Sequence[str] = (),
    ) -> None:
        """Create the starts. `single` names the programs of SINGLE tasks.

        Inputs are used only while the gateway's last publication is at most `heartbeat_limit_ms` old."""
        self._reader = image.reader(INPUTS)
        self._forces = forces
        self._limit_ns = int(heartbeat_limit_ms * NS_PER_MS)
        self.all: dict[str, ProgramStart] = {}
        for bound, policy in programs:
            self.all[bound.name] = ProgramStart(bound.name, policy, _plant_inputs(bound, self._reader.shape.index))
        self._link([bound for bound, _ in programs], frozenset(single))
        self.waiting: list[ProgramStart] = list(self.all.values())

    def _link(self, programs: Sequence[BoundProgram], single: frozenset[str]) -> None:
        direct = {bound.name: self._producers_of(bound) for bound in programs}
        reached = {name: _reachable(name, direct) for name in direct}
        for name, start in self.all.items():
            start.all_producers = tuple(self.all[p] for p in reached[name] if p != name)
            start.producers = tuple(
                self.all[p] for p in direct[name] if p not in single and name not in reached[p] and p != name
            )

    def _producers_of(self, bound: BoundProgram) -> list[str]:
        """Return the programs whose variables are inputs of `bound`."""
        tags = [binding.tag for binding in bound.inputs.values() if binding.tag not in self._reader.shape.index]
        return list(dict.fromkeys(tag.partition(".")[0] for tag in tags if tag.partition(".")[0] in self.all))

    def look(self, now_ns: int) -> None:
        """Check the missing inputs and start the programs that can start. Raises `InputsMissing` if a program whose policy is
        ``stop`` is overdue.
        """
        snapshot = self._reader.snapshot()
        alive = snapshot.counter > 0 and now_ns - snapshot.t_ns <= self._limit_ns and not snapshot.stopped
        index = self._reader.shape.index
        for start in self.waiting:
            for tag in list(start.missing):
                at = index[tag]
                if tag in self._forces.inputs or (alive and snapshot.qualities[at] < _UNCERTAIN):
                    del start.missing[tag]
                elif alive:
                    start.missing[tag] = Reason(snapshot.reasons[at])
                elif snapshot.counter > 0:  # otherwise the gateway has not published anything yet, and may be about to
                    start.missing[tag] = Reason.GATEWAY_DEAD
            if start.since_ns is None:
                start.since_ns = now_ns
            start.overdue = now_ns - start.since_ns >= start.policy.timeout_ms * NS_PER_MS
        for start in self.waiting:
            if (not start.needed and not start.waits_for) or (
                start.overdue and start.policy.at_timeout == "start_anyway"
            ):
                start.start()
            elif start.overdue and start.policy.at_timeout == "stop":
                raise start.error()
        self.waiting = [start for start in self.waiting if not start.started]

    @property
    def missing_something(self) -> list[ProgramStart]:
        """Return the programs that wait, without those that start with the next scan."""
        return [start for start in self.waiting if start.needed or start.waits_for]

    @property
    def error(self) -> InputsMissing | None:
        """Return the error of the first program that is overdue; None if no program is overdue."""
        return next((start.error() for start in self.waiting if start.overdue), None)

    def waiting_statuses(self, now_ns: int) -> dict[str, WaitingStatus]:
        """Return the statuses of the programs that wait."""
        return {start.name: start.status(now_ns) for start in self.missing_something}

    def started_without(self) -> dict[str, dict[str, str]]:
        """Return, by program, the inputs that were missing when it started, with the reason."""
        return {
            name: {tag: str(reason) for tag, reason in start.without.items()}
            for name, start in self.all.items()
            if start.without
        }

    def release(self) -> None:
        self._reader.release()


def _plant_inputs(bound: BoundProgram, index: Mapping[str, int]) -> dict[str, bool]:
    """Return the plant's tags to which inputs of `bound` are bound, each with whether a number replaces it while it is bad."""
    found: dict[str, bool] = {}
    for variable in bound.variables(Role.INPUT):
        binding = bound.inputs.get(variable.name)
        if binding is not None and variable.kind is not TagKind.MESSAGE and binding.tag in index:
            numbered = not isinstance(binding.if_bad, str)
            found[binding.tag] = found.get(binding.tag, True) and numbered
    return found


def _reachable(name: str, direct: Mapping[str, Sequence[str]]) -> list[str]:
    """Return every program on which `name` depends, directly or through others; including itself if it does."""
    found: list[str] = []
    waiting = list(direct[name])
    while waiting:
        one = waiting.pop()
        if one not in found:
            found.append(one)
            waiting += direct[one]
    return found
