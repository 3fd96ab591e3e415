"""The part of `fieldtwin test` that runs unit tests in Structured Text."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldtwin.cli.option_groups import option
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.plc.source_files import SUFFIXES, is_test_file, source_paths
from fieldtwin.plc.st.dialects import DIALECTS, dialect_of

if TYPE_CHECKING:
    from fieldtwin.plc.st.unit_tests.run import AssertionResult, TestResult
    from fieldtwin.plc.st.unit_tests.suite import Suite
    from fieldtwin.results.model import CheckResult, ScenarioResult

_TESTS = re.compile(r"^\s*TEST\s+['\"].*\bEND_TEST\b", re.IGNORECASE | re.MULTILINE | re.DOTALL)
"""TEST blocks in the file of a program."""
_SUITES = re.compile(r"\bEXTENDS\s+(TcUnit\s*\.\s*)?FB_TestSuite\b", re.IGNORECASE)
"""The declaration of a suite of TcUnit."""
TARGET = "unit test"
"""The target of a unit test in reports, where a scenario has virtual, local, compose or real."""


@dataclass(frozen=True)
class UnitTestOptions:
    """The dialect and the libraries of the tested programs."""

    dialect: str = option(
        "--dialect",
        type=click.Choice(list(DIALECTS)),
        default="standard",
        show_default=True,
        help="The dialect of unit tests and of the programs that they test.",
    )
    libraries: tuple[Path, ...] = option(
        "--library",
        type=click.Path(path_type=Path, exists=True),
        multiple=True,
        help="A file or folder whose declarations unit tests may use, in addition to the files in their folder. Can be repeated.",
    )

    def words(self) -> tuple[str, ...]:
        """Return the options as words of a command line."""
        dialect = ("--dialect", self.dialect) if self.dialect != "standard" else ()
        return (*dialect, *(word for one in self.libraries for word in ("--library", str(one))))


def is_unit_test(path: Path) -> bool:
    """Return whether a file that the user named holds unit tests, not a scenario."""
    return is_test_file(path) or path.suffix.lower() in SUFFIXES


def unit_tests_below(folder: Path, dialect: str) -> list[Path]:
    """Return the files with unit tests in a folder and below it, sorted, without hidden ones.

    They are the files `*.test.st`, the programs with TEST blocks, and in `codesys` and `twincat` the suites of TcUnit.
    """
    vendor = dialect_of(dialect).vendor
    return sorted(path for path in source_paths(folder) if is_test_file(path) or _has_tests(path, vendor=vendor))


def _has_tests(path: Path, *, vendor: bool) -> bool:
    if path.suffix.lower() == ".xml":
        return False
    try:
        text = path.read_text("utf-8", errors="replace")
    except OSError:
        return False
    return _TESTS.search(text) is not None or (vendor and _SUITES.search(text) is not None)


def load_suites(paths: list[Path], options: UnitTestOptions) -> list[Suite]:
    """Read and compile the files of unit tests. Raises `FileInvalid`."""
    from fieldtwin.plc.st.unit_tests.suite import load_suite

    return [load_suite(path, dialect_of(options.dialect), options.libraries) for path in paths]


def run_suites(suites: list[Suite], options: UnitTestOptions) -> Iterator[ScenarioResult]:
    """Run the tests of all files, one after the other."""
    for suite in suites:
        reproduce = shlex.join(["fieldtwin", "test", str(suite.path), *options.words()])
        began_ns = WallClock().monotonic_ns()
        for result in suite.run():
            now_ns = WallClock().monotonic_ns()
            yield _as_result(result, suite.path, reproduce, round((now_ns - began_ns) / NS_PER_S, 3))
            began_ns = now_ns


def _as_result(result: TestResult, path: Path, reproduce: str, took_s: float) -> ScenarioResult:
    from fieldtwin.results.model import ScenarioResult, Verdict

    verdict, reason = Verdict.PASSED, ""
    failed = next(((n, one) for n, one in enumerate(result.assertions, 1) if one.failed), None)
    if result.error:
        place, line = result.error_place
        verdict, reason = Verdict.ERROR, f"{result.error} ({place}:{line})"
    elif failed is not None:
        verdict, reason = Verdict.FAILED, f"{failed[0]}: {_text(failed[1])}"
    elif not any(one.executed for one in result.assertions):
        verdict, reason = Verdict.INCONCLUSIVE, "the test executed no assertion"
    return ScenarioResult(
        name=result.test.name,
        verdict=verdict,
        checks=tuple(_as_check(str(n), one) for n, one in enumerate(result.assertions, 1)),
        file=str(path),
        line=result.test.pos.line,
        target=TARGET,
        reason=reason,
        reproduce=reproduce,
        simulated_s=result.simulated_ns / NS_PER_S,
        took_s=took_s,
    )


def _as_check(number: str, one: AssertionResult) -> CheckResult:
    from fieldtwin.results.model import CheckResult, Verdict

    verdict = Verdict.FAILED if one.failed else Verdict.PASSED if one.executed else Verdict.SKIPPED
    return CheckResult(
        number,
        _text(one),
        verdict,
        t_ns=one.t_ns if one.executed else None,
        expected=one.expected,
        got=one.got or ("" if one.executed else "not executed"),
        where=f"{one.text.pos.path}:{one.text.pos.line}",
    )


def _text(one: AssertionResult) -> str:
    return f"{one.text.message}: {one.text.text}" if one.text.message else one.text.text
