"""The text of a Structured Text file before it is parsed: comments and pragmas become blanks, line for line, column for
column.

Comments may be nested (IEC 61131-3, 6.1.5). This module also refuses files and literals that are implausibly long.
"""

from __future__ import annotations

import re

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.dialects import STANDARD, Dialect, StWarning

MAX_CHARACTERS = 1_000_000
"""The longest file, in characters: some 30,000 lines."""
MAX_NAME = 255
MAX_LITERAL = 4 * 65_535
MAX_SHOWN = 60

_CONDITIONAL = re.compile(r"\{\s*(IF|ELSIF|ELSE|END_IF|DEFINE|UNDEFINE)\b", re.IGNORECASE)
_HARMLESS = re.compile(r"\{\s*(attribute|region|endregion|text|info|warning|error)\b", re.IGNORECASE)
"""Pragmas of CODESYS without effect on what a program computes; `qualified_only` is read by `project`."""
_MARKS = re.compile(r"""\(\*|\*\)|/\*|\*/|//[^\n]*|'|"|\{""")
_CLOSING = {"(*": "*)", "/*": "*/"}
_ENDS = {quote: re.compile(rf"[{quote}\n]|\$.", re.DOTALL) for quote in "'\""}
_NOT_A_LINE = re.compile(r"[^\n]")


def shortened(text: str) -> str:
    """Return `text` as an error message shows it: if it is long, only its beginning and its length."""
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}... ({len(text)} characters)"


def blanked(text: str, path: str = "", dialect: Dialect = STANDARD, warnings: list[StWarning] | None = None) -> str:
    """Return `text` without a byte order mark, comments and pragmas, and with line feeds as line ends. Raises
    `FileInvalid`.

    Warnings about skipped pragmas are added to `warnings`.
    """
    if len(text) > MAX_CHARACTERS:
        raise FileInvalid(
            "too long for a program", path=path, line=1, column=1, expected=f"at most {MAX_CHARACTERS} characters"
        )
    text = text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")
    out: list[str] = []
    at = 0
    while found := _MARKS.search(text, at):
        start, mark = found.start(), found.group()
        if mark in _ENDS:
            end = _end_of_literal(text, found.end(), mark)
            if end - start > MAX_LITERAL:
                raise _error(text, start, "a literal that is too long", path)
            out.append(text[at:end])
        elif mark in ("*)", "*/"):
            end = found.end()  # the parser reports this error
            out.append(text[at:end])
        else:
            if mark == "{":
                end = _end_of_pragma(text, start, path, dialect, warnings)
            else:
                end = found.end() if mark.startswith("//") else _end_of_comment(text, found, path)
            out.append(text[at:start])
            out.append(_NOT_A_LINE.sub(" ", text[start:end]))
        at = end
    out.append(text[at:])
    return "".join(out)


def _end_of_literal(text: str, at: int, quote: str) -> int:
    """Return the position after the closing quote, or the end of the line if there is none; the parser reports that
    error."""
    while found := _ENDS[quote].search(text, at):
        if not found.group().startswith("$"):
            return found.end() if found.group() == quote else found.start()
        at = found.end()
    return len(text)


def _end_of_pragma(text: str, start: int, path: str, dialect: Dialect, warnings: list[StWarning] | None) -> int:
    """Return the position after a pragma, which is skipped. Raises `FileInvalid` for one that must not be skipped."""
    mark = "}}" if text.startswith("{{", start) else "}"
    at = text.find(mark, start)
    if at < 0:
        raise _error(text, start, "a pragma that does not end", path)
    end = at + len(mark)
    pragma = text[start:end]
    if _CONDITIONAL.match(pragma):
        raise _error(text, start, "conditional compilation is not supported", path, shortened(pragma))
    if mark == "}}" and dialect.name != "matiec":
        raise _error(
            text, start, "program text in another language is not supported", path, shortened(pragma),
            hint="the dialect matiec skips it",
        )  # fmt: skip
    if warnings is not None and "ST007" in dialect.accepts and not (dialect.vendor and _HARMLESS.match(pragma)):
        line, column = _place(text, start)
        shown = shortened(" ".join(pragma.split()))
        warnings.append(StWarning("ST007", f"this pragma is skipped: {shown}", path, line, column))
    return end


def _end_of_comment(text: str, opening: re.Match[str], path: str) -> int:
    mark, deep, at = opening.group(), 1, opening.end()
    marks = re.compile(f"{re.escape(mark)}|{re.escape(_CLOSING[mark])}")
    while found := marks.search(text, at):
        deep += 1 if found.group() == mark else -1
        at = found.end()
        if not deep:
            return at
    raise _error(text, opening.start(), "a comment that does not end", path)


def _place(text: str, at: int) -> tuple[int, int]:
    return text.count("\n", 0, at) + 1, at - text.rfind("\n", 0, at)


def _error(text: str, at: int, message: str, path: str, got: str = "", hint: str = "") -> FileInvalid:
    line, column = _place(text, at)
    return FileInvalid(message, path=path, line=line, column=column, got=got, hint=hint)
