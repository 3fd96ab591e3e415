"""Convert PLCopen XML (TC6, version 2.01, as CODESYS, OpenPLC and Beremiz export it) to Structured Text, line for line.

Each line of the resulting text holds the content of the same line of the XML, so that every later error names a line of
the user's file. Bodies in languages other than ST are refused with their language; drawings, task configurations and
vendors' additions are ignored. Document types are refused, which excludes all attacks with entities.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.parsers import expat

from fieldtwin.gateway.core.errors import FileInvalid

MAX_ELEMENTS = 500_000
_BLOCKS = {
    "localVars": "VAR", "inputVars": "VAR_INPUT", "outputVars": "VAR_OUTPUT", "inOutVars": "VAR_IN_OUT",
    "tempVars": "VAR_TEMP", "externalVars": "VAR_EXTERNAL", "globalVars": "VAR_GLOBAL",
}  # fmt: skip
_QUALIFIED = re.compile(
    r"""\(\*.*?\*\)|//[^\n]*|'(?:\$.|[^'$])*'|"(?:\$.|[^"$])*"|(?<![\w.\#])(?P<name>[A-Za-z_]\w*)\.(?=[A-Za-z_])""",
    re.DOTALL,
)
"""A name before a dot; comments and strings are skipped."""
_POUS = {"program": "PROGRAM", "function": "FUNCTION", "functionBlock": "FUNCTION_BLOCK"}


@dataclass(slots=True)
class _Element:
    tag: str
    attributes: dict[str, str]
    line: int
    children: list[_Element] = field(default_factory=list)
    text: list[tuple[int, str]] = field(default_factory=list)
    """Pieces of text with the line on which each begins."""
    end_line: int = 0

    def find(self, tag: str) -> _Element | None:
        return next((c for c in self.children if c.tag == tag), None)

    def every(self, tag: str) -> Iterator[_Element]:
        for child in self.children:
            if child.tag == tag:
                yield child
            yield from child.every(tag)


def is_plcopen(text: str) -> bool:
    return text.lstrip("\ufeff \t\r\n").startswith("<")


def to_st(text: str, path: str = "") -> str:
    """Return the Structured Text of a PLCopen XML export. Raises `FileInvalid`."""
    return _Converter(_parsed(text, path), path, text.count("\n") + 1).text()


def _parsed(text: str, path: str) -> _Element:
    root = _Element("", {}, 1)
    stack, count = [root], 0
    parser = expat.ParserCreate(namespace_separator="}")
    parser.buffer_text = False

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if count > MAX_ELEMENTS:
            raise FileInvalid("the export is too large", path=path, expected=f"at most {MAX_ELEMENTS} elements")
        element = _Element(name.rpartition("}")[2], attributes, parser.CurrentLineNumber)
        stack[-1].children.append(element)
        stack.append(element)

    def end(name: str) -> None:
        stack.pop().end_line = parser.CurrentLineNumber

    def characters(data: str) -> None:
        stack[-1].text.append((parser.CurrentLineNumber, data))

    def doctype(*_: object) -> None:
        raise FileInvalid("a document type declaration is not allowed", path=path, line=parser.CurrentLineNumber)

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = characters
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(text.encode(), True)
    except expat.ExpatError as e:
        raise FileInvalid(f"not XML: {expat.ErrorString(e.code)}", path=path, line=e.lineno, column=e.offset + 1) from e
    project = root.find("project")
    if project is None:
        raise FileInvalid("not a PLCopen export", path=path, line=1, expected="a <project>")
    return project


