"""Conversions of binary coded decimals by name: a digit in four bits (IEC 61131-3, 6.6.2.5.3).

The standard names the width of the bit string: WORD_BCD_TO_UINT, UINT_TO_BCD_WORD, and BCD_TO_UINT, TO_BCD_WORD for any width.
Other systems also have INT_TO_BCD, whose result is as wide as the number, and integers with a sign, which cannot be negative.
In CODESYS and TwinCAT, INT_TO_BCD gives a BYTE.
"""

from __future__ import annotations

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.functions.library import Write
from fieldtwin.plc.st.compiler.scope import Compiling, Value
from fieldtwin.plc.st.syntax import tree as t

_NUMBERS = ("USINT", "UINT", "UDINT", "ULINT", "SINT", "INT", "DINT", "LINT")
_BITS = ("BYTE", "WORD", "DWORD", "LWORD")


def _from_bcd(source: str, target: ty.Elementary) -> Write:
    def write(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
        wanted = ty.ELEMENTARY[source] if source else None
        value = x.value(given[0], wanted)
        if wanted is not None:
            code = x.coerced(value, wanted, given[0].pos, f"the argument of {call.ref.name}")
        elif ty.is_kind(value.type, "bits"):
            code = value.code
        else:
            x.env.fail(given[0].pos, f"the argument of {call.ref.name}", expected="a bit string", got=str(value.type))
        return Value(f"_v.of_bcd({code}, {target.high})", target)

    return write


def _to_bcd(source: str, target: ty.Elementary) -> Write:
    def write(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
        value = x.value(given[0])
        kind = ty.ELEMENTARY[source] if source else ty.plain(value.type)
        if not (isinstance(kind, ty.Elementary) and kind.kind in ("int", "bits")):
            kind = ty.ULINT  # a constant without a type
        code = x.coerced(value, kind, given[0].pos, f"the argument of {call.ref.name}")
        into = ty.ELEMENTARY["BYTE"] if x.env.dialect.vendor and call.ref.name.upper() == "INT_TO_BCD" else target
        return Value(f"_v.to_bcd({code}, {into.bits})", into)

    return write


def _same_width(number: str) -> ty.Elementary:
    return next(ty.ELEMENTARY[name] for name in _BITS if ty.ELEMENTARY[name].bits == ty.ELEMENTARY[number].bits)


BCD: dict[str, Write] = {
    **{f"{bits}_BCD_TO_{number}": _from_bcd(bits, ty.ELEMENTARY[number]) for bits in _BITS for number in _NUMBERS},
    **{f"BCD_TO_{number}": _from_bcd("", ty.ELEMENTARY[number]) for number in (*_NUMBERS, *_BITS)},
    **{f"{number}_TO_BCD_{bits}": _to_bcd(number, ty.ELEMENTARY[bits]) for number in _NUMBERS for bits in _BITS},
    **{f"{number}_TO_BCD": _to_bcd(number, _same_width(number)) for number in (*_NUMBERS, *_BITS)},
    **{f"TO_BCD_{bits}": _to_bcd("", ty.ELEMENTARY[bits]) for bits in _BITS},
}
"""The conversions by name."""
