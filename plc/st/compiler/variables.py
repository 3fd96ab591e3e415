"""References in expressions: variables, their members, elements and bits, and values of enumerations."""

from __future__ import annotations

from typing import NoReturn

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.classes.members import is_own, own_property, own_variable, property_value
from fieldtwin.plc.st.compiler.implicit import as_number
from fieldtwin.plc.st.compiler.scope import Compiling, Symbol, Value
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.written import reference

_BITS = ("BYTE", "WORD", "DWORD", "LWORD")


def lookup(x: Compiling, ref: t.Ref) -> tuple[Symbol | None, tuple[t.Selector, ...]]:
    """Return the variable to which `ref` refers, and the selectors after its name, which may be qualified by a global list."""
    if is_own(x, ref):
        return own_variable(x, ref)
    name = ref.name.lower()
    symbol = x.symbols.get(name) or x.env.globals.get(name)
    first = ref.selectors[0] if ref.selectors else None
    if symbol is None and name in x.env.lists and isinstance(first, t.Member):
        return x.env.lists[name].get(first.name.lower()), ref.selectors[1:]
    return symbol, ref.selectors


def variable(x: Compiling, ref: t.Ref) -> Value:
    """Compile the name of a variable, a property or a part of one, or a value of an enumeration. A REFERENCE TO stands for its
    variable.
    """
    return followed(x, place(x, ref), ref.pos)


def place(x: Compiling, ref: t.Ref) -> Value:
    """Compile a name as `variable` does, except that a REFERENCE TO stands for itself."""
    if ref.of is not None:
        value, selectors = _result(x, ref.of), ref.selectors
    else:
        found = None if ref.name.lower() in x.symbols else own_property(x, ref)
        value, selectors = found if found is not None else _variable(x, ref)
    for selector in selectors:
        value = followed(x, value, selector.pos)
        if isinstance(selector, t.Deref):
            value = _dereferenced(x, value, selector.pos)
        elif isinstance(selector, t.Member):
            value = _member(x, value, ref, selector)
        elif isinstance(selector, t.Index):
            value = _index(x, value, selector)
        else:
            value = bit(x, value, selector)
    return value


def _result(x: Compiling, call: t.Call) -> Value:
    """Return the result of a call of which a part is used. It is stored first, because the part may use it several times."""
    value = x.typed(x.value(call), call.pos)
    if not x.env.dialect.vendor:
        hint = "assign the result to a variable first; the dialects codesys and twincat accept it"
        x.env.fail(call.pos, f"a part of the result of {reference(call.ref)}", hint=hint)
    if isinstance(value.type, ty.Nothing):
        x.env.fail(call.pos, f"{reference(call.ref)} has no result")
    if x.only_constants:
        return value
    stored = x.out.temporary()
    x.out.line(f"{stored} = {value.code}", call.pos)
    return Value(stored, value.type)


def _variable(x: Compiling, ref: t.Ref) -> tuple[Value, tuple[t.Selector, ...]]:
    symbol, selectors = lookup(x, ref)
    if symbol is None or (x.env.dialect.vendor and isinstance(symbol.type, ty.Enum) and selectors):
        return _enum_value(x, ref), ()
    if _is_enum_value(symbol, ref) and _is_value_of(x.wanted, ref):
        return _enum_value(x, ref), ()
    if symbol.refused:
        x.env.fail(ref.pos, symbol.refused)
    if ref.name.lower() in x.env.ambiguous and ref.name.lower() not in x.symbols:
        expected = ", ".join(x.env.ambiguous[ref.name.lower()])
        x.env.fail(ref.pos, f"{ref.name} is a variable of several global lists", expected=expected)
    if x.only_constants and symbol.constant is None:
        x.env.fail(ref.pos, f"{ref.name} is not a constant", expected="a constant expression")
    owner, _, own = symbol.code.rpartition(".")
    reference = symbol.reference or (f"_v.MemberReference({owner}, {own!r})" if owner else "")
    value = Value(symbol.code, symbol.type, symbol.constant, True, symbol.writable, reference, symbol.is_input)
    return value, selectors


