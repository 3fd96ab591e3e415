"""The base class of the rules: positions of nodes, and tokens without a valid meaning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lark import Token
from lark.tree import Meta
from lark.visitors import Transformer_NonRecursive

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.source import MAX_NAME, shortened


class Bad(Exception):
    """A token that is well formed but has no valid meaning."""

    def __init__(self, token: Token, message: str) -> None:
        super().__init__(message)
        self.token = token

    def at(self, path: str) -> FileInvalid:
        """Return the error with its place in the file `path`."""
        line, column = self.token.line or 1, self.token.column or 1
        return FileInvalid(str(self), path=path, line=line, column=column, got=shortened(str(self.token)))


@dataclass(frozen=True, slots=True)
class Bases:
    """The names after EXTENDS, IMPLEMENTS or USING."""

    word: str
    names: tuple[t.NamedType, ...]


class Rules(Transformer_NonRecursive[Token, Any]):
    """The transformer that builds the tree bottom up: children are already nodes, tokens are still tokens.

    It is not recursive, so the nesting depth has no limit. Its subclasses have a method for each rule.
    """

    def __init__(self, path: str, before: tuple[int, int] = (0, 0), at: t.Pos | None = None) -> None:
        super().__init__()
        self._path = path
        self._lines, self._columns = before
        self._at = at

    def _pos(self, where: Meta | Token) -> t.Pos:
        if self._at is not None:
            return self._at
        line, column = where.line or 1, where.column or 1
        return t.Pos(line + self._lines, column + (self._columns if line == 1 else 0), self._path)

    def NAME(self, token: Token) -> Token:
        if len(token) > MAX_NAME:
            raise Bad(token, f"a name of more than {MAX_NAME} characters")
        return token


def integer(token: Token) -> int:
    """Return the value of an integer literal: underscores, ``16#``, ``8#``, ``2#``, with or without a type before
    it."""
    *_, base, digits = ["10", *token.replace("_", "").split("#")]
    try:
        return int(digits, int(base))
    except ValueError as e:
        raise Bad(token, "not a whole number that any type holds") from e
