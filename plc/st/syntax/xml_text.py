"""Parse the XML files of other PLC tools. Document types are refused, which excludes all attacks with entities."""

from __future__ import annotations

from collections.abc import Callable
from xml.parsers import expat

from fieldtwin.gateway.core.errors import FileInvalid


def parse_xml(
    text: str, path: str, listen: Callable[[expat.XMLParserType], None], namespace_separator: str | None = None
) -> None:
    """Parse a text. `listen` sets the handlers of the parser; text arrives in pieces, one for each line or entity.

    With a `namespace_separator`, names begin with their namespace and this separator. Raises `FileInvalid`.
    """
    # the text is decoded already, so the encoding that it declares, which may be unknown, does not count
    parser = expat.ParserCreate("utf-8", namespace_separator)
    parser.buffer_text = False

    def doctype(*_: object) -> None:
        raise FileInvalid("a document type declaration is not allowed", path=path, line=parser.CurrentLineNumber)

    parser.StartDoctypeDeclHandler = doctype
    listen(parser)
    try:
        parser.Parse(text.encode(), True)
    except expat.ExpatError as e:
        raise FileInvalid(f"not XML: {expat.ErrorString(e.code)}", path=path, line=e.lineno, column=e.offset + 1) from e
