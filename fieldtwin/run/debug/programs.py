"""The programs that can be debugged: unit tests in Structured Text, and the programs of a system in virtual time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.dialects import Dialect
from fieldtwin.plc.st.unit_tests.run import AssertionResult
from fieldtwin.plc.st.unit_tests.suite import load_suite
from fieldtwin.run.virtual.group_kinds import VirtualSystems
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun

Output = Callable[[str], None]
Failed = Callable[[str], None]
"""Called with a text about a failed assertion, while the program is at this assertion."""


@dataclass
class Debuggee:
    """A program that is ready to run: its compiled units, the names of POUs that the source does not name, and `run`.

    `run` gets a function for lines of text, and one for failed assertions. It returns whether all went well.
    """

    units: list[CompiledUnit]
    run: Callable[[Output, Failed], bool]
    names: Mapping[str, str] = field(default_factory=dict)
    started_ns: Callable[[], int] = lambda: 0
    """Returns the time of the program's clock at its start, while it runs."""


def unit_tests(path: Path, dialect: Dialect, libraries: tuple[Path, ...]) -> Debuggee:
    """Return the unit tests of a file. Raises `FileInvalid`."""
    suite = load_suite(path, dialect, libraries, coverage=False)

    def run(say: Output, failed: Failed) -> bool:
        well = True
        for result in suite.run(lambda one: failed(_about(one))):
            executed = any(one.executed for one in result.assertions)
            well = well and executed and not result.failed and not result.error
            verdict = (
                "error" if result.error else "failed" if result.failed else "passed" if executed else "inconclusive"
            )
            say(f"{verdict}  {result.test.name}  {result.simulated_ns / NS_PER_S:g} s")
            if result.error:
                say(f"  {result.error} ({result.error_place[0]}:{result.error_place[1]})")
            elif not executed:
                say("  the test executed no assertion")
            for one in result.failed:
                place = f"{one.text.pos.path}:{one.text.pos.line}"
                say(f"  {_about(one)} ({place}, at {one.t_ns / NS_PER_S:.3f} s)")
        return well

    return Debuggee([suite.unit], run, {test.program: test.name for test in suite.tests})


def _about(one: AssertionResult) -> str:
    """Return the text about a failed assertion, with the message of the user."""
    message = f"{one.text.message}: " if one.text.message else ""
    return f"{message}{one.text.text}: expected {one.expected}, got {one.got}"


class _EachScan(VirtualRun):
    """A run in virtual time that executes every scan, so that none passes by a breakpoint."""

    def attach(self, running: VirtualSystems) -> None:
        super().attach(running)
        self.running = running
        for system in running.systems.values():
            system.run.plc.execute_every_scan()


def virtual_run(options: VirtualOptions, units: list[CompiledUnit]) -> Debuggee:
    """Return the programs of a system, which runs in virtual time with its emulated devices. Raises `FileInvalid`."""
    made = _EachScan(options)

    def run(say: Output, failed: Failed) -> bool:
        made.run(lambda elapsed_s: say(f"{elapsed_s:g} s of {options.duration_s:g} s"))
        summary = made.summary()
        for error in summary.get("errors", ()):
            say(str(error))
        say("passed" if summary["ok"] else "failed")
        return bool(summary["ok"])

    def started_ns() -> int:
        return min(system.run.started_ns for system in made.running.systems.values())

    return Debuggee(units, run, started_ns=started_ns)