def followed(x: Compiling, value: Value, pos: t.Pos) -> Value:
    """Return the variable to which a REFERENCE TO refers; other values as they are."""
    is_reference = isinstance(value.type, ty.Pointer) and value.type.word == "REFERENCE TO"
    return _dereferenced(x, value, pos) if is_reference else value


def _dereferenced(x: Compiling, value: Value, pos: t.Pos) -> Value:
    """Return the variable to which a reference refers. NULL is an error at run time."""
    kind = value.type
    if not isinstance(kind, ty.Pointer):
        x.env.fail(pos, "a ^ after a value that is not a reference", got=str(kind))
    reference = f"_v.pointed({value.code})"
    return pointed(reference, x.env.target(kind, pos))


def pointed(reference: str, of: ty.Type) -> Value:
    """Return the variable to which the Python expression `reference` refers."""
    code, view = f"{reference}.v", ""
    if isinstance(of, ty.Array) and len(of.ranges) == 1:
        view, code = code, f"_v.whole({code}, {ty.elements(ty.Array(of.ranges, ty.INT))})"
    return Value(code, of, None, True, True, reference, view=view)


def _is_value_of(kind: ty.Type | None, ref: t.Ref) -> bool:
    """Return whether a name is a value of an enumeration."""
    return isinstance(kind, ty.Enum) and not ref.selectors and ref.name.lower() in map(str.lower, kind.values)


def _is_enum_value(symbol: Symbol, ref: t.Ref) -> bool:
    """Return whether a symbol is a value of an enumeration without a name. The type that its context demands has precedence."""
    return not symbol.writable and symbol.constant is not None and _is_value_of(symbol.type, ref)


def _enum_value(x: Compiling, ref: t.Ref) -> Value:
    first = ref.selectors[0] if ref.selectors else None
    if len(ref.selectors) == 1 and isinstance(first, t.Member):
        enum = x.env.types.get(ref.name.lower())
        if isinstance(enum, ty.Enum):
            return _qualified_value(x, enum, first)
        if ref.name.lower() in x.env.lists:
            known = [s.name for s in x.env.lists[ref.name.lower()].values()]
            x.env.unknown(first.pos, f"in {ref.name}, a variable", first.name, known)
    found = x.env.enum_values.get(ref.name.lower(), [])
    wanted = x.wanted
    if isinstance(wanted, ty.Enum) and _is_value_of(wanted, ref):
        found = [(wanted, n) for name, n in wanted.values.items() if name.lower() == ref.name.lower()]
    if not found or ref.selectors:
        unknown_variable(x, ref)
    if len(found) > 1:
        names = ", ".join(f"{enum}#{ref.name}" for enum, _ in found)
        x.env.fail(ref.pos, f"{ref.name} is a value of several types", expected=names)
    enum, number = found[0]
    return Value(repr(number), enum, number)


def unknown_variable(x: Compiling, ref: t.Ref) -> NoReturn:
    """Raise the error of a name that is not declared as a variable."""
    known = [s.name for s in (*x.symbols.values(), *x.env.globals.values())]
    qualifies = bool(ref.selectors) and isinstance(ref.selectors[0], t.Member)
    x.env.unknown(ref.pos, "a variable", ref.name, known, x.env.of_library(ref.name) if qualifies else "")


def _qualified_value(x: Compiling, enum: ty.Enum, member: t.Member) -> Value:
    if not x.env.dialect.vendor:
        hint = "the dialects codesys and twincat accept the dot"
        x.env.fail(member.pos, f"a value of {enum}", expected=f"{enum}#{member.name}", hint=hint)
    number = {name.lower(): value for name, value in enum.values.items()}.get(member.name.lower())
    if number is None:
        x.env.unknown(member.pos, f"in {enum}, a value", member.name, list(enum.values))
    return Value(repr(number), enum, number)