class _Converter:
    def __init__(self, project: _Element, path: str, lines: int) -> None:
        self.path = path
        self.project = project
        self.lines: list[list[str]] = [[] for _ in range(lines + 2)]
        self.last = 1
        enums = [d for d in project.every("dataType") if any(b.find("enum") for b in d.children if b.tag == "baseType")]
        self.qualifiers = {d.attributes.get("name", "").lower(): "#" for d in enums}
        """The names that CODESYS writes before a dot, and what the standard has instead of the dot: ``#`` for an
        enumeration, and nothing for a list of globals."""
        self.qualifiers |= {
            g.attributes["name"].lower(): "" for g in project.every("globalVars") if "name" in g.attributes
        }

    def text(self) -> str:
        for data_type in self.project.every("dataType"):
            self._data_type(data_type)
        for pou in self.project.every("pou"):
            self._pou(pou)
        for block in self.project.every("globalVars"):
            self._variables(block)
        return "\n".join(" ".join(pieces) for pieces in self.lines[1:])

    def _put(self, line: int, text: str) -> None:
        """Write `text` on `line`, or on a later line if earlier text has already reached one."""
        self.last = max(self.last, line)
        self.lines[min(self.last, len(self.lines) - 1)].append(text)

    def _fail(self, element: _Element, message: str, *, expected: str = "", got: str = "") -> FileInvalid:
        return FileInvalid(message, path=self.path, line=element.line, expected=expected, got=got)

    def _name(self, element: _Element) -> str:
        name = element.attributes.get("name", "")
        if not name.isidentifier():
            raise self._fail(element, f"a <{element.tag}> without a usable name", got=repr(name))
        return name

    # -- declarations -----------------------------------------------------------------------------------------------------

    def _data_type(self, element: _Element) -> None:
        self.last = element.line  # types, POUs and globals may be in any order, so each starts anew
        base = element.find("baseType")
        if base is None or not base.children:
            raise self._fail(element, "a data type without a base", expected="<baseType>")
        inner, name = base.children[0], self._name(element)
        self._put(element.line, "TYPE")
        if inner.tag == "enum":
            values = [
                self._name(v) + (f" := {v.attributes['value']}" if "value" in v.attributes else "")
                for v in inner.every("value")
            ]
            self._put(inner.line, f"{name} : ({', '.join(values)}){self._initial(element)};")
        elif inner.tag == "struct":
            self._put(inner.line, f"{name} : STRUCT")
            for v in inner.children:
                if v.tag == "variable":
                    self._put(v.line, f"{self._name(v)} : {self._type(v)}{self._initial(v)};")
            self._put(inner.end_line, "END_STRUCT;")
        else:
            self._put(inner.line, f"{name} : {self._type_of(inner)}{self._initial(element)};")
        self._put(element.end_line, "END_TYPE")

    def _pou(self, pou: _Element) -> None:
        self.last = pou.line
        kind = _POUS.get(pou.attributes.get("pouType", ""))
        if kind is None:
            raise self._fail(
                pou, "a POU of unknown kind", expected=", ".join(_POUS), got=pou.attributes.get("pouType", "")
            )
        for unsupported in ("Method", "Property", "action", "transition"):
            for found in pou.every(unsupported):
                raise self._fail(found, f"{self._name(pou)} has an unsupported part: {unsupported.lower()}")
        interface = pou.find("interface")
        returns = interface.find("returnType") if interface else None
        result = returns.children[0] if kind == "FUNCTION" and returns is not None and returns.children else None
        self._put(pou.line, f"{kind} {self._name(pou)}" + (f" : {self._type_of(result)}" if result is not None else ""))
        for block in interface.children if interface else ():
            if block.tag in _BLOCKS:
                self._variables(block)
        self._body(pou)
        self._put(pou.end_line, f"END_{kind}")

    def _variables(self, block: _Element) -> None:
        if block.tag == "globalVars":
            self.last = block.line
        words = [_BLOCKS[block.tag]]
        words += [
            word
            for flag, word in (("constant", "CONSTANT"), ("retain", "RETAIN"))
            if block.attributes.get(flag) == "true"
        ]
        self._put(block.line, " ".join(words))
        for v in block.children:
            if v.tag == "variable":
                at = f" AT {v.attributes['address']}" if v.attributes.get("address") else ""
                self._put(v.line, f"{self._name(v)}{at} : {self._type(v)}{self._initial(v)};")
        self._put(block.end_line, "END_VAR")

    def _type(self, variable: _Element) -> str:
        kind = variable.find("type")
        if kind is None or not kind.children:
            raise self._fail(variable, f"variable {variable.attributes.get('name')} has no type", expected="<type>")
        return self._type_of(kind.children[0])

    def _type_of(self, element: _Element) -> str:
        tag = element.tag
        if tag == "derived":
            return self._name(element)
        if tag in ("string", "wstring"):
            length = element.attributes.get("length", "")
            return tag.upper() + (f"[{length}]" if length else "")
        base = element.find("baseType")
        inner = self._type_of(base.children[0]) if base is not None and base.children else ""
        ranges = [
            f"{d.attributes.get('lower')}..{d.attributes.get('upper')}"
            for d in element.children
            if d.tag in ("dimension", "range")
        ]
        if tag == "array" and inner and ranges:
            return f"ARRAY[{', '.join(ranges)}] OF {inner}"
        if tag in ("subrangeSigned", "subrangeUnsigned") and inner and ranges:
            return f"{inner}({ranges[0]})"
        if element.children or not tag.isupper():
            raise self._fail(element, f"a type that is not supported: {tag}")
        return tag

    def _initial(self, element: _Element) -> str:
        found = element.find("initialValue")
        return f" := {self._value(found.children[0])}" if found is not None and found.children else ""

    def _value(self, element: _Element) -> str:
        if element.tag == "simpleValue":
            return element.attributes.get("value", "")
        inner = [(v, self._value(v.children[0])) for v in element.children if v.tag == "value" and v.children]
        if element.tag == "arrayValue":
            repeats = [(v.attributes.get("repetitionValue", ""), text) for v, text in inner]
            return f"[{', '.join(f'{n}({text})' if n not in ('', '1') else text for n, text in repeats)}]"
        if element.tag == "structValue":
            members = [f"{v.attributes.get('member')} := {text}" for v, text in inner]
            return f"({', '.join(members)})"
        raise self._fail(element, f"an initial value that is not supported: {element.tag}")

    # -- bodies -----------------------------------------------------------------------------------------------------------

    def _body(self, pou: _Element) -> None:
        body = pou.find("body")
        if body is None or not body.children:
            raise self._fail(pou, f"POU {self._name(pou)} has no body", expected="<body><ST>")
        language = next((c for c in body.children if c.tag in ("ST", "IL", "LD", "FBD", "SFC")), None)
        if language is None or language.tag != "ST":
            got = language.tag if language else body.children[0].tag
            raise self._fail(body, f"the body of {self._name(pou)} is not Structured Text", expected="ST", got=got)
        interface = pou.find("interface")
        own = {v.attributes.get("name", "").lower() for v in interface.every("variable")} if interface else set()
        for line, text in _texts(language):
            for offset, piece in enumerate(self._unqualified(text, own).split("\n")):
                if piece.strip():
                    self._put(line + offset, piece)

    def _unqualified(self, text: str, own: set[str]) -> str:
        """Write ``Mode.Idle`` as ``Mode#Idle``, ``GVL.x`` as ``x``; columns stay the same, so that errors name the
        right column."""

        def standard(found: re.Match[str]) -> str:
            name = found["name"]
            if name is None or name.lower() in own or name.lower() not in self.qualifiers:
                return found[0]
            mark = self.qualifiers[name.lower()]
            return name + mark + found[0][len(name) + 1 :] if mark else " " * len(found[0])

        return _QUALIFIED.sub(standard, text)


def _texts(element: _Element) -> Iterator[tuple[int, str]]:
    if element.text:  # the parser delivers text in pieces, one for each entity or line
        yield element.text[0][0], "".join(piece for _, piece in element.text)
    for child in element.children:
        yield from _texts(child)
