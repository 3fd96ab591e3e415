"""Run the unit tests of a file, each alone in its own virtual time.

Each test begins with the initial values of all variables, also the global ones, at time 0. A call of a program or function
block in a test executes it once, as a scan does; time passes with ADVANCE_TIME only.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.plc.program import ScanTooLong
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st import values
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.context import MAX_STEPS, Context
from fieldtwin.plc.st.inspection import elements, literal
from fieldtwin.plc.st.resource import Resource, line_of_error
from fieldtwin.plc.st.unit_tests.assertions import AssertionText, TranslatedTest

CYCLE_NS = 10 * NS_PER_MS
"""The cycle of the programs of cyclic tests."""
MAX_CYCLIC_NS = 600 * NS_PER_S
"""How long cyclic tests may take, in virtual time."""
MAX_ADVANCES = 1_000_000
"""How often a test may advance its time, so that a test with an endless loop ends."""


@dataclass(frozen=True, slots=True)
class AssertionResult:
    """An assertion of a test: how often it was executed, and its first failure, if any.

    `t_ns` is the time of the first failure, or else of the last execution, in ns since the test's start. `expected` and `got`
    describe the failure.
    """

    text: AssertionText
    executed: int
    failed: bool
    t_ns: int
    expected: str = ""
    got: str = ""


@dataclass(frozen=True, slots=True)
class TestResult:
    """A test that has ended. `error`: why it ended early, with the place of the statement; "" if it was executed to its end."""

    __test__ = False  # no class of tests for pytest

    test: TranslatedTest
    assertions: tuple[AssertionResult, ...]
    simulated_ns: int
    error: str = ""
    error_place: tuple[str, int] = ("", 0)

    @property
    def failed(self) -> list[AssertionResult]:
        return [one for one in self.assertions if one.failed]


Failed = Callable[[AssertionResult], None]
"""Called while the test is at an assertion that has failed."""


@dataclass(slots=True)
class _Count:
    executed: int = 0
    failed: bool = False
    t_ns: int = 0
    values: tuple[Any, ...] = ()


class _TestContext(Context):
    """The context of compiled code in a test: its time is that of the test."""

    __slots__ = ("_advances", "_failed", "_ordered", "counts", "finished")

    def __init__(self, recorded: set[Any], failed: Callable[[int], None]) -> None:
        """`failed` is called with the number of an assertion when it fails for the first time."""
        super().__init__()
        self._failed = failed
        self.first_scan = True
        self.counts: dict[int, _Count] = {}
        self.finished: set[int] = set()
        """The numbers of the cyclic tests that have ended."""
        self.executed = recorded.add
        self._advances = 0
        self._ordered: list[int] = []
        """The numbers of the ordered tests, in the order in which the suite has named them first."""

    def asserted(self, number: int, holds: bool, shown: tuple[Any, ...], of_test: int) -> None:
        """Record an execution of an assertion, unless the cyclic test `of_test` has ended. The first failure is kept."""
        if of_test in self.finished:
            return
        count = self.counts.setdefault(number, _Count())
        count.executed += 1
        if not count.failed:
            count.failed, count.t_ns = not holds, self.now_ns
            count.values = shown if holds else copy.deepcopy(shown)  # an array may change after this
            if not holds:
                self._failed(number)

    @staticmethod
    def same(actual: Any, expected: Any, within: float | None) -> bool:
        """Return whether two arrays have the same size and equal elements, those of REAL within a tolerance."""
        if isinstance(actual, list):
            return len(actual) == len(expected) and all(
                _TestContext.same(a, e, within) for a, e in zip(actual, expected, strict=True)
            )
        return bool(actual == expected if within is None else abs(actual - expected) <= within)

    def has_turn(self, test: int) -> bool:
        """Return whether an ordered test is the first one that has not ended."""
        if test not in self._ordered:
            self._ordered.append(test)
        return next((one for one in self._ordered if one not in self.finished), None) == test

    def advance(self, by_ns: int) -> None:
        """Advance the time. Raises `LogicError` for a negative time, and `ScanTooLong` for a test that does not end."""
        if by_ns < 0:
            raise values.LogicError(
                "ADVANCE_TIME goes back", expected="T#0s or more", got=values.duration_text(by_ns, "T")
            )
        self._advances += 1
        if self._advances > MAX_ADVANCES:
            raise ScanTooLong(f"more than {MAX_ADVANCES:,} calls of ADVANCE_TIME in one test")
        self.now_ns += by_ns
        self.first_scan = False
        self.left = MAX_STEPS


def run_tests(
    unit: CompiledUnit, tests: Iterable[TranslatedTest], recorded: set[Any], failed: Failed | None = None
) -> Iterator[TestResult]:
    """Run each test. The probes for coverage add their records to `recorded`: numbers, and pairs of a number and a value.

    `failed` is called at the first failure of each assertion.
    """
    for _, group in groupby(tests, lambda test: test.program):
        yield from _run(unit, list(group), recorded, failed)


def _run(
    unit: CompiledUnit, tests: list[TranslatedTest], recorded: set[Any], failed: Failed | None
) -> Iterator[TestResult]:
    """Run the program of `tests`: once, or if they are cyclic, until all of them have ended."""
    texts = {number: text for test in tests for number, text in test.assertions.items()}

    def report(number: int) -> None:
        if failed is not None:
            failed(_result(number, texts[number], context, unit))

    context = _TestContext(recorded, report)
    error, place = "", ("", 0)
    try:
        program = Resource(unit, context).created(f"P_{tests[0].program}")
        program.execute()
        while (
            tests[0].cyclic
            and context.now_ns < MAX_CYCLIC_NS
            and any(one.number not in context.finished for one in tests)
        ):
            context.advance(CYCLE_NS)
            program.execute()
    except (FieldtwinError, ArithmeticError, ValueError, RecursionError) as e:
        error, place = _reason(e), _place(e, unit, tests[0])
    for test in tests:
        found = tuple(_result(number, text, context, unit) for number, text in test.assertions.items())
        if test.cyclic and test.number in context.finished:
            yield TestResult(test, found, context.now_ns)  # an error after its end is not an error of this test
        elif test.cyclic and not error:
            late = f"it did not call TEST_FINISHED within {values.duration_text(MAX_CYCLIC_NS, 'T')}"
            yield TestResult(test, found, context.now_ns, late, (test.pos.path, test.pos.line))
        else:
            yield TestResult(test, found, context.now_ns, error, place)


def _result(number: int, text: AssertionText, context: _TestContext, unit: CompiledUnit) -> AssertionResult:
    count = context.counts.get(number, _Count())
    if not count.failed:
        return AssertionResult(text, count.executed, False, count.t_ns)
    kinds = unit.recorded[number]
    if isinstance(kinds[0], ty.Array) and isinstance(kinds[1], ty.Array):
        within = count.values[2] if len(kinds) > 2 else None
        expected, got = _difference(kinds[0], kinds[1], count.values[0], count.values[1], within)
        return AssertionResult(text, count.executed, True, count.t_ns, expected, got)
    shown = [literal(kind, value) for kind, value in zip(kinds, count.values, strict=True)]
    expected = text.expected + (shown[1] if len(shown) > 1 else "")
    if len(shown) > 2:
        expected += f" within {shown[2]}"
    return AssertionResult(text, count.executed, True, count.t_ns, expected, shown[0])


def _difference(kind: ty.Array, other: ty.Array, actual: Any, expected: Any, within: float | None) -> tuple[str, str]:
    """Return the expected and the actual value of the first different element of two arrays, or their sizes."""
    sizes = [" x ".join(str(high - low + 1) for low, high in of.ranges) for of in (other, kind)]
    if sizes[0] != sizes[1]:
        return f"{sizes[0]} elements", f"{sizes[1]} elements"
    for (index, is_), (_, wanted) in zip(elements(kind, actual), elements(other, expected), strict=True):
        if not _TestContext.same(is_, wanted, within):
            tolerance = "" if within is None else f" within {literal(ty.LREAL, within)}"
            return f"{literal(other.of, wanted)}{tolerance} in element {index}", literal(kind.of, is_)
    return "", ""


def _reason(error: BaseException) -> str:
    if not isinstance(error, FieldtwinError):
        return f"{type(error).__name__}: {error}"
    more = "".join(f"; {name} {text}" for name, text in (("expected", error.expected), ("got", error.got)) if text)
    return f"{error.message}{more}"


def _place(error: BaseException, unit: CompiledUnit, test: TranslatedTest) -> tuple[str, int]:
    """Return the innermost line of the source in which the error occurred; without one, that of the test."""
    return line_of_error(error, unit.files) or (test.pos.path, test.pos.line)
