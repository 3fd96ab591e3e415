"""Runs a file of rusty's tests/lit: Structured Text that prints with `printf`, and the expected output in comments.

LLVM's FileCheck defines the comments: the text of ``CHECK:`` follows somewhere after the previous match, the text of
``CHECK-NEXT:`` in the next line, and that of ``CHECK-NOT:`` does not occur before the next match.
"""

from __future__ import annotations

import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from corpus_rust import NotRead

from fieldtwin.cli.plc.checking import checked
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st import values
from fieldtwin.plc.st.compiler.arguments import Formals
from fieldtwin.plc.st.compiler.functions.library import Standard
from fieldtwin.plc.st.compiler.functions.standard import FUNCTIONS
from fieldtwin.plc.st.compiler.scope import Compiling, Value
from fieldtwin.plc.st.dialects import Dialect
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.unit_tests.run import TestResult
from fieldtwin.plc.st.unit_tests.suite import load_suite

_CHECK = re.compile(r"//\s*CHECK(-[A-Z]+)?:(.*)")
_CONVERSION = re.compile(r"%([-+ 0#]*\d*(?:\.\d+)?)(hh|h|ll|l|z|j)?([diuxXfFeEgGscp%])")
_EXTERNAL = re.compile(r"(?is)\{external\}\s*FUNCTION\s+printf\b.*?END_FUNCTION")
_WIDTHS = {"hh": 8, "h": 16, "": 32}
_KINDS = ("", "-NEXT", "-SAME", "-NOT", "-EMPTY")
_MAIN = "TEST 'main'\n  main();\n  ASSERT_TRUE(TRUE);\nEND_TEST\n"
_printed: list[str] = []


def lit_result(text: str, dialect: Dialect) -> str:
    """Return the first difference of a file's output from the expected one, or "" if both agree.

    Raises `NotRead` if the file is not executed by its own test, or has a comment that is not known.
    """
    if not re.search(r"//\s*RUN:.*%RUN", text) or "%COMPILE %s" not in text:
        raise NotRead("its test does not execute it")
    checks = [(kind or "", expected.strip()) for kind, expected in _CHECK.findall(text)]
    if unknown := [kind for kind, _ in checks if kind not in _KINDS]:
        raise NotRead(f"a comment CHECK{unknown[0]}")
    if not checks:
        raise NotRead("no comment CHECK")
    _printed.clear()
    try:
        (result,) = executed(_EXTERNAL.sub("", text), _MAIN, dialect)
    except FileInvalid as e:
        return shown(e)
    return result.error or difference(checks, "".join(_printed))


def shown(error: FileInvalid) -> str:
    """Return the first error of a compilation with its line."""
    more = "".join(f"; {name} {text}" for name, text in (("expected", error.expected), ("got", error.got)) if text)
    return f"line {error.line}: {error.message}{more}"


def executed(text: str, tests: str, dialect: Dialect) -> list[TestResult]:
    """Compile `text` and run the TEST blocks `tests` with it. The program may call `printf`.

    Raises `FileInvalid` for the first error, which is one of `text` before one of `tests`.
    """
    FUNCTIONS.by_name["PRINTF"] = Standard(Formals(("FORMAT",), repeats="ARG"), _write)
    values.corpus_printf = _printf  # type: ignore[attr-defined]  # compiled code calls it by this name
    with TemporaryDirectory() as folder:
        (Path(folder) / "source.st").write_text(text, encoding="utf-8")
        made = Path(folder) / "source.test.st"
        made.write_text(tests, encoding="utf-8")
        try:
            return list(load_suite(made, dialect, coverage=False).run())
        except FileInvalid as e:
            errors = checked({(Path(folder) / "source.st", dialect, ()): {}}, frozenset()).errors
            raise (errors[0] if errors else e) from e


def _write(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    """Write a call of `printf`. An argument REF(text) is the text itself: C gets the address of its first character."""
    codes = []
    for expr in given:
        inner = expr
        while isinstance(inner, t.Call) and inner.ref.name.upper() in ("REF", "ADR") and len(inner.arguments) == 1:
            value = inner.arguments[0].value
            assert value is not None
            inner = value
        codes.append(x.value(inner).code)
    return Value(f"_v.corpus_printf({', '.join(codes)})", ty.DINT)


def _printf(text: str, *arguments: Any) -> int:
    """Print as printf of C does with numbers of the given sizes. Return the number of characters."""
    left = list(arguments)

    def one(match: re.Match[str]) -> str:
        flags, size, letter = match[1], match[2] or "", match[3]
        if letter == "%":
            return "%"
        if not left:
            raise values.LogicError("printf has more conversions than arguments", expected=match[0])
        value = left.pop(0)
        if letter in "diuxX":
            if not isinstance(value, int):
                raise values.LogicError(
                    "an argument of printf", expected=f"a whole number for {match[0]}", got=str(value)
                )
            bits = _WIDTHS.get(size, 64)
            value = int(value) & (1 << bits) - 1
            if letter in "di" and value >> (bits - 1):
                value -= 1 << bits
        elif letter in "fFeEgG" and not isinstance(value, float):
            raise values.LogicError("an argument of printf", expected=f"a REAL for {match[0]}", got=str(value))
        return f"%{flags}{letter.replace('u', 'd')}" % value

    made = _CONVERSION.sub(one, text).replace("\r\n", "\n")
    _printed.append(made)
    return len(made)


def difference(checks: list[tuple[str, str]], output: str) -> str:
    """Return the first check that the output does not have; "" if it has all of them."""
    at, forbidden = 0, []
    for kind, expected in checks:
        pattern = _pattern(expected)
        if kind == "-NOT":
            forbidden.append((expected, pattern))
            continue
        if kind == "-EMPTY":
            pattern, kind = re.compile(r"(?m)^$"), "-NEXT"
        found = pattern.search(output, at)
        lines = output[at : found.start()].count("\n") if found else 0
        wanted = {"-NEXT": 1, "-SAME": 0}.get(kind)
        if found is None or (wanted is not None and lines != wanted):
            rest = output[at:].strip("\n").split("\n")
            return f"expected {expected!r}; got {' | '.join(rest[:2])[:80]!r}"
        if found_not := _forbidden(forbidden, output[at : found.start()]):
            return found_not
        at, forbidden = found.end(), []
    return _forbidden(forbidden, output[at:])


def _forbidden(forbidden: list[tuple[str, re.Pattern[str]]], output: str) -> str:
    return next((f"expected no {text!r}" for text, pattern in forbidden if pattern.search(output)), "")


def _pattern(expected: str) -> re.Pattern[str]:
    """Return the regular expression of a check: ``{{...}}`` is one, and blanks match any number of blanks."""
    parts = re.split(r"\{\{(.*?)\}\}", expected)
    return re.compile(
        "".join(
            f"(?:{part})" if n % 2 else re.sub(r"(?:\\ |\\\t)+", r"[ \\t]+", re.escape(part))
            for n, part in enumerate(parts)
        )
    )
