"""Read a file of unit tests in Rust into items and expressions: the part of the language that such tests use.

Types, lifetimes and visibility are skipped. An expression is a tuple whose first element is its kind, such as
``("call", function, arguments)``. This module knows nothing of what the tests call.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

Expression = tuple[Any, ...]

_TOKEN = re.compile(
    r"""(?P<skip>\s+|//[^\n]*|/\*.*?\*/)
    |(?P<raw>b?r(?P<hashes>\#*)".*?"(?P=hashes))
    |(?P<text>b?"(?:\\.|[^"\\])*")
    |(?P<char>b?'(?:\\.[^']*|[^'\\])')
    |(?P<lifetime>'\w+)
    |(?P<number>0x[0-9A-Fa-f_]+?(?:[iu](?:8|16|32|64|size))?(?!\w)|0b[01_]+
        |\d[\d_]*(?:\.\d[\d_]*)?(?:[eE][+-]?\d+)?(?:_?[iuf](?:8|16|32|64|size))?)
    |(?P<name>[^\W\d]\w*)
    |(?P<mark>::|->|=>|\.\.=|\.\.|&&|\|\||==|!=|<=|>=|.)""",
    re.VERBOSE | re.DOTALL,
)
_SUFFIX = re.compile(r"_?[iuf](?:8|16|32|64|size)$")
_ESCAPES = {"n": "\n", "t": "\t", "r": "\r", "0": "\0"}
_CLOSING = {"(": ")", "[": "]", "{": "}"}
_BINARY = [["||"], ["&&"], ["==", "!=", "<", ">", "<=", ">="], ["+", "-"], ["*", "/"]]


class NotRead(Exception):
    """The file or test uses a construct that is not read. The text names it."""


@dataclass(frozen=True, slots=True)
class Token:
    kind: str
    text: str
    start: int
    end: int


@dataclass(slots=True)
class Function:
    """A function, with its cases if it is a test with several: by the name of the case the expressions of its arguments."""

    name: str
    parameters: list[str]
    body: Callable[[], Expression]
    """Parses the body, so that a construct which is not read concerns this function only."""
    is_test: bool = False
    cases: dict[str, Callable[[], list[Expression]]] = field(default_factory=dict)
    values: dict[str, Callable[[], list[Expression]]] = field(default_factory=dict)
    """By parameter of a test: the values with which it is executed."""


@dataclass(slots=True)
class RustFile:
    functions: dict[str, Function] = field(default_factory=dict)
    constants: dict[str, Callable[[], Expression]] = field(default_factory=dict)
    macros: list[Expression] = field(default_factory=list)
    """The calls of macros outside of functions, as ``("macro", name, parser of the arguments, text of the arguments)``."""


def tokens_of(text: str) -> list[Token]:
    found = []
    for match in _TOKEN.finditer(text):
        kind = str(match.lastgroup) if match.lastgroup != "hashes" else "raw"
        if kind not in ("skip", "lifetime"):
            found.append(Token(kind, match.group(), match.start(), match.end()))
    return found


def read(text: str) -> RustFile:
    """Return the functions, constants and calls of macros of a file."""
    return _Items(text, tokens_of(text)).read()


class _Cursor:
    def __init__(self, text: str, tokens: list[Token]) -> None:
        self.text, self.tokens, self.at = text, tokens, 0

    def peek(self, ahead: int = 0) -> str:
        place = self.at + ahead
        return self.tokens[place].text if place < len(self.tokens) else ""

    def take(self, wanted: str = "") -> Token:
        if self.at >= len(self.tokens) or (wanted and self.peek() != wanted):
            raise NotRead(f"{wanted or 'a token'} is expected; got {self.peek() or 'the end'}")
        self.at += 1
        return self.tokens[self.at - 1]

    def skip(self, wanted: str) -> bool:
        if self.peek() != wanted:
            return False
        self.at += 1
        return True

    def group(self) -> Parser:
        """Take a group in brackets, and return what parses its inside."""
        opening = self.take()
        closing, depth, start = _CLOSING[opening.text], 1, self.at
        while depth:
            text = self.take().text
            depth += (text == opening.text) - (text == closing)
        return Parser(self.text, self.tokens[start : self.at - 1])

    def until(self, *ends: str) -> None:
        """Take everything up to one of `ends` outside of brackets, such as a type."""
        while self.at < len(self.tokens) and self.peek() not in ends:
            if self.peek() in _CLOSING:
                self.group()
            else:
                self.at += 1

    def generic(self) -> str:
        """Take the types in angle brackets, if there are any, and return their text."""
        if self.peek() != "<":
            return ""
        start, depth = self.at, 0
        while True:
            text = self.take().text
            depth += (text == "<") - (text == ">")
            if not depth:
                return "".join(token.text for token in self.tokens[start + 1 : self.at - 1])


class _Items(_Cursor):
    def read(self) -> RustFile:
        found = RustFile()
        while self.at < len(self.tokens):
            cases, is_test = self._attributes()
            while self.peek() in ("pub", "async", "unsafe"):
                self.take()
                if self.peek() == "(":
                    self.group()
            word = self.take().text if self.at < len(self.tokens) else ""
            if word == "fn":
                made = self._function()
                made.is_test, made.cases = is_test, cases
                found.functions[made.name] = made
            elif word in ("const", "static"):
                name = self.take().text
                self.until("=")
                self.take("=")
                start = self.at
                self.until(";")
                found.constants[name] = Parser(self.text, self.tokens[start : self.at]).later("expression")
                self.take(";")
            elif self.peek() == "!" and self.peek(1) in _CLOSING:
                self.take("!")
                inside = self.group()
                found.macros.append(("macro", word, inside.later("arguments"), inside.span()))
                self.skip(";")
            else:  # use, mod, struct, impl
                self.until(";", "{")
                if self.peek() == "{":
                    self.group()
                self.skip(";")
        return found

    def _attributes(self) -> tuple[dict[str, Callable[[], list[Expression]]], bool]:
        cases: dict[str, Callable[[], list[Expression]]] = {}
        is_test = False
        while self.skip("#"):
            self.skip("!")
            inside = self.group()
            name = inside.take().text
            is_test = is_test or name in ("test", "rstest", "spec_test")
            if name == "case" and inside.at < len(inside.tokens):
                label = inside.take().text if inside.skip("::") else f"case_{len(cases) + 1}"
                cases[label] = inside.group().later("arguments")
        return cases, is_test

    def _function(self) -> Function:
        name = self.take().text
        self.generic()
        inside, found = self.group(), Function(name, [], self._nothing)
        while inside.at < len(inside.tokens):
            values = None
            while inside.skip("#"):
                attribute = inside.group()
                if attribute.take().text == "values":
                    values = attribute.group().later("arguments")
            inside.skip("mut")
            found.parameters.append(inside.take().text)
            if values is not None:
                found.values[found.parameters[-1]] = values
            inside.until(",")
            inside.skip(",")
        self.until("{")
        found.body = self.group().later("block")
        return found

    @staticmethod
    def _nothing() -> Expression:
        return ("block", [])


class Parser(_Cursor):
    """Parses expressions and statements."""

    def later(self, method: str) -> Callable[[], Any]:
        """Return what parses the tokens with `method`, so that an error concerns only what needs them."""
        return lambda: getattr(Parser(self.text, self.tokens), method)()

    def span(self) -> str:
        return self.text[self.tokens[0].start : self.tokens[-1].end] if self.tokens else ""

    def arguments(self) -> list[Expression]:
        """Return expressions separated by commas. Attributes before them are skipped."""
        found = []
        while self.at < len(self.tokens):
            while self.skip("#"):
                self.group()
            if self.at + 1 < len(self.tokens) and self.peek(1) == "=":
                name = self.take().text
                self.take("=")
                found.append(("let", name, self.expression()))
            else:
                found.append(self.expression())
            if self.at < len(self.tokens):
                self.take(",")
        return found

    def block(self) -> Expression:
        statements: list[Expression] = []
        while self.at < len(self.tokens):
            if self.skip(";"):
                continue
            if self.skip("use"):
                self.until(";")
            elif self.skip("let"):
                statements.append(self._let())
            elif self.skip("for"):
                pattern = self._pattern()
                self.take("in")
                over = self.expression(structs=False)
                statements.append(("for", pattern, over, self.group().block()))
            elif self.skip("{"):
                self.at -= 1
                statements.append(self.group().block())
            else:
                statements.append(self.expression())
        return ("block", statements)

    def _let(self) -> Expression:
        pattern = self._pattern()
        if self.peek() == ":":
            self.until("=", ";")
        self.take("=")
        return ("let", pattern, self.expression())

    def _pattern(self) -> Any:
        self.skip("mut")
        if self.peek() == "(":
            inside, names = self.group(), []
            while inside.at < len(inside.tokens):
                names.append(inside._pattern())
                inside.skip(",")
            return names
        return self.take().text

    def expression(self, level: int = 0, structs: bool = True) -> Expression:
        if level == 0:
            first = self._binary(0, structs)
            if self.peek() in ("..", "..="):
                inclusive = self.take().text == "..="
                return ("range", first, self._binary(0, structs), inclusive)
            return first
        return self._binary(level, structs)

    def _binary(self, level: int, structs: bool) -> Expression:
        if level == len(_BINARY):
            return self._cast(structs)
        left = self._binary(level + 1, structs)
        while self.peek() in _BINARY[level]:
            operator = self.take().text
            left = ("binary", operator, left, self._binary(level + 1, structs))
        return left

    def _cast(self, structs: bool) -> Expression:
        found = self._unary(structs)
        while self.skip("as"):
            found = ("cast", found, self.take().text)
        return found

    def _unary(self, structs: bool) -> Expression:
        if self.peek() in ("&", "*", "&&"):
            self.take()
            self.skip("mut")
            return self._unary(structs)
        if self.peek() in ("-", "!"):
            return ("unary", self.take().text, self._unary(structs))
        return self._postfix(self._primary(structs))

    def _postfix(self, found: Expression) -> Expression:
        while True:
            if self.skip("."):
                name = self.take().text
                generic = self.generic() if self.skip("::") else ""
                if self.peek() == "(":
                    found = ("method", found, name, generic, self.group().arguments())
                else:
                    found = ("field", found, name)
            elif self.peek() == "(":
                found = ("call", found, self.group().arguments())
            elif self.peek() == "[":
                found = ("index", found, self.group().expression())
            elif not self.skip("?"):
                return found

    def _primary(self, structs: bool) -> Expression:
        token = self.tokens[self.at] if self.at < len(self.tokens) else Token("", "", 0, 0)
        match token.kind, token.text:
            case "number", text:
                self.take()
                return ("value", number(text))
            case (("text" | "raw"), text):
                self.take()
                return ("value", text_of(text))
            case "char", text:
                self.take()
                return ("value", text_of(text.replace('"', '\\"')))
            case _, "(":
                inside = self.group()
                found = inside.arguments()
                is_tuple = len(found) != 1 or inside.tokens[-1].text == ","
                return ("tuple", found) if is_tuple else found[0]
            case _, "[":
                return ("list", self.group().arguments())
            case _, "{":
                return self.group().block()
            case _, "|":
                self.take()
                parameters = []
                while not self.skip("|"):
                    parameters.append(self.take().text)
                    self.until(",", "|")
                    self.skip(",")
                return ("closure", parameters, self.expression())
            case "name", "move":
                self.take()
                return self._primary(structs)
            case "name", _:
                return self._path(structs)
        raise NotRead(f"an expression is expected; got {token.text or 'the end'}")

    def _path(self, structs: bool) -> Expression:
        parts, generic = [self.take().text], ""
        while self.skip("::"):
            if self.peek() == "<":
                generic = self.generic()
            else:
                parts.append(self.take().text)
        name = "::".join(parts)
        if name in ("true", "false"):
            return ("value", name == "true")
        if self.peek() == "!" and self.peek(1) in _CLOSING:
            self.take("!")
            inside = self.group()
            return ("macro", name, inside.later("arguments"), inside.span())
        if self.peek() == "{" and structs and name[0].isupper():
            return ("struct", name, self._fields(self.group()))
        return ("name", name, generic)

    def _fields(self, inside: Parser) -> dict[str, Expression]:
        found: dict[str, Expression] = {}
        while inside.at < len(inside.tokens):
            if inside.skip(".."):
                inside.expression()
            else:
                name = inside.take().text
                found[name] = inside.expression() if inside.skip(":") else ("name", name, "")
            inside.skip(",")
        return found


def number(text: str) -> int | float:
    if text.startswith(("0x", "0b")):
        return int(_SUFFIX.sub("", text) if text.startswith("0b") or re.search(r"[iu]\w+$", text) else text, 0)
    plain = _SUFFIX.sub("", text).replace("_", "")
    is_real = "." in plain or "e" in plain.lower() or re.search(r"f(32|64)$", text)
    return float(plain) if is_real else int(plain)


def text_of(literal: str) -> str:
    """Return the text of a string literal: escapes are replaced, and a backslash at the end of a line joins it to the next."""
    literal = literal.removeprefix("b")
    if literal.startswith("r"):
        hashes = literal.index('"') - 1
        return literal[2 + hashes : len(literal) - 1 - hashes]

    def escaped(match: re.Match[str]) -> str:
        text = match.group(1)
        if text[0] in "xu":
            return chr(int(text.strip("xu{}"), 16))
        return "" if text[0] == "\n" else _ESCAPES.get(text, text)

    return re.sub(r"\\(x[0-9a-fA-F]{2}|u\{[^}]*\}|\n\s*|.)", escaped, literal[1:-1])
