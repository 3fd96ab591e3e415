"""Compiles how a variable that a decision read is found after the scan: with the values that indices had then, and through
VAR_IN_OUT.

This happens at changes of tags, between two scans, so each variable becomes one Python function.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.scope import Symbol
from fieldtwin.plc.st.inspection import Inspection
from fieldtwin.plc.st.runtime.lines import RECORD_HEAD, SOURCE, Record, record_of
from fieldtwin.plc.st.runtime.logic_error import LogicError
from fieldtwin.plc.st.runtime.references import Element, MemberReference
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.written import text_of
from fieldtwin.plc.st.values import index


class NotFollowed(Exception):
    """A variable that cannot be found after the scan. The text says why."""


class Found(NamedTuple):
    """A variable as it was found: its value, the object and the attribute that hold it, and the indices, from 0, of an
    element.
    """

    value: Any
    owner: Any
    attribute: str
    at: tuple[int, ...] = ()
    lines: Any = None
    """The records of the elements of its array, if only a reference knows them."""

    def record(self, path: str) -> Record:
        """Return the record of its last assignment; empty if that is not known. `path` is the file of the program."""
        if self.lines is not None:
            found: Record = self.lines.of(self.at)
            return found
        return record_of(self.owner, self.attribute, self.at, path)


@dataclass(frozen=True, slots=True)
class Access:
    """How a variable of type `kind` is found in the object of its POU, with the record of the statement that read it."""

    ref: t.Ref
    kind: ty.Type
    find: Callable[[Any, Record], Found]
    """Raises `NotFollowed`."""


class Accesses:
    """The variables of one POU. `symbols` are its declared variables by name in lower case, `shared` the global ones."""

    def __init__(self, inspection: Inspection, symbols: Mapping[str, Symbol], shared: Mapping[str, Symbol]) -> None:
        self._inspection, self._symbols, self._shared = inspection, symbols, shared

    def is_variable(self, ref: t.Ref) -> bool:
        """Return whether `ref` is a variable of the POU, or a part of a global one; not a constant or an enumerated value."""
        own = self._symbols.get(ref.name.lower())
        if own is None:
            return ref.name.lower() in self._shared and bool(ref.selectors)
        return own.constant is None

    def is_in_out(self, ref: t.Ref) -> bool:
        """Return whether `ref` is a VAR_IN_OUT of a simple type."""
        own = self._symbols.get(ref.name.lower())
        return own is not None and own.reference.startswith("self.")

    def access(self, ref: t.Ref, source: Sequence[Any]) -> Access:
        """Return how `ref` is found. `source` is that of the record of the statement. Raises `NotFollowed`."""
        symbol = self._symbols.get(ref.name.lower())
        if symbol is None or not symbol.code.startswith("self."):
            why = "a global variable" if ref.name.lower() in self._shared else "not kept after the call"
            raise NotFollowed(f"{ref.name} is {why}")
        lent = symbol.reference.startswith("self.")
        owner, attribute, kind = "b", symbol.code.split(".")[1], symbol.type
        at: list[str] = []
        for selector in ref.selectors:
            if isinstance(kind, ty.Pointer | ty.Interface):
                raise NotFollowed("a reference is followed only if the statement assigns through it")
            if isinstance(selector, t.Bit):
                break
            if isinstance(selector, t.Index) and isinstance(kind, ty.Array):
                at += self._numbers(selector, kind, source)
                kind = kind.of
            elif isinstance(selector, t.Member):
                found = self._inspection.member_attribute(kind, selector.name)
                if found is None:
                    raise NotFollowed(f"{selector.name} is not kept after the scan")
                owner, at = f"{owner}.{attribute}{''.join(f'[{i}]' for i in at)}", []
                attribute, kind = found
            else:
                raise NotFollowed(f"a part of a {kind} is not followed")
        if lent:
            return Access(ref, kind, lambda b, r: _referred(getattr(b, attribute)))
        value = f"o.{attribute}" + "".join(f"[a[{n}]]" for n in range(len(at)))
        code = f"lambda b, r: (lambda o, a: Found({value}, o, {attribute!r}, a))({owner}, ({''.join(f'{i}, ' for i in at)}))"
        find = eval(code, {"Found": Found, "index": index})  # safe: names of declarations, and numbers
        return Access(ref, kind, _checked(find))

    def _numbers(self, selector: t.Index, kind: ty.Array, source: Sequence[Any]) -> Iterator[str]:
        """Yield the Python code of each index, from 0."""
        for expr, (low, high) in zip(selector.indices, kind.ranges, strict=True):
            yield f"index({self._number(expr, source)}, {low}, {high})"

    def _number(self, expr: t.Expr, source: Sequence[Any]) -> str:
        """Return the Python code of the value that an index had."""
        if isinstance(expr, t.Literal) and expr.kind == "INTEGER":
            return str(int(expr.text.replace("_", "")))
        if isinstance(expr, t.Unary) and expr.op == "-":
            return f"(-{self._number(expr.operand, source)})"
        if isinstance(expr, t.Binary) and expr.op in ("+", "-", "*"):
            return f"({self._number(expr.left, source)} {expr.op} {self._number(expr.right, source)})"
        if isinstance(expr, t.Ref):
            symbol = self._symbols.get(expr.name.lower()) or self._shared.get(expr.name.lower())
            if symbol is not None and isinstance(symbol.constant, int) and not expr.selectors:
                return str(symbol.constant)
            for code in self._codes(expr):
                if code in source:
                    return f"r[{RECORD_HEAD + source.index(code) - SOURCE}]"
        raise NotFollowed(f"the value that {text_of(expr)} had in this line was not recorded")

    def index_names(self, ref: t.Ref, source: Sequence[Any]) -> Iterator[tuple[str, int]]:
        """Yield the variables in the indices of `ref`, with the places of their values in records with this `source`,
        counted after the first part.
        """
        for selector in ref.selectors:
            for expr in selector.indices if isinstance(selector, t.Index) else ():
                for one in _refs(expr):
                    for code in self._codes(one):
                        if code in source:
                            yield text_of(one), source.index(code) - SOURCE

    def _codes(self, ref: t.Ref) -> list[str]:
        """Return the Python code that a variable in an index may have, without ``self.``."""
        symbol = self._symbols.get(ref.name.lower()) or self._shared.get(ref.name.lower())
        codes = [symbol.code.removeprefix("self.")] if symbol is not None else []
        for selector in ref.selectors:
            name = selector.name if isinstance(selector, t.Member) else ""
            codes = [
                f"{code}.{of}" for code in codes for of in (f"m_{name.lower()}", f"v_{name.lower()}", name.upper())
            ]
        return codes


def _refs(expr: t.Expr) -> Iterator[t.Ref]:
    """Yield the variables in an index."""
    if isinstance(expr, t.Binary):
        yield from _refs(expr.left)
        yield from _refs(expr.right)
    elif isinstance(expr, t.Unary):
        yield from _refs(expr.operand)
    elif isinstance(expr, t.Ref):
        yield expr


def _checked(find: Callable[[Any, Record], Found]) -> Callable[[Any, Record], Found]:
    def checked(body: Any, record: Record) -> Found:
        try:
            return find(body, record)
        except (LogicError, AttributeError) as e:
            raise NotFollowed(e.message if isinstance(e, LogicError) else "a VAR_IN_OUT has no variable yet") from e

    return checked


def _referred(reference: Any) -> Found:
    """Return the variable to which the reference of a VAR_IN_OUT refers."""
    if isinstance(reference, MemberReference):
        return Found(reference.v, reference.owner, reference.name)
    if isinstance(reference, Element):
        try:
            return Found(reference.v, reference.owner, "", (reference.at,), reference.of_array)
        except LogicError as e:
            raise NotFollowed(e.message) from e
    raise NotFollowed("a VAR_IN_OUT whose variable is not kept after the call")
