"""Read an XML document from an untrusted file: elements with their lines, within limits, and without a document type.

Entities that a document type declares can name other files or expand to gigabytes, so a document type is refused. No format of
device descriptions needs one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.parsers import expat

from fieldtwin.gateway.core.errors import FileInvalid

MAX_DEPTH = 64
MAX_ELEMENTS = 1_000_000


@dataclass(slots=True)
class Element:
    """An element. `name` and the keys of `attributes` have no prefix of a namespace. `line` counts from 1."""

    name: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list)
    text: str = ""

    def get(self, key: str) -> str:
        """Return an attribute without spaces at its ends; empty if the element lacks it."""
        return self.attributes.get(key, "").strip()

    def child(self, name: str) -> Element | None:
        """Return the first child of this name, or None."""
        return next((each for each in self.children if each.name == name), None)

    def all(self, *names: str) -> Iterator[Element]:
        """Yield the elements with one of these names, at any depth, in the order of the document."""
        for each in self.children:
            if each.name in names:
                yield each
            yield from each.all(*names)

    def first(self, name: str) -> Element | None:
        """Return the first element of this name at any depth, or None."""
        return next(self.all(name), None)

    def text_of(self, name: str) -> str:
        """Return the text of the first element of this name at any depth; empty if no element has the name."""
        found = self.first(name)
        return found.text.strip() if found is not None else ""


def read_xml(data: bytes, path: str) -> Element:
    """Return the root element. Raises `FileInvalid` with line and column."""
    reader = _Reader(path)
    try:
        reader.parser.Parse(data, True)
    except expat.ExpatError as e:
        raise FileInvalid(
            f"not XML: {expat.ErrorString(e.code)}",
            path=path,
            line=e.lineno,
            column=e.offset + 1,
            expected="well-formed XML",
        ) from e
    except (ValueError, LookupError) as e:
        raise FileInvalid(f"its encoding is not supported: {e}", path=path, line=1, expected="UTF-8") from e
    assert reader.root is not None  # a document without a root is not well-formed
    return reader.root


class _Reader:
    def __init__(self, path: str) -> None:
        self.root: Element | None = None
        self._path, self._open, self._count = path, list[Element](), 0
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._text
        self.parser.StartDoctypeDeclHandler = self._doctype

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        line = self.parser.CurrentLineNumber
        self._count += 1
        if len(self._open) >= MAX_DEPTH or self._count > MAX_ELEMENTS:
            expected = f"at most {MAX_DEPTH} levels and {MAX_ELEMENTS} elements"
            raise FileInvalid("too many elements", path=self._path, line=line, expected=expected)
        found = Element(_local(name), {_local(key): value for key, value in attributes.items()}, line)
        if self._open:
            self._open[-1].children.append(found)
        else:
            self.root = found
        self._open.append(found)

    def _end(self, name: str) -> None:
        self._open.pop()

    def _text(self, text: str) -> None:
        if self._open:
            self._open[-1].text += text

    def _doctype(self, *declared: object) -> None:
        raise FileInvalid(
            "the document declares a document type",
            path=self._path,
            line=self.parser.CurrentLineNumber,
            expected="a file without <!DOCTYPE>, because entities could name other files",
        )


def _local(name: str) -> str:
    return name.rpartition(":")[2]
