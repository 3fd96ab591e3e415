"""Convert the files of a TwinCAT project (.TcPOU, .TcIO, .TcDUT, .TcGVL) to Structured Text, line for line and column for column.

Such a file is XML with the declaration and the ST body of one object as text in CDATA sections; outside of these, an entity
moves the columns after it. Actions, methods and properties become those of Structured Text. Transitions and bodies in graphical
languages are refused by name.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from xml.parsers import expat

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.plc.st.syntax.xml_text import parse_xml

_ROOT = re.compile(r"\s*(<\?xml[^>]*\?>)?\s*<TcPlcObject\b")
_KIND = re.compile(
    r"(?:\s|\(\*(?:[^*]|\*(?!\)))*\*\)|//[^\n]*(?![^\n])|\{[^}]*\})*(FUNCTION_BLOCK|FUNCTION|PROGRAM|INTERFACE)\b",
    re.DOTALL | re.IGNORECASE,
)
"""The first word of a declaration; comments and pragmas are skipped."""
_OBJECTS = ("POU", "Itf", "DUT", "GVL")
_PARTS = {"Action": "ACTION", "Method": "METHOD", "Property": "PROPERTY"}
"""The elements of a POU or interface that become a part of Structured Text, with its word."""
_ACCESSORS = {"Get": "GET", "Set": "SET"}


def is_twincat(text: str) -> bool:
    return _ROOT.match(text.removeprefix("\ufeff")) is not None


def to_st(text: str, path: str = "") -> str:
    """Return the Structured Text of a TwinCAT file. Raises `FileInvalid` for an unsupported part, with the others."""
    reader = _Reader(path)
    reader.read(text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n"))
    return reader.text()


Piece = tuple[int, int, str]
"""A part of a text, with its line and column in the file."""


@dataclass(slots=True)
class _Part:
    """An object, or an action, method, property or accessor of one: where its element begins and ends, and its texts.

    `word` is its word in Structured Text; "" for an object, whose declaration has the word.
    """

    name: str
    word: str
    begin: tuple[int, int]
    declaration: list[Piece] = field(default_factory=list)
    body: list[Piece] = field(default_factory=list)
    parts: list[_Part] = field(default_factory=list)
    end: tuple[int, int] = (1, 0)


class _Reader:
    def __init__(self, path: str) -> None:
        self._path = path
        self._errors = ErrorCollector()
        self._open: list[str] = []
        self._objects: list[_Part] = []
        self._inside: list[_Part] = []
        """The object, the part and the accessor whose elements are open."""
        self._parser: expat.XMLParserType

    def read(self, text: str) -> None:
        parse_xml(text, self._path, self._listen)
        self._errors.raise_all()

    def _listen(self, parser: expat.XMLParserType) -> None:
        self._parser = parser
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._characters

    def text(self) -> str:
        lines: list[str] = []
        for found in self._objects:
            _put_part(lines, found)
        return "\n".join(lines)

    def _fail(self, message: str, *, expected: str = "", got: str = "") -> None:
        line, column = self._parser.CurrentLineNumber, self._parser.CurrentColumnNumber + 1
        self._errors.add(FileInvalid(message, path=self._path, line=line, column=column, expected=expected, got=got))

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._open.append(tag)
        name = attributes.get("Name", "")
        deep = len(self._inside)
        if deep == 0 and len(self._open) == 2 and tag in _OBJECTS:
            self._enter(_Part(name, "", self._place()), self._objects)
        elif deep == 1 and len(self._open) == 3 and tag in _PARTS:
            self._enter(_Part(name, _PARTS[tag], self._place()), self._inside[0].parts)
        elif deep == 2 and len(self._open) == 4 and tag in _ACCESSORS and self._inside[1].word == "PROPERTY":
            self._enter(_Part(tag, _ACCESSORS[tag], self._place()), self._inside[1].parts)
        elif deep == 1 and len(self._open) == 3 and tag == "Transition":
            self._fail(f"{name} of {self._owner()}: transitions are not supported")
        elif deep and tag != "ST" and self._open[deep + 1 : -1] == ["Implementation"]:
            self._fail(f"the body of {self._owner()} is not Structured Text", expected="ST", got=tag)

    def _enter(self, part: _Part, among: list[_Part]) -> None:
        among.append(part)
        self._inside.append(part)

    def _end(self, tag: str) -> None:
        if self._inside and len(self._open) == len(self._inside) + 1:
            self._inside.pop().end = self._place()
        self._open.pop()

    def _owner(self) -> str:
        """Return the name of the object, or of its part, that is being read."""
        return ".".join(part.name for part in self._inside)

    def _place(self) -> tuple[int, int]:
        return self._parser.CurrentLineNumber, self._parser.CurrentColumnNumber

    def _characters(self, data: str) -> None:
        if not self._inside:
            return
        part = self._inside[-1]
        inner = "/".join(self._open[len(self._inside) + 1 :])
        pieces = {"Declaration": part.declaration, "Implementation/ST": part.body}.get(inner)
        if pieces is not None and (pieces or data.strip()):  # white space before a CDATA section is not text
            pieces.append((*self._place(), data))


def _put_part(lines: list[str], part: _Part) -> None:
    """Write an object or a part of one, with the words at its beginning and end that its texts do not have."""
    if part.word == "ACTION":
        _put(lines, *part.begin, f"ACTION {part.name}:")
    elif part.word in _ACCESSORS.values():
        _put(lines, *part.begin, f"{part.word} ")
    _put_pieces(lines, part.declaration)
    _put_pieces(lines, part.body)
    for inner in part.parts:
        _put_part(lines, inner)
    kind = _KIND.match("".join(piece for _, _, piece in part.declaration))
    word = part.word or (kind[1].upper() if kind is not None else "")
    if word:
        _put(lines, *part.end, f"END_{word} ")


def _put_pieces(lines: list[str], pieces: list[Piece]) -> None:
    """Write a text at its place. The parser delivers it in pieces, one for each line or entity."""
    if pieces:
        line, column, _ = pieces[0]
        _put(lines, line, column, "".join(piece for _, _, piece in pieces))


def _put(lines: list[str], line: int, column: int, text: str) -> None:
    """Write `text` at its place: `line` from 1, `column` from 0."""
    for offset, part in enumerate(text.split("\n")):
        lines.extend([""] * (line + offset - len(lines)))
        at = line + offset - 1
        lines[at] = lines[at].ljust(column if offset == 0 else 0) + part
