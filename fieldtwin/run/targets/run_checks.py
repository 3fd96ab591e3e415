"""`judge: run` of a scenario in virtual time: the checks of `fieldtwin run --virtual`, in addition to the scenario's own.

Every value published as good is compared with the values that its device held within its age; no exchange may be lost
and no scan stopped; and once every fault has been over for a minute, everything must be well again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.results.model import CheckResult, ScenarioResult, Verdict
from fieldtwin.run.benches.virtual_bench import VirtualBench
from fieldtwin.run.virtual.driven import PIECE_S
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun
from fieldtwin.scenarios.language.form import Scenario
from fieldtwin.twin.network.faults import placed_all
from fieldtwin.twin.prototype.file import Prototype

MOST_TOLD = 5
TITLE = "the checks of a run in virtual time"


class _Judged(VirtualRun):
    disturbed = True
    """The scenario decides what a program should do."""


class RunJudge:
    """The checker of a run: `attach`, then `watch` as a task, and `finish` at the end of the scenario."""

    def __init__(
        self, scenario: Scenario, prototype: Prototype | None, by_chance: tuple[dict[str, Any], ...] = ()
    ) -> None:
        """Prepare the checks. `by_chance`: random faults, in addition to those of the steps."""
        steps = enumerate(scenario.form.steps, 1)
        faults = by_chance + tuple({"id": f"step {n}", **step.fault} for n, step in steps if step.fault is not None)
        if scenario.network is None:
            assert prototype is not None
            files = {"": (scenario.system.path, prototype.path)}
            placed = {"": faults}
        else:
            files = {name: (m.system.path, m.prototype.path) for name, m in scenario.network.members.items()}
            placed = placed_all(scenario.network, faults)
        self._runs = {
            name: _Judged(
                VirtualOptions(
                    str(system), 0.0, profiles=scenario.profiles, prototype_file=file, faults=placed.get(name, ())
                )
            )
            for name, (system, file) in files.items()
        }
        for name, run in self._runs.items():
            prefix = f"{name}." if name else ""
            run.may_refuse = tuple(t.removeprefix(prefix) for t in scenario.form.refused if t.startswith(prefix))
        self._benches: Mapping[str, VirtualBench] = {}
        self._where = scenario.line("judge")

    def attach(self, benches: Mapping[str, VirtualBench]) -> None:
        """Begin to check the events of the benches. A single system has the name ``""``."""
        self._benches = benches
        for name, run in self._runs.items():
            run.attach(benches[name])

    async def watch(self) -> None:
        """Check often enough that no journal overflows; until cancelled."""
        while True:
            for name, run in self._runs.items():
                run.judge(self._benches[name])
            first = next(iter(self._benches.values()))
            await first.sleep_until_s(first.now_s() + PIECE_S)

    async def finish(self, result: ScenarioResult) -> ScenarioResult:
        """Return the scenario's result, changed to failed if the run had errors."""
        errors = []
        for name, run in self._runs.items():
            await run.finish(self._benches[name])
            errors += [f"{name}: {error}" if name else error for error in run.summary()["errors"]]
        now_ns = round(next(iter(self._benches.values())).now_s() * NS_PER_S)
        verdict = Verdict.FAILED if errors else Verdict.PASSED
        expected, got = ("no error", "; ".join(errors[:MOST_TOLD])) if errors else ("", "")
        check = CheckResult("judge", TITLE, verdict, now_ns, 0, expected, got, where=self._where)
        ended = verdict if result.verdict is Verdict.PASSED else result.verdict
        reason = f"{TITLE}: {errors[0]}" if errors and result.verdict is Verdict.PASSED else result.reason
        return replace(result, verdict=ended, reason=reason, checks=(*result.checks, check))
