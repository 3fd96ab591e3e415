"""A proposed write of a tag, and the end of a proposal."""

from __future__ import annotations

from typing import Literal

import msgspec

EXPIRES_AFTER_S = 600
"""Time in seconds after which a proposal can no longer be confirmed."""
MOST_WAITING = 8
"""Largest number of proposals that wait at the same time, of all agents of a user together."""
LONGEST_REASON = 200
"""Largest number of characters of an agent's reason."""

EndState = Literal["written", "failed", "refused", "expired", "withdrawn"]


class Seen(msgspec.Struct, frozen=True):
    """A value of a tag (bytes as hex) with its quality and its reason."""

    value: bool | int | float | str | None
    quality: str
    reason: str = ""


class Proposal(msgspec.Struct, frozen=True, kw_only=True):
    """A proposed write of a tag of a running plant.

    `by` names the agent, and `reason` is what it says. `value` is in engineering units, and `seen` is what the tag had when the
    write was proposed. `run_pid` and `run_started_ns` name the run: a run that is started later gets no write of it. Times with
    `utc` are for display; `asked_ns` and `expires_ns` count on the monotonic clock of the computer. `audit` is the audit log
    that records the decision.
    """

    number: int
    by: str
    reason: str
    instance: str
    tag: str
    value: float
    seen: Seen
    unit: str
    run_pid: int
    run_started_ns: int
    asked_utc_ns: int
    asked_ns: int
    expires_ns: int
    audit: str

    def has_expired(self, now_ns: int) -> bool:
        """Return whether it is too late to confirm the proposal. After a restart of the computer, `now_ns` may be before its
        beginning.
        """
        return not self.asked_ns <= now_ns < self.expires_ns


class Ended(msgspec.Struct, frozen=True, kw_only=True):
    """The end of a proposal: `state`, who decided (`by`, "" if it expired), and a text such as the error of a failed write."""

    proposal: Proposal
    state: EndState
    by: str
    text: str
    utc_ns: int
