"""A manual clock and the reports of a plant, for the tests of shadow and twin."""

from __future__ import annotations

from fieldtwin.gateway.core.statemachine import delta
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.twin.model.status import encode_status
from fieldtwin.twin.model.variables import ModelVariable

DECLARED = (
    ModelVariable("ctd.pressure", "real", "dbar", (0.0, 100.0)),
    ModelVariable("ctd.sample_count", "int"),
    ModelVariable("ctd.sample", "message"),
)
NOW_MS = 1_790_000_000_000


class Hands:
    """A clock that the test sets."""

    def __init__(self) -> None:
        self.now_ms = NOW_MS

    def monotonic_ns(self) -> int:
        return self.now_ms * 1_000_000

    utc_ns = monotonic_ns

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        raise AssertionError("nobody waits here")


def status(period_s: int, state: str = "", t_ms: int = NOW_MS) -> Event:
    """A report of the state machine `relay`; the state follows from the period unless it is given."""
    return Event(1, t_ms, Kind.STATE, "relay", encode_status(state or delta(period_s).name, period_s).data)


def value(
    number: float | None, t_ms: int = NOW_MS, quality: Quality = Quality.GOOD, reason: Reason = Reason.NONE
) -> Event:
    return Event(1, t_ms, Kind.VALUE, "ctd.pressure", number, int(quality), int(reason))
