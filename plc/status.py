"""The status of a PLC process on the control channel: the answer to `get`, for sender and receivers.

The fields are the keys of the JSON object. A field with a default may be missing in the answer of an older PLC.
"""

from __future__ import annotations

from typing import Any

import msgspec

Buckets = list[tuple[float, int]]
"""The upper limit of each bucket in microseconds, and its count (`Histogram.buckets_us`)."""
Spread = dict[str, int | float]
"""Count, minimum, percentiles and maximum of a duration in microseconds (`Histogram.summary_us`)."""


class ScanStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The state and the counters of one task."""

    state: str
    """``ready``, ``running``, ``paused``, ``waiting`` or ``stopped``."""
    stop_reason: str = "none"
    error: str = ""
    error_at: str = ""
    """File and line of `error`, if they are known."""
    cycle_ms: float = 0.0
    late_ms: float = 0.0
    scans: int = 0
    missed_periods: int = 0
    overruns: int = 0
    lateness_us: Spread = {}
    duration_us: Spread = {}


class TaskStatus(ScanStatus, frozen=True, kw_only=True):
    """One task among several. `single` is the tag that starts it, "" for a cyclic task."""

    priority: int = 0
    single: str = ""


class WaitingStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A program that has not started, because inputs have not been good yet."""

    inputs: dict[str, str] = {}
    """By tag of an input that has not been good: the reason."""
    programs: list[str] = []
    """The programs that it waits for."""
    reason: str
    since_s: float = 0.0
    timeout_s: float = 0.0
    at_timeout: str = ""
    overdue: bool = False


class StopsStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The failures after which the PLC restarted its programs: their number, and the error of the last one."""

    count: int = 0
    last: str = ""


class ChangesStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The replacements of programs while they ran: their number, and what the last one did."""

    count: int = 0
    last: list[str] = []


class RetainStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The kind of the last start, and the number of times that retained values were saved."""

    start: str = ""
    saves: int = 0


class RealtimeStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The real-time measures that the operating system granted, and those that it refused, with its reason."""

    granted: list[str] = []
    refused: dict[str, str] = {}


class PlcStatus(ScanStatus, frozen=True, kw_only=True):
    """The status of a whole PLC.

    The fields of `ScanStatus` are those of the task that stopped it, otherwise of the first task.
    """

    waiting: dict[str, WaitingStatus] = {}
    started_without: dict[str, dict[str, str]] = {}
    """By program: the inputs that were missing when it started, with the reason."""
    restarts: int = 0
    stops: StopsStatus = StopsStatus()
    changes: ChangesStatus = ChangesStatus()
    stepping: int = 0
    """The number of steps that a paused PLC still has to execute."""
    restart_in_ms: float | None = None
    retain: RetainStatus = RetainStatus()
    forces: dict[str, dict[str, Any]] = {}
    """By tag: value, age in ms and user (`Forces.describe`)."""
    tasks: dict[str, TaskStatus] = {}
    pid: int = 0
    gateway_alive: bool = False
    counters: dict[str, int] = {}
    realtime: RealtimeStatus | None = None
    """None in virtual time. This also applies to `acts`."""
    debugger: str = ""
    """Whether a debugger is attached, and where it has stopped the programs; empty without one."""
    acts: dict[str, int] | None = None
    """By kind of manual intervention (force, pause and so on): how often it was carried out."""
    programs: dict[str, str] = {}
    """By program: the name of its class."""
    duration_buckets: Buckets = []
    """The durations of the first task's scans; `lateness_buckets` holds their delays. A brief status has both only if the
    client asks with ``"buckets": true``.
    """
    lateness_buckets: Buckets = []


class WholePlcStatus(PlcStatus, frozen=True, kw_only=True):
    """The status with all values, which a client gets unless it asks with ``"brief": true``."""

    retained: dict[str, Any] = {}
    inputs: dict[str, Any] = {}
    outputs: dict[str, Any] = {}
    variables: dict[str, Any] = {}
