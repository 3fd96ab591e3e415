"""Test suites in the form of TcUnit, the library of unit tests for TwinCAT: a FUNCTION_BLOCK that extends FB_TestSuite.

Its body runs once in each cycle, and calls methods, each of which is a test: TEST('name'), assertions, TEST_FINISHED(). The
library itself is not needed. The names and the order of the parameters are those of its documentation (https://tcunit.org).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.errors import invalid
from fieldtwin.plc.st.syntax.walk import nodes, with_parts
from fieldtwin.plc.st.syntax.written import text_of
from fieldtwin.plc.st.tcunit_suites import is_suite
from fieldtwin.plc.st.unit_tests.assertions import ARRAYS, AssertionText, TranslatedTest, assertion, bound

_EQUAL, _TRUE, _FALSE = "ASSERTEQUALS", "ASSERTTRUE", "ASSERTFALSE"
_WITH_DELTA = ("ASSERTEQUALS_REAL", "ASSERTEQUALS_LREAL")
_ARRAYS = re.compile(r"ASSERTARRAY(2D|3D)?EQUALS_\w+$")


def suites_as_programs(
    unit: t.SourceUnit, numbers: Iterator[int], errors: ErrorCollector
) -> tuple[t.SourceUnit, list[TranslatedTest]]:
    """Return `unit` with a PROGRAM for each suite, and the tests of all suites. Errors in suites are added to `errors`."""
    tests: list[TranslatedTest] = []
    pous: list[t.Pou] = []
    for n, pou in enumerate(unit.pous):
        if not is_suite(pou):
            pous.append(pou)
            continue
        suite = _Suite(pou, f"0suite_{n}", numbers, errors)
        pous += [suite.block(), suite.program()]
        tests += suite.tests.values()
    return replace(unit, pous=tuple(pous)), tests


@dataclass
class _Suite:
    """The translation of one suite."""

    pou: t.Pou
    name: str
    numbers: Iterator[int]
    errors: ErrorCollector

    def __post_init__(self) -> None:
        self.tests: dict[str, TranslatedTest] = {}

    def block(self) -> t.Pou:
        """Return the suite as an ordinary function block."""
        methods = tuple(replace(one, body=self._body(one.body)) for one in self.pou.methods)
        return replace(self.pou, extends=(), body=self._body(self.pou.body), methods=methods)

    def program(self) -> t.Pou:
        """Return the program that calls the suite."""
        pos = self.pou.pos
        variable = t.VarDecl(pos, "0suite", t.NamedType(pos, self.pou.name), None)
        call = t.CallStatement(pos, t.Call(pos, t.Ref(pos, "0suite")))
        return t.Pou(pos, "PROGRAM", self.name, None, (t.VarBlock(pos, "VAR", frozenset(), (variable,)),), (call,))

    def _body(self, body: tuple[t.Statement, ...]) -> tuple[t.Statement, ...]:
        current: list[TranslatedTest] = []
        found: tuple[t.Statement, ...] = self._statements(body, current)
        return found

    def _statements(self, node: Any, current: list[TranslatedTest]) -> Any:
        """Return a part of a body. The only item of `current` is the test to which the next statements belong."""
        if not isinstance(node, tuple):
            return with_parts(node, lambda part: self._statements(part, current))
        found: list[Any] = []
        for part in node:
            if isinstance(part, t.If) and any(_is_ordered(one) for one in nodes(part.branches[0][0])):
                try:
                    found += self._ordered(part)
                except FileInvalid as e:
                    self.errors.add(e)
                continue
            name = _called(part)
            if not name:
                found.append(self._statements(part, current))
                continue
            try:
                found += self._statement(part.call, name, current)
            except FileInvalid as e:
                self.errors.add(e)
        return tuple(found)

    def _ordered(self, statement: t.If) -> list[t.Statement]:
        """Return an ordered test: ``IF TEST_ORDERED('name') THEN ... END_IF``."""
        (condition, body), *more = statement.branches
        call: t.Call = next(one for one in nodes(condition) if _is_ordered(one))
        if more or statement.otherwise or not _is_ordered(condition):
            raise invalid(call.pos, call.ref.name, expected="IF TEST_ORDERED('name') THEN ... END_IF")
        test = self._begin(call)
        return [t.Ordered(statement.pos, test.number, self._statements(body, [test]))]

    def _statement(self, call: t.Call, name: str, current: list[TranslatedTest]) -> list[t.Statement]:
        if name == "TEST":
            current[:] = [self._begin(call)]
            return []
        if name == "TEST_FINISHED_NAMED":
            title = _literal(call)
            if title not in self.tests:
                raise invalid(call.pos, f"a test {title!r} has not begun", expected="TEST('name') before it")
            return [t.Finished(call.pos, self.tests[title].number)]
        if not current:
            raise invalid(call.pos, f"{call.ref.name} before a test has begun", expected="TEST('name') before it")
        if name == "TEST_FINISHED":
            return [t.Finished(call.pos, current[0].number)]
        return self._assertion(call, name, current[0])

    def _begin(self, call: t.Call) -> TranslatedTest:
        title = _literal(call)
        return self.tests.setdefault(
            title, TranslatedTest(call.pos, title, self.name, {}, next(self.numbers), cyclic=True)
        )

    def _assertion(self, call: t.Call, name: str, test: TranslatedTest) -> list[t.Statement]:
        given, message = _arguments(call, _parameters(call, name))
        number = next(self.numbers)
        kind = {_TRUE: "ASSERT_TRUE", _FALSE: "ASSERT_FALSE"}.get(
            name, ARRAYS if _ARRAYS.match(name) else "ASSERT_NEAR" if len(given) > 2 else "ASSERT_EQ"
        )
        expected = {_TRUE: "TRUE", _FALSE: "FALSE"}.get(name, "")
        said = replace(call, arguments=tuple(one for one in call.arguments if one.value in given))
        test.assertions[number] = AssertionText(call.pos, text_of(said), expected, message)
        return assertion(kind, call.pos, number, given, test.number)


def _is_ordered(node: Any) -> bool:
    return isinstance(node, t.Call) and node.ref.name.upper() == "TEST_ORDERED" and not node.ref.selectors


def _called(statement: Any) -> str:
    """Return the name in capitals of the method of FB_TestSuite that a statement calls; "" for every other statement."""
    if not isinstance(statement, t.CallStatement):
        return ""
    ref = statement.call.ref
    name = ref.name.upper()
    if name.rstrip("^") in ("THIS", "SUPER") and ref.selectors and isinstance(ref.selectors[-1], t.Member):
        name = ref.selectors[-1].name.upper()
    elif ref.selectors:
        return ""
    return name if name in ("TEST", "TEST_FINISHED", "TEST_FINISHED_NAMED") or name.startswith("ASSERT") else ""


def _parameters(call: t.Call, name: str) -> tuple[str, ...]:
    """Return the parameters of an assertion, the actual value first, as fieldtwin shows them."""
    if name in (_TRUE, _FALSE):
        return ("CONDITION",)
    if name in _WITH_DELTA:
        return ("EXPECTED", "ACTUAL", "DELTA")
    if name == _EQUAL or (name.startswith(f"{_EQUAL}_") and "ARRAY" not in name):
        return ("EXPECTED", "ACTUAL")
    if _ARRAYS.match(name):
        delta = ("DELTA",) if name.endswith("REAL") else ()
        return ("EXPECTEDS", "ACTUALS", *delta)
    known = "AssertTrue, AssertFalse, AssertEquals, AssertEquals_INT, AssertArrayEquals_INT, and those of other types"
    raise invalid(call.pos, f"{call.ref.name} is not supported", expected=known)


def _arguments(call: t.Call, parameters: tuple[str, ...]) -> tuple[list[t.Expr], str]:
    """Return the actual value, the expected one and the tolerance, as far as the assertion has them, and the text of Message."""
    found = bound(call, (*parameters, "MESSAGE"))
    message = found.get("MESSAGE")
    text = message.text[1:-1] if isinstance(message, t.Literal) else ""
    order = [
        name for name in ("CONDITION", "ACTUAL", "ACTUALS", "EXPECTED", "EXPECTEDS", "DELTA") if name in parameters
    ]
    return [found[name] for name in order], text


def _literal(call: t.Call) -> str:
    """Return the name of a test."""
    value = call.arguments[0].value if len(call.arguments) == 1 else None
    if not isinstance(value, t.Literal) or value.kind != "STRING_LITERAL":
        raise invalid(call.pos, f"the name in {call.ref.name}", expected="one text in quotation marks")
    return value.text[1:-1]
