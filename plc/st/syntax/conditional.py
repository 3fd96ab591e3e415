"""Conditional compilation of CODESYS and TwinCAT: ``{IF defined (name)}``, ``{ELSIF ...}``, ``{ELSE}``, ``{END_IF}``,
``{DEFINE name}`` and ``{UNDEFINE name}``.

A name is defined from its ``{DEFINE}`` on to the end of the file. Conditions are ``defined (name)``, NOT, AND, OR and
parentheses. The others of CODESYS, such as ``defined (type: ST_Axis)`` and ``hasvalue (...)``, depend on declarations or on
the controller and are refused by name.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field

_DIRECTIVE = re.compile(r"\{\s*(IF|ELSIF|ELSE|END_IF|DEFINE|UNDEFINE)\b(.*)\}\Z", re.IGNORECASE | re.DOTALL)
_TOKEN = re.compile(r"\s*([A-Za-z_]\w*|[():,']|.)", re.DOTALL)
_OTHERS = (
    "hasattribute",
    "hastype",
    "hasvalue",
    "hasconstantvalue",
    "project_defined",
    "is_little_endian",
    "is_simulation",
)
MAX_NESTED = 32
"""How deep conditional parts may be nested."""


class Wrong(Exception):
    """A directive with an error. `expected` is what is allowed in its place."""

    def __init__(self, message: str, expected: str = "") -> None:
        super().__init__(message)
        self.expected = expected


def is_directive(pragma: str) -> bool:
    return _DIRECTIVE.match(pragma) is not None


@dataclass(slots=True)
class _Part:
    """An ``{IF}`` at the position `at` of the text that has not ended.

    `outside`: the text around it is compiled. `taken`: one of its branches was compiled.
    """

    at: int
    outside: bool
    taken: bool
    active: bool
    otherwise: bool = False


@dataclass(slots=True)
class Conditions:
    """The conditional parts of a text at the present place."""

    names: set[str] = field(default_factory=set)
    parts: list[_Part] = field(default_factory=list)

    @property
    def active(self) -> bool:
        """Return whether the text at this place is compiled."""
        return not self.parts or self.parts[-1].active

    def read(self, pragma: str, at: int) -> None:
        """Follow a directive at the position `at` of the text. Raises `Wrong`."""
        found = _DIRECTIVE.match(pragma)
        assert found is not None
        word, rest = found[1].upper(), found[2].strip()
        if word in ("DEFINE", "UNDEFINE"):
            self._define(word, rest)
        elif word == "IF":
            if len(self.parts) >= MAX_NESTED:
                raise Wrong("{IF} nested too deep", f"at most {MAX_NESTED} levels")
            value = self.active and _Condition(rest, self.names).value()
            self.parts.append(_Part(at, self.active, value, value))
        elif not self.parts:
            raise Wrong(f"{{{word}}} without {{IF}}")
        elif word == "END_IF":
            self.parts.pop()
        else:
            self._branch(self.parts[-1], word, rest)

    def _branch(self, part: _Part, word: str, rest: str) -> None:
        if part.otherwise:
            raise Wrong(f"{{{word}}} after {{ELSE}}", "{END_IF}")
        open_ = part.outside and not part.taken
        part.active = open_ and (word == "ELSE" or _Condition(rest, self.names).value())
        part.taken = part.taken or part.active
        part.otherwise = word == "ELSE"

    def _define(self, word: str, rest: str) -> None:
        if re.fullmatch(r"[A-Za-z_]\w*(\s+'[^']*')?", rest) is None:
            raise Wrong(f"{{{word}}} without a name", f"{{{word} name}}")
        name = rest.split()[0].lower()
        if self.active:
            (self.names.add if word == "DEFINE" else self.names.discard)(name)


class _Condition:
    """The condition of an ``{IF}``, which is evaluated while it is read."""

    def __init__(self, text: str, names: set[str]) -> None:
        self._tokens = [token for token in _TOKEN.findall(text) if token.strip()]
        self._names = names
        self._at = 0

    def value(self) -> bool:
        found = self._joined("OR", lambda: self._joined("AND", self._single))
        if self._at < len(self._tokens):
            raise Wrong(f"{self._tokens[self._at]} in the condition of {{IF}}", "AND, OR or the end of the condition")
        return found

    def _joined(self, word: str, operand: Callable[[], bool]) -> bool:
        values = [operand()]
        while self._is(word):
            values.append(operand())
        return any(values) if word == "OR" else all(values)

    def _single(self) -> bool:
        inverted = False
        while self._is("NOT"):
            inverted = not inverted
        if self._is("("):
            found = self._joined("OR", lambda: self._joined("AND", self._single))
        else:
            self._expect("DEFINED")
            self._expect("(")
            name = self._next()
            if self._at < len(self._tokens) and self._tokens[self._at] == ":":
                raise Wrong(f"the condition defined ({name}: ...) is not supported", "defined (name)")
            found = name.lower() in self._names
        self._expect(")")
        return found != inverted

    def _next(self) -> str:
        if self._at == len(self._tokens):
            raise Wrong("a condition of {IF} that is not complete", "defined (name)")
        self._at += 1
        token: str = self._tokens[self._at - 1]
        return token

    def _is(self, word: str) -> bool:
        found = self._at < len(self._tokens) and self._tokens[self._at].upper() == word
        self._at += found
        return found

    def _expect(self, word: str) -> None:
        got = self._next()
        if got.lower() in _OTHERS:
            raise Wrong(f"the condition {got} (...) is not supported", "defined (name)")
        if got.upper() != word:
            raise Wrong(f"{got} in the condition of {{IF}}", "defined (name), NOT, AND, OR and parentheses")
