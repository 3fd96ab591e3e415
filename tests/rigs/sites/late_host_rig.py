"""Run a scenario in virtual time on a bench that reports the lateness of its host."""

from __future__ import annotations

from pathlib import Path

from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.results.model import ScenarioResult
from fieldtwin.results.trace import Trace
from fieldtwin.run.benches.virtual_bench import VirtualBench
from fieldtwin.scenarios.judging.runner import ScenarioRunner
from fieldtwin.scenarios.language.form import load_scenario
from fieldtwin.twin.prototype.file import load_prototype

HEAD = "scenario: a test\nsystem: observatory\n"


def judged_on(bench_type: type[VirtualBench], folder: Path, text: str) -> ScenarioResult:
    """Write `text` below `HEAD` as a scenario file into `folder`, run it on a bench of `bench_type` and return the result."""
    path = folder / "x.scenario.yaml"
    path.write_text(HEAD + text)
    scenario = load_scenario(path)
    loop = VirtualLoop()

    async def main() -> ScenarioResult:
        prototype = load_prototype(scenario.system, None)
        async with bench_type(scenario.system, prototype, loop, folder, Trace()) as bench:
            return await ScenarioRunner(scenario, bench).run()

    try:
        return loop.run_until_complete(main())
    finally:
        loop.close()
