"""The text of a Structured Text file before it is parsed: comments and pragmas become blanks, line for line, column for
column.

Comments may be nested (IEC 61131-3, 6.1.5). This module also refuses files and literals that are implausibly long.
"""

from __future__ import annotations

import re

from fieldtwin.gateway.core.errors import FileInvalid

MAX_CHARACTERS = 1_000_000
"""The longest file, in characters: some 30,000 lines."""
MAX_NAME = 255
MAX_LITERAL = 4 * 65_535
MAX_SHOWN = 60

_MARKS = re.compile(r"""\(\*|\*\)|/\*|\*/|//[^\n]*|'|"|\{""")
_CLOSING = {"(*": "*)", "/*": "*/"}
_ENDS = {quote: re.compile(rf"[{quote}\n]|\$.", re.DOTALL) for quote in "'\""}
_NOT_A_LINE = re.compile(r"[^\n]")


def shortened(text: str) -> str:
    """Return `text` as an error message shows it: if it is long, only its beginning and its length."""
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}... ({len(text)} characters)"


def blanked(text: str, path: str = "") -> str:
    """Return `text` without a byte order mark, comments and pragmas, and with line feeds as line ends. Raises
    `FileInvalid`."""
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


def _end_of_comment(text: str, opening: re.Match[str], path: str) -> int:
    if opening.group() == "{":
        end = text.find("}", opening.end())
        if end < 0:
            raise _error(text, opening.start(), "a pragma that does not end", path)
        return end + 1
    mark, deep, at = opening.group(), 1, opening.end()
    marks = re.compile(f"{re.escape(mark)}|{re.escape(_CLOSING[mark])}")
    while found := marks.search(text, at):
        deep += 1 if found.group() == mark else -1
        at = found.end()
        if not deep:
            return at
    raise _error(text, opening.start(), "a comment that does not end", path)


def _error(text: str, at: int, message: str, path: str) -> FileInvalid:
    line = text.count("\n", 0, at) + 1
    return FileInvalid(message, path=path, line=line, column=at - text.rfind("\n", 0, at))
