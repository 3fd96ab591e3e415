"""A scenario on the target `virtual`: a prototype in virtual time, in this thread, without access to clocks, sockets and
threads while it runs.
"""

from __future__ import annotations

import shlex
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from fieldtwin.emulators.virtual.chance import seeded
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.emulators.virtual.seal import sealed
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.reports.run.coverage import Collector
from fieldtwin.reports.run.machines import machines_of
from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.results.trace import Trace, open_sink
from fieldtwin.results.trace_about import TraceAbout, write_results
from fieldtwin.run.targets.progress import Progress
from fieldtwin.run.targets.run_checks import RunChecker
from fieldtwin.run.virtual.group_kinds import VirtualSystems, virtual_kind
from fieldtwin.run.virtual.guided_faults import GuidedFaults
from fieldtwin.run.virtual.recorded_variables import RecordedVariables
from fieldtwin.run.virtual.trace_description import begin_description, described_checks
from fieldtwin.scenarios.judging.runner import ByChance, ScenarioRunner, gone
from fieldtwin.scenarios.language.about import result_of
from fieldtwin.scenarios.language.form import Scenario
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.group import SystemGroup, one_system


def run_virtual(
    scenario: Scenario,
    seed: int | None = None,
    trace_file: Path | None = None,
    by_chance: ByChance | None = None,
    progress: Progress | None = None,
    most_trace_bytes: int | None = None,
    watch: Callable[[Trace], None] | None = None,
    guide: GuidedFaults | None = None,
    variables: Sequence[str] = (),
) -> ScenarioResult:
    """Run the scenario. `seed` takes precedence over the scenario's own seed and the prototype file's. `by_chance`: random
    faults of a campaign; `guide` chooses further ones during the run. `most_trace_bytes` limits the trace file (see
    `open_sink`). `watch` gets the trace before its first event, to listen to it. `variables` are in the trace as well.
    """
    group = group_of(scenario)
    chosen = seed if seed is not None else scenario.form.seed if scenario.form.seed is not None else group.seed
    judge = (
        RunChecker(scenario, group, by_chance.faults if by_chance is not None else ())
        if scenario.form.judge is not None
        else None
    )
    collector = Collector(scenario.system, machines_of(scenario.system))
    began_ns = WallClock().monotonic_ns()
    loop = VirtualLoop()
    error: FieldtwinError | None = None
    result: ScenarioResult | None = None
    about: TraceAbout | None = None
    with tempfile.TemporaryDirectory(prefix="ft-scenario-") as folder:
        sink = open_sink(trace_file, most_trace_bytes) if trace_file is not None else None
        trace = Trace(sink=sink)
        trace.listen(collector.feed)
        if guide is not None:
            guide.listen(trace)
        if watch is not None:
            watch(trace)
        if progress is not None:
            progress.begin(scenario, "virtual", trace)

        async def main() -> ScenarioResult:
            kind = virtual_kind(group)
            nonlocal about
            async with kind.virtual(group, loop, Path(folder), trace, chosen, None, scenario.probes) as running:
                recorded = RecordedVariables(running, variables) if variables else None
                if trace_file is not None:
                    about = begin_description(
                        trace_file,
                        group,
                        running,
                        seed=chosen,
                        profiles=scenario.profiles,
                        title=scenario.form.scenario,
                        recorded=recorded.variables if recorded is not None else (),
                    )
                async with Nursery() as nursery:
                    if guide is not None:
                        nursery.start(guide.run(running.bench, optional=True), "guided faults")
                    return await _judged(ScenarioRunner(scenario, running.bench, by_chance), judge, running, guide)

        try:
            with seeded(chosen), sealed():
                result = loop.run_until_complete(main())
        except FieldtwinError as e:
            error = e
        finally:
            loop.close()
            trace.close()
    if result is None:
        assert error is not None
        events = tuple(trace.events)
        checks = (gone(error, events[-1].t_ns if events else 0),)
        result = result_of(scenario, "virtual", Verdict.ERROR, checks=checks, reason=str(error), trace=events)
    if trace_file is not None:
        checks_of = described_checks(result.checks)
        write_results(trace_file, about, verdict=result.verdict.value, reason=result.reason, checks=checks_of)
    return replace(
        result,
        seed=chosen,
        trace_file="" if about is None else str(trace_file),
        reproduce=reproduce(scenario, "--seed", str(chosen)),
        took_s=(WallClock().monotonic_ns() - began_ns) / 1e9,
        counts=collector.finish(),
    )


async def _judged(
    runner: ScenarioRunner, judge: RunChecker | None, running: VirtualSystems, guide: GuidedFaults | None
) -> ScenarioResult:
    """Run the scenario. If it requests `judge: run`, `judge` makes the checks of a run in addition."""
    if judge is None:
        return await runner.run()
    judge.attach(running.systems)
    async with Nursery() as nursery:
        nursery.start(judge.watch(), "judge")
        result = await runner.run()
    if guide is not None:
        judge.add_faults(guide.chosen)
    return await judge.finish(result)


def reproduce(scenario: Scenario, *more: str) -> str:
    """Return the command line that repeats a scenario, with the options `more`."""
    profiles = [word for folder in scenario.profiles for word in ("--profiles", str(folder))]
    return shlex.join(["fieldtwin", "test", str(scenario.path), *more, *profiles])


def group_of(scenario: Scenario) -> SystemGroup:
    """Return the systems of the scenario with their prototypes. Raises `FileInvalid`."""
    if scenario.group is not None:
        return scenario.group
    return one_system(scenario.system, load_prototype(scenario.system, prototype_of(scenario)))


def prototype_of(scenario: Scenario) -> Path | None:
    """Return the prototype file that the scenario names, if any."""
    named = scenario.form.prototype
    return None if named is None else scenario.path.parent / named
