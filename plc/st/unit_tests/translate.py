"""Translate TEST blocks into programs of the tree: an assertion, and an advance of the time, is a node.

A test calls ASSERT_TRUE(IN), ASSERT_FALSE(IN), ASSERT_EQ, ASSERT_NE, ASSERT_LT, ASSERT_LE, ASSERT_GT, ASSERT_GE
(IN, EXPECTED), ASSERT_NEAR(IN, EXPECTED, TOLERANCE), each with an optional text MESSAGE, and ADVANCE_TIME(BY).
Names that begin with 0 belong to this translation; no source can contain them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.errors import invalid
from fieldtwin.plc.st.syntax.walk import with_parts
from fieldtwin.plc.st.syntax.written import text_of
from fieldtwin.plc.st.unit_tests.assertions import COMPARISONS, AssertionText, TranslatedTest, assertion, bound

_PARAMETERS = {
    "ASSERT_TRUE": ("IN",),
    "ASSERT_FALSE": ("IN",),
    **dict.fromkeys(COMPARISONS, ("IN", "EXPECTED")),
    "ASSERT_NEAR": ("IN", "EXPECTED", "TOLERANCE"),
    "ADVANCE_TIME": ("BY",),
}
_EXPECTED = {
    "ASSERT_TRUE": "TRUE", "ASSERT_FALSE": "FALSE", "ASSERT_EQ": "", "ASSERT_NE": "not ", "ASSERT_LT": "less than ",
    "ASSERT_LE": "at most ", "ASSERT_GT": "more than ", "ASSERT_GE": "at least ", "ASSERT_NEAR": "",
}  # fmt: skip


def tests_as_programs(
    unit: t.SourceUnit, numbers: Iterator[int], errors: ErrorCollector
) -> tuple[t.SourceUnit, list[TranslatedTest]]:
    """Return `unit` with a PROGRAM for each of its tests, which are removed, and the tests. Errors are added to `errors`."""
    tests: list[TranslatedTest] = []
    programs: list[t.Pou] = []
    seen: dict[str, t.Pos] = {}
    for n, test in enumerate(unit.tests):
        if test.name in seen:
            errors.add(invalid(test.pos, f"a second test with the name {test.name!r}", expected="different names"))
        seen[test.name] = test.pos
        found = TranslatedTest(test.pos, test.name, f"0test_{n}", {})
        body = _Translation(found, numbers, errors).statements(test.body)
        programs.append(t.Pou(test.pos, "PROGRAM", found.program, None, _variables(test, errors), body))
        tests.append(found)
    return replace(unit, pous=(*unit.pous, *programs), tests=()), tests


def _variables(test: t.Test, errors: ErrorCollector) -> tuple[t.VarBlock, ...]:
    for block in test.blocks:
        if block.kind not in ("VAR", "VAR_TEMP", "VAR_EXTERNAL"):
            errors.add(invalid(block.pos, "the variables of a test", expected="VAR or VAR_EXTERNAL", got=block.kind))
    return test.blocks


class _Translation:
    """The translation of the statements of one test."""

    def __init__(self, test: TranslatedTest, numbers: Iterator[int], errors: ErrorCollector) -> None:
        self._test, self._numbers, self._errors = test, numbers, errors

    def statements(self, node: Any) -> Any:
        """Return a part of a body with assertions and advances as statements."""
        if not isinstance(node, tuple):
            return with_parts(node, self.statements)
        found: list[Any] = []
        for part in node:
            if isinstance(part, t.CallStatement) and self._is_of_tests(part.call):
                try:
                    found += self._statement(part.call)
                except FileInvalid as e:
                    self._errors.add(e)
            else:
                found.append(self.statements(part))
        return tuple(found)

    def _is_of_tests(self, call: t.Call) -> bool:
        name = call.ref.name.upper()
        return not call.ref.selectors and (name in _PARAMETERS or name.startswith("ASSERT_"))

    def _statement(self, call: t.Call) -> list[t.Statement]:
        name = call.ref.name.upper()
        if name not in _PARAMETERS:
            known = list(_PARAMETERS)
            raise invalid(
                call.pos, f"{call.ref.name} is no assertion", ", ".join(known), hint=did_you_mean(name, known)
            )
        given, message = self._arguments(call, name)
        if name == "ADVANCE_TIME":
            return [t.Advance(call.pos, given[0])]
        number = next(self._numbers)
        said = t.Call(call.pos, call.ref, tuple(t.Argument(one.pos, "", one) for one in given))
        text = AssertionText(call.pos, text_of(said), _EXPECTED[name], message)
        self._test.assertions[number] = text
        return assertion(name, call.pos, number, given)

    def _arguments(self, call: t.Call, name: str) -> tuple[list[t.Expr], str]:
        """Return the arguments in the order of the parameters, and the text of MESSAGE, which comes last."""
        found = bound(call, (*_PARAMETERS[name], "MESSAGE") if name != "ADVANCE_TIME" else _PARAMETERS[name])
        message = found.pop("MESSAGE", None)
        if message is not None and not (isinstance(message, t.Literal) and message.kind == "STRING_LITERAL"):
            raise invalid(message.pos, f"MESSAGE of {name}", expected="a text in quotation marks", got=text_of(message))
        text = message.text[1:-1] if isinstance(message, t.Literal) else ""
        return [found[one] for one in _PARAMETERS[name]], text
