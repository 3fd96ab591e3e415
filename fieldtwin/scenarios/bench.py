"""What a scenario drives: a running system, wherever it runs. Targets differ in what they can do, and say so.

`virtual` is a prototype in virtual time, in this process; `local` one as processes on this host; `compose` one in containers;
`real` a plant. A step that asks for more than `can` holds is skipped, with the reason; it never passes.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

from fieldtwin.conformance.case import Danger
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
    JUDGE_RUN = "judge_run"
    """What a run is judged by (`judge: run`): every value that was published as good is compared with what its device held."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A tag or a program's variable now. `quality` is good, uncertain, bad, substituted or simulated; `age_s` that of the value,
    `updates` how often it was published since the start; both 0 for a variable."""

    value: Any
    quality: str
    reason: str
    age_s: float
    updates: int


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

    def late_ms(self) -> float:
        """How late the last scan was by the host's own making; 0 in virtual time."""
        ...

    def host_late_s(self, since_s: float) -> float:
        """The longest that the host, by its own load, kept us or a scan waiting since `since_s`; 0 in virtual time."""
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

    async def held(self, name: str) -> list[tuple[float, bytes]]:
        """What the device held for a tag: since when (s since the start), and the raw bytes."""
        ...
