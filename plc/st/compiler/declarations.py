"""Declarations: type names to types, initial values to Python, structures to Python classes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from fieldtwin.gateway.core.image.layout import MAX_DEPTH, MAX_MESSAGE_BYTES
from fieldtwin.plc.blocks import BLOCKS
from fieldtwin.plc.program import MESSAGE_BYTES, MESSAGE_DEPTH
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.calls import Calls
from fieldtwin.plc.st.compiler.initial.values import FB_INIT, FIXED, InitialValues, element
from fieldtwin.plc.st.compiler.pointers.memory import layout, members
from fieldtwin.plc.st.compiler.scope import CodeWriter, Environment, Symbol, default_value, identifier
from fieldtwin.plc.st.runtime.lines import line_of
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.walk import nodes

MAX_REPEATED = 100
"""The limit, in characters, up to which generated Python code repeats an initial value. A longer one becomes a function."""
_STANDARD = ty.standard_blocks(BLOCKS)
_VENDOR_NAMES = {
    "sr": {"set1": "S1", "reset": "R"}, "rs": {"set": "S", "reset1": "R1"}, "ctu": {"reset": "R"}, "ctd": {"load": "LD"},
    "ctud": {"reset": "R", "load": "LD"},
}  # fmt: skip
"""The names that inputs of the standard blocks have in the library Standard of CODESYS and in Tc2_Standard of TwinCAT."""


class Declarations:
    """The types of a unit. Each is resolved when it is first needed, so they may be declared in any order."""

    def __init__(self, env: Environment, unit: t.SourceUnit, out: CodeWriter) -> None:
        self.env = env
        self.out = out
        self.scope: dict[str, Symbol] = {}
        """The constants of the POU whose declarations are being read."""
        self._constants: dict[t.Pos, dict[str, Symbol]] = {}
        """The constants of each POU and method, by its position."""
        self._deep = 0
        self._unit = unit
        self._types: dict[str, t.TypeDecl] = {}
        self._blocks = {p.name.lower(): p for p in unit.pous if p.kind in ("FUNCTION_BLOCK", "CLASS", "INTERFACE")}
        self._enumerated: dict[t.Pos, dict[str, Symbol]] = {}
        self._open: list[str] = []
        self._pointed: list[t.NamedType] = []
        """Structures and blocks to which references refer, and which have to be resolved when no other type is open."""
        for declared in unit.types:
            with env.declaring(declared.name, env.faulty):
                if declared.name.lower() in self._types or declared.name.upper() in ty.ELEMENTARY:
                    env.fail(declared.pos, f"type {declared.name} is declared twice")
                self._types[declared.name.lower()] = declared
                if isinstance(declared, t.EnumDecl) and not _computed(declared):
                    self.env.types[declared.name.lower()] = self._registered(declared)

    def resolve(self) -> None:
        """Resolve all types, after the global constants are known, because limits may use them."""
        for declared in self._unit.types:
            with self.env.declaring(declared.name, self.env.faulty):
                self.named(declared.name, declared.pos)

    @contextmanager
    def within(self, pou: t.Pou) -> Iterator[None]:
        """Make the constants of `pou` available to limits and initial values. A method also has those of its owner."""
        before = self.scope
        known = pou.pos in self._constants
        self.scope = self._constants.setdefault(pou.pos, dict(before) if pou.kind in t.METHODS else {})
        try:
            if not known:
                for block in pou.blocks:
                    for v in block.variables if "CONSTANT" in block.qualifiers else ():
                        found = self.constant(v, f"v_{v.name.lower()}")
                        if found is not None:
                            self.scope[v.name.lower()] = found
                self._enumerated[pou.pos] = self._values_of(pou)
                self.scope.update(self._enumerated[pou.pos])
            yield
        finally:
            self.scope = before

    def _values_of(self, pou: t.Pou) -> dict[str, Symbol]:
        """Return the values of the enumerations without a name in the declarations of a POU; they are known in this POU
        only.
        """
        found: dict[str, Symbol] = {}
        for v in (v for block in pou.blocks for v in block.variables if isinstance(v.type, t.EnumType)):
            enum = self.type_of(v.type)
            for name, number in enum.values.items() if isinstance(enum, ty.Enum) else ():
                value = Symbol(name, enum, repr(number), writable=False, constant=number)
                before = found.setdefault(name.lower(), value)
                if before != value:
                    several = f"{name} is a value of {before.type} and of {enum}"
                    refused = f"{several}; declare them in TYPE and write TYPE#{name}"
                    found[name.lower()] = replace(before, refused=refused)
        return found

    def enumerated(self, pou: t.Pou) -> dict[str, Symbol]:
        """Return the values of the enumerations without a name in the declarations of a POU, by their names in lower case."""
        return self._enumerated.get(pou.pos, {})

    def constant(self, v: t.VarDecl, code: str) -> Symbol | None:
        """Return a CONSTANT with its value; None if the value is not elementary, or too long to be written at each use."""
        if v.initial is None or isinstance(v.initial, t.InitArray | t.InitStruct):
            return None
        kind = self.type_of(v.type)
        compiler = self.constants()
        value = compiler.settled(compiler.value(v.initial, kind), v.initial.pos)
        text = compiler.coerced(value, kind, v.initial.pos, "an initial value")
        if value.constant is None or len(text) > MAX_REPEATED or isinstance(kind, ty.String):
            return None
        return Symbol(v.name, kind, text, writable=False, constant=value.constant)

    def constant_of(self, expr: t.Expr, kind: ty.Type, what: str) -> Any:
        """Return the value of a constant expression of type `kind`; `what` names it in errors. Raises `FileInvalid`."""
        compiler = self.constants()
        value = compiler.settled(compiler.value(expr, kind), expr.pos)
        compiler.coerced(value, kind, expr.pos, what)
        if value.constant is None:
            self.env.fail(expr.pos, what, expected="a constant")
        return value.constant

    def constants(self, symbols: dict[str, Symbol] | None = None) -> Calls:
        """Return a compiler of constant expressions. `symbols` are the constants that it knows; None for those of the POU."""
        compiler = Calls(self.env, self.scope if symbols is None else symbols, CodeWriter())
        compiler.only_constants = True
        return compiler

    def shared(self, code: str) -> str:
        """Return `code`, or, if it is long, the call of a function that contains it, so that the code is written only once."""
        if len(code) <= MAX_REPEATED:
            return code
        name = f"_new{len(self.out.lines)}"
        with self.out.block(f"def {name}():"):
            self.out.line(f"return {code}")
        return f"{name}()"

    # -- types ----------------------------------------------------------------------------------------------------------

    def type_of(self, spec: t.TypeSpec, role: str = "") -> ty.Type:
        """Return the type of a type specification. `role` is the kind of the block of a variable or parameter. On it depends
        whether MESSAGES and ARRAY[*] are allowed.
        """
        if isinstance(spec, t.NamedType):
            return self.named(spec.name, spec.pos)
        if isinstance(spec, t.ArrayType):
            return self._open_array(spec, role) if spec.open else self._array(spec)
        if isinstance(spec, t.PointerType):
            return self._pointer(spec)
        if isinstance(spec, t.EnumType):
            name = f"({', '.join(name for name, _ in spec.values)})"
            return self._enum(t.EnumDecl(spec.pos, name, spec.values, None, spec.base))
        if isinstance(spec, t.SubrangeType):
            return self._subrange(spec)
        if isinstance(spec, t.StringType):
            length = ty.DEFAULT_STRING if spec.length is None else self._constant(spec.length, "the length of a string")
            if not 1 <= length <= ty.MAX_STRING:
                self.env.fail(spec.pos, "the length of a string", expected=f"1 to {ty.MAX_STRING}", got=str(length))
            return ty.String(length, spec.wide)
        return self._messages(spec, role)

    def _open_array(self, spec: t.ArrayType, role: str) -> ty.OpenArray:
        if role not in ty.GIVEN:
            expected = "a VAR_IN_OUT, or a VAR_INPUT or VAR_OUTPUT of a FUNCTION or METHOD"
            hint = "in a FUNCTION_BLOCK use VAR_IN_OUT, elsewhere an array with limits"
            self.env.fail(spec.pos, "an array of variable length (ARRAY[*])", expected=expected, hint=hint)
        return ty.OpenArray(spec.open, self.type_of(spec.of))

    def _array(self, spec: t.ArrayType) -> ty.Array:
        if self._deep >= ty.MAX_NESTED:
            self.env.fail(spec.pos, "arrays nested too deep", expected=f"at most {ty.MAX_NESTED}")
        ranges = tuple((self._constant(a, "an index"), self._constant(b, "an index")) for a, b in spec.ranges)
        if any(low > high for low, high in ranges):
            self.env.fail(spec.pos, "an empty range of indices")
        self._deep += 1
        try:
            of = self.type_of(spec.of)
        finally:
            self._deep -= 1
        if isinstance(of, ty.MessagesIn | ty.MessagesOut):
            self.env.fail(spec.pos, "an array of MESSAGES")
        made = ty.Array(ranges, of)
        self.bounded(spec.pos, [made])
        return made

    def _pointer(self, spec: t.PointerType) -> ty.Pointer:
        word = spec.word if spec.word == "REF_TO" else f"{spec.word} TO"
        if spec.word != "REF_TO" and not self.env.dialect.vendor:
            hint = "the dialects codesys and twincat accept it; the standard has REF_TO"
            self.env.fail(spec.pos, f"{word} is not in the standard", hint=hint)
        key = spec.of.name.lower() if isinstance(spec.of, t.NamedType) else ""
        if key in self.env.incomplete:
            raise self.env.following(key, spec.pos)
        if isinstance(spec.of, t.NamedType) and (key in self._blocks or isinstance(self._types.get(key), t.StructDecl)):
            declared = self._blocks.get(key) or self._types[key]
            self._pointed.append(spec.of)  # it may contain this reference
            made = ty.Pointer(word, ty.Named(key, declared.name))
        else:
            made = ty.Pointer(word, self.type_of(spec.of))
        self._resolve_pointed()
        return made

    def _resolve_pointed(self) -> None:
        while self._pointed and not self._open:
            later = self._pointed.pop()
            self.named(later.name, later.pos)

    def bounded(self, pos: t.Pos, kinds: Iterable[ty.Type]) -> tuple[int, int]:
        """Return the size and the nesting depth of variables of these types. Raises `FileInvalid` beyond the limits."""
        found = list(kinds)
        total, nested = sum(map(ty.elements, found)), max(map(ty.nested, found), default=0)
        if total > ty.MAX_ELEMENTS:
            self.env.fail(pos, "too much data", expected=f"at most {ty.MAX_ELEMENTS} elements", got=str(total))
        if nested > ty.MAX_NESTED:
            self.env.fail(pos, "arrays, structures and blocks nested too deep", expected=f"at most {ty.MAX_NESTED}")
        return total, nested

    def _messages(self, spec: t.MessagesType, role: str) -> ty.Type:
        if role == "VAR_INPUT" and spec.max_bytes is None:
            return ty.MessagesIn()
        if role != "VAR_OUTPUT":
            self.env.fail(
                spec.pos,
                "MESSAGES are not allowed here",
                expected="MESSAGES as VAR_INPUT, MESSAGES[bytes, depth] as VAR_OUTPUT of a PROGRAM",
            )
        max_bytes = MESSAGE_BYTES if spec.max_bytes is None else self._constant(spec.max_bytes, "the longest message")
        depth = MESSAGE_DEPTH if spec.depth is None else self._constant(spec.depth, "the depth")
        if not (1 <= max_bytes <= MAX_MESSAGE_BYTES and 1 <= depth <= MAX_DEPTH):
            self.env.fail(
                spec.pos,
                "MESSAGES of an impossible size",
                expected=f"1 to {MAX_MESSAGE_BYTES} bytes, depth 1 to {MAX_DEPTH}",
            )
        return ty.MessagesOut(max_bytes, depth)

    def named(self, name: str, pos: t.Pos, *, as_base: bool = False) -> ty.Type:
        """Return the type with this name. An incomplete one is only known in its own declaration, or `as_base` of others."""
        key = name.lower()
        if key in self.env.incomplete and not as_base and not self._is_own(key, pos):
            raise self.env.following(name, pos)
        found = ty.ELEMENTARY.get(name.upper()) or self.env.types.get(key)
        if found is not None:
            return found
        if key in self._open:
            self.env.fail(pos, f"type {name} contains itself")
        if len(self._open) > ty.MAX_NESTED:
            self.env.fail(pos, "arrays, structures and blocks nested too deep", expected=f"at most {ty.MAX_NESTED}")
        self._open.append(key)
        try:
            found = self._resolved(key, name, pos)
        finally:
            self._open.pop()
        self.env.types[key] = found
        self._resolve_pointed()
        return found

    def _is_own(self, key: str, pos: t.Pos) -> bool:
        """Return whether `pos` is the place of the declaration `key`."""
        declared = self._blocks.get(key) or self._types.get(key)
        return declared is not None and declared.pos == pos

    def _resolved(self, key: str, name: str, pos: t.Pos) -> ty.Type:
        if key in self._types:
            return self._declared(self._types[key])
        if key in self._blocks:
            pou = self._blocks[key]
            return self._interface(pou) if pou.kind == "INTERFACE" else self._block(pou)
        self.env.refuse_missing(key, pos)
        if key == "bit" and self.env.dialect.vendor:
            self.env.fail(
                pos, "BIT outside of a structure", expected="BOOL, or BIT as the type of a member of a STRUCT"
            )
        if key in _STANDARD:
            found = _STANDARD[key]
            aliases = _VENDOR_NAMES.get(key.partition("_")[0], {}) if self.env.dialect.vendor else {}
            return replace(found, aliases=aliases)
        known = [*ty.ELEMENTARY, *(d.name for d in self._types.values()), *(b.name for b in self._blocks.values())]
        library = name.rpartition(".")[0]
        if library:
            known = [one for one in known if "." in one]
            raise self.env.unknown(pos, "a type", name, known, self.env.of_library(library))
        raise self.env.unknown(pos, "a type", name, known + [b.name for b in _STANDARD.values()])

    def _declared(self, declared: t.TypeDecl) -> ty.Type:
        if isinstance(declared, t.StructDecl):
            fields: dict[str, tuple[str, ty.Type]] = {}
            for field in declared.fields:
                if field.name.lower() in fields:
                    self.env.fail(field.pos, f"{field.name} is declared twice")
                kind = ty.BIT if self._is_bit(field.type) and not declared.union else self.type_of(field.type)
                if field.location and (declared.union or ty.holds_union(kind)):
                    what = "is a member of a union" if declared.union else "is or contains a union"
                    self.env.fail(field.pos, f"{field.name} {what} and has an address", expected="no AT")
                if isinstance(field.type, t.EnumType) and isinstance(kind, ty.Enum):
                    self.register(kind)
                fields[field.name.lower()] = (field.name, kind)
            total, nested = self.bounded(declared.pos, (kind for _, kind in fields.values()))
            refers = any(ty.holds_interface(kind) for _, kind in fields.values())
            struct = ty.Struct(declared.name, fields, total, nested + 1, refers, declared.union, declared.packed)
            if declared.union:
                self._write_union(struct, declared)
            else:
                self._write_struct(struct, declared)
            return struct
        if isinstance(declared, t.EnumDecl):
            return self._registered(declared)
        kind = self.type_of(declared.type)
        if declared.initial is not None or not isinstance(element(kind), ty.Block):
            code = self.initial(kind, declared.initial, declared.type)
            if code != default_value(kind):  # a derived type has the initial value of its base
                self.env.type_initials[declared.name.lower()] = self.shared(code)
        return kind

    def _is_bit(self, spec: t.TypeSpec) -> bool:
        """Return whether a type is BIT, which the dialects of CODESYS have for members of structures."""
        named = isinstance(spec, t.NamedType) and spec.name.upper() == ty.BIT.name
        return named and self.env.dialect.vendor and "bit" not in self._types

    def _registered(self, declared: t.EnumDecl) -> ty.Enum:
        enum = self._enum(declared)
        self.register(enum)
        return enum

    def register(self, enum: ty.Enum) -> None:
        """Make the values of an enumeration known in the whole unit."""
        for name, value in enum.values.items():
            found = self.env.enum_values.setdefault(name.lower(), [])
            if (enum, value) not in found:
                found.append((enum, value))

    def _enum(self, declared: t.EnumDecl) -> ty.Enum:
        values: dict[str, int] = {}
        number = 0
        for name, stated in declared.values:
            if stated is not None:
                number = stated if isinstance(stated, int) else self._computed_value(stated, values)
            if name.lower() in {v.lower() for v in values}:
                self.env.fail(declared.pos, f"{declared.name} has the value {name} twice")
            values[name] = number
            number += 1
        self._check_base(declared, values)
        first = next(iter(values.values()))
        base = ty.ELEMENTARY[declared.base.name.upper()].bits if declared.base is not None else ty.INT.bits
        enum = ty.Enum(declared.name, values, first, base)
        if isinstance(declared.initial, t.Ref):
            lower = {k.lower(): v for k, v in values.items()}
            if declared.initial.name.lower() not in lower:
                self.env.unknown(declared.pos, f"in {declared.name}, a value", declared.initial.name, list(values))
            enum = ty.Enum(declared.name, values, lower[declared.initial.name.lower()], base)
        return enum

    def _computed_value(self, expr: t.Expr, before: dict[str, int]) -> int:
        """Return the value of an enumerated value's expression. `before` are the values that are declared before it."""
        for ref in (node for node in nodes(expr) if isinstance(node, t.Ref)):
            if isinstance(self._types.get(ref.name.lower()), t.EnumDecl):
                self.named(ref.name, ref.pos)
        known = {
            name.lower(): Symbol(name, ty.LINT, repr(number), writable=False, constant=number)
            for name, number in before.items()
        }
        compiler = self.constants({**self.scope, **known})
        value = compiler.settled(compiler.value(expr), expr.pos)
        whole = ty.is_kind(value.type, "int", "bits") or isinstance(value.type, ty.Enum)
        if value.constant is None or not whole:
            self.env.fail(
                expr.pos, "the number of an enumerated value", expected="a constant whole number", got=str(value.type)
            )
        return int(value.constant)

    def _check_base(self, declared: t.EnumDecl, values: dict[str, int]) -> None:
        """Check that each value of an enumeration fits the type that is stated for them, an elementary type."""
        if declared.base is None:
            return
        base = ty.ELEMENTARY.get(declared.base.name.upper())
        if base is None or base.kind not in ("int", "bits"):
            expected = "an integer type or a bit string, such as INT"
            self.env.fail(
                declared.base.pos, "the type of an enumeration's values", expected=expected, got=declared.base.name
            )
        for name, value in values.items():
            if not base.low <= value <= base.high:
                self.env.fail(
                    declared.pos, f"{name} is outside {base}", expected=f"{base.low} to {base.high}", got=str(value)
                )

    def _subrange(self, spec: t.SubrangeType) -> ty.Subrange:
        base = self.named(spec.name, spec.pos)
        low, high = self._constant(spec.low, "a limit"), self._constant(spec.high, "a limit")
        if not (isinstance(base, ty.Elementary) and base.kind == "int" and base.low <= low <= high <= base.high):
            self.env.fail(
                spec.pos, "a subrange", expected="limits inside an integer type", got=f"{base}({low}..{high})"
            )
        return ty.Subrange(base, low, high)

    def _block(self, pou: t.Pou) -> ty.Block:
        members: dict[str, dict[str, tuple[str, ty.Type]]] = {"VAR_INPUT": {}, "VAR_OUTPUT": {}, "VAR_IN_OUT": {}}
        publics: dict[str, tuple[str, ty.Type]] = {}
        hidden: set[str] = set()
        held: list[ty.Type] = []
        with self.within(pou):
            for block in pou.blocks:
                for v in block.variables if block.kind in (*members, "VAR") else ():
                    kind = self.type_of(
                        v.type, block.kind if block.kind == "VAR_IN_OUT" else ""
                    )  # also finds a block that contains itself
                    if block.kind != "VAR_IN_OUT":
                        held.append(kind)
                    if block.kind in members:
                        members[block.kind][v.name.lower()] = (v.name, kind)
                    elif block.qualifiers & {"PUBLIC", "INTERNAL"} and "CONSTANT" not in block.qualifiers:
                        publics[v.name.lower()] = (v.name, kind)
                    else:
                        hidden.add(v.name.lower())
        total, nested = self.bounded(pou.pos, held)
        inputs, outputs, in_outs = members.values()
        order = tuple(v.name for block in pou.blocks if block.kind in ty.GIVEN for v in block.variables)
        base = self.named(pou.extends[0].name, pou.extends[0].pos, as_base=True) if pou.extends else None
        actions = frozenset(action.name.lower() for action in pou.actions)
        bases, interfaces = frozenset[str](), self._interfaces(pou.implements)
        if isinstance(base, ty.Block):
            bases, interfaces = base.bases | {base.name.lower()}, interfaces | base.interfaces
            actions |= base.actions
        created = self.env.dialect.vendor and _fb_init(pou) is not None
        return ty.Block(
            pou.name, inputs, outputs, order, in_outs,
            elements=total, nested=nested + 1, actions=actions, publics=publics, hidden=frozenset(hidden),
            bases=bases, interfaces=interfaces, refers=any(map(ty.holds_interface, held)), is_class=pou.kind == "CLASS",
            abstract="ABSTRACT" in pou.modifiers, created=created or (isinstance(base, ty.Block) and base.created),
        )  # fmt: skip

    def _interface(self, pou: t.Pou) -> ty.Interface:
        return ty.Interface(pou.name, self._interfaces(pou.extends))

    def _interfaces(self, names: tuple[t.NamedType, ...]) -> frozenset[str]:
        """Return the interfaces with these names, and those that they extend, in lower case."""
        found: set[str] = set()
        for name in names:
            kind = self.named(name.name, name.pos, as_base=True)
            if isinstance(kind, ty.Interface):
                found |= {kind.name.lower(), *kind.bases}
        return frozenset(found)

    def _constant(self, expr: t.Expr, what: str) -> int:
        return self.constants().constant_integer(expr, what)

    # -- initial values -------------------------------------------------------------------------------------------------

    def initial(self, kind: ty.Type, init: t.Init | None, spec: t.TypeSpec | None = None) -> str:
        """Return the Python expression of a new variable's value, computed from constants only."""
        return InitialValues(self).of(kind, init, spec)

    def creation(self, block: ty.Block) -> list[t.VarDecl]:
        """Return the parameters of FB_init of a block, in their order, for which a declaration has arguments."""
        pou = self._blocks.get(block.name.lower())
        while pou is not None:
            own = _fb_init(pou)
            if own is not None:
                given = [v for b in own.blocks if b.kind == "VAR_INPUT" for v in b.variables]
                return given[len(FIXED) :]
            pou = self._blocks.get(pou.extends[0].name.lower()) if pou.extends else None
        return []

    def needed(self, block: ty.Block) -> list[str]:
        """Return the names of the parameters of FB_init that have no initial value."""
        return [v.name for v in self.creation(block) if v.initial is None] if block.created else []

    def _write_union(self, union: ty.Struct, declared: t.StructDecl) -> None:
        """Write the class of a union, whose members are bytes of the same memory."""
        out, name = self.out, f"S_{identifier(union.name)}"
        for field in declared.fields:
            layout(self.env, union.fields[field.name.lower()][1], field.pos, f"{union.name}.{field.name}")
        code = members(self.env, union, declared.pos, union.name)
        out.line(f"{name} = _v.layouts.union({name!r}, {code})", declared.pos)
        stated = [field for field in declared.fields if field.initial is not None]
        if stated:
            with out.block(f"def _{name}_initialise(self):", declared.pos):
                for field in stated:
                    kind = union.fields[field.name.lower()][1]
                    out.line(
                        f"self.m_{field.name.lower()} = {self.initial(kind, field.initial, field.type)}", field.pos
                    )
            out.line(f"{name}.initialise = _{name}_initialise", declared.pos)

    def _write_struct(self, struct: ty.Struct, declared: t.StructDecl) -> None:
        out, names = self.out, [f"m_{name}" for name in struct.fields]
        with out.block(f"class L_S_{identifier(struct.name)}:", declared.pos):
            out.line(f"__slots__ = {(*map(line_of, names),)}")
        with out.block(f"class S_{identifier(struct.name)}(L_S_{identifier(struct.name)}):", declared.pos):
            out.line(f"__slots__ = {tuple(names)}")
            with out.block("def __init__(self):"):
                for field in declared.fields:
                    kind = struct.fields[field.name.lower()][1]
                    out.line(
                        f"self.m_{field.name.lower()} = {self.initial(kind, field.initial, field.type)}", field.pos
                    )
            with out.block("def copy(self):"):
                out.line(f"new = S_{identifier(struct.name)}.__new__(S_{identifier(struct.name)})")
                for name, (_, kind) in zip(names, struct.fields.values(), strict=True):
                    code = f"self.{name}"
                    if isinstance(kind, ty.Array):
                        code = f"_v.copied({code})"
                    elif isinstance(kind, ty.Struct):
                        code += ".copy()"
                    out.line(f"new.{name} = {code}")
                out.line("return new")


def _computed(declared: t.EnumDecl) -> bool:
    """Return whether an expression, which may use other declarations, states the number of a value."""
    return not all(stated is None or isinstance(stated, int) for _, stated in declared.values)


def _fb_init(pou: t.Pou) -> t.Pou | None:
    """Return the method FB_init that a POU declares; None if it has none."""
    found = (method for method in pou.methods if method.kind == "METHOD" and method.name.lower() == FB_INIT.lower())
    return next(found, None)
