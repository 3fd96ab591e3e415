"""Messages between the stages of a twin: statuses and measurements as they arrived, and verdicts on them."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.gateway.core.values import DATA, MEASUREMENT, STATUS, Quality, Reason
from fieldtwin.gateway.store.event import Event

_REASONS = frozenset(int(reason) for reason in Reason)


@dataclass(frozen=True, slots=True)
class SeenStatus(STATUS):
    """A STATUS of the program `whose`, sent by the plant at `t_ms` and received at `arrived_ms` (both UTC)."""

    whose: str = ""
    t_ms: int = 0
    arrived_ms: int = 0


@dataclass(frozen=True, slots=True)
class SeenMeasurement(MEASUREMENT):
    """A measurement: a value or a payload, with the complete event that carried it."""

    event: Event = Event(0, 0, 0, "")  # noqa: RUF009  immutable
    arrived_ms: int = 0

    @property
    def quality(self) -> Quality:
        """Return the quality of the value. An unknown quality, which a newer plant may send, is read as bad."""
        return Quality(min(self.event.quality, Quality.BAD))

    @property
    def reason(self) -> Reason:
        """Return the reason for a quality that is not good.

        An unknown reason, which a newer plant may send, is read as NONE.
        """
        return Reason(self.event.reason) if self.event.reason in _REASONS else Reason.NONE


@dataclass(frozen=True, slots=True)
class AnalysisFinding(DATA):
    """A finding of an analysis about `subject`.

    `finding` is a key of `FINDINGS`, `text` a sentence, and `data` the text as UTF-8.

    `again` is true if the same finding was emitted before, as history or before a restart, and now holds at present.
    """

    finding: str = ""
    subject: str = ""
    text: str = ""
    t_ms: int = 0
    again: bool = False

    @property
    def fine(self) -> bool:
        """Return whether the finding reports a normal condition."""
        return self.finding in ("agree", "inside", "good", "fresh")


FINDINGS = {
    "agree": "state and period that the plant reports agree with the model",
    "mismatch": "the state that the plant reports differs from the model's state for its period",
    "inside": "a value is inside its limits again",
    "outside": "a value is outside the limits that its profile states",
    "good": "a value is good again",
    "bad": "the plant reports that a value cannot be trusted",
    "fresh": "a tag is received again",
    "stale": "a tag was not received for too long",
    "unreadable": "a status is invalid",
}


def verdict(finding: str, subject: str, text: str, t_ms: int, *, again: bool = False) -> AnalysisFinding:
    return AnalysisFinding(text.encode(), finding, subject, text, t_ms, again)
