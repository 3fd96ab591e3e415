"""The status of a running shadow or twin: the answer to the command `status` on its control channel.

The fields are the keys of the JSON object. Times are UTC in milliseconds.
"""

from __future__ import annotations

from typing import Any

import msgspec

from fieldtwin.twin.model.mape.decisions import Decision
from fieldtwin.twin.thread.status import ThreadStatus

MOST_DECISIONS = 200
"""Largest number of decisions that a status contains: the newest ones."""


class VariableStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A variable of the digital model as the plant last reported it. `t_ms` is None if it never did."""

    value: Any
    unit: str = ""
    quality: str
    reason: str
    t_ms: int | None


class LagStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The time between an event at the plant and its arrival here, in milliseconds."""

    median: int
    p95: int
    max: int


class CommandCounts(msgspec.Struct, frozen=True, kw_only=True):
    """Counts of a twin's commands since it started."""

    planned: int
    simulated: int
    sent: int
    refused: int
    refused_by_plant: int
    unconfirmed: int
    """Commands that the plant has not acknowledged yet."""


class TwinStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The status of a shadow or a twin. `commands` is None for a shadow, which has no way to send any."""

    kind: str
    """``shadow`` or ``twin``."""
    system: str
    place: str
    """The address at which it receives the plant's digital thread."""
    now_ms: int
    origins: list[str]
    """The logs that it has received since it started."""
    state: str
    period_s: int
    thread: ThreadStatus | None
    store: str
    store_trouble: str
    variables: dict[str, VariableStatus]
    undeclared: int
    statuses: int
    agreed: int
    measurements: int
    backfilled: int
    twinning_rate_hz: float | None
    lag_ms: LagStatus | None
    wrong: dict[str, list[str]]
    """The findings that hold now, by their subject."""
    decisions: list[Decision]
    """The newest decisions, oldest first."""
    decided: int
    """Number of decisions so far; the older ones are not in `decisions`."""
    commands: CommandCounts | None = None
