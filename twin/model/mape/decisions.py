"""The log of a shadow's or twin's findings, and of the commands that were planned and sent or refused because of each."""

from __future__ import annotations

from collections import deque

import msgspec

from fieldtwin.gateway.core.errors import Desync
from fieldtwin.gateway.core.statemachine import decode_period
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.twin.model.mape.messages import AnalysisFinding
from fieldtwin.twin.model.mape.what_if import Question

MOST = 500
"""Number of decisions that are kept; the oldest ones are forgotten."""
BY_HAND, BY_PLANT = "by hand", "by the plant"
OBSERVED, WAITING, SIMULATING, SENT, REFUSED = "observed", "waiting", "simulating", "sent", "refused"


class Decision(msgspec.Struct, kw_only=True):
    """A finding and what followed from it.

    `outcome` is ``observed`` (nothing was planned), ``waiting``, ``simulating``, ``sent`` or ``refused``; `reason` explains it.
    """

    number: int
    t_ms: int
    """Time of the finding (UTC)."""
    finding: str
    """A key of `FINDINGS`; ``by hand`` for a user's plan, ``by the plant`` for a command that the plant refused."""
    subject: str
    observed: str
    """The finding as a sentence."""
    plan: str = ""
    """The planned command; empty without one."""
    outcome: str = OBSERVED
    reason: str = ""
    settled_ms: int | None = None
    """Time at which the command was sent or refused (UTC)."""


class DecisionLog:
    """The newest `MOST` decisions. Findings that repeat what is known are not recorded, unless a command follows from them."""

    def __init__(self) -> None:
        self.count = 0
        """Number of decisions so far."""
        self._kept: deque[tuple[Decision, AnalysisFinding | None]] = deque(maxlen=MOST)
        self._open: deque[tuple[Decision, COMMAND]] = deque(maxlen=MOST)
        """Planned commands that are neither sent nor refused, in order."""
        self._states: dict[str, str] = {}
        """The last state of each program on which plant and model agreed."""

    def newest(self, most: int) -> list[Decision]:
        """Return the newest decisions, at most `most`, the oldest first."""
        return [decision for decision, _ in self._kept][-most:]

    def observed(self, finding: AnalysisFinding, reason: str = "") -> None:
        """Record a finding. `reason` explains why nothing is planned for it."""
        known = finding.finding == "agree" and self._states.get(finding.subject) == finding.text
        if known or (finding.again and finding.fine) or self._of(finding) is not None:
            return
        if finding.finding in ("agree", "mismatch"):
            self._states[finding.subject] = finding.text
        self._add(finding.finding, finding.subject, finding.text, finding.t_ms, finding).reason = reason

    def planned(self, command: COMMAND, now_ms: int, finding: AnalysisFinding | None) -> None:
        """Record a command that is planned because of a finding, or by the user (None)."""
        if finding is None:
            decision = self._add(BY_HAND, "", "the user plans a command", now_ms)
        else:
            decision = self._of(finding) or self._add(
                finding.finding, finding.subject, finding.text, finding.t_ms, finding
            )
        decision.plan, decision.outcome = _in_words(command), WAITING
        self._open.append((decision, command))

    def failed(self, finding: AnalysisFinding, why: str, now_ms: int) -> None:
        """Record that the planner failed for a finding."""
        decision = self._of(finding) or self._add(finding.finding, finding.subject, finding.text, finding.t_ms, finding)
        decision.outcome, decision.reason, decision.settled_ms = REFUSED, why, now_ms

    def asked(self, command: COMMAND, question: Question) -> None:
        """Record that a prototype is simulated before a command is sent."""
        for decision, planned in self._open:
            if planned is command:
                decision.outcome = SIMULATING
                decision.reason = f"a prototype runs {question.horizon_s:g} s ahead"
                return

    def settled(self, command: COMMAND, objection: str, now_ms: int) -> None:
        """Record that a command was sent, or refused with an objection."""
        while self._open:
            decision, planned = self._open.popleft()
            decision.settled_ms = now_ms
            if planned is command:
                asked = decision.outcome == SIMULATING
                decision.outcome = REFUSED if objection else SENT
                decision.reason = (
                    objection or f"the model accepts it{', and the prototype met all requirements' * asked}"
                )
                return
            decision.outcome, decision.reason = REFUSED, "too many commands were waiting"

    def refused_by_plant(self, why: str, t_ms: int) -> None:
        """Record that the plant refused a command."""
        decision = self._add(BY_PLANT, "", "the plant refuses a command", t_ms)
        decision.outcome, decision.reason, decision.settled_ms = REFUSED, why, t_ms

    def _of(self, finding: AnalysisFinding) -> Decision | None:
        return next((decision for decision, of in reversed(self._kept) if of is finding), None)

    def _add(self, finding: str, subject: str, observed: str, t_ms: int, of: AnalysisFinding | None = None) -> Decision:
        self.count += 1
        made = Decision(number=self.count, t_ms=t_ms, finding=finding, subject=subject, observed=observed)
        self._kept.append((made, of))
        return made


def _in_words(command: COMMAND) -> str:
    try:
        return f"period {decode_period(command)} s"
    except Desync:
        return f"the bytes {command.data.hex()}"