def _member(x: Compiling, value: Value, ref: t.Ref, member: t.Member) -> Value:
    kind, name = value.type, member.name.lower()
    if isinstance(kind, ty.Struct) and name in kind.fields:
        reference = f"_v.MemberReference({value.code}, {f'm_{name}'!r})"
        code = f"{value.code}.m_{name}"
        return Value(code, kind.fields[name][1], None, True, value.writable, reference, value.is_input)
    if isinstance(kind, ty.Block):
        inner = x.env.inner.get(kind.name.lower(), {})
        name = kind.aliases.get(name, name).lower()
        for members, writable in ((kind.inputs, True), (kind.outputs, False), (kind.publics, True), (inner, False)):
            if name in members:
                attribute = members[name][0] if kind.standard else f"v_{name}"
                reference = f"_v.MemberReference({value.code}, {attribute!r})"
                return Value(f"{value.code}.{attribute}", members[name][1], None, True, writable, reference)
    found = property_value(x, value, ref, member)
    if found is not None:
        return found
    if isinstance(kind, ty.Block) and name in kind.hidden:
        hint = f"declare it in VAR_OUTPUT, or in VAR PUBLIC, of {kind}"
        x.env.fail(member.pos, f"{member.name} is a local variable of {kind}", hint=hint)
    known: list[str] = []
    if isinstance(kind, ty.Struct):
        known = [f for f, _ in kind.fields.values()]
    elif isinstance(kind, ty.Block):
        known = [f for f, _ in (*kind.inputs.values(), *kind.outputs.values(), *kind.publics.values())]
    raise x.env.unknown(member.pos, f"in {kind}, a member", member.name, known)


def _index(x: Compiling, value: Value, selector: t.Index) -> Value:
    kind = value.type
    if isinstance(kind, ty.Pointer) and kind.word == "POINTER TO":
        return _moved(x, value, kind, selector)
    if isinstance(kind, ty.OpenArray):
        return _open_index(x, value, kind, selector)
    if isinstance(kind, ty.String):
        return _character(x, value, kind, selector)
    if not isinstance(kind, ty.Array):
        x.env.fail(selector.pos, "an index into a value that is not an array", got=str(kind))
    if len(selector.indices) != len(kind.ranges):
        x.env.fail(selector.pos, "indices", expected=f"{len(kind.ranges)} for {kind}", got=str(len(selector.indices)))
    code, owner, at = value.view or value.code, "", ""
    for expr, (low, high) in zip(selector.indices, kind.ranges, strict=True):
        index = _whole_number(x, expr)
        if value.view:
            at = f"_v.view({code}, {index.code}, {low}, {high})"
        elif isinstance(index.constant, int):
            if not low <= index.constant <= high:
                x.env.fail(expr.pos, "an index outside its array", expected=f"{low} to {high}", got=index.code)
            at = str(index.constant - low)
        else:
            at = f"_v.index({index.code}, {low}, {high})"
        owner, code = code, f"{code}[{at}]"
    return Value(code, kind.of, None, True, value.writable, f"_v.Element({owner}, {at})", value.is_input)


def _character(x: Compiling, value: Value, kind: ty.String, selector: t.Index) -> Value:
    """Compile a character of a string: a CHAR by its index from 1 (IEC 61131-3:2013, 6.4.2), in the dialects of CODESYS a BYTE
    by its index from 0; of a WSTRING a WCHAR or a WORD.
    """
    if len(selector.indices) != 1:
        x.env.fail(selector.pos, "indices", expected=f"1 for {kind}", got=str(len(selector.indices)))
    (expr,) = selector.indices
    index = _whole_number(x, expr)
    low = 0 if x.env.dialect.vendor else 1
    if isinstance(index.constant, int) and not low <= index.constant <= kind.length:
        x.env.fail(expr.pos, "an index outside its string", expected=f"{low} to {kind.length}", got=index.code)
    held = value.reference or f"_v.Cell({value.code})"
    owner = f"_v.Characters({held}, {kind.length})" if x.env.dialect.vendor else f"_v.Letters({held})"
    at = f"_v.index({index.code}, {low}, {kind.length})"
    of = character_type(kind, vendor=x.env.dialect.vendor)
    writable = value.writable and bool(value.reference)
    reference = f"_v.Element({owner}, {at})" if value.reference else ""
    return Value(f"{owner}[{at}]", of, None, True, writable, reference, value.is_input)


