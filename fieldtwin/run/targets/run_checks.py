"""`judge: run` of a scenario in virtual time: the checks of `fieldtwin simulate`, in addition to the scenario's own.

Every value published as good is compared with the values that its device held within its age; no exchange may be lost
and no scan stopped; and once every fault has been over for a minute, all devices and programs must work again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.results.model import CheckResult, ScenarioResult, Verdict
from fieldtwin.run.benches.virtual_bench import VirtualBench
from fieldtwin.run.virtual.run import PIECE_S
from fieldtwin.run.virtual.system_check import SystemCheck
from fieldtwin.scenarios.language.form import Scenario
from fieldtwin.twin.prototype.group import SystemGroup

MOST_REPORTED = 5
TITLE = "the checks of a run in virtual time"


class RunChecker:
    """The checks of one scenario's run. Call `attach`, run `watch` as a task, and call `finish` at the end of the scenario."""

    def __init__(self, scenario: Scenario, group: SystemGroup, by_chance: tuple[dict[str, Any], ...] = ()) -> None:
        """Prepare the checks. `by_chance`: random faults, in addition to those of the steps."""
        steps = enumerate(scenario.form.steps, 1)
        faults = by_chance + tuple({"id": f"step {n}", **step.fault} for n, step in steps if step.fault is not None)
        self._group, placed = group, group.place(faults)
        self._checks = {
            name: SystemCheck(
                member.system,
                placed.get(name, ()),
                disturbed=True,  # the scenario states the expected behaviour of programs
                may_refuse=_of_member(scenario.form.refused, member.prefix),
            )
            for name, member in group.members.items()
        }
        self._benches: Mapping[str, VirtualBench] = {}
        self._where = scenario.line("judge")

    def add_faults(self, faults: Iterable[Mapping[str, Any]]) -> None:
        """Add faults that were chosen during the run."""
        for name, placed in self._group.place(faults).items():
            self._checks[name].faults = (*self._checks[name].faults, *placed)

    def attach(self, benches: Mapping[str, VirtualBench]) -> None:
        """Begin to check the events of the benches. A single system has the name ``""``."""
        self._benches = benches
        for name, check in self._checks.items():
            check.attach(benches[name])

    async def watch(self) -> None:
        """Check often enough that no journal overflows; until cancelled."""
        while True:
            for name, check in self._checks.items():
                check.check(self._benches[name])
            first = next(iter(self._benches.values()))
            await first.sleep_until_s(first.now_s() + PIECE_S)

    async def finish(self, result: ScenarioResult) -> ScenarioResult:
        """Return the scenario's result, changed to failed if the run had errors."""
        errors = []
        for name, check in self._checks.items():
            await check.finish(self._benches[name])
            errors += [f"{name}: {error}" if name else error for error in check.summary()["errors"]]
        now_ns = round(next(iter(self._benches.values())).now_s() * NS_PER_S)
        verdict = Verdict.FAILED if errors else Verdict.PASSED
        expected, got = ("no error", "; ".join(errors[:MOST_REPORTED])) if errors else ("", "")
        result_of_run = CheckResult("judge", TITLE, verdict, now_ns, 0, expected, got, where=self._where)
        ended = verdict if result.verdict is Verdict.PASSED else result.verdict
        reason = f"{TITLE}: {errors[0]}" if errors and result.verdict is Verdict.PASSED else result.reason
        return replace(result, verdict=ended, reason=reason, checks=(*result.checks, result_of_run))


def _of_member(tags: Sequence[str], prefix: str) -> tuple[str, ...]:
    return tuple(tag.removeprefix(prefix) for tag in tags if tag.startswith(prefix))
