"""References in expressions: variables, their members, elements and bits, and values of enumerations."""

from __future__ import annotations

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.scope import Compiling, Value
from fieldtwin.plc.st.syntax import tree as t


def variable(x: Compiling, ref: t.Ref) -> Value:
    """Compile a reference to a variable or to a part of it, or a value of an enumeration."""
    symbol = x.symbols.get(ref.name.lower()) or x.env.globals.get(ref.name.lower())
    if symbol is None:
        return _enum_value(x, ref)
    if x.only_constants and symbol.constant is None:
        x.env.fail(ref.pos, f"{ref.name} is not a constant", expected="a constant expression")
    owner, _, own = symbol.code.rpartition(".")
    reference = symbol.reference or (f"_v.MemberReference({owner}, {own!r})" if owner else "")
    value = Value(symbol.code, symbol.type, symbol.constant, True, symbol.writable, reference)
    for selector in ref.selectors:
        if isinstance(selector, t.Member):
            value = _member(x, value, selector)
        elif isinstance(selector, t.Index):
            value = _index(x, value, selector)
        else:
            value = bit(x, value, selector)
    return value


def _enum_value(x: Compiling, ref: t.Ref) -> Value:
    found = x.env.enum_values.get(ref.name.lower(), [])
    if not found or ref.selectors:
        known = [s.name for s in (*x.symbols.values(), *x.env.globals.values())]
        x.env.unknown(ref.pos, "a variable", ref.name, known)
    if len(found) > 1:
        names = ", ".join(f"{enum}#{ref.name}" for enum, _ in found)
        x.env.fail(ref.pos, f"{ref.name} is a value of several types", expected=names)
    enum, number = found[0]
    return Value(repr(number), enum, number)


def _member(x: Compiling, value: Value, member: t.Member) -> Value:
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
    raise x.env.unknown(member.pos, f"in {kind}, a member", member.name, known)


def _index(x: Compiling, value: Value, selector: t.Index) -> Value:
    kind = value.type
    if not isinstance(kind, ty.Array):
        x.env.fail(selector.pos, "an index into a value that is not an array", got=str(kind))
    if len(selector.indices) != len(kind.ranges):
        x.env.fail(selector.pos, "indices", expected=f"{len(kind.ranges)} for {kind}", got=str(len(selector.indices)))
    code, owner, at = value.code, "", ""
    for expr, (low, high) in zip(selector.indices, kind.ranges, strict=True):
        index = x.flat(x.value(expr), expr.pos)
        if not ty.is_kind(index.type, "int", "bits"):
            x.env.fail(expr.pos, "an index", expected="a whole number", got=str(index.type))
        if isinstance(index.constant, int):
            if not low <= index.constant <= high:
                x.env.fail(expr.pos, "an index outside its array", expected=f"{low} to {high}", got=index.code)
            at = str(index.constant - low)
        else:
            at = f"_v.index({index.code}, {low}, {high})"
        owner, code = code, f"{code}[{at}]"
    return Value(code, kind.of, None, True, value.writable, f"_v.Element({owner}, {at})")


def bit(x: Compiling, value: Value, selector: t.Bit) -> Value:
    """Compile a bit of an integer or of a bit string, such as ``word.3``."""
    kind = ty.plain(value.type)
    if not (isinstance(kind, ty.Elementary) and kind.kind in ("int", "bits")):
        x.env.fail(selector.pos, "a bit of a value without bits", expected="an integer or a bit string", got=str(kind))
    if selector.number >= kind.bits:
        x.env.fail(selector.pos, f"{kind} has bits 0 to {kind.bits - 1}", got=str(selector.number))
    return Value(f"bool({value.code} >> {selector.number} & 1)", ty.BOOL)
