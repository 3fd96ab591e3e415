"""Compiles calls of functions, output arguments, and assignments to variables."""

from __future__ import annotations

from collections.abc import Callable

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.arguments import bind, given_outputs
from fieldtwin.plc.st.compiler.classes.members import Selected, class_of, method_of, note, selected
from fieldtwin.plc.st.compiler.execution_control import split_control
from fieldtwin.plc.st.compiler.expressions import Expressions
from fieldtwin.plc.st.compiler.functions.standard import FUNCTIONS
from fieldtwin.plc.st.compiler.pointers import references
from fieldtwin.plc.st.compiler.scope import (
    Parameter,
    Signature,
    Value,
    by_reference,
    default_value,
    identifier,
    open_outputs,
    wrapped,
)
from fieldtwin.plc.st.compiler.variables import bit, lookup, part_of, place, unknown_variable, variable
from fieldtwin.plc.st.syntax import tree as t

_OF_ADDRESSES = frozenset({"BITADR", "INDEXOF", "__NEW", "__DELETE"})
"""Functions of other tools that need the memory of a controller."""


class Calls(Expressions):
    """The compiler of expressions with calls, and of assignments."""

    def call(self, call: t.Call) -> Value:
        name = call.ref.name.lower()
        method = method_of(self, call.ref, "METHOD")
        signature = method.signature if method is not None else self.env.functions.get(name)
        inner, en, eno = split_control(self.env, call, signature.names() if signature is not None else ())
        if en is not None or eno is not None:
            return self._controlled_call(inner, en, eno)
        if signature is not None and (method is not None or not call.ref.selectors):
            if self.only_constants:
                self.env.fail(call.pos, f"{call.ref.name} is called", expected="a constant expression")
            if method is not None:
                return self._user_function(call, signature, selected(self, call.ref, "METHOD"))
            note(self, name, call.pos)
            return self._user_function(call, signature)
        if not call.ref.selectors:
            self.env.refuse_missing(name, call.pos)
        own = self.symbols.get(name) or self.env.globals.get(name)
        if not call.ref.selectors and (own is None or not isinstance(own.type, ty.Block)):
            standard = FUNCTIONS.find(name.upper())
            if standard is not None:
                return standard(self, call)
            if name.upper() in _OF_ADDRESSES:
                message = "addresses as numbers and memory of a controller are not supported"
                self.env.fail(call.pos, message, got=call.ref.name)
            if name in self.env.classes and self.env.classes[name].kind == "PROGRAM":
                hint = "declare a FUNCTION_BLOCK; the dialects codesys and twincat call programs"
                self.env.fail(call.pos, f"{call.ref.name} is a PROGRAM and cannot be called", hint=hint)
            known = (
                [s.name for s in self.env.functions.values()]
                + FUNCTIONS.names()
                + [s.name for s in self.symbols.values()]
            )
            self.env.unknown(call.pos, "a function", call.ref.name, known)
        raise self._wrong_call(call)

    def result_of(self, call: t.Call) -> ty.Type | None:
        """Return the type of the result of a user's function or method without compiling it; None for other calls."""
        method = method_of(self, call.ref, "METHOD")
        signature = method.signature if method is not None else self.env.functions.get(call.ref.name.lower())
        return signature.returns if signature is not None else None

    def _wrong_call(self, call: t.Call) -> FileInvalid:
        """Return the error of a call in an expression that calls neither a function nor a method."""
        ref = call.ref
        last = ref.selectors[-1] if ref.selectors else None
        if isinstance(last, t.Member):
            of = class_of(self, self.type_of(ref.without_last()))
            if of is not None and last.name.lower() not in of.actions:
                known = [one.signature.name for one in of.methods.values() if one.kind == "METHOD"]
                self.env.unknown(last.pos, f"in {of.name}, a method", last.name, known)
        if (
            ref.of is None
            and lookup(self, ref)[0] is None
            and ref.name.lower() not in (*self.env.lists, *self.env.types)
        ):
            unknown_variable(self, ref)
        return self.env.error(call.pos, "a function block is called in a separate statement", got=ref.name)

    def _controlled_call(self, call: t.Call, en: t.Expr | None, eno: t.Argument | None) -> Value:
        """Write the call of a function with EN or ENO before the expression of which it is a part."""
        if self.only_constants:
            self.env.fail(call.pos, "EN or ENO", expected="a constant expression")
        result, made = self.out.temporary(), Value("None", ty.NOTHING)

        def executed() -> None:
            nonlocal made
            made = self.typed(self.call(call), call.pos)
            self.out.line(f"{result} = {made.code}", call.pos)

        self.controlled(
            call.pos, en, eno, executed, lambda: self.out.line(f"{result} = {default_value(made.type)}", call.pos)
        )
        return Value(result, made.type)

    def controlled(
        self,
        pos: t.Pos,
        en: t.Expr | None,
        eno: t.Argument | None,
        executed: Callable[[], None],
        otherwise: Callable[[], None] = lambda: None,
    ) -> None:
        """Write what `executed` writes under the condition EN, and the assignments of ENO (`execution_control`)."""

        def branch(write: Callable[[], None], done: bool) -> None:
            write()
            if eno is not None:
                self.take(eno, Value(repr(done), ty.BOOL))

        if en is None:
            branch(executed, True)
            return
        with self.out.block(f"if {self.condition(en, 'EN')}:", pos):
            branch(executed, True)
        with self.out.block("else:", pos):
            branch(otherwise, False)

    def _user_function(self, call: t.Call, signature: Signature, method: Selected | None = None) -> Value:
        """Compile the call of a function or method."""
        places = {p.name.lower(): n for n, p in enumerate(signature.outputs, 1)}
        given = bind(self.env, call, signature.order, signature.name, places)
        outputs = given_outputs(self.env, call, given, places, signature.name)
        codes: list[str] = []
        for p in signature.inputs:
            expr, mark = _value_of(given.get(p.name.lower())), len(self.out.lines)
            if expr is None:
                if isinstance(p.type, ty.OpenArray):
                    self.env.fail(call.pos, f"{_into(p, signature)} needs an array")
                codes.append(p.initial)
                continue
            code = self.given(expr, p.type, expr.pos, _into(p, signature))
            codes = [self.earlier(Value(one, p.type), mark, expr.pos).code for one in codes]
            codes.append(code)
        cells: dict[str, str] = {}
        for p in signature.in_outs:
            expr = _value_of(given.get(p.name.lower()))
            codes.append(self.in_out(expr, p.name, p.type, call, signature.name, cells))
        targets = {argument.name.lower(): argument.target for argument in outputs}
        for p in open_outputs(signature.outputs):
            target = targets.get(p.name.lower())
            if target is None:
                self.env.fail(call.pos, f"{_into(p, signature)} needs an array")
            assert isinstance(p.type, ty.OpenArray)
            codes.append(self._open_array(self.writable(target), p.type, target.pos, _into(p, signature)))
        arguments = ", ".join(codes)
        code = f"f_{identifier(signature.name)}({arguments})" if method is None else method.called(arguments)
        more = bool(signature.outputs)
        if not outputs and all(by_reference(p.type) for p in signature.in_outs):
            return Value(f"{code}[0]" if more else code, signature.returns)
        result = self.out.temporary()
        self.out.line(f"{result} = {code}", call.pos)
        self.take_back(cells, call.pos)
        types = {p.name.lower(): p.type for p in signature.outputs}
        for argument in outputs:
            key = argument.name.lower()
            if key not in types:
                self.env.unknown(
                    argument.pos, f"in {signature.name}, an output", argument.name, [p.name for p in signature.outputs]
                )
            code, kind = f"{result}[{places[key]}]", types[key]
            if isinstance(kind, ty.OpenArray):
                self._take_open(argument, code, kind)
            else:
                self.take(argument, Value(code, kind))
        return Value(f"{result}[0]" if more else result, signature.returns)

    def given(self, expr: t.Expr, kind: ty.Type, pos: t.Pos, what: str) -> str:
        """Return the Python expression of the argument for an input of type `kind`."""
        if isinstance(kind, ty.Pointer) and kind.word == references.REFERENCE:
            return references.referring(self, expr, kind, pos)
        if isinstance(kind, ty.OpenArray):
            return f"{self._open_array(self.value(expr), kind, pos, what)}.copied()"
        return self.coerced(self.value(expr, kind), kind, pos, what)

    def _open_array(self, value: Value, kind: ty.OpenArray, pos: t.Pos, what: str) -> str:
        """Return the Python expression of an array as the argument for a parameter of variable length."""
        source = value.type
        if source == kind:
            return value.code
        if not (isinstance(source, ty.Array) and len(source.ranges) == kind.dimensions and source.of == kind.of):
            self.env.fail(pos, what, expected=str(kind), got=str(source))
        return f"_v.OpenArray({value.code}, {source.ranges})"

    def _check_inverted(self, argument: t.Argument, kind: ty.Type) -> None:
        """Refuse ``NOT output => target`` for an output of a type other than BOOL."""
        if kind != ty.BOOL:
            self.env.fail(argument.pos, f"NOT before the output {argument.name}", expected="a BOOL", got=str(kind))

    def _take_open(self, argument: t.Argument, result: str, kind: ty.OpenArray) -> None:
        """Write the assignment of an output of variable length to the array whose limits it has."""
        assert argument.target is not None
        if argument.inverted:
            self._check_inverted(argument, kind)
        target, pos = self.writable(argument.target), argument.pos
        items = f"{target.code}.items" if isinstance(target.type, ty.OpenArray) else target.code
        self.out.line(f"_v.fill({items}, {result}.items)", pos)

    def take(self, argument: t.Argument, value: Value) -> None:
        """Compile the output argument ``name => target``: write the assignment of `value` to the target."""
        assert argument.target is not None
        if argument.inverted:
            self._check_inverted(argument, value.type)
            value = Value(f"(not {value.code})", value.type)
        self.assign(argument.target, value, argument.pos)

    def assign(self, ref: t.Ref, value: Value, pos: t.Pos) -> None:
        """Write an assignment, or the call of SET of a property. An assignment to a bit of a variable keeps all other bits."""
        if self._assign_property(ref, value, pos):
            return
        if ref.selectors and isinstance(ref.selectors[-1], t.Bit):
            whole = self.writable(ref.without_last())
            part = ref.selectors[-1]
            bit(self, whole, part)
            given = self.coerced(value, part_of(part), pos)
            code = f"_v.set_part({whole.code}, {part.number * part.size}, {part.size}, {given})"
            kind = ty.plain(whole.type)
            assert isinstance(kind, ty.Elementary)
            code = wrapped(code, kind)
            if isinstance(whole.type, ty.Subrange):
                code = f"_v.inside({code}, {whole.type.low}, {whole.type.high})"
            self.out.line(f"{whole.code} = {code}", pos)
            return
        target = self.writable(ref)
        if isinstance(target.type, ty.OpenArray):
            self.env.fail(ref.pos, f"{ref.name} is an array of variable length", expected="an assignment to an element")
        code = self.coerced(value, target.type, pos, f"assigned to {ref.name}")
        if isinstance(target.type, ty.Array):  # in place, because a VAR_IN_OUT may refer to it
            self.out.line(f"_v.fill({target.code}, {code})", pos)
        elif isinstance(target.type, ty.Struct):
            self.out.line(f"_v.put({target.code}, {code})", pos)
        else:
            self.out.line(f"{target.code} = {code}", pos)

    def _assign_property(self, ref: t.Ref, value: Value, pos: t.Pos) -> bool:
        """Write the call of SET if `ref` is a property; return False if it is not."""
        if not ref.selectors and ref.name.lower() in self.symbols:
            return False
        getter = method_of(self, ref, "GET")
        setter = selected(self, ref, "SET") if method_of(self, ref, "SET") is not None else None
        if setter is not None:
            kind = setter.method.signature.inputs[0].type
            code = self.coerced(value, kind, pos, f"assigned to {ref.name}")
            self.out.line(setter.called(code), pos)
        elif getter is not None:
            self.env.fail(ref.pos, f"property {getter.owner}.{getter.signature.name} has no SET")
        return setter is not None

    def refer(self, s: t.Refer) -> None:
        """Write ``reference REF= variable``."""
        target = place(self, s.target)
        if not (isinstance(target.type, ty.Pointer) and target.type.word == references.REFERENCE):
            self.env.fail(s.pos, "the left side of REF=", expected="a REFERENCE TO", got=str(target.type))
        allowed = target.writable or (
            target.is_input and self.env.accepts("ST001", s.pos, f"{s.target.name} is an input and is assigned to")
        )
        if not allowed:
            self.env.fail(s.pos, f"{s.target.name} cannot be assigned to")
        code = references.referring(self, s.value, target.type, s.value.pos)
        self.out.line(f"{target.code} = {code}", s.pos)

    def attempt(self, s: t.Attempt) -> None:
        """Write ``?=`` (IEC 61131-3:2013, table 52): NULL if the reference does not refer to a block of the target's type."""
        target, value = self.writable(s.target), self.value(s.value)
        if isinstance(target.type, ty.Interface):
            self.out.line(f"{target.code} = {references.queried(self, value, target.type, s.pos)}", s.pos)
            return
        kinds = [v.type for v in (target, value)]
        if not all(isinstance(kind, ty.Pointer) and kind.word == references.REF_TO for kind in kinds):
            self.env.fail(
                s.pos,
                "operands of ?=",
                expected="two references (REF_TO) or interfaces",
                got=f"{kinds[0]} and {kinds[1]}",
            )
        to, of = (self.env.target(kind, s.pos) for kind in kinds if isinstance(kind, ty.Pointer))
        code = value.code
        if to != of:
            if not (isinstance(to, ty.Block) and isinstance(of, ty.Block)) or to.standard or of.standard:
                self.env.fail(s.pos, "types differ", expected=str(kinds[0]), got=str(kinds[1]))
            code = f"_v.attempted({code}, {to.name.lower()!r})"
        self.out.line(f"{target.code} = {code}", s.pos)

    def writable(self, ref: t.Ref) -> Value:
        target = variable(self, ref)
        allowed = target.writable or (
            target.is_input and self.env.accepts("ST001", ref.pos, f"{ref.name} is an input and is assigned to")
        )
        if not allowed:
            hint = "it is a constant, an input, or a block's output"
            if target.is_input:
                hint = "it is an input; the dialects codesys, twincat and matiec accept this with a warning"
            self.env.fail(ref.pos, f"{ref.name} cannot be assigned to", hint=hint)
        self._check_controls(ref, target)
        return target

    def _check_controls(self, ref: t.Ref, target: Value) -> None:
        """Refuse to alter the control variable of a FOR around the statement, or note it in the dialects of CODESYS."""
        what = f"{ref.name} is the control variable of the FOR around this statement and"
        for index, control in enumerate(self.controls):
            if control == target.code and self.env.accepts("ST011", ref.pos, f"{what} is altered"):
                self.altered.add(index)
            elif control == target.code or control.startswith(f"{target.code}."):
                hint = "leave the loop with EXIT, or use WHILE"
                self.env.fail(ref.pos, f"{what} cannot be altered here", hint=hint)

    def in_out(
        self, expr: t.Expr | None, name: str, kind: ty.Type, call: t.Call, of: str, cells: dict[str, str]
    ) -> str:
        """Return the Python expression of the argument for VAR_IN_OUT `name` of `of`. A function's own variables are passed in
        cells: `cells` receives each variable with its cell, so that `take_back` can assign the values back after the call."""
        if not isinstance(expr, t.Ref):
            self.env.fail(call.pos, f"VAR_IN_OUT {name} of {of} needs a variable")
        target = self.writable(expr)
        if isinstance(kind, ty.OpenArray):
            return self._open_array(target, kind, expr.pos, f"VAR_IN_OUT {name} of {of}")
        extends = (
            isinstance(target.type, ty.Block) and isinstance(kind, ty.Block) and kind.name.lower() in target.type.bases
        )
        if target.type != kind and not extends and not (isinstance(kind, ty.String) and ty.fits(target.type, kind)):
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


def _value_of(argument: t.Argument | None) -> t.Expr | None:
    return None if argument is None else argument.value


def _into(p: Parameter, signature: Signature) -> str:
    return f"{p.name} of {signature.name}"
