"""The text of a Structured Text file before it is parsed: comments and pragmas become blanks, line for line, column for
column.

Comments may be nested (IEC 61131-3, 6.1.5). Parts whose condition is false become blanks too (`conditional`).
This module also refuses files and literals that are implausibly long.
"""

from __future__ import annotations

import re

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.dialects import STANDARD, Dialect, StWarning
from fieldtwin.plc.st.syntax.conditional import Conditions, Wrong, is_directive
from fieldtwin.plc.st.syntax.pragmas import is_silent

MAX_CHARACTERS = 1_000_000
"""The longest file, in characters: some 30,000 lines."""
MAX_NAME = 255
MAX_LITERAL = 4 * 65_535
MAX_SHOWN = 60

_PACKED = re.compile(
    r"\{\s*attribute\s+'pack_mode'\s*:=\s*'[01248]'\s*\}(?=(?:\s|\{[^}]*\}|//[^\n]*\n|\(\*.*?\*\))*TYPE\b)",
    re.IGNORECASE | re.DOTALL,
)
"""The pragma of CODESYS that states how the members of the type after it are packed. It is a token of the grammar."""
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
    conditions = Conditions()
    while found := _MARKS.search(text, at):
        start, mark = found.start(), found.group()
        if not conditions.active:
            text = text[:at] + _NOT_A_LINE.sub(" ", text[at:start]) + text[start:]
        if mark in _ENDS:
            end = _end_of_literal(text, found.end(), mark, lines=dialect.vendor and conditions.active)
            if end is None and not conditions.active:
                end = found.end()
            if end is None:
                raise _error(
                    text, start, "a string that does not end", path, shortened(text[start:].partition("\n")[0])
                )
            if end - start > MAX_LITERAL:
                raise _error(text, start, "a literal that is too long", path)
            literal = text[at:end]
            out.append(literal if conditions.active else _NOT_A_LINE.sub(" ", literal))
        elif mark in ("*)", "*/"):
            end = found.end()  # the parser reports this error
            out.append(text[at:end])
        else:
            if mark == "{":
                end = _end_of_pragma(text, start, path, dialect, warnings, conditions)
            else:
                end = found.end() if mark.startswith("//") else _end_of_comment(text, found, path)
            out.append(text[at:start])
            packed = dialect.vendor and conditions.active and _PACKED.match(text, start)
            out.append(text[start:end] if packed else _NOT_A_LINE.sub(" ", text[start:end]))
        at = end
    if conditions.parts:
        raise _error(text, conditions.parts[-1].at, "an {IF} that does not end", path, hint="write {END_IF}")
    out.append(text[at:])
    return "".join(out)


def _end_of_literal(text: str, at: int, quote: str, *, lines: bool) -> int | None:
    """Return the position after the closing quote; None if there is none in the text (`lines`) or in the line."""
    while found := _ENDS[quote].search(text, at):
        if found.group() == quote:
            return found.end()
        if found.group() == "\n" and not lines:
            return None
        at = found.end()
    return None


def _end_of_pragma(
    text: str, start: int, path: str, dialect: Dialect, warnings: list[StWarning] | None, conditions: Conditions
) -> int:
    """Return the position after a pragma, which is skipped. Raises `FileInvalid` for one that must not be skipped."""
    mark = "}}" if text.startswith("{{", start) else "}"
    at = text.find(mark, start)
    if at < 0:
        raise _error(text, start, "a pragma that does not end", path)
    end = at + len(mark)
    pragma = text[start:end]
    if is_directive(pragma):
        _follow(text, start, pragma, path, dialect, conditions)
        return end
    if mark == "}}" and dialect.name != "matiec":
        raise _error(
            text, start, "program text in another language is not supported", path, shortened(pragma),
            hint="the dialect matiec skips it",
        )  # fmt: skip
    if warnings is not None and "ST007" in dialect.accepts and not (dialect.vendor and is_silent(pragma)):
        line, column = _place(text, start)
        shown = shortened(" ".join(pragma.split()))
        warnings.append(StWarning("ST007", f"this pragma is skipped: {shown}", path, line, column))
    return end


def _follow(text: str, start: int, pragma: str, path: str, dialect: Dialect, conditions: Conditions) -> None:
    """Follow a directive of conditional compilation. Raises `FileInvalid` for one that is wrong or not in the dialect."""
    if not dialect.vendor:
        hint = "the dialects codesys and twincat accept it"
        raise _error(text, start, "conditional compilation is not in this dialect", path, shortened(pragma), hint)
    try:
        conditions.read(pragma, start)
    except Wrong as e:
        raise _error(
            text, start, str(e), path, shortened(pragma), f"expected {e.expected}" if e.expected else ""
        ) from e


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
