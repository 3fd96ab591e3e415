"""The parser of the grammar, and the errors of texts that the grammar does not accept."""

from __future__ import annotations

import re
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from lark import Lark, UnexpectedCharacters, UnexpectedEOF, UnexpectedToken
from lark.exceptions import UnexpectedInput
from lark.lexer import PatternStr

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.syntax.parse_tables import parser_with_tables, place_of
from fieldtwin.plc.st.syntax.source import shortened

MAX_EXPECTED = 8
"""How many of the expected tokens an error names."""

_UNSUPPORTED = {
    word: construct
    for construct, words in {
        "labels and jumps": "JMP",
        "exceptions (__TRY, __CATCH)": "__TRY __CATCH __FINALLY __ENDTRY",
        "bodies in instruction list (IL)": "LD LDN ST STN CAL CALC CALCN JMPC JMPCN RETC RETCN ANDN ORN XORN",
    }.items()
    for word in words.split()
}
"""The words of constructs that other compilers know, by which an error names the construct."""

_UNNAMED = re.compile(r"(?::|\bOF\b|\bTO\b|\bREF_TO\b)\s*(?P<what>STRUCT|UNION)\s+\Z", re.IGNORECASE)
"""The text before the first member of a structure or union in the declaration of a variable."""
_LABEL = re.compile(r"(\A|;|\b(END_\w+|THEN|ELSE|DO|REPEAT))\s*[A-Za-z_]\w*\s*\Z", re.IGNORECASE)
"""The text before the colon of a label."""
_READABLE = {
    "NAME": "a name", "CASE_NAME": "a name", "INTEGER": "a number", "REAL": "a number", "BASED": "a number", "TYPED": "a number",
    "DURATION": "a duration", "DATE": "a date", "TIME_OF_DAY": "a time of day", "DATE_AND_TIME": "a date",
    "STRING_LITERAL": "a string", "WSTRING_LITERAL": "a string", "ENUM_REF": "a name", "VAR_KIND": "VAR", "SEMICOLON": ";",
    "COLON": ":", "COMMA": ",", "DOT": ".", "LPAR": "(", "RPAR": ")", "LSQB": "[", "RSQB": "]", "SIGN": "+ or -",
    "FACTOR": "* or /", "ORDER": "<", "EQUALITY": "=", "POWER": "**", "$END": "the end of the file", "DIRECT": "an address",
    "STRING_TYPE": "STRING", "MESSAGES": "MESSAGES", "QUALIFIER": "RETAIN or CONSTANT", "SET_ASSIGN": "S=",
    "METHOD": "METHOD", "PROPERTY": "PROPERTY", "GET": "GET", "SET": "SET", "MODIFIER": "PUBLIC", "OWN": "THIS^",
    "USING": "USING", "UNION": "UNION", "PACKED": "TYPE",
    "PARTIAL": "%X0", "TYPED_TEXT": "a string", "POINTER": "POINTER TO", "REFERENCE": "REFERENCE TO", "_REF_ASSIGN": "REF=",
}  # fmt: skip


@cache
def parser() -> Lark:
    """Return the parser, with the rules `start`, `expression` and `body` as its starts."""
    grammar = resources.files("fieldtwin.plc.st.syntax").joinpath("grammar.lark").read_text(encoding="utf-8")
    options = {
        "start": ["start", "expression", "body"], "parser": "lalr", "propagate_positions": True, "maybe_placeholders": False,
        "g_regex_flags": re.ASCII,
    }  # fmt: skip
    place = place_of(Path(__file__).with_name("grammar.lark"))
    return parser_with_tables(place, f"{grammar}\n{options}", lambda: Lark(grammar, **options))


def invalid(e: UnexpectedInput, text: str, path: str) -> FileInvalid:
    """Return the error of the parser as an error in the file, with the readable names of the expected tokens."""
    if isinstance(e, UnexpectedToken) and e.token.type != "$END":
        got, line, column = str(e.token), e.line, e.column
        names = e.accepts or e.expected
    elif isinstance(e, UnexpectedCharacters):
        got, line, column = e.char, e.line, e.column
        names = e.allowed or set()
    else:  # the end of the text
        before = text.rstrip()
        got, line, column = "the end of the file", before.count("\n") + 1, len(before) - before.rfind("\n")
        names = getattr(e, "accepts", None) or (set() if isinstance(e, UnexpectedEOF) else e.expected)  # type: ignore[attr-defined]
    word = re.match(r"\w+", text.split("\n")[line - 1][column - 1 :]) if got.isalnum() else None
    if word is not None:  # the token may be the beginning of a word, such as DO of done
        got = word[0]
    construct = _unsupported(got, text, line, column)
    if construct:
        return FileInvalid(f"{construct} are not supported", path=path, line=line, column=column, got=shortened(got))
    if "SEMICOLON" in names and (unnamed := _unnamed(text, line, column)) is not None:
        return FileInvalid(**unnamed, path=path)
    readable = sorted({_readable(name) for name in names})
    more = f" and {len(readable) - MAX_EXPECTED} more" if len(readable) > MAX_EXPECTED else ""
    return FileInvalid(
        "not Structured Text",
        path=path,
        line=line,
        column=column,
        got=shortened(got if got.isprintable() else repr(got)),
        expected=", ".join(readable[:MAX_EXPECTED]) + more,
    )


def _unnamed(text: str, line: int, column: int) -> dict[str, Any] | None:
    """Return the error of a structure or union without a name whose first member is at this place; otherwise return None.

    The parser took its first word for the name of a type.
    """
    lines = text.split("\n")[:line]
    lines[-1] = lines[-1][: column - 1]
    before = "\n".join(lines)
    found = _UNNAMED.search(before)
    if found is None:
        return None
    what, at = found["what"].upper(), found.start("what")
    return {
        "message": f"a {what} without a name",
        "line": before.count("\n", 0, at) + 1,
        "column": at - before.rfind("\n", 0, at),
        "expected": "the name of a type",
        "hint": f"declare it, TYPE Name : {what} ... END_{what}; END_TYPE, and write Name here",
    }


def _unsupported(got: str, text: str, line: int, column: int) -> str:
    """Return the construct that the unexpected token `got`, or the word before it, belongs to; "" for an ordinary error."""
    lines = text.split("\n")[:line]
    lines[-1] = lines[-1][: column - 1]
    before = re.search(r"([A-Za-z_]\w*)\s*\Z", "\n".join(lines[-2:]))
    if got == ":" and _LABEL.search("\n".join(lines[-2:])):
        return "labels and jumps"
    return _UNSUPPORTED.get(got.upper()) or (_UNSUPPORTED.get(before[1].upper(), "") if before else "")


@cache
def _readable(name: str) -> str:
    for terminal in parser().terminals:
        if terminal.name == name and isinstance(terminal.pattern, PatternStr):
            return str(terminal.pattern.value)
    return _READABLE.get(name, name)