def character_type(kind: ty.String, *, vendor: bool) -> ty.Type:
    """Return the type of a character of a string."""
    narrow, wide = ("BYTE", "WORD") if vendor else ("CHAR", "WCHAR")
    return ty.ELEMENTARY[wide if kind.wide else narrow]


def _open_index(x: Compiling, value: Value, kind: ty.OpenArray, selector: t.Index) -> Value:
    """Compile an element of an array of variable length. Its limits are known at run time only."""
    if len(selector.indices) != kind.dimensions:
        x.env.fail(selector.pos, "indices", expected=f"{kind.dimensions} for {kind}", got=str(len(selector.indices)))
    code, owner, at = f"{value.code}.items", "", ""
    for n, expr in enumerate(selector.indices):
        at = f"_v.index({_whole_number(x, expr).code}, *{value.code}.ranges[{n}])"
        owner, code = code, f"{code}[{at}]"
    return Value(code, kind.of, None, True, value.writable, f"_v.Element({owner}, {at})", value.is_input)


def _whole_number(x: Compiling, expr: t.Expr) -> Value:
    index = x.flat(x.value(expr), expr.pos)
    if isinstance(index.type, ty.Enum):
        index = as_number(x, index, expr.pos)
    if not ty.is_kind(index.type, "int", "bits"):
        x.env.fail(expr.pos, "an index", expected="a whole number", got=str(index.type))
    return index


def _moved(x: Compiling, value: Value, kind: ty.Pointer, selector: t.Index) -> Value:
    """Compile ``pointer[i]``, which is the variable `i` elements after the one to which the pointer points."""
    of = x.env.target(kind, selector.pos)
    if len(selector.indices) != 1 or isinstance(of, ty.Array | ty.String):
        x.env.fail(selector.pos, f"an index into a {kind}", hint="write ^ before the index")
    return pointed(f"_v.moved({value.code}, {_whole_number(x, selector.indices[0]).code}, 1)", of)


def bit(x: Compiling, value: Value, selector: t.Bit) -> Value:
    """Compile a bit of an integer or of a bit string, such as ``word.3``, or a part of a bit string, such as ``word.%B1``."""
    kind = part_of(selector)
    held = ty.plain(value.type)
    if kind != ty.BOOL and not (isinstance(held, ty.Elementary) and held.kind == "bits"):
        x.env.fail(
            selector.pos, f"a {kind} of a value that is not a bit string", expected="a bit string", got=str(held)
        )
    if not (isinstance(held, ty.Elementary) and held.kind in ("int", "bits")):
        x.env.fail(selector.pos, "a bit of a value without bits", expected="an integer or a bit string", got=str(held))
    count = held.bits // selector.size if held.bits > selector.size else 0
    if selector.number >= count:
        parts = (
            f"bits 0 to {held.bits - 1}" if kind == ty.BOOL else f"{kind}s 0 to {count - 1}" if count else f"no {kind}s"
        )
        x.env.fail(selector.pos, f"{held} has {parts}", got=str(selector.number))
    shifted = f"{value.code} >> {selector.number * selector.size}"
    return Value(f"bool({shifted} & 1)" if kind == ty.BOOL else f"({shifted} & {kind.high})", kind)


def part_of(selector: t.Bit) -> ty.Elementary:
    """Return the type of a part of a bit string."""
    return {1: ty.BOOL, **{ty.ELEMENTARY[name].bits: ty.ELEMENTARY[name] for name in _BITS}}[selector.size]
