"""Convert the files of a TwinCAT project (.TcPOU, .TcDUT, .TcGVL) to Structured Text, line for line and column for column.

Such a file is XML with the declaration and the ST body of one object as text in CDATA sections; outside of these, an entity
moves the columns after it. Actions become those of Structured Text. Methods, properties, transitions and bodies in graphical
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
    r"(?:\s|\(\*.*?\*\)|//[^\n]*|\{[^}]*\})*(FUNCTION_BLOCK|FUNCTION|PROGRAM)\b", re.DOTALL | re.IGNORECASE
)
"""The first word of a declaration; comments and pragmas are skipped."""
_UNSUPPORTED = {
    "Method": "methods", "Property": "properties", "Transition": "transitions", "Itf": "interfaces",
}  # fmt: skip
_PARTS = ("POU", "DUT", "GVL")


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
class _Action:
    """An action of a POU: its name, where its element begins and ends, and the pieces of its body."""

    name: str
    begin: tuple[int, int]
    body: list[Piece] = field(default_factory=list)
    end: tuple[int, int] = (1, 0)


@dataclass(slots=True)
class _Object:
    """A POU, type or list: the pieces of its texts, its actions, and where it ends."""

    name: str
    declaration: list[Piece] = field(default_factory=list)
    body: list[Piece] = field(default_factory=list)
    actions: list[_Action] = field(default_factory=list)
    end: tuple[int, int] = (1, 0)


class _Reader:
    def __init__(self, path: str) -> None:
        self._path = path
        self._errors = ErrorCollector()
        self._open: list[str] = []
        self._objects: list[_Object] = []
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
            _put_pieces(lines, found.declaration)
            _put_pieces(lines, found.body)
            for action in found.actions:
                _put(lines, *action.begin, f"ACTION {action.name}:")
                _put_pieces(lines, action.body)
                _put(lines, *action.end, "END_ACTION ")
            kind = _KIND.match("".join(piece for _, _, piece in found.declaration))
            if kind is not None:
                _put(lines, *found.end, f"END_{kind[1].upper()}")
        return "\n".join(lines)

    def _fail(self, message: str, *, expected: str = "", got: str = "") -> None:
        line, column = self._parser.CurrentLineNumber, self._parser.CurrentColumnNumber + 1
        self._errors.add(FileInvalid(message, path=self._path, line=line, column=column, expected=expected, got=got))

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._open.append(tag)
        name = attributes.get("Name", "")
        if self._open[1:] == [tag] and tag in _PARTS:
            self._objects.append(_Object(name))
        elif tag in _UNSUPPORTED and len(self._open) <= 3:
            of = f" of {self._objects[-1].name}" if self._objects else ""
            self._fail(f"{name}{of}: {_UNSUPPORTED[tag]} are not supported")
        elif self._open[1:] == ["POU", "Action"]:
            self._objects[-1].actions.append(_Action(name, self._place()))
        elif self._objects and tag != "ST" and self._open[2:-1] in (["Implementation"], ["Action", "Implementation"]):
            self._fail(f"the body of {self._owner()} is not Structured Text", expected="ST", got=tag)

    def _end(self, tag: str) -> None:
        if self._open[1:] == [tag] and self._objects:
            self._objects[-1].end = self._place()
        elif self._open[1:] == ["POU", "Action"]:
            self._objects[-1].actions[-1].end = self._place()
        self._open.pop()

    def _owner(self) -> str:
        """Return the name of the POU or the action that is being read."""
        found = self._objects[-1]
        return f"{found.name}.{found.actions[-1].name}" if "Action" in self._open else found.name

    def _place(self) -> tuple[int, int]:
        return self._parser.CurrentLineNumber, self._parser.CurrentColumnNumber

    def _characters(self, data: str) -> None:
        piece = (*self._place(), data)
        if not self._objects:
            return
        found = self._objects[-1]
        places = {"Declaration": found.declaration, "Implementation/ST": found.body}
        if found.actions:
            places["Action/Implementation/ST"] = found.actions[-1].body
        pieces = places.get("/".join(self._open[2:]))
        if pieces is not None and (pieces or data.strip()):  # white space before a CDATA section is no part of the text
            pieces.append(piece)


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
