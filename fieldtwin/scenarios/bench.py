"""The interface through which a scenario controls and observes a running system. A target (a way to run the system) declares its
capabilities in `can`.

The target `virtual` is a prototype (the system with emulated devices) in virtual time, in this process; `local` is a prototype as
processes on this host; `compose` is a prototype in containers; `real` is a plant. A step that needs a capability that is not in
`can` is skipped, with the reason; it never passes.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal, Protocol

from fieldtwin.conformance.core.case import Impact
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.runtime.gateway_status import AlarmEvent
from fieldtwin.results.model import Struck
from fieldtwin.results.trace import Trace

SCENARIO = "scenario"
"""The user in whose name a scenario acknowledges alarms."""


class Can(Enum):
    """The capabilities of targets. The values are the words of a scenario's `needs`."""

    INJECT_FAULT = "inject_fault"
    SEND_COMMAND = "send_command"
    SET_VALUE = "set_value"
    SEE_WIRE = "see_wire"
    SEE_HELD = "see_held"
    """Read the values in the emulated devices' registers and objects, with which published values are compared."""
    EXACT_TIME = "exact_time"
    """Time is exact: load of the host never affects the run."""
    PROBE = "probe"
    FRESH_START = "fresh_start"
    """Restart PLC, simulations and devices before the scenario (`start: fresh`)."""
    ACKNOWLEDGE = "acknowledge"
    """Acknowledge alarms."""
    JUDGE_RUN = "judge_run"
    """Apply the checks of `run` (`judge: run`): every value published as good is compared with what its device held."""


Part = Literal["plc", "gateway", "field"]
"""The parts of a system that must run for a scenario."""


@dataclass(frozen=True, slots=True)
class TagReading:
    """The current value of a tag or of a program's variable.

    `quality` is good, uncertain, bad, substituted or simulated; `age_s` is the value's age, and `updates` how often it
    was published since the start; both are 0 for a variable.
    """

    value: Any
    quality: str
    reason: str
    age_s: float
    updates: int


def variable(value: Any, *, runs: bool) -> TagReading:
    """Return the reading of a program's variable. If the PLC does not run, it is bad: the value must not be used."""
    return TagReading(value, "good" if runs else "bad", "" if runs else "not_operational", 0.0, 0)


def alarm_reading(event: AlarmEvent, now_ns: int) -> TagReading | None:
    """Return the reading of an alarm after its last change; None if its condition has never been known."""
    if not event.number:
        return None
    return TagReading(event.state, event.quality, event.reason, (now_ns - event.t_ns) / NS_PER_S, event.number)


@dataclass(frozen=True, slots=True)
class Stopped:
    """A part of the system under test that does not run: the PLC, the gateway or the simulated field devices.

    `what` is the error, `where` the file and line of the logic that failed, if logic did. `bound_s`: the stop
    may have been caused by a host that was late by a part of this time; 0 if lateness cannot be the cause.
    """

    part: Part
    what: str
    where: str = ""
    bound_s: float = 0.0


class NothingKnown(FieldtwinError):
    """Raised when the test runner itself was interrupted: its observations prove nothing about the system, and the scenario is
    INCONCLUSIVE.
    """


class Bench(Protocol):
    """A running system. The methods raise `FieldtwinError` if the system has ended."""

    @property
    def target(self) -> str:
        """Return the kind of the target: virtual, local, compose or real."""
        ...

    @property
    def can(self) -> frozenset[Can]: ...

    @property
    def allowed(self) -> Impact:
        """Return the highest impact level that steps may have: `expect`, `wait` and `pause` only observe; probes read; `send`,
        `set` and `acknowledge` write; `fault` and `clear` disrupt.
        """
        ...

    @property
    def trace(self) -> Trace: ...

    def now_s(self) -> float:
        """Return the seconds since the start."""
        ...

    async def sleep_until_s(self, t_s: float) -> None:
        """Wait until `t_s` seconds since the start, or slightly later, and update `reading` and `trace`."""
        ...

    def names(self) -> list[str]:
        """Return the names that `reading` accepts: DEVICE.TAG, PROGRAM.VARIABLE and alarm.NAME."""
        ...

    def reading(self, name: str) -> TagReading | None:
        """Return the value of a tag or variable as it was when `sleep_until_s` last returned; None if it was never published.

        Raises `UsageError` for an unknown name.
        """
        ...

    def why_unknown(self, name: str) -> str:
        """Return why `reading` is None, as far as that is known: which endpoint did not answer, and with what error."""
        ...

    def stopped(self) -> Stopped | None:
        """Return a part of the system that should run and does not, or None. A plant has no simulated field devices."""
        ...

    def not_started(self) -> str:
        """Return as text which programs have not started, and which inputs they wait for; empty if all programs run."""
        ...

    def late_ms(self) -> float:
        """Return by how many ms the last scan was late because of the host; 0 in virtual time."""
        ...

    def host_late_s(self, since_s: float) -> float:
        """Return the longest time since `since_s` for which the host's load delayed this process or a scan; 0 in
        virtual time.
        """
        ...

    def host_late_total_s(self, since_s: float) -> tuple[float, float]:
        """Return the sum of all lateness since `since_s`, in seconds, as two numbers: that of this process's own
        sleeps, which only the host can cause, and all that was observed, which the system may also cause. Both are 0 in
        virtual time."""
        ...

    async def send(self, period_s: int) -> None:
        """Send a command with a sample period in seconds, as the remote client."""
        ...

    async def set_value(self, device: str, tag: str, value: float | str | bool | None) -> None:
        """Make the device hold `value` for `tag` from now on, instead of its recorded or simulated value; None restores that
        value.
        """
        ...

    async def inject(self, fault: dict[str, Any]) -> None:
        """Inject a fault, which is described as in a fault file: `id`, `name`, its target and its parameters."""
        ...

    async def acknowledge(self, alarm: str) -> None:
        """Acknowledge an alarm by its name in expressions. Raises `UsageError` if there is nothing to acknowledge."""
        ...

    async def failures(self) -> dict[str, str]:
        """Return the emulated devices that fell silent because their simulation has failed, with the error."""
        ...

    async def clear(self, id: str) -> None:
        """End the fault with this id."""
        ...

    async def struck(self) -> list[Struck]:
        """Return how often each fault of this bench took effect, in the order of injection."""
        ...

    async def held(self, name: str) -> list[tuple[float, bytes]]:
        """Return the values that the device held for a tag: the start of each (s since the start), and its raw bytes."""
        ...
