"""The elements of a PLCopen XML file with their positions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.parsers import expat

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.syntax.xml_text import parse_xml

MAX_ELEMENTS = 500_000


@dataclass(slots=True)
class Element:
    """An element without its namespace; `line` and `column` count from 1."""

    tag: str
    attributes: dict[str, str]
    line: int
    column: int = 1
    children: list[Element] = field(default_factory=list)
    text: list[tuple[int, str]] = field(default_factory=list)
    """Pieces of text with the line on which each begins."""
    end_line: int = 0

    def find(self, tag: str) -> Element | None:
        return next((c for c in self.children if c.tag == tag), None)

    def inside(self, tag: str) -> list[Element]:
        """Return the children of the first child `tag`, or an empty list."""
        found = self.find(tag)
        return found.children if found is not None else []

    def every(self, tag: str) -> Iterator[Element]:
        for child in self.children:
            if child.tag == tag:
                yield child
            yield from child.every(tag)

    def texts(self) -> Iterator[tuple[int, str]]:
        """Return each text in the element and below it with its first line."""
        if self.text:  # the parser delivers text in pieces, one for each entity or line
            yield self.text[0][0], "".join(piece for _, piece in self.text)
        for child in self.children:
            yield from child.texts()


def is_plcopen(text: str) -> bool:
    return text.lstrip("\ufeff \t\r\n").startswith("<")


def project_of(text: str, path: str = "") -> Element:
    """Return the ``<project>`` of a PLCopen XML file. Raises `FileInvalid`."""
    root = Element("", {}, 1)
    stack, count = [root], 0

    def listen(parser: expat.XMLParserType) -> None:
        def start(name: str, attributes: dict[str, str]) -> None:
            nonlocal count
            count += 1
            if count > MAX_ELEMENTS:
                raise FileInvalid("the export is too large", path=path, expected=f"at most {MAX_ELEMENTS} elements")
            line, column = parser.CurrentLineNumber, parser.CurrentColumnNumber + 1
            element = Element(name.rpartition("}")[2], attributes, line, column)
            stack[-1].children.append(element)
            stack.append(element)

        def end(name: str) -> None:
            stack.pop().end_line = parser.CurrentLineNumber

        def characters(data: str) -> None:
            stack[-1].text.append((parser.CurrentLineNumber, data))

        parser.StartElementHandler = start
        parser.EndElementHandler = end
        parser.CharacterDataHandler = characters

    parse_xml(text, path, listen, "}")
    project = root.find("project")
    if project is None:
        raise FileInvalid("not a PLCopen export", path=path, line=1, expected="a <project>")
    return project
