"""Compiles expressions to Python and checks their types. Code that has to run before an expression (calls with outputs)
is written to the `CodeWriter` first, in order."""

from __future__ import annotations

from dataclasses import replace
from math import isfinite

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st import values
from fieldtwin.plc.st.compiler.classes.members import own_property_type, property_type
from fieldtwin.plc.st.compiler.implicit import converted
from fieldtwin.plc.st.compiler.literals import Malformed, constant
from fieldtwin.plc.st.compiler.operators import binary, unary
from fieldtwin.plc.st.compiler.pointers import references
from fieldtwin.plc.st.compiler.scope import (
    Class,
    CodeWriter,
    Environment,
    Symbol,
    Value,
)
from fieldtwin.plc.st.compiler.variables import character_type, followed, lookup, part_of, variable
from fieldtwin.plc.st.syntax import tree as t

MAX_DEEP = 80
"""How deep calls, parentheses and indices may be nested."""
MAX_OPEN = 40
"""How deep brackets may be nested in one line of Python: a deeper part is computed on a line before it."""


class Expressions:
    """The compiler of expressions in the scope of one POU: names are looked up in `symbols` (in lower case), then in the
    environment.
    """

    def __init__(self, env: Environment, symbols: dict[str, Symbol], out: CodeWriter, pou: str = "") -> None:
        self.env = env
        self.symbols = symbols
        self.out = out
        self.pou = pou
        self.only_constants = False
        """Whether variables and a user's functions are refused: in initial values and limits of types."""
        self.wanted: ty.Type | None = None
        """The type that the context demands of the expression which is being compiled, if that is known."""
        self._deep = 0
        self.controls: list[str] = []
        """The control variables of the FOR loops around the statement."""
        self.altered: set[int] = set()
        """The indices in `controls` of those that a statement in their loop alters, in the dialects of CODESYS."""
        self.program_inputs: set[str] = set()
        """The inputs whose quality can be queried, when a PROGRAM is compiled."""
        self.own: Class | None = None
        """The class to which the body belongs."""

    # -- assignment compatibility ---------------------------------------------------------------------------------------

    def coerced(self, value: Value, target: ty.Type, pos: t.Pos, what: str = "") -> str:
        """Return the Python expression of `value` as a `target`. Raises `FileInvalid` if this needs an explicit conversion
        function such as REAL_TO_INT.
        """
        if isinstance(value.type, ty.Pointer) or isinstance(target, ty.Pointer):
            return references.coerced(self, value, target, pos, what)
        source = ty.plain(value.type)
        if ty.is_kind(target, "char") and _is_character(value, wide=target == ty.WCHAR):
            return value.code
        accepted = None if ty.fits(value.type, target) else converted(self, value, target, pos)
        if accepted is not None:
            return accepted
        if not ty.fits(value.type, target):
            hint = f"{source}_TO_{ty.plain(target)}" if _convertible(source) and _convertible(ty.plain(target)) else ""
            self.env.fail(pos, what or "types differ", expected=str(target), got=str(value.type), hint=hint)
        if isinstance(target, ty.Subrange) and value.type != target and not isinstance(source, ty.AnyInt):
            return f"_v.inside({value.code}, {target.low}, {target.high})"
        sink = ty.plain(target)
        if isinstance(source, ty.AnyReal) and value.constant is None:
            return f"_v.real({value.code})" if sink == ty.REAL else value.code
        if isinstance(source, ty.AnyInt | ty.AnyReal):
            return _literal(source.value, sink)
        if isinstance(source, ty.String) and isinstance(sink, ty.String):
            return value.code if source.length <= sink.length else f"{value.code}[:{sink.length}]"
        if isinstance(source, ty.Elementary) and isinstance(sink, ty.Elementary):
            if source.kind in ("int", "bool") and sink.kind != source.kind:
                return f"{'float' if sink.kind == 'real' else 'int'}({value.code})"
            return value.code
        if isinstance(source, ty.Array | ty.Struct):
            if not value.place:
                return value.code
            return f"_v.copied({value.code})" if isinstance(source, ty.Array) else f"{value.code}.copy()"
        if isinstance(target, ty.Interface):
            return f"_v.Instance({value.code})" if isinstance(source, ty.Block) else value.code
        if isinstance(source, ty.Block | ty.MessagesIn | ty.MessagesOut):
            self.env.fail(pos, f"a {source} cannot be assigned")
        return value.code

    def condition(self, expr: t.Expr, what: str) -> str:
        value = self.value(expr)
        if isinstance(value.type, ty.AnyInt):  # 0 and 1 are literals of BOOL (Table 5)
            return self.coerced(value, ty.BOOL, expr.pos, f"the condition of {what}")
        if not ty.is_kind(value.type, "bool"):
            self.env.fail(expr.pos, f"the condition of {what}", expected="BOOL", got=str(value.type))
        return value.code

    def constant_integer(self, expr: t.Expr, what: str) -> int:
        value = self.settled(self.value(expr), expr.pos)
        if value.constant is None or not ty.is_kind(value.type, "int", "bits"):
            self.env.fail(expr.pos, what, expected="a constant whole number", got=str(value.type))
        return int(value.constant)

    def settled(self, value: Value, pos: t.Pos) -> Value:
        """Return `value`, replaced by its result if it is computed from constants only, such as ``N - 1`` of a constant N. It
        is used where only constants are allowed.
        """
        of_a_scan = "_c." in value.code or bool(self.out.lines)
        if value.constant is not None or of_a_scan or not isinstance(ty.plain(value.type), ty.Elementary):
            return value
        try:
            # safe: this compiler wrote the code, which holds only literals and calls of `values`
            worth = eval(value.code, {"_v": values})
        except values.LogicError as e:
            self.env.fail(pos, e.message)
        return Value(repr(worth), value.type, worth)

    # -- expressions ------------------------------------------------------------------------------------------------------

    def value(self, expr: t.Expr, wanted: ty.Type | None = None) -> Value:
        """Compile `expr`. `wanted` is the type that its context demands.

        An untyped literal in a shift, NOT or choice takes that type (IEC 61131-3, 6.3.2). The caller still has to coerce the
        value.
        """
        if isinstance(expr, t.Literal):
            return self._literal(expr)
        if self._deep >= MAX_DEEP:
            self.env.fail(expr.pos, "the expression is nested too deeply", expected=f"at most {MAX_DEEP} levels")
        self._deep += 1
        before, self.wanted = self.wanted, wanted
        try:
            if isinstance(expr, t.Ref):
                return variable(self, expr)
            if isinstance(expr, t.Call):
                made = self.call(expr)
                if not (isinstance(wanted, ty.Pointer) and wanted.word == references.REFERENCE):
                    made = followed(self, made, expr.pos)
                return self.flat(made, expr.pos)
            return self.flat(unary(self, expr) if isinstance(expr, t.Unary) else binary(self, expr), expr.pos)
        finally:
            self._deep -= 1
            self.wanted = before

    def declared(self, *exprs: t.Expr) -> ty.Type | None:
        """Return the type of the first of `exprs` that is a variable or literal of a bit string type or BOOL, or None. In the
        dialects of CODESYS, this includes integers and enumerations.
        """
        for expr in exprs:
            if isinstance(expr, t.Literal | t.Ref):
                kind = self._literal(expr).type if isinstance(expr, t.Literal) else self.type_of(expr)
                if kind is not None and self.of_context(kind):
                    return kind
        return None

    def of_context(self, kind: ty.Type) -> bool:
        """Return whether a constant that is shifted, or the name of an enumerated value, gets the type of the other operand,
        `kind`. The standard refuses the name of a value that several enumerations have (6.4.4.2).
        """
        return ty.of_bits(kind) or (self.env.dialect.vendor and (ty.is_kind(kind, "int") or isinstance(kind, ty.Enum)))

    def type_of(self, ref: t.Ref) -> ty.Type | None:
        """Return the type of a variable or of its part without compiling it, or None if it has no such part."""
        symbol, selectors = lookup(self, ref)
        kind: ty.Type | None
        if ref.of is not None:
            kind = self.result_of(ref.of)
        elif symbol is not None:
            kind = symbol.type
        else:
            kind, selectors = own_property_type(self, ref)
        for selector in selectors:
            kind = self._followed(kind, selector.pos)
            if isinstance(selector, t.Deref):
                kind = self.env.target(kind, selector.pos) if isinstance(kind, ty.Pointer) else None
            elif isinstance(selector, t.Bit):
                kind = part_of(selector)
            elif isinstance(selector, t.Index):
                if isinstance(kind, ty.Pointer):
                    kind = self.env.target(kind, selector.pos)
                else:
                    vendor = self.env.dialect.vendor
                    of_string = character_type(kind, vendor=vendor) if isinstance(kind, ty.String) else None
                    kind = kind.of if isinstance(kind, ty.Array | ty.OpenArray) else of_string
            else:
                name = selector.name.lower()
                members = kind.fields if isinstance(kind, ty.Struct) else {}
                if isinstance(kind, ty.Block):
                    inner = self.env.inner.get(kind.name.lower(), {})
                    members = {**inner, **kind.inputs, **kind.outputs, **kind.publics}
                    name = kind.aliases.get(name, name).lower()
                kind = members[name][1] if name in members else property_type(self, kind, name)
        return self._followed(kind, ref.pos)

    def _followed(self, kind: ty.Type | None, pos: t.Pos) -> ty.Type | None:
        """Return the type of the variable for which a REFERENCE TO stands; other types as they are."""
        if isinstance(kind, ty.Pointer) and kind.word == references.REFERENCE:
            return self.env.target(kind, pos)
        return kind

    def flat(self, value: Value, pos: t.Pos) -> Value:
        """Return `value`. If it has more nested brackets than Python can parse, write it on a preceding line."""
        if value.code.count("(") + value.code.count("[") <= MAX_OPEN or _open(value.code) <= MAX_OPEN:
            return value
        name = self.out.temporary()
        self.out.line(f"{name} = {value.code}", pos)
        return Value(name, value.type, value.constant)

    def earlier(self, value: Value, mark: int, pos: t.Pos) -> Value:
        """Return `value`, computed before the lines that were written after the first `mark` lines.

        Operands and arguments are evaluated from left to right, and those lines belong to a later one.
        """
        if len(self.out.lines) == mark or value.constant is not None:
            return value
        later, name = self.out.since(mark), self.out.temporary()
        self.out.line(f"{name} = {value.code}", pos)
        self.out.again(later)
        return replace(value, code=name)

    def known(self, expr: t.Expr, result: float) -> Value:
        """Return `result`, which the compiler computed for the untyped constant `expr`, as a `Value`."""
        if isinstance(result, int) and not -(2**63) <= result < 2**64:
            self.env.fail(expr.pos, "a whole number that no type holds")
        if isinstance(result, float) and not isfinite(result):
            self.env.fail(expr.pos, "a number outside the range of LREAL")
        kind: ty.Type = ty.AnyInt(result) if isinstance(result, int) else ty.AnyReal(result)
        return Value(repr(result), kind, result)

    def _literal(self, literal: t.Literal) -> Value:
        if literal.kind == "ENUM_REF":
            return self._enum(literal)
        if literal.kind == "NULL":
            return Value("None", ty.NULL)
        try:
            known = constant(literal)
        except Malformed as e:
            self.env.fail(literal.pos, str(e), got=literal.text)
        return Value(repr(known.value), known.type, known.value)

    def _enum(self, literal: t.Literal) -> Value:
        type_name, _, name = literal.text.partition("#")
        enum = self.env.types.get(type_name.lower())
        if not isinstance(enum, ty.Enum):
            library = type_name.rpartition(".")[0]
            hint = self.env.of_library(library) if library else ""
            self.env.unknown(literal.pos, "an enumeration", type_name, [] if hint else list(self.env.types), hint)
        number = {k.lower(): v for k, v in enum.values.items()}.get(name.lower())
        if number is None:
            self.env.unknown(literal.pos, f"in {enum}, a value", name, list(enum.values))
        return Value(repr(number), enum, number)

    def typed(self, value: Value, pos: t.Pos) -> Value:
        """Return `value`; a constant without a type gets the type that its context demands, or the narrowest that holds it."""
        wanted = ty.plain(self.wanted) if self.wanted is not None else None
        if not isinstance(value.type, ty.AnyInt | ty.AnyReal):
            return value
        kinds = (ty.INT, ty.DINT, ty.LINT, ty.ULINT, ty.LREAL)
        first = (wanted,) if isinstance(wanted, ty.Elementary) else ()
        kind = next(kind for kind in (*first, *kinds) if ty.fits(value.type, kind))
        return Value(self.coerced(value, kind, pos), kind)

    # -- calls and assignments (`calls.Calls`) ----------------------------------------------------------------------------

    def call(self, call: t.Call) -> Value:
        """Compile a call of a function."""
        raise NotImplementedError

    def result_of(self, call: t.Call) -> ty.Type | None:
        """Return the type of the result of a call without compiling it; None if it is not known."""
        raise NotImplementedError

    def take(self, argument: t.Argument, value: Value) -> None:
        """Compile the output argument ``name => target``."""
        raise NotImplementedError


def _is_character(value: Value, *, wide: bool) -> bool:
    """Return whether a value is a string literal with one character, which is also a CHAR or WCHAR."""
    return isinstance(value.type, ty.String) and value.type.wide == wide and len(value.constant or "") == 1


def _open(code: str) -> int:
    """Return the greatest nesting depth of brackets. Brackets in strings also count, which does no harm."""
    open_, most = 0, 0
    for char in code:
        if char in "([":
            open_ += 1
            most = max(most, open_)
        elif char in ")]":
            open_ -= 1
    return most


def _literal(value: float, kind: ty.Type) -> str:
    """Return a constant without a type as a literal of `kind`, in which it fits."""
    if not isinstance(kind, ty.Elementary):
        return repr(value)
    if kind.kind == "bool":
        return repr(bool(value))
    if kind.kind == "real":
        number = values.real(float(value)) if kind.bits == 32 else float(value)
        return repr(number) if abs(number) != float("inf") else f"float({str(number)!r})"
    return repr(int(value))


def _convertible(kind: ty.Type) -> bool:
    return isinstance(kind, ty.Elementary)
