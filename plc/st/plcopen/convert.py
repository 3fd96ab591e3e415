"""Convert PLCopen XML (TC6, version 2.01, as CODESYS, OpenPLC and Beremiz export it) to Structured Text, line for line.

Each line of the resulting text holds the content of the same line of the XML, so that every later error names a line of
the user's file. Bodies in FBD and LD become statements of the tree (`networks`), and bodies in SFC become charts (`charts`).
A POU, an action or a type with a part that is not supported is left out and listed in `Export.missing`. Drawings and vendors'
additions are ignored, except methods, properties, bases and qualifiers of CODESYS.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.plcopen.charts import read_chart
from fieldtwin.plc.st.plcopen.configurations import configuration_text
from fieldtwin.plc.st.plcopen.elements import Element, project_of
from fieldtwin.plc.st.plcopen.networks import Drawn, drawn
from fieldtwin.plc.st.plcopen.nodes import Unsupported
from fieldtwin.plc.st.syntax.tree import Missing, Pos

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
_ACCESSORS = {"GetAccessor": "GET", "SetAccessor": "SET"}
_QUALIFIERS = {"constant": "CONSTANT", "retain": "RETAIN", "persistent": "PERSISTENT", "nonretain": "NON_RETAIN"}
"""The attributes of a block of variables."""
_MODIFIERS = ("Public", "Protected", "Private", "Internal", "Final")
"""The attributes of an element AccessModifiers."""
_LANGUAGES = ("ST", "FBD", "LD", "SFC", "IL")


@dataclass(frozen=True, slots=True)
class Export:
    """A PLCopen XML file as Structured Text, and what of it is missing there."""

    text: str
    missing: tuple[Missing, ...]
    drawings: Mapping[tuple[str, str], Drawn]
    """The bodies in FBD, LD and SFC by POU and action, in lower case; the body of a POU has "" as its action."""


def convert(text: str, path: str = "") -> Export:
    """Return the Structured Text of a PLCopen XML export. Raises `FileInvalid`."""
    return _Converter(project_of(text, path), path, text.count("\n") + 1).export()


class _Converter:
    def __init__(self, project: Element, path: str, lines: int) -> None:
        self.path = path
        self.project = project
        self.count = lines
        self.pieces: list[tuple[int, str]] = []
        """Each piece of the text with its line."""
        self.missing: list[Missing] = []
        self.drawings: dict[tuple[str, str], Drawn] = {}
        self.last = 1
        enums = [d for d in project.every("dataType") if any(b.find("enum") for b in d.children if b.tag == "baseType")]
        self.qualifiers = {d.attributes.get("name", "").lower(): "#" for d in enums}
        """The names that CODESYS writes before a dot, and what the standard has instead of the dot: ``#`` for an
        enumeration, and nothing for a list of globals."""
        self.qualifiers |= {
            g.attributes["name"].lower(): "" for g in project.every("globalVars") if "name" in g.attributes
        }

    def export(self) -> Export:
        for data_type in self.project.every("dataType"):
            with self._whole(data_type, "type", data_type.attributes.get("name", "")):
                self._data_type(data_type)
        for union in self.project.every("union"):
            with self._whole(union, "type", union.attributes.get("name", "")):
                self._union(union)
        for pou in self.project.every("pou"):
            with self._whole(pou, _kind(pou).lower().replace("_", " "), pou.attributes.get("name", "")):
                self._pou(pou)
        parts = {id(b) for mixed in self.project.every("MixedAttrsVarList") for b in mixed.children}
        for block in self.project.every("globalVars"):
            if id(block) not in parts:
                self._variables(block)
        programs = {
            pou.attributes.get("name", "").lower() for pou in self.project.every("pou") if _kind(pou) == "PROGRAM"
        }
        for configuration in self.project.every("configuration"):
            self.last = configuration.line
            self._put(configuration.line, configuration_text(configuration, programs))
        lines: list[list[str]] = [[] for _ in range(self.count + 2)]
        for line, text in self.pieces:
            lines[min(line, len(lines) - 1)].append(text)
        return Export("\n".join(" ".join(pieces) for pieces in lines[1:]), tuple(self.missing), self.drawings)

    @contextmanager
    def _whole(self, element: Element, kind: str, name: str) -> Iterator[None]:
        """Convert an element completely, or, if a part of it is not supported, not at all."""
        mark = len(self.pieces)
        try:
            yield
        except Unsupported as e:
            del self.pieces[mark:]
            self.missing.append(Missing(Pos(e.line, e.column, self.path), kind, name, e.message))

    def _put(self, line: int, text: str) -> None:
        """Write `text` on `line`, or on a later line if earlier text has already reached one."""
        self.last = max(self.last, line)
        self.pieces.append((self.last, text))

    def _fail(self, element: Element, message: str, *, expected: str = "", got: str = "") -> FileInvalid:
        return FileInvalid(message, path=self.path, line=element.line, expected=expected, got=got)

    def _unsupported(self, element: Element, message: str) -> Unsupported:
        return Unsupported(message, path=self.path, line=element.line, column=element.column)

    def _name(self, element: Element) -> str:
        name = element.attributes.get("name", "")
        if not name.isidentifier():
            raise self._fail(element, f"a <{element.tag}> without a usable name", got=repr(name))
        return name

    # -- declarations -----------------------------------------------------------------------------------------------------

    def _data_type(self, element: Element) -> None:
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
                    self._variable(v)
            self._put(inner.end_line, "END_STRUCT;")
        else:
            self._put(inner.line, f"{name} : {self._type_of(inner)}{self._initial(element)};")
        self._put(element.end_line, "END_TYPE")

    def _union(self, element: Element) -> None:
        """Write a union, which CODESYS adds to the data types."""
        self.last = element.line
        self._put(element.line, f"TYPE {self._name(element)} : UNION")
        for v in element.every("variable"):
            self._variable(v)
        self._put(element.end_line, "END_UNION END_TYPE")

    def _pou(self, pou: Element) -> None:
        self.last = pou.line
        kind = _kind(pou)
        if not kind:
            raise self._fail(
                pou, "a POU of unknown kind", expected=", ".join(_POUS), got=pou.attributes.get("pouType", "")
            )
        interface = pou.find("interface")
        result = interface.inside("returnType") if kind == "FUNCTION" and interface is not None else []
        self._put(pou.line, f"{kind} {self._name(pou)}" + (f" : {self._type_of(result[0])}" if result else ""))
        for base in interface.every("Extends") if interface is not None else ():
            self._put(pou.line, f"EXTENDS {''.join(text for _, text in base.texts()).strip()}")
        for block in interface.children if interface else ():
            if block.tag in _BLOCKS:
                self._variables(block)
        if not pou.inside("body"):
            raise self._fail(pou, f"POU {self._name(pou)} has no body", expected="<body><ST>")
        for part in pou.children:  # in their order in the file, because the text keeps the lines
            if part.tag == "body":
                self._body(pou, part)
            elif part.tag == "actions":
                self._actions(pou, part)
        for added in sorted((*pou.every("Method"), *pou.every("Property")), key=lambda one: (one.line, one.column)):
            (self._method if added.tag == "Method" else self._property)(pou, added)
        self._put(pou.end_line, f"END_{kind}")

    def _method(self, pou: Element, method: Element) -> None:
        """Write a method, which CODESYS adds to a POU after its body."""
        name, interface = self._name(method), method.find("interface")
        result = interface.inside("returnType") if interface is not None else []
        kind = f" : {self._type_of(result[0])}" if result else ""
        self._put(method.line, f"METHOD {_modifiers(method) or 'PUBLIC'} {name}{kind}")
        self._own_body(pou, method, f"the method {self._name(pou)}.{name}")
        self._put(method.end_line, "END_METHOD")

    def _property(self, pou: Element, found: Element) -> None:
        """Write a property, which CODESYS adds in the same way as a method. Its accessors may be in any order."""
        name, interface = self._name(found), found.find("interface")
        of = f"the property {self._name(pou)}.{name}"
        result = interface.inside("returnType") if interface is not None else []
        accessors = [part for part in found.children if part.tag in _ACCESSORS]
        if not result or not accessors:
            raise self._unsupported(found, f"{of} has no type and no accessor, which is not supported")
        self._put(found.line, f"PROPERTY {_modifiers(found) or 'PUBLIC'} {name} : {self._type_of(result[0])}")
        for accessor in accessors:
            word = _ACCESSORS[accessor.tag]
            self._put(accessor.line, f"{word} {_modifiers(accessor)}".strip())
            self._own_body(pou, accessor, f"{word} of {of}")
            self._put(accessor.end_line, f"END_{word}")
        self._put(found.end_line, "END_PROPERTY")

    def _own_body(self, pou: Element, part: Element, of: str) -> None:
        """Write the variables and the body of a method or an accessor `of` a POU."""
        interface, body, whole = part.find("interface"), part.find("body"), pou.find("interface")
        text = body.find("ST") if body is not None else None
        if interface is None or text is None:
            raise self._unsupported(part, f"{of} has no interface and body in ST, which is not supported")
        for block in interface.children:
            if block.tag in _BLOCKS:
                self._variables(block)
        variables = [*interface.every("variable"), *(whole.every("variable") if whole is not None else ())]
        self._statements(text, {v.attributes.get("name", "").lower() for v in variables})

    def _actions(self, pou: Element, actions: Element) -> None:
        for action in actions.children:
            if action.tag != "action":
                continue
            name = f"{self._name(pou)}.{self._name(action)}"
            with self._whole(action, "action", name):
                if _kind(pou) == "FUNCTION":
                    raise self._fail(action, f"{name}: a function has no actions")
                body = action.find("body")
                if body is None:
                    raise self._fail(action, f"action {name} has no body", expected="<body><ST>")
                self._put(action.line, f"ACTION {self._name(action)}:")
                is_chart = any(language.tag == "SFC" for language in body.children)
                if is_chart:  # the statements in its action blocks become actions, which are not nested
                    self._put(action.line, "END_ACTION")
                self._body(pou, body, self._name(action))
                if not is_chart:
                    self._put(action.end_line, "END_ACTION")

    def _variables(self, block: Element) -> None:
        """Write a block of variables. CODESYS adds its parts with different qualifiers, such as CONSTANT, if it has several."""
        if block.tag == "globalVars":
            self.last = block.line
        if mixed := next(block.every("MixedAttrsVarList"), None):
            for part in mixed.children:
                if part.tag in _BLOCKS:
                    self._variables(part)
            return
        words = [_BLOCKS[block.tag]]
        words += [word for flag, word in _QUALIFIERS.items() if block.attributes.get(flag) == "true"]
        self._put(block.line, " ".join(words))
        for v in block.children:
            if v.tag == "variable":
                self._variable(v)
        self._put(block.end_line, "END_VAR")

    def _variable(self, v: Element) -> None:
        at = f" AT {v.attributes['address']}" if v.attributes.get("address") else ""
        self._put(v.line, f"{self._name(v)}{at} : {self._type(v)}{self._initial(v)};")

    def _type(self, variable: Element) -> str:
        kind = variable.find("type")
        if kind is None or not kind.children:
            raise self._fail(variable, f"variable {variable.attributes.get('name')} has no type", expected="<type>")
        return self._type_of(kind.children[0])

    def _type_of(self, element: Element) -> str:
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
        if tag == "pointer" and inner:
            return f"POINTER TO {inner}"
        if tag in ("subrangeSigned", "subrangeUnsigned") and inner and ranges:
            return f"{inner}({ranges[0]})"
        if element.children or not tag.isupper():
            raise self._unsupported(element, f"the type {tag} is not supported")
        return tag

    def _initial(self, element: Element) -> str:
        found = element.find("initialValue")
        return f" := {self._value(found.children[0])}" if found is not None and found.children else ""

    def _value(self, element: Element) -> str:
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

    def _body(self, pou: Element, body: Element, action: str = "") -> None:
        """Write the body of a POU, or of its action `action`."""
        of = f"action {self._name(pou)}.{action}" if action else self._name(pou)
        language = next((c for c in body.children if c.tag in _LANGUAGES), None)
        if language is None:
            raise self._fail(body, f"the body of {of} has no language", expected=", ".join(_LANGUAGES))
        interface = pou.find("interface")
        own = {v.attributes.get("name", "").lower() for v in interface.every("variable")} if interface else set()
        if language.tag in ("FBD", "LD"):
            found = drawn(language, of, self.path, lambda text: self._unqualified(text, own), action.lower())
            if found.edges and _kind(pou) == "FUNCTION":
                raise self._unsupported(language, f"{of} is a function that detects an edge, which is not supported")
            self.drawings[self._name(pou).lower(), action.lower()] = found
            return
        if language.tag == "SFC" and _kind(pou) != "FUNCTION":
            self._chart(pou, language, own, action)
            return
        if language.tag != "ST":
            raise self._unsupported(language, f"{of} has a body in {language.tag}, which is not supported")
        self._statements(language, own)

    def _statements(self, text: Element, own: set[str]) -> None:
        for line, part in text.texts():
            for offset, piece in enumerate(self._unqualified(part, own).split("\n")):
                if piece.strip():
                    self._put(line + offset, piece)

    def _chart(self, pou: Element, language: Element, own: set[str], action: str) -> None:
        """Read a chart, and write the statements in its action blocks as actions."""
        named = {
            transition.attributes.get("name", "").lower(): body
            for transition in pou.inside("transitions")
            if (body := transition.find("body")) is not None
        }
        name = self._name(pou)
        of = f"{name}.{action}" if action else name
        found = read_chart(language, of, self.path, lambda text: self._unqualified(text, own), named)
        for inline in found.inline:
            self._put(inline.element.line, f"ACTION {inline.name}:")
            self._statements(inline.element, own)
            self._put(inline.element.end_line, "END_ACTION")
        self.drawings[name.lower(), action.lower()] = found.drawn

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


def _modifiers(element: Element) -> str:
    """Return the access and other modifiers of a method, a property or an accessor; "" for none."""
    found = {word for interface in (element.find("interface"),) if interface for one in interface.every("AccessModifiers")
             for word, value in one.attributes.items() if value == "true"}  # fmt: skip
    return " ".join(word.upper() for word in _MODIFIERS if word in found)


def _kind(pou: Element) -> str:
    """Return the kind of a POU in capitals, or "" if the standard does not know it."""
    return _POUS.get(pou.attributes.get("pouType", ""), "")
