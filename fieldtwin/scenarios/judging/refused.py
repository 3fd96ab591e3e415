"""The always-on check of a scenario: no output of a program is refused, except for the tags that the scenario names.

A refusal breaks the check if the program or the configuration is wrong (a value outside its limits, a tag that may not
be written). Until the scenario has injected a fault, a refusal by the device breaks it too. A refusal by design (a read-only
plant), a write that is tried again, and a client's request do not break the check. Traces and reports show them.
"""

from __future__ import annotations

from collections import Counter

from fieldtwin.results.model import CheckResult, Verdict
from fieldtwin.results.trace import TraceEvent, TraceKind, refusal_text
from fieldtwin.scenarios.judging.violation import Violation
from fieldtwin.scenarios.language.form import Scenario

EXPECTED = "every output of a program reaches its device"
NUMBER = "refused"
MOST_REPORTED = 10


class RefusedOutputs:
    """The check of one scenario. The caller passes the events of the trace to `hear`, and `look` returns the first refusal that
    breaks the check.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._allowed = tuple(scenario.form.refused)
        self._disturbed = False
        """Whether the scenario has injected a fault: from then on a device may refuse."""
        self._seen: Counter[str] = Counter()
        """The refusals of each tag that could break the check."""
        self._broken: Violation | None = None
        self._others: dict[str, str] = {}
        """The first refusal of each tag and cause that does not break the check."""

    def hear(self, event: TraceEvent) -> None:
        """Process an event of the trace."""
        if event.kind is TraceKind.FAULT:
            self._disturbed = True
        if event.kind is not TraceKind.REFUSED:
            return
        fault, got = event.data.get("fault"), refusal_text(event.where, event.data)
        allowed = event.where in self._allowed
        self._seen[event.where] += bool(fault)
        if not fault or allowed or (fault == "device" and self._disturbed):
            if len(self._others) < MOST_REPORTED:
                self._others.setdefault(f"{event.where} {event.data.get('cause')}", got)
        elif self._broken is None:
            place = str(event.data.get("place", ""))
            self._broken = Violation(NUMBER, EXPECTED, got, (event.where,), 0.0, event.t_ns / 1e9, place)

    def look(self) -> Violation | None:
        """Return the first refusal that breaks the check; None if there is none."""
        return self._broken

    def results(self, now_ns: int) -> list[CheckResult]:
        """Return a check for each tag whose refusal the scenario expects, and one that lists the refusals that break no
        rule.
        """
        found = []
        if self._others:
            tags = tuple(dict.fromkeys(key.partition(" ")[0] for key in self._others))
            text, got = "writes that did not reach their device, and break no rule", "; ".join(self._others.values())
            found.append(CheckResult(NUMBER, text, Verdict.PASSED, now_ns, 0, got=got, names=tags))
        for n, tag in enumerate(self._allowed):
            times = self._seen[tag]
            text, verdict = f"{tag} is refused", Verdict.PASSED if times else Verdict.FAILED
            got = f"{times} times" if times else "every value that a program gave it reached the device"
            where = self._scenario.line("refused", n)
            found.append(CheckResult(NUMBER, text, verdict, now_ns, 0, text, got, where=where, names=(tag,)))
        return found
