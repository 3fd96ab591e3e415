"""Compiles how a variable that a decision read is found after the scan: with the values that indices and pointers had then, and
through VAR_IN_OUT.

This happens at changes of tags, between two scans, so each variable becomes one Python function.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.assignments import GLOBALS
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.compiler.scope import Symbol
from fieldtwin.plc.st.inspection import Inspection
from fieldtwin.plc.st.runtime.lines import RECORD_HEAD, SOURCE, Record, record_of
from fieldtwin.plc.st.runtime.logic_error import LogicError
from fieldtwin.plc.st.runtime.references import Cut, Element, MemberReference, Whole
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.written import reference, text_of
from fieldtwin.plc.st.values import index

_SHARED = f"{GLOBALS}."
"""The beginning of the Python code of a global variable."""


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


Find = Callable[[Any, Any, Record], Found]
"""A function of the object of the POU, the object with the global variables, and the record of the statement."""


@dataclass(frozen=True, slots=True)
class Access:
    """How a variable of type `kind` is found after the statement with a record was executed."""

    ref: t.Ref
    kind: ty.Type
    find: Find
    """Raises `NotFollowed`."""
    of_pou: bool = True
    """Whether it is a variable of the object of the POU, and not a global one or one to which a pointer points."""
    pointer: str = ""
    """The pointer that leads to it, as in the source; empty for none."""
    pointed: int = 0
    """The place of the value of the pointer after the first part of a record."""
    whole: bool = False
    """Whether it is the variable to which the pointer points, and not a part of it."""


class Accesses:
    """The variables that statements of a POU use. `pou` is its name in lower case."""

    def __init__(self, inspection: Inspection, unit: CompiledUnit, pou: str) -> None:
        self._inspection, self._unit, self._pou = inspection, unit, pou
        self._shared = {s.name.lower(): s for s in unit.global_symbols}
        self._visible: dict[str, Mapping[str, Symbol]] = {}

    def visible(self, inside: str) -> Mapping[str, Symbol]:
        """Return the variables that `inside` declares, by name in lower case: the POU, a method (``pou.method``) with the
        variables of its owner, or a function.
        """
        if inside not in self._visible:
            symbols = self._unit.symbols
            keys = [key for key in (inside, f"{inside}.get", f"{inside}.set") if key in symbols]
            if not keys and inside.partition(".")[0] == self._pou:  # an action
                keys = [self._pou]
            self._visible[inside] = {s.name.lower(): s for key in keys for s in symbols.get(key, ())}
        return self._visible[inside]

    def variable(self, ref: t.Ref, inside: str) -> tuple[Symbol | None, tuple[t.Selector, ...]]:
        """Return the variable to which `ref` refers in the POU or method `inside`, and the selectors after its name."""
        name = ref.name.lower()
        symbol = self.visible(inside).get(name) or self._shared.get(name)
        first = ref.selectors[0] if ref.selectors else None
        if symbol is None and isinstance(first, t.Member):
            of_list = self._unit.globals.get(f"{name}.{first.name.lower()}")
            if of_list is not None:
                return Symbol(of_list.name, of_list.kind, f"{_SHARED}{of_list.attribute}"), ref.selectors[1:]
        return symbol, ref.selectors

    def is_variable(self, ref: t.Ref, inside: str) -> bool:
        """Return whether `ref` is a variable; not a constant or an enumerated value."""
        symbol = self.variable(ref, inside)[0]
        return symbol is not None and symbol.constant is None

    def is_own(self, ref: t.Ref, inside: str) -> bool:
        """Return whether `ref` is a variable that the object of the POU keeps, or a part of one."""
        symbol = self.variable(ref, inside)[0]
        return symbol is not None and symbol.code.startswith("self.")

    def is_in_out(self, ref: t.Ref, inside: str) -> bool:
        """Return whether `ref` is a VAR_IN_OUT of a simple type."""
        symbol = self.variable(ref, inside)[0]
        return symbol is not None and symbol.reference.startswith("self.")

    def access(self, ref: t.Ref, inside: str, source: Sequence[Any]) -> Access:
        """Return how `ref` is found. `source` is that of the record of the statement. Raises `NotFollowed`."""
        symbol, selectors = self.variable(ref, inside)
        if symbol is None:
            raise NotFollowed(f"{ref.name} is not known here")
        if symbol.reference.startswith("self."):
            attribute = symbol.reference.removeprefix("self.")
            return Access(ref, symbol.type, lambda b, g, r: _referred(getattr(b, attribute), "a VAR_IN_OUT"))
        return _Path(self, ref, inside, source).access(symbol, selectors)

    def member(self, kind: ty.Type, name: str) -> tuple[str, ty.Type]:
        """Return the attribute and the type of a member. Raises `NotFollowed`."""
        found = self._inspection.member_attribute(kind, name)
        if found is None:
            raise NotFollowed(f"{name} is not kept after the scan")
        return found

    def target(self, kind: ty.Pointer) -> ty.Type:
        """Return the type of the variables to which pointers of a type point. Raises `NotFollowed`."""
        if not isinstance(kind.of, ty.Named):
            return kind.of
        if kind.of.key not in self._unit.types:
            raise NotFollowed(f"the type {kind.of} is not known here")
        return self._unit.types[kind.of.key]

    def number(self, expr: t.Expr, inside: str, source: Sequence[Any]) -> str:
        """Return the Python code of the value that an index had. Raises `NotFollowed`."""
        if isinstance(expr, t.Literal) and expr.kind == "INTEGER":
            return str(int(expr.text.replace("_", "")))
        if isinstance(expr, t.Unary) and expr.op == "-":
            return f"(-{self.number(expr.operand, inside, source)})"
        if isinstance(expr, t.Binary) and expr.op in ("+", "-", "*"):
            return f"({self.number(expr.left, inside, source)} {expr.op} {self.number(expr.right, inside, source)})"
        if isinstance(expr, t.Ref):
            symbol, selectors = self.variable(expr, inside)
            if symbol is not None and isinstance(symbol.constant, int) and not selectors:
                return str(symbol.constant)
            for code in self._codes(expr, inside):
                if code in source:
                    return _recorded(code, source)
        raise NotFollowed(f"the value that {text_of(expr)} had in this line was not recorded")

    def index_names(self, ref: t.Ref, inside: str, source: Sequence[Any]) -> Iterator[tuple[str, int]]:
        """Yield the variables in the indices of `ref`, with the places of their values in records with this `source`,
        counted after the first part.
        """
        for selector in ref.selectors:
            for expr in selector.indices if isinstance(selector, t.Index) else ():
                for one in _refs(expr):
                    for code in self._codes(one, inside):
                        if code in source:
                            yield text_of(one), source.index(code) - SOURCE

    def _codes(self, ref: t.Ref, inside: str) -> list[str]:
        """Return the Python code that a variable in an index may have, without ``self.``."""
        symbol, selectors = self.variable(ref, inside)
        codes = [symbol.code.removeprefix("self.")] if symbol is not None else []
        for selector in selectors:
            name = selector.name if isinstance(selector, t.Member) else ""
            codes = [
                f"{code}.{of}" for code in codes for of in (f"m_{name.lower()}", f"v_{name.lower()}", name.upper())
            ]
        return codes


class _Path:
    """The way from the object of a POU, or from the global variables, to a variable, as Python code."""

    def __init__(self, accesses: Accesses, ref: t.Ref, inside: str, source: Sequence[Any]) -> None:
        self._accesses, self._ref, self._inside, self._source = accesses, ref, inside, source
        self._holder, self._attribute, self._lines = "b", "", "None"
        self._at: list[str] = []
        self._kind: ty.Type = ty.INT
        self._recorded = ""
        """The code that a record has for the variable so far; empty if it is an element, or behind a pointer."""
        self._of_pou, self._pointer, self._pointed = True, "", 0

    def access(self, symbol: Symbol, selectors: Sequence[t.Selector]) -> Access:
        self._kind, self._recorded = symbol.type, symbol.code.removeprefix("self.")
        if symbol.code.startswith(("self.", _SHARED)):
            of, self._attribute = symbol.code.split(".")[:2]
            self._holder, self._of_pou = ("g", False) if of == GLOBALS else ("b", True)
        elif not (isinstance(symbol.type, ty.Pointer) and self._recorded in self._source):
            raise NotFollowed(f"{self._ref.name} is not kept after the call")
        for selector in selectors:
            if _is_reference(self._kind):
                self._dereference(selector)
            if isinstance(selector, t.Bit):
                break
            if isinstance(selector, t.Deref) and isinstance(self._kind, ty.Pointer):
                self._dereference(selector)
            elif isinstance(selector, t.Index) and isinstance(self._kind, ty.Array):
                self._recorded = ""
                self._at += self._numbers(selector, self._kind)
                self._kind = self._kind.of
            elif isinstance(selector, t.Member):
                attribute, kind = self._accesses.member(self._kind, selector.name)
                self._holder, self._attribute, self._kind = self._code(self._holder), attribute, kind
                self._recorded = self._recorded and f"{self._recorded}.{attribute}"
                self._at, self._lines = [], "None"
            else:
                raise NotFollowed(f"a part of a {self._kind} is not followed")
        if _is_reference(self._kind):
            self._dereference(None)
        return self._made()

    def _numbers(self, selector: t.Index, kind: ty.Array) -> Iterator[str]:
        """Yield the Python code of each index, from 0."""
        for expr, (low, high) in zip(selector.indices, kind.ranges, strict=True):
            yield f"index({self._accesses.number(expr, self._inside, self._source)}, {low}, {high})"

    def _dereference(self, at: t.Selector | None) -> None:
        """Continue at the variable to which the pointer pointed when the statement was executed."""
        assert isinstance(self._kind, ty.Pointer)
        selectors = self._ref.selectors
        before = selectors[: selectors.index(at)] if at is not None else selectors
        self._pointer = reference(t.Ref(self._ref.pos, self._ref.name, before))
        if not self._recorded or self._recorded not in self._source:
            raise NotFollowed(f"the variable to which {self._pointer} pointed in this line was not recorded")
        self._pointed = self._source.index(self._recorded) - SOURCE
        held = _recorded(self._recorded, self._source)
        self._kind = self._accesses.target(self._kind)
        self._holder, self._attribute, self._lines = f"target({held})", "", f"{held}.lines"
        self._of_pou, self._at, self._recorded = False, [], ""

    def _code(self, owner: str) -> str:
        """Return the Python code of the variable so far, in `owner`."""
        attribute = f".{self._attribute}" if self._attribute else ""
        return f"{owner}{attribute}{''.join(f'[{i}]' for i in self._at)}"

    def _made(self) -> Access:
        more = self._of_pou, self._pointer, self._pointed
        if not self._attribute and not self._at:  # the variable of a pointer itself
            place = RECORD_HEAD + self._pointed
            find = _checked(lambda b, g, r: _referred(r[place], "a pointer"))
            return Access(self._ref, self._kind, find, *more, whole=True)
        value = self._code_of_elements()
        made = f"Found({value}, o, {self._attribute!r}, a, {self._lines if not self._attribute else None})"
        code = f"lambda b, g, r: (lambda o, a: {made})({self._holder}, ({''.join(f'{i}, ' for i in self._at)}))"
        find = eval(code, _NAMES.copy())  # safe: names of declarations, and numbers
        return Access(self._ref, self._kind, _checked(find), *more)

    def _code_of_elements(self) -> str:
        attribute = f".{self._attribute}" if self._attribute else ""
        return f"o{attribute}" + "".join(f"[a[{n}]]" for n in range(len(self._at)))


def _target(held: Any) -> Any:
    """Return the array, structure or block to which a pointer pointed. Raises `NotFollowed` for NULL."""
    if held is None:
        raise NotFollowed("the pointer was NULL")
    return held.v


_NAMES = {"Found": Found, "index": index, "target": _target}
"""The names that the Python code of a path uses."""


def _recorded(code: str, source: Sequence[Any]) -> str:
    """Return the Python code of a recorded value in the record ``r``."""
    return f"r[{RECORD_HEAD + source.index(code) - SOURCE}]"


def _is_reference(kind: ty.Type) -> bool:
    """Return whether a variable of this type stands for the variable to which it refers."""
    return isinstance(kind, ty.Pointer) and kind.word == "REFERENCE TO"


def _refs(expr: t.Expr) -> Iterator[t.Ref]:
    """Yield the variables in an index."""
    if isinstance(expr, t.Binary):
        yield from _refs(expr.left)
        yield from _refs(expr.right)
    elif isinstance(expr, t.Unary):
        yield from _refs(expr.operand)
    elif isinstance(expr, t.Ref):
        yield expr


def _checked(find: Find) -> Find:
    def checked(body: Any, shared: Any, record: Record) -> Found:
        try:
            return find(body, shared, record)
        except (LogicError, AttributeError, IndexError) as e:
            raise NotFollowed(e.message if isinstance(e, LogicError) else "a VAR_IN_OUT has no variable yet") from e

    return checked


def _referred(held: Any, what: str) -> Found:
    """Return the variable to which the reference of `what` refers: a pointer or a VAR_IN_OUT. Raises `NotFollowed`."""
    if isinstance(held, MemberReference):
        return Found(held.v, held.owner, held.name)
    if isinstance(held, Element):
        try:
            return Found(held.v, held.owner, "", (held.at,), held.of_array)
        except LogicError as e:
            raise NotFollowed(e.message) from e
    if isinstance(held, Whole | Cut):
        return Found(held.v, held, "v")
    if held is None:
        raise NotFollowed(f"{what} that refers to no variable")
    raise NotFollowed(f"{what} whose variable is not kept after the call")
