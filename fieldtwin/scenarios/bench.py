"""What a scenario drives: a running system, wherever it runs. Targets differ in what they can do, and say so.

`virtual` is a prototype in virtual time, in this process; `local` one as processes on this host; `compose` one in containers;
`real` a plant. A step that asks for more than `can` holds is skipped, with the reason; it never passes.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal, Protocol

from fieldtwin.conformance.case import Danger
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.report.model import Struck
from fieldtwin.scenarios.trace import Trace


class Can(Enum):
    """What a target may be able to do. The values are the words of a scenario's `needs`."""

    INJECT_FAULT = "inject_fault"
    SEND_COMMAND = "send_command"
    SET_VALUE = "set_value"
    SEE_WIRE = "see_wire"
    SEE_HELD = "see_held"
    """What the devices held: the oracle can judge."""
    EXACT_TIME = "exact_time"
    """Lateness of the host never shows."""
    PROBE = "probe"
    FRESH_START = "fresh_start"
    """PLC, simulations and devices begin anew before the scenario (`start: fresh`)."""
    JUDGE_RUN = "judge_run"
    """What a run is judged by (`judge: run`): every value that was published as good is compared with what its device held."""


Part = Literal["plc", "gateway", "field"]
"""The parts of a system that a scenario needs running."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A tag or a program's variable now. `quality` is good, uncertain, bad, substituted or simulated; `age_s` that of the value,
    `updates` how often it was published since the start; both 0 for a variable."""

    value: Any
    quality: str
    reason: str
    age_s: float
    updates: int


def variable(value: Any, *, runs: bool) -> Reading:
    """Return the reading of a program's variable. That of a PLC that does not run is bad: nobody may act on it."""
    return Reading(value, "good" if runs else "bad", "" if runs else "not_operational", 0.0, 0)


@dataclass(frozen=True, slots=True)
class Stopped:
    """A part of the system under test that does not run: the PLC, the gateway or the simulated field devices.

    `what` is the error, `where` the file and line of the logic that failed, if logic did. `bound_s`: a host that was late by a
    part of this time may have caused it; 0 if the host's lateness cannot be the cause.
    """

    part: Part
    what: str
    where: str = ""
    bound_s: float = 0.0


class NothingKnown(FieldtwinError):
    """The judge itself was interrupted: what it saw says nothing about the system, and the scenario is INCONCLUSIVE."""


class Bench(Protocol):
    """A running system. Raises `FieldtwinError` when the system is gone."""

    @property
    def target(self) -> str:
        """virtual, local, compose or real."""
        ...

    @property
    def can(self) -> frozenset[Can]: ...

    @property
    def allowed(self) -> Danger:
        """What steps may do to it at most: `expect`, `wait` and `pause` observe, probes read, `send` and `set` write, `fault`
        and `clear` disrupt."""
        ...

    @property
    def trace(self) -> Trace: ...

    def now_s(self) -> float:
        """Seconds since the start."""
        ...

    async def sleep_until_s(self, t_s: float) -> None:
        """Return at or after `t_s` seconds since the start, with `reading` and `trace` up to date."""
        ...

    def names(self) -> list[str]:
        """What `reading` knows: DEVICE.TAG and PROGRAM.VARIABLE."""
        ...

    def reading(self, name: str) -> Reading | None:
        """As it was when the last `sleep_until_s` returned. None: never published. Raises `UsageError` for an unknown name."""
        ...

    def why_unknown(self, name: str) -> str:
        """Return why `reading` is None, as far as that is known: which endpoint did not answer, and with what error."""
        ...

    def stopped(self) -> Stopped | None:
        """Return the part of the system that does not run, or None. A plant has no simulated field devices."""
        ...

    def not_started(self) -> str:
        """Return which programs wait for their inputs and have not started, with what is missing; empty where all run."""
        ...

    def late_ms(self) -> float:
        """How late the last scan was by the host's own making; 0 in virtual time."""
        ...

    def host_late_s(self, since_s: float) -> float:
        """The longest that the host, by its own load, kept us or a scan waiting since `since_s`; 0 in virtual time."""
        ...

    def host_late_total_s(self, since_s: float) -> tuple[float, float]:
        """All lateness since `since_s`, together, in seconds: that of the judge's own sleeps, which is the host's alone, and all
        that was seen, which may also be the system's. Both 0 in virtual time."""
        ...

    async def send(self, period_s: int) -> None:
        """The far end commands a period."""
        ...

    async def set_value(self, device: str, tag: str, value: float | str | bool | None) -> None:
        """From now on the device holds `value` for `tag`, whatever its recording says; None: no longer."""
        ...

    async def inject(self, fault: dict[str, Any]) -> None:
        """Put a fault in: `id`, `name`, what it aims at and its parameters, as in a fault file."""
        ...

    async def clear(self, id: str) -> None:
        """Take the fault away."""
        ...

    async def struck(self) -> list[Struck]:
        """Return how often each fault struck that was put in through this bench, in the order in which they were put in."""
        ...

    async def held(self, name: str) -> list[tuple[float, bytes]]:
        """What the device held for a tag: since when (s since the start), and the raw bytes."""
        ...
