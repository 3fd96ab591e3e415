"""Compiles the initial values of variables to Python (IEC 61131-3:2013, 6.5.1.3).

The standard allows constant expressions. In the dialects of CODESYS, the initial value of a variable of a POU, and of a global
one, may also use variables and call functions, and the declaration of a function block has the arguments of its FB_init.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.arguments import bind
from fieldtwin.plc.st.compiler.calls import Calls
from fieldtwin.plc.st.compiler.scope import Environment, Symbol, default_value, repeated
from fieldtwin.plc.st.syntax import tree as t

FB_INIT = "FB_init"
"""The method that CODESYS calls when an instance is created."""
FIXED = ("bInitRetains", "bInCopyCode")
"""The first two inputs of `FB_INIT`, which have no arguments in a declaration."""
Lists = tuple[tuple[t.Argument, ...], ...]
"""The arguments of FB_init: one list for all instances, or one for each element of an array."""


class Declaring(Protocol):
    """The declarations of a unit (`declarations.Declarations`), as initial values use them."""

    env: Environment

    def constants(self, symbols: dict[str, Symbol] | None = None) -> Calls: ...

    def creation(self, block: ty.Block) -> list[t.VarDecl]: ...

    def needed(self, block: ty.Block) -> list[str]: ...

    def type_of(self, spec: t.TypeSpec, role: str = "") -> ty.Type: ...


@dataclass(frozen=True, slots=True)
class InitialValues:
    """The compiler of initial values. `expressions` compiles the expressions in them; None for one of constants only."""

    declarations: Declaring
    expressions: Calls | None = None

    def of(self, kind: ty.Type, init: t.Init | None, spec: t.TypeSpec | None = None) -> str:
        """Return the Python expression of a new variable's value. `spec` is its declared type."""
        return self._value(kind, init, spec, _lists(spec))

    def _value(self, kind: ty.Type, init: t.Init | None, spec: t.TypeSpec | None, lists: Lists) -> str:
        env, of = self.declarations.env, element(kind)
        if isinstance(of, ty.Block) and of.abstract and (place := init or spec) is not None:
            hint = "declare a POU that extends it, or pass an instance as VAR_IN_OUT"
            env.fail(place.pos, f"{of} is ABSTRACT and has no instances", hint=hint)
        if isinstance(init, t.InitArray):
            return self._array(kind, init, spec, lists)
        if isinstance(init, t.InitStruct):
            return self._structure(kind, init, spec, lists)
        if init is None:
            return self._new(kind, spec, lists)
        compiler = self.expressions or self.declarations.constants()
        code = compiler.coerced(compiler.value(init, kind), kind, init.pos, "an initial value")
        if self.expressions is None and compiler.out.lines:
            env.fail(init.pos, "too deep an expression for an initial value")
        return code

    # -- new instances --------------------------------------------------------------------------------------------------

    def _new(self, kind: ty.Type, spec: t.TypeSpec | None, lists: Lists) -> str:
        """Return the Python expression of a new variable with the initial value of its type."""
        env, of = self.declarations.env, element(kind)
        if isinstance(spec, t.NamedType) and (code := env.type_initials.get(spec.name.lower())):
            return code
        if not lists:
            if spec is not None and isinstance(of, ty.Block) and (needed := self.declarations.needed(of)):
                env.fail(
                    spec.pos, f"an instance of {of} without the arguments of {FB_INIT}", expected=", ".join(needed)
                )
            if isinstance(kind, ty.Array) and isinstance(spec, t.ArrayType) and not isinstance(of, ty.Block):
                return repeated(self._value(kind.of, None, spec.of, ()), kind)
            return default_value(kind)
        if not (isinstance(of, ty.Block) and of.created):
            pos = lists[0][0].pos if lists[0] else spec.pos if spec is not None else t.Pos(1, 1)
            hint = "" if env.dialect.vendor else f"the dialects codesys and twincat have {FB_INIT}"
            env.fail(pos, f"{of} has no method {FB_INIT} for these arguments", hint=hint)
        if not isinstance(kind, ty.Array):
            return self._created(of, lists[0])
        count = ty.elements(ty.Array(kind.ranges, ty.INT))
        if len(lists) > 1 or isinstance(kind.of, ty.Array):
            return _shaped([self._value(kind.of, None, None, one) for one in self._each(lists, count, spec)], kind)
        code = f"[{self._created(of, lists[0])} for _ in range({count})]"
        return f"_v.shaped({code}, {_sizes(kind)})" if _sizes(kind) else code

    def _each(self, lists: Lists, count: int, spec: t.TypeSpec | None) -> list[Lists]:
        """Return the arguments for each element of an array."""
        if len(lists) in (0, 1):
            return [lists] * count
        if len(lists) != count:
            pos = lists[0][0].pos if lists[0] or spec is None else spec.pos
            self.declarations.env.fail(
                pos, f"arguments of {FB_INIT} for an array", expected=f"{count} lists", got=str(len(lists))
            )
        return [(one,) for one in lists]

    def _created(self, block: ty.Block, arguments: tuple[t.Argument, ...]) -> str:
        """Return the Python expression of a new instance whose FB_init gets these arguments."""
        env = self.declarations.env
        parameters = self.declarations.creation(block)
        what = f"{FB_INIT} of {block}"
        pos = arguments[0].pos if arguments else t.Pos(1, 1)
        call = t.Call(pos, t.Ref(pos, what), arguments)
        for argument in arguments:
            if argument.target is not None:
                env.fail(argument.pos, f"{what} has no outputs")
        given = bind(env, call, [v.name for v in parameters], what)
        compiler, codes = self.expressions or self.declarations.constants(), []
        for v in parameters:
            value = given[v.name.lower()].value if v.name.lower() in given else None
            if value is None:
                if v.initial is None:
                    env.fail(pos, f"arguments of {what}", expected=", ".join(one.name for one in parameters))
                continue
            kind = self.declarations.type_of(v.type)
            code = compiler.given(value, kind, value.pos, f"{v.name} of {what}")
            codes.append(f"v_{v.name.lower()}={code}")
        return f"{default_value(block).removesuffix('()')}({', '.join(codes)})"

    # -- arrays and structures ------------------------------------------------------------------------------------------

    def _array(self, kind: ty.Type, init: t.InitArray, spec: t.TypeSpec | None, lists: Lists) -> str:
        env = self.declarations.env
        if not isinstance(kind, ty.Array):
            env.fail(init.pos, "an array value for a type that is not an array", got=str(kind))
        if not (init.bracketed or env.dialect.vendor):
            hint = "the dialects codesys and twincat accept it"
            env.fail(init.pos, "an initial array without brackets", expected="[...]", hint=hint)
        items, count = [], 0
        total = ty.elements(ty.Array(kind.ranges, ty.INT))
        each = self._each(lists, total, spec)
        for often, item in init.items:
            if often < 0 or count + often > total:
                env.fail(init.pos, "more values than elements", expected=f"at most {total}")
            if len(lists) > 1:
                items += [self._value(kind.of, item, None, one) for one in each[count : count + often]]
            else:
                code = self._value(kind.of, item, None, lists)
                items.append(code if often == 1 else f"*({code} for _ in range({often}))")
            count += often
        if count < total and lists:
            items += [self._value(kind.of, None, None, one) for one in each[count:]]
        elif count < total:
            rest = self._value(kind.of, None, spec.of if isinstance(spec, t.ArrayType) else None, ())
            items.append(f"*({rest} for _ in range({total - count}))")
        return _shaped(items, kind)

    def _structure(self, kind: ty.Type, init: t.InitStruct, spec: t.TypeSpec | None, lists: Lists) -> str:
        env = self.declarations.env
        members = kind.fields if isinstance(kind, ty.Struct) else kind.inputs if isinstance(kind, ty.Block) else None
        if members is None:
            env.fail(init.pos, "a structure value for a type that is not a structure", got=str(kind))
        given, properties = [], []
        for name, item in init.members:
            if name.lower() not in members:
                properties.append(self._property(kind, init, name, item, [n for n, _ in members.values()]))
                continue
            member, of = members[name.lower()]
            attribute = f"m_{name.lower()}" if isinstance(kind, ty.Struct) else f"v_{name.lower()}"
            if isinstance(kind, ty.Block) and kind.standard:
                attribute = member
            given.append(f"{attribute}={self._value(of, item, None, ())}")
        code = f"_v.with_members({', '.join([self._new(kind, spec, lists), *given])})"
        return f"_v.with_properties({', '.join([code, *properties])})" if properties else code

    def _property(self, kind: ty.Type, init: t.InitStruct, name: str, item: t.Init, known: Sequence[str]) -> str:
        """Return the argument that sets a property of a new instance."""
        of = self.declarations.env.classes.get(str(kind).lower())
        setter = of.of("SET", name) if of is not None else None
        if setter is None:
            self.declarations.env.unknown(init.pos, f"in {kind}, a member", name, list(known))
        return f"{setter.attribute}={self._value(setter.signature.inputs[0].type, item, None, ())}"


def element(kind: ty.Type) -> ty.Type:
    """Return the type of the elements of an array, and of arrays in it; any other type itself."""
    while isinstance(kind, ty.Array):
        kind = kind.of
    return kind


def _lists(spec: t.TypeSpec | None) -> Lists:
    """Return the arguments of FB_init that a declared type has."""
    while isinstance(spec, t.ArrayType):
        spec = spec.of
    return spec.arguments if isinstance(spec, t.NamedType) else ()


def _sizes(kind: ty.Array) -> tuple[int, ...]:
    return tuple(high - low + 1 for low, high in kind.ranges[1:])


def _shaped(items: Sequence[str], kind: ty.Array) -> str:
    """Return the Python expression of an array of these elements, the last index changing fastest."""
    code = f"[{', '.join(items)}]"
    return f"_v.shaped({code}, {_sizes(kind)})" if _sizes(kind) else code
