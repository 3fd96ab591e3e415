"""Compiles expressions to Python and checks their types. Code that has to run before an expression (calls with outputs)
is written to the `CodeWriter` first, in order."""

from __future__ import annotations

from math import isfinite
from typing import NoReturn

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st import values
from fieldtwin.plc.st.compiler.arguments import bind
from fieldtwin.plc.st.compiler.literals import Malformed, constant
from fieldtwin.plc.st.compiler.scope import (
    COMPARISONS,
    CodeWriter,
    Environment,
    Parameter,
    Signature,
    Symbol,
    Value,
    by_reference,
    wrapped,
)
from fieldtwin.plc.st.compiler.standard import FUNCTIONS
from fieldtwin.plc.st.compiler.time_arithmetic import with_time
from fieldtwin.plc.st.syntax import tree as t

MAX_DEEP = 80
"""How deep calls, parentheses and indices may be nested."""
MAX_OPEN = 40
"""How deep brackets may be nested in one line of Python: a deeper part is computed on a line before it."""
_LOGIC = {"AND": "&", "&": "&", "OR": "|", "XOR": "^", "AND_THEN": "and", "OR_ELSE": "or"}


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
        self.program_inputs: set[str] = set()
        """The inputs whose quality can be queried, when a PROGRAM is compiled."""

    # -- assignment compatibility ---------------------------------------------------------------------------------------

    def coerced(self, value: Value, target: ty.Type, pos: t.Pos, what: str = "") -> str:
        """Return the Python expression of `value` as a `target`. Raises `FileInvalid` if a named conversion is
        needed."""
        source = ty.plain(value.type)
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
        if isinstance(source, ty.Block | ty.MessagesIn | ty.MessagesOut):
            self.env.fail(pos, f"a {source} cannot be assigned")
        return value.code

    def condition(self, expr: t.Expr, what: str) -> str:
        value = self.value(expr)
        if not ty.is_kind(value.type, "bool"):
            self.env.fail(expr.pos, f"the condition of {what}", expected="BOOL", got=str(value.type))
        return value.code

    def constant_integer(self, expr: t.Expr, what: str) -> int:
        value = self.settled(self.value(expr), expr.pos)
        if value.constant is None or not ty.is_kind(value.type, "int", "bits"):
            self.env.fail(expr.pos, what, expected="a constant whole number", got=str(value.type))
        return int(value.constant)

    def settled(self, value: Value, pos: t.Pos) -> Value:
        """Return `value` with its computed constant, for places where only constants are allowed, such as ``N - 1`` of a constant
        N.
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
                return self.reference(expr)
            if isinstance(expr, t.Call):
                return self._flat(self.call(expr), expr.pos)
            return self._flat(self._unary(expr) if isinstance(expr, t.Unary) else self._binary(expr), expr.pos)
        finally:
            self._deep -= 1
            self.wanted = before

    def declared(self, *exprs: t.Expr) -> ty.Type | None:
        """Return the type of the first of `exprs` that is a variable or literal of a bit string type or BOOL, or None."""
        for expr in exprs:
            if isinstance(expr, t.Literal | t.Ref):
                kind = self._literal(expr).type if isinstance(expr, t.Literal) else self.type_of(expr)
                if kind is not None and ty.of_bits(kind):
                    return kind
        return None

    def type_of(self, ref: t.Ref) -> ty.Type | None:
        """Return the type of a variable or of its part without compiling it, or None if it has no such part."""
        symbol = self.symbols.get(ref.name.lower()) or self.env.globals.get(ref.name.lower())
        kind = symbol.type if symbol is not None else None
        for selector in ref.selectors:
            if isinstance(selector, t.Bit):
                kind = ty.BOOL
            elif isinstance(selector, t.Index):
                kind = kind.of if isinstance(kind, ty.Array) else None
            else:
                name = selector.name.lower()
                members = kind.fields if isinstance(kind, ty.Struct) else {}
                if isinstance(kind, ty.Block):
                    members = {**kind.inputs, **kind.outputs}
                kind = members[name][1] if name in members else None
        return kind

    def _flat(self, value: Value, pos: t.Pos) -> Value:
        """Return `value`. If it has more nested brackets than Python can parse, write it on a preceding line."""
        if value.code.count("(") + value.code.count("[") <= MAX_OPEN or _open(value.code) <= MAX_OPEN:
            return value
        name = self.out.temporary()
        self.out.line(f"{name} = {value.code}", pos)
        return Value(name, value.type, value.constant)

    def known(self, expr: t.Expr, result: float) -> Value:
        """Return the value for an untyped constant that the compiler computed."""
        if isinstance(result, int) and not -(2**63) <= result < 2**64:
            self.env.fail(expr.pos, "a whole number that no type holds")
        if isinstance(result, float) and not isfinite(result):
            self.env.fail(expr.pos, "a number outside the range of LREAL")
        kind: ty.Type = ty.AnyInt(result) if isinstance(result, int) else ty.AnyReal(result)
        return Value(repr(result), kind, result)

    def _literal(self, literal: t.Literal) -> Value:
        if literal.kind == "ENUM_REF":
            return self._enum(literal)
        try:
            known = constant(literal)
        except Malformed as e:
            self.env.fail(literal.pos, str(e), got=literal.text)
        return Value(repr(known.value), known.type, known.value)

    def _enum(self, literal: t.Literal) -> Value:
        type_name, _, name = literal.text.partition("#")
        enum = self.env.types.get(type_name.lower())
        if not isinstance(enum, ty.Enum):
            self.env.unknown(literal.pos, "an enumeration", type_name, list(self.env.types))
        number = {k.lower(): v for k, v in enum.values.items()}.get(name.lower())
        if number is None:
            self.env.unknown(literal.pos, f"in {enum}, a value", name, list(enum.values))
        return Value(repr(number), enum, number)

    def _unary(self, expr: t.Unary) -> Value:
        wanted = self.wanted
        value = self.value(expr.operand, wanted)
        kind = ty.plain(value.type)
        if expr.op == "NOT":
            if isinstance(kind, ty.AnyInt) and ty.takes_bits(wanted, kind):
                value, kind = Value(self.coerced(value, wanted, expr.pos), wanted), wanted
            if ty.is_kind(kind, "bool"):
                return Value(f"(not {value.code})", ty.BOOL, None if value.constant is None else not value.constant)
            if isinstance(kind, ty.Elementary) and kind.kind == "bits":
                return Value(f"({value.code} ^ {kind.high})", kind)
            self.env.fail(expr.pos, "NOT", expected="BOOL or a bit string", got=str(kind))
        if not ty.is_kind(kind, "int", "real", "duration"):
            self.env.fail(expr.pos, f"the sign {expr.op}", expected="a number or a duration", got=str(kind))
        if expr.op == "+":
            return value
        if isinstance(kind, ty.AnyInt | ty.AnyReal):
            return Value(f"(-{value.code})", kind) if value.constant is None else self.known(expr, -value.constant)
        assert isinstance(kind, ty.Elementary)
        return Value(wrapped(f"-{value.code}", kind), kind)

    def _binary(self, expr: t.Binary) -> Value:
        """Compile a chain of operators from its left end, so that a long chain does not nest deeply."""
        chain, first = [expr], expr.left
        while isinstance(first, t.Binary):
            chain.append(first)
            first = first.left
        wanted = self.wanted if expr.op in _LOGIC else None
        value = self.value(first, wanted or self.declared(*(link.right for link in reversed(chain))))
        for link in reversed(chain):
            value = self._flat(self._joined(link, value), link.pos)
        return value

    def _joined(self, expr: t.Binary, left: Value) -> Value:
        mark = len(self.out.lines)
        wanted = left.type if ty.of_bits(left.type) else self.wanted if expr.op in _LOGIC else None
        right = self.value(expr.right, wanted)
        if expr.op in ("AND_THEN", "OR_ELSE") and len(self.out.lines) > mark:
            left, right = self._only_if_needed(expr, left, right, self.out.since(mark))
        if expr.op in _LOGIC:
            return self._logic(expr, left, right)
        if expr.op in COMPARISONS:
            return self._comparison(expr, left, right)
        timed = with_time(expr.op, left, right)
        if timed is not None:
            return timed
        kind = ty.common(left.type, right.type)
        if kind is None or not ty.is_kind(kind, "int", "real"):
            self._mismatch(expr, left, right, "numbers of compatible types")
        if isinstance(kind, ty.AnyInt | ty.AnyReal):
            return self._folded(expr, left, right)
        assert isinstance(kind, ty.Elementary)
        if expr.op == "**":
            kind = kind if kind.kind == "real" else ty.LREAL
            power = f"_v.power({left.code}, {right.code})"
            return Value(f"_v.real({power})" if kind.bits == 32 else power, kind)
        a, b = self.coerced(left, kind, expr.pos), self.coerced(right, kind, expr.pos)
        if expr.op == "MOD":
            if kind.kind != "int":
                self._mismatch(expr, left, right, "integers")
            return Value(f"_v.modulo({a}, {b})", kind)
        if expr.op == "/":
            return Value(wrapped(f"_v.{'divide' if kind.kind == 'int' else 'divide_real'}({a}, {b})", kind), kind)
        return Value(wrapped(f"{a} {expr.op} {b}", kind), kind)

    def _only_if_needed(
        self, expr: t.Binary, left: Value, right: Value, prepared: list[tuple[str, int]]
    ) -> tuple[Value, Value]:
        """Return both sides of AND or OR.

        Lines that the right side needs run only if the left side does not decide the result.
        """
        name = self.out.temporary()
        self.out.line(f"{name} = {left.code}", expr.pos)
        decided = "not " if expr.op == "OR_ELSE" else ""
        with self.out.block(f"if {decided}{name}:", expr.pos):
            self.out.again(prepared)
            self.out.line(f"{name} = {right.code}", expr.pos)
        known = Value(name, left.type)
        return known, Value(name, right.type)

    def _logic(self, expr: t.Binary, left: Value, right: Value) -> Value:
        a, b = left.constant, right.constant
        untyped = isinstance(left.type, ty.AnyInt) and isinstance(right.type, ty.AnyInt)
        if untyped and expr.op in ("AND", "&", "OR", "XOR") and min(a, b) >= 0:  # the context determines the width
            return self.known(expr, a & b if expr.op in ("AND", "&") else a | b if expr.op == "OR" else a ^ b)
        kind = ty.common(left.type, right.type)
        if kind is None or not ty.is_kind(kind, "bool", "bits"):
            self._mismatch(expr, left, right, "BOOL, or bit strings of compatible types")
        x, y = self.coerced(left, kind, expr.pos), self.coerced(right, kind, expr.pos)
        if expr.op in ("AND_THEN", "OR_ELSE") and not ty.is_kind(kind, "bool"):
            self._mismatch(expr, left, right, "BOOL")
        return Value(f"({x} {_LOGIC[expr.op]} {y})", kind)

    def _comparison(self, expr: t.Binary, left: Value, right: Value) -> Value:
        kind = ty.common(left.type, right.type)
        if kind is None or not isinstance(kind, ty.Elementary | ty.AnyInt | ty.AnyReal | ty.String | ty.Enum):
            self._mismatch(expr, left, right, "two values of compatible types")
        if isinstance(kind, ty.AnyInt | ty.AnyReal | ty.String):
            a, b = left.code, right.code
        else:
            a, b = self.coerced(left, kind, expr.pos), self.coerced(right, kind, expr.pos)
        return Value(f"({a} {COMPARISONS[expr.op]} {b})", ty.BOOL)

    def _folded(self, expr: t.Binary, left: Value, right: Value) -> Value:
        a, b = left.constant, right.constant
        if a is None or b is None:  # a choice between constants (SEL, MAX)
            if expr.op == "MOD":
                self._mismatch(expr, left, right, "integers")
            return Value(_of_reals(expr.op, left.code, right.code), ty.AnyReal(0.0))
        whole = isinstance(a, int) and isinstance(b, int)
        try:
            if expr.op == "/":
                result = values.divide(a, b) if whole else values.divide_real(a, b)
            elif expr.op == "MOD" and whole:
                result = values.modulo(a, b)
            elif expr.op == "**":
                result = values.power(a, b)
            elif expr.op in ("+", "-", "*"):
                result = a + b if expr.op == "+" else a - b if expr.op == "-" else a * b
            else:
                self._mismatch(expr, left, right, "integers")
        except values.LogicError as e:
            self.env.fail(expr.pos, e.message)
        return self.known(expr, result)

    def _mismatch(self, expr: t.Binary, left: Value, right: Value, expected: str) -> NoReturn:
        self.env.fail(expr.pos, f"operands of {expr.op}", expected=expected, got=f"{left.type} and {right.type}")

    # -- variables --------------------------------------------------------------------------------------------------------

    def reference(self, ref: t.Ref) -> Value:
        symbol = self.symbols.get(ref.name.lower()) or self.env.globals.get(ref.name.lower())
        if symbol is None:
            return self._enum_value(ref)
        if self.only_constants and symbol.constant is None:
            self.env.fail(ref.pos, f"{ref.name} is not a constant", expected="a constant expression")
        owner, _, own = symbol.code.rpartition(".")
        reference = symbol.reference or (f"_v.MemberReference({owner}, {own!r})" if owner else "")
        value = Value(symbol.code, symbol.type, symbol.constant, True, symbol.writable, reference)
        for selector in ref.selectors:
            if isinstance(selector, t.Member):
                value = self._member(value, selector)
            elif isinstance(selector, t.Index):
                value = self._index(value, selector)
            else:
                value = self._bit(value, selector)
        return value

    def _enum_value(self, ref: t.Ref) -> Value:
        found = self.env.enum_values.get(ref.name.lower(), [])
        if not found or ref.selectors:
            known = [s.name for s in (*self.symbols.values(), *self.env.globals.values())]
            self.env.unknown(ref.pos, "a variable", ref.name, known)
        if len(found) > 1:
            names = ", ".join(f"{enum}#{ref.name}" for enum, _ in found)
            self.env.fail(ref.pos, f"{ref.name} is a value of several types", expected=names)
        enum, number = found[0]
        return Value(repr(number), enum, number)

    def _member(self, value: Value, member: t.Member) -> Value:
        kind, name = value.type, member.name.lower()
        if isinstance(kind, ty.Struct) and name in kind.fields:
            reference = f"_v.MemberReference({value.code}, {f'm_{name}'!r})"
            return Value(f"{value.code}.m_{name}", kind.fields[name][1], None, True, value.writable, reference)
        if isinstance(kind, ty.Block):
            for members, writable in ((kind.inputs, True), (kind.outputs, False)):
                if name in members:
                    attribute = members[name][0] if kind.standard else f"v_{name}"
                    reference = f"_v.MemberReference({value.code}, {attribute!r})"
                    return Value(f"{value.code}.{attribute}", members[name][1], None, True, writable, reference)
        known: list[str] = []
        if isinstance(kind, ty.Struct):
            known = [f for f, _ in kind.fields.values()]
        elif isinstance(kind, ty.Block):
            known = [f for f, _ in (*kind.inputs.values(), *kind.outputs.values())]
        raise self.env.unknown(member.pos, f"in {kind}, a member", member.name, known)

    def _index(self, value: Value, selector: t.Index) -> Value:
        kind = value.type
        if not isinstance(kind, ty.Array):
            self.env.fail(selector.pos, "an index into a value that is not an array", got=str(kind))
        if len(selector.indices) != len(kind.ranges):
            self.env.fail(
                selector.pos, "indices", expected=f"{len(kind.ranges)} for {kind}", got=str(len(selector.indices))
            )
        code, owner, at = value.code, "", ""
        for expr, (low, high) in zip(selector.indices, kind.ranges, strict=True):
            index = self._flat(self.value(expr), expr.pos)
            if not ty.is_kind(index.type, "int", "bits"):
                self.env.fail(expr.pos, "an index", expected="a whole number", got=str(index.type))
            if isinstance(index.constant, int):
                if not low <= index.constant <= high:
                    self.env.fail(expr.pos, "an index outside its array", expected=f"{low} to {high}", got=index.code)
                at = str(index.constant - low)
            else:
                at = f"_v.index({index.code}, {low}, {high})"
            owner, code = code, f"{code}[{at}]"
        return Value(code, kind.of, None, True, value.writable, f"_v.Element({owner}, {at})")

    def _bit(self, value: Value, selector: t.Bit) -> Value:
        kind = ty.plain(value.type)
        if not (isinstance(kind, ty.Elementary) and kind.kind in ("int", "bits")):
            self.env.fail(
                selector.pos, "a bit of a value without bits", expected="an integer or a bit string", got=str(kind)
            )
        if selector.number >= kind.bits:
            self.env.fail(selector.pos, f"{kind} has bits 0 to {kind.bits - 1}", got=str(selector.number))
        return Value(f"bool({value.code} >> {selector.number} & 1)", ty.BOOL)

    # -- calls ------------------------------------------------------------------------------------------------------------

    def call(self, call: t.Call) -> Value:
        name = call.ref.name.lower()
        if not call.ref.selectors and name in self.env.functions:
            if self.only_constants:
                self.env.fail(call.pos, f"{call.ref.name} is called", expected="a constant expression")
            return self._user_function(call, self.env.functions[name])
        own = self.symbols.get(name)
        if not call.ref.selectors and (own is None or not isinstance(own.type, ty.Block)):
            standard = FUNCTIONS.find(name.upper())
            if standard is not None:
                return standard(self, call)
            known = (
                [s.name for s in self.env.functions.values()]
                + FUNCTIONS.names()
                + [s.name for s in self.symbols.values()]
            )
            self.env.unknown(call.pos, "a function", call.ref.name, known)
        raise self.env.error(call.pos, "a function block is called in a separate statement", got=call.ref.name)

    def _user_function(self, call: t.Call, signature: Signature) -> Value:
        self.env.calls.setdefault(self.pou, {}).setdefault(signature.name.lower(), call.pos)
        given = bind(self.env, call, [p.name for p in (*signature.inputs, *signature.in_outs)], signature.name)
        codes = []
        for p in signature.inputs:
            expr = _value_of(given.get(p.name.lower()))
            codes.append(
                p.initial
                if expr is None
                else self.coerced(self.value(expr, p.type), p.type, expr.pos, _into(p, signature))
            )
        cells: dict[str, str] = {}
        for p in signature.in_outs:
            expr = _value_of(given.get(p.name.lower()))
            codes.append(self.in_out(expr, p.name, p.type, call, signature.name, cells))
        code = f"f_{signature.name.lower()}({', '.join(codes)})"
        outputs = [a for a in call.arguments if a.target is not None]
        more = bool(signature.outputs)
        if not outputs and all(by_reference(p.type) for p in signature.in_outs):
            return Value(f"{code}[0]" if more else code, signature.returns)
        result = self.out.temporary()
        self.out.line(f"{result} = {code}", call.pos)
        self.take_back(cells, call.pos)
        places = {p.name.lower(): n for n, p in enumerate(signature.outputs, 1)}
        types = {p.name.lower(): p.type for p in signature.outputs}
        for argument in outputs:
            key = argument.name.lower()
            if key not in types:
                self.env.unknown(
                    argument.pos, f"in {signature.name}, an output", argument.name, [p.name for p in signature.outputs]
                )
            self.take(argument, Value(f"{result}[{places[key]}]", types[key]))
        return Value(f"{result}[0]" if more else result, signature.returns)

    def take(self, argument: t.Argument, value: Value) -> None:
        """Compile ``name => target``."""
        assert argument.target is not None
        if argument.inverted:
            value = Value(f"(not {value.code})", value.type)
        self.assign(argument.target, value, argument.pos)

    def assign(self, ref: t.Ref, value: Value, pos: t.Pos) -> None:
        """Write an assignment. An assignment to a bit of a variable keeps all other bits."""
        if ref.selectors and isinstance(ref.selectors[-1], t.Bit):
            whole = self.writable(t.Ref(ref.pos, ref.name, ref.selectors[:-1]))
            self._bit(whole, ref.selectors[-1])
            code = f"_v.set_bit({whole.code}, {ref.selectors[-1].number}, {self.coerced(value, ty.BOOL, pos)})"
            kind = ty.plain(whole.type)
            assert isinstance(kind, ty.Elementary)
            code = wrapped(code, kind)
            if isinstance(whole.type, ty.Subrange):
                code = f"_v.inside({code}, {whole.type.low}, {whole.type.high})"
            self.out.line(f"{whole.code} = {code}", pos)
            return
        target = self.writable(ref)
        code = self.coerced(value, target.type, pos, f"assigned to {ref.name}")
        if isinstance(target.type, ty.Array):  # in place, because a VAR_IN_OUT may refer to it
            self.out.line(f"_v.fill({target.code}, {code})", pos)
        elif isinstance(target.type, ty.Struct):
            self.out.line(f"_v.put({target.code}, {code})", pos)
        else:
            self.out.line(f"{target.code} = {code}", pos)

    def writable(self, ref: t.Ref) -> Value:
        target = self.reference(ref)
        if not target.writable:
            self.env.fail(
                ref.pos, f"{ref.name} cannot be assigned to", hint="it is a constant, an input, or a block's output"
            )
        if any(control == target.code or control.startswith(f"{target.code}.") for control in self.controls):
            self.env.fail(
                ref.pos,
                f"{ref.name} is the control variable of the FOR around this statement and cannot be altered here",
                hint="leave the loop with EXIT, or use WHILE",
            )
        return target

    def in_out(
        self, expr: t.Expr | None, name: str, kind: ty.Type, call: t.Call, of: str, cells: dict[str, str]
    ) -> str:
        """Return the Python expression of the argument for VAR_IN_OUT `name` of `of`. A function's own variables are
        passed in cells: `cells` receives each variable with its cell, until `take_back`."""
        if not isinstance(expr, t.Ref):
            self.env.fail(call.pos, f"VAR_IN_OUT {name} of {of} needs a variable")
        target = self.writable(expr)
        if target.type != kind and not (isinstance(kind, ty.String) and ty.fits(target.type, kind)):
            self.env.fail(expr.pos, f"VAR_IN_OUT {name} of {of}", expected=str(kind), got=str(target.type))
        if by_reference(kind):
            return target.code
        reference = target.reference
        if not reference:
            if target.code not in cells:
                cells[target.code] = self.out.temporary()
                self.out.line(f"{cells[target.code]} = _v.Cell({target.code})", expr.pos)
            reference = cells[target.code]
        if isinstance(kind, ty.String) and isinstance(target.type, ty.String) and target.type.length < kind.length:
            return f"_v.Cut({reference}, {target.type.length})"
        return reference

    def take_back(self, cells: dict[str, str], pos: t.Pos) -> None:
        """Assign the values in the cells back to the variables after the call."""
        for code, cell in cells.items():
            self.out.line(f"{code} = {cell}.v", pos)


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


def _value_of(argument: t.Argument | None) -> t.Expr | None:
    return None if argument is None else argument.value


def _of_reals(op: str, a: str, b: str) -> str:
    if op in ("/", "**"):
        return f"_v.{'divide_real' if op == '/' else 'power'}({a}, {b})"
    return f"({a} {op} {b})"


def _into(p: Parameter, signature: Signature) -> str:
    return f"{p.name} of {signature.name}"


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
