"""What the stages of a twin pass on to each other: statuses and measurements as they arrived, and verdicts on them. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.gateway.core.values import DATA, MEASUREMENT, STATUS, Quality, Reason
from fieldtwin.gateway.store.event import Event

_REASONS = frozenset(int(reason) for reason in Reason)


@dataclass(frozen=True, slots=True)
class SeenStatus(STATUS):
    """A STATUS of `whose` state machine, at `t_ms` on the plant and `arrived_ms` here (UTC)."""

    whose: str = ""
    t_ms: int = 0
    arrived_ms: int = 0


@dataclass(frozen=True, slots=True)
class SeenMeasurement(MEASUREMENT):
    """A value or a payload with everything that is known of it."""

    event: Event = Event(0, 0, 0, "")  # noqa: RUF009  immutable
    arrived_ms: int = 0

    @property
    def quality(self) -> Quality:
        """How far it can be trusted. A worse word than any that is known here, from a newer plant, is bad."""
        return Quality(min(self.event.quality, Quality.BAD))

    @property
    def reason(self) -> Reason:
        """Why it is not good; one that is not known here, from a newer plant, is none."""
        return Reason(self.event.reason) if self.event.reason in _REASONS else Reason.NONE


@dataclass(frozen=True, slots=True)
class Verdict(DATA):
    """What an analysis says of `subject`: `finding` is a word of `FINDINGS`, `text` a sentence. `data` is the text as UTF-8.

    `again`: the same was said when it was history, or before a restart; now it is so.
    """

    finding: str = ""
    subject: str = ""
    text: str = ""
    t_ms: int = 0
    again: bool = False

    @property
    def fine(self) -> bool:
        """Whether all is as it should be."""
        return self.finding in ("agree", "inside", "good", "fresh")


FINDINGS = {
    "agree": "state and period reported by the plant are those of the model",
    "mismatch": "the state that the plant reports is not the one that its period leads to in the model",
    "inside": "a value is inside its limits again",
    "outside": "a value is outside the limits that its profile states",
    "good": "a value is good again",
    "bad": "the plant says that a value cannot be trusted",
    "fresh": "a tag is heard of again",
    "stale": "a tag was not heard of for too long",
    "unreadable": "a status is none",
}


def verdict(finding: str, subject: str, text: str, t_ms: int, *, again: bool = False) -> Verdict:
    return Verdict(text.encode(), finding, subject, text, t_ms, again)
