"""Parse Structured Text to a tree, with lark (LALR). An error has line, column, and the tokens that were expected."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from lark.exceptions import UnexpectedInput, VisitError

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.plc.st.dialects import STANDARD, Dialect, StWarning
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.grammar import invalid, parser
from fieldtwin.plc.st.syntax.rules.base import Bad
from fieldtwin.plc.st.syntax.rules.charts import ChartRules
from fieldtwin.plc.st.syntax.rules.declarations import DeclarationRules
from fieldtwin.plc.st.syntax.rules.expressions import ExpressionRules
from fieldtwin.plc.st.syntax.rules.statements import StatementRules
from fieldtwin.plc.st.syntax.rules.units import UnitRules
from fieldtwin.plc.st.syntax.source import blanked, shortened

_ENDS = re.compile(
    r"""'(?:[^$'\n]|\$.)*'|"(?:[^$"\n]|\$.)*"|\S\s*\Z
    |\b(?P<end>END_(?:PROGRAM|FUNCTION_BLOCK|FUNCTION|CLASS|INTERFACE|TYPE|CONFIGURATION|TEST))\b(?!\s*(?:METHOD|PROPERTY)\b)""",
    re.IGNORECASE | re.VERBOSE,
)
"""The ends of POUs and TYPE blocks, and the end of the text. Strings are skipped. Methods after a POU belong to it."""

_NAMESPACE = re.compile(r"\bEND_NAMESPACE\b", re.IGNORECASE)
_OF_NAMESPACES = re.compile(
    r"""'(?:[^$'\n]|\$.)*'|"(?:[^$"\n]|\$.)*"
    |\b(?P<words>NAMESPACE\s+(?:INTERNAL\s+)?[A-Za-z_][\w.]*|END_NAMESPACE\b|USING\s[^;]*;)""",
    re.IGNORECASE | re.VERBOSE,
)
"""The words of namespaces around and in POUs. Strings are skipped."""

_DECLARED = re.compile(
    r"\b(?:PROGRAM|FUNCTION_BLOCK|FUNCTION|CLASS|INTERFACE|TYPE)\s+(?:(?:PUBLIC|INTERNAL|ABSTRACT|FINAL)\s+)*([A-Za-z_]\w*)",
    re.IGNORECASE,
)


class _Build(UnitRules, DeclarationRules, ChartRules, StatementRules, ExpressionRules):
    """The rules of the whole grammar."""


def parse(text: str, path: str = "", dialect: Dialect = STANDARD, before: tuple[int, int] = (0, 0)) -> t.SourceUnit:
    """Return the tree of `text`. Raises `FileInvalid` with line and column.

    `before`: for a part of a file, the lines before it, and the columns before it in its first line. Positions in the tree are
    those in the file; an error has its position in the part.
    """
    warnings: list[StWarning] = []
    text = blanked(text, path, dialect, warnings)
    try:
        unit: t.SourceUnit = _Build(path, before).transform(parser().parse(text, start="start"))
        return replace(unit, warnings=tuple(warnings))
    except UnexpectedInput as e:
        raise invalid(e, text, path) from e
    except VisitError as e:
        if not isinstance(e.orig_exc, Bad):
            raise
        raise e.orig_exc.at(path) from e


def parse_expression(text: str, at: t.Pos) -> t.Expr:
    """Return the tree of one expression of a drawing; all its parts are at the element `at`. Raises `FileInvalid`."""
    return _parsed(text, at, "expression")  # type: ignore[no-any-return]


def parse_statements(text: str, at: t.Pos) -> tuple[t.Statement, ...]:
    """Return the statements in an element `at` of a drawing, as `parse_expression` does."""
    return _parsed(text, at, "body")  # type: ignore[no-any-return]


def _parsed(text: str, at: t.Pos, start: str) -> Any:
    try:
        text = blanked(text, at.path)
        return _Build(at.path, at=at).transform(parser().parse(text, start=start))
    except UnexpectedInput as e:
        error = invalid(e, text, at.path)
    except VisitError as e:
        if not isinstance(e.orig_exc, Bad):
            raise
        error = e.orig_exc.at(at.path)
    except FileInvalid as e:
        error = e
    raise FileInvalid(
        f"{at.element}: {shortened(text.strip())}: {error.message}",
        path=at.path, line=at.line, column=at.column, expected=error.expected, got=error.got,
    )  # fmt: skip


def parse_all(text: str, path: str = "", dialect: Dialect = STANDARD) -> t.SourceUnit:
    """Return the tree of `text`. Raises `FileInvalid` for its first error, with the first errors of the other POUs and types.

    A parser cannot go on after an error. So after one, each POU and each TYPE block is parsed alone, without its namespace.
    """
    try:
        return parse(text, path, dialect)
    except FileInvalid as whole:
        try:
            blank = blanked(text, path, dialect)
        except FileInvalid:  # a comment or a literal does not end
            raise whole from None
        found = ErrorCollector()
        for part, line, column in _parts(_OF_NAMESPACES.sub(_spaces, blank)):
            try:
                parse(part, path)
            except FileInvalid as e:
                found.add(_moved(e, line, column))
                if len(found.errors) > FileInvalid.MAX_OTHERS:
                    break
        found.raise_all()
        raise


def parse_parts(
    text: str, path: str = "", dialect: Dialect = STANDARD
) -> Iterator[tuple[t.SourceUnit, tuple[str, ...], FileInvalid | None]]:
    """Parse each POU and TYPE block of `text` alone. Yield its tree; or an empty tree, the names that it declares, and its error.

    Raises `FileInvalid` if a comment or a pragma makes the whole text unusable.
    """
    for part, line, column in _parts(blanked(text, path, dialect)):
        try:
            yield parse(part, path, dialect, (line, column)), (), None
        except FileInvalid as e:
            yield t.SourceUnit(), tuple(found[1] for found in _DECLARED.finditer(part)), _moved(e, line, column)


def _parts(text: str) -> Iterator[tuple[str, int, int]]:
    """Return each POU and TYPE block of a text without comments, the lines before it, and the columns before it in its line."""
    begin = line = line_begin = 0
    if _NAMESPACE.search(text):  # its POUs cannot be parsed without it
        yield text, 0, 0
        return
    for found in _ENDS.finditer(text):
        end = found.end()
        if found["end"] is None and end < len(text):
            continue
        yield text[begin:end], line, begin - line_begin
        line += text.count("\n", begin, end)
        line_begin = max(line_begin, text.rfind("\n", begin, end) + 1)
        begin = end


def _spaces(found: re.Match[str]) -> str:
    """Return spaces and line ends in place of the words of a namespace; strings as they are."""
    return found[0] if found["words"] is None else re.sub(r"[^\n]", " ", found[0])


def _moved(error: FileInvalid, lines: int, columns: int) -> FileInvalid:
    """Return an error in a part of a text with its position in the whole text."""
    return FileInvalid(
        error.message,
        path=error.path,
        line=error.line + lines,
        column=error.column + (columns if error.line == 1 else 0),
        expected=error.expected,
        got=error.got,
        hint=error.hint,
    )


__all__ = ["parse", "parse_all", "parse_parts"]
