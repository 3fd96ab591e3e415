"""Type conversions by name: INT_TO_REAL, TO_DINT, TRUNC, REAL_TRUNC_INT... (IEC 61131-3, 6.6.2.5.2).

A conversion from real to integer rounds to the nearest, ties to even; TRUNC truncates, and gives a DINT (REAL_TRUNC_LINT and
similar functions give other types). A number that the target cannot hold is an error at run time. A conversion between integer or
bit string types, however, keeps only the bits that fit, as the standard requires. As a number, TIME counts ms, and LTIME ns.
"""

from __future__ import annotations

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.functions.bcd import BCD
from fieldtwin.plc.st.compiler.functions.library import Write
from fieldtwin.plc.st.compiler.scope import Compiling, Value
from fieldtwin.plc.st.syntax import tree as t

_NAMES: dict[str, ty.Type] = {**ty.ELEMENTARY, "STRING": ty.String(254), "WSTRING": ty.String(254, wide=True)}
_DIGITS = {32: 7, 64: 15}


def conversion(name: str) -> Write | None:
    """Return the conversion function with this name (in capitals), or None."""
    if name == "TRUNC":
        return lambda x, call, given: _convert(x, call, given[0], None, ty.DINT, cut=True)
    if name in BCD:
        return BCD[name]
    source, word, target = name.rpartition("_TRUNC_")
    if word and target in _NAMES:
        return _made(_NAMES.get(source), _NAMES[target], cut=True) if source in _NAMES else None
    source, word, target = name.rpartition("_TO_")
    if word and source in _NAMES and target in _NAMES:
        return _made(_NAMES[source], _NAMES[target], cut=False)
    name = name.removeprefix("ANY_")
    if name.startswith("TO_") and name[3:] in _NAMES:
        return _made(None, _NAMES[name[3:]], cut=False)
    return None


def _made(source: ty.Type | None, target: ty.Type, cut: bool) -> Write:
    return lambda x, call, given: _convert(x, call, given[0], source, target, cut)


def _convert(x: Compiling, call: t.Call, expr: t.Expr, source: ty.Type | None, target: ty.Type, cut: bool) -> Value:
    value = x.value(expr, source)
    kind = ty.plain(value.type)
    if source is not None and not isinstance(source, ty.String):
        code: str | None = x.coerced(value, source, expr.pos, f"the argument of {call.ref.name}")
        kind = source
    else:
        code = value.code
        if isinstance(source, ty.String) and not isinstance(kind, ty.String):
            x.env.fail(expr.pos, f"the argument of {call.ref.name}", expected="a string", got=str(kind))
    if isinstance(kind, ty.AnyInt):
        kind = ty.LINT if ty.fits(kind, ty.LINT) else ty.ULINT
    elif isinstance(kind, ty.AnyReal):
        kind = ty.LREAL
    elif isinstance(kind, ty.Enum):
        kind = ty.DINT
    assert code is not None
    made = (
        _of_string(code, target, x.env.dialect.vendor)
        if isinstance(kind, ty.String)
        else _of_value(code, kind, target, cut)
    )
    if made is None and x.env.dialect.vendor:
        made = _of_date(code, kind, target)
    if made is None:
        x.env.fail(call.pos, f"there is no conversion from {kind} to {target}")
    if isinstance(kind, ty.String) and isinstance(target, ty.String):
        target = ty.String(kind.length, target.wide)
    return Value(made, target)


def _of_string(code: str, target: ty.Type, vendor: bool) -> str | None:
    if isinstance(target, ty.String):
        return code if target.wide else f"{code}.encode('latin-1', 'replace').decode('latin-1')"
    assert isinstance(target, ty.Elementary)
    if target.kind == "char":
        first = f"({code}[:1] or {chr(39)}\\0{chr(39)})"
        return first if target == ty.WCHAR else f"{first}.encode('latin-1', 'replace').decode('latin-1')"
    if target.kind in ("int", "bits"):
        return f"_v.{'leading_number' if vendor else 'number_of'}({code}, {target.low}, {target.high})"
    if target.kind == "real":
        number = f"_v.{'leading_real' if vendor else 'real_of'}({code})"
        return f"_v.real({number})" if target.bits == 32 else number
    return f"({code}.strip().upper() in ('TRUE', '1'))" if target.kind == "bool" else None


def _of_value(code: str, kind: ty.Type, target: ty.Type, cut: bool) -> str | None:
    if not isinstance(kind, ty.Elementary):
        return None
    if kind.kind == "char" or (isinstance(target, ty.Elementary) and target.kind == "char"):
        return _of_character(code, kind, target)
    if isinstance(target, ty.String):
        return _text(code, kind)
    assert isinstance(target, ty.Elementary)
    whole = ("int", "bits", "bool")
    if kind.kind in whole and target.kind in whole:
        return _between_integers(code, kind, target)
    if kind.kind in whole and target.kind == "real":
        return f"_v.real({code})" if ty.is_rounded(kind, target) else f"float({code})"
    if kind.kind == "real":
        return _of_real(code, target, cut)
    if kind.kind == "duration" or target.kind == "duration":
        return _of_time(code, kind, target)
    if kind.kind == "dt" and target.kind in ("date", "tod"):
        return f"({code} // {ty.DAY_NS} * {ty.DAY_NS})" if target.kind == "date" else f"({code} % {ty.DAY_NS})"
    return code if kind.kind == target.kind or (kind.kind == "date" and target.kind == "dt") else None


def _of_character(code: str, kind: ty.Elementary, target: ty.Type) -> str | None:
    """Write the conversion of a CHAR or WCHAR, or to one. A bit string holds the code of the character (tables 25 and 26)."""
    if isinstance(target, ty.String):
        return code if target.wide == (kind == ty.WCHAR) else None
    assert isinstance(target, ty.Elementary)
    if kind.kind == target.kind:
        return code if target.bits >= kind.bits else f"{code}.encode('latin-1', 'replace').decode('latin-1')"
    if kind.kind == "char" and target.kind == "bits" and target.bits >= kind.bits:
        return f"ord({code})"
    return f"chr({code} & {2**target.bits - 1})" if kind.kind == "bits" else None


def _of_date(code: str, kind: ty.Type, target: ty.Type) -> str | None:
    """Write the conversion between a date and a number: CODESYS counts seconds since 1970, and ms since midnight."""
    if not (isinstance(kind, ty.Elementary) and isinstance(target, ty.Elementary)):
        return None
    unit = {"date": 1_000_000_000, "dt": 1_000_000_000, "tod": 1_000_000}
    if kind.kind in unit and target.kind in ("int", "bits"):
        return _between_integers(f"({code} // {unit[kind.kind]})", ty.LINT, target)
    if kind.kind in ("int", "bits") and target.kind in unit:
        whole = {"date": f" // {ty.DAY_NS} * {ty.DAY_NS}", "tod": f" % {ty.DAY_NS}"}.get(target.kind, "")
        return f"_v.signed({code} * {unit[target.kind]}{whole}, 64)"
    return None


def _between_integers(code: str, kind: ty.Elementary, target: ty.Elementary) -> str:
    if target.kind == "bool":
        return f"({code} != 0)"
    if target.low <= kind.low and kind.high <= target.high:
        return f"int({code})" if kind.kind == "bool" else code
    return f"_v.signed({code}, {target.bits})" if target.low < 0 else f"({code} & {target.high})"


def _of_real(code: str, target: ty.Elementary, cut: bool) -> str | None:
    if target.kind == "real":
        return f"_v.real({code})" if target.bits == 32 else code
    if target.kind in ("int", "bits"):
        return f"_v.{'truncated' if cut else 'to_integer'}({code}, {target.low}, {target.high})"
    if target.kind == "bool":
        return f"({code} != 0.0)"
    if target.kind == "duration":
        return f"_v.to_integer({code} * {_unit(target)}, {target.low}, {target.high})"
    return None


def _unit(kind: ty.Elementary) -> int:
    """Return the unit, in ns, in which a duration is converted to a number."""
    return 1 if kind.name == "LTIME" else 1_000_000


def _of_time(code: str, kind: ty.Elementary, target: ty.Elementary) -> str | None:
    if kind.kind == target.kind:
        return code
    if kind.kind in ("int", "bits") and target.kind == "duration":
        return f"_v.signed({code} * {_unit(target)}, 64)"
    if target.kind in ("int", "bits"):
        count = code if _unit(kind) == 1 else f"_v.divide({code}, {_unit(kind)})"
        return _between_integers(f"({count})", ty.LINT, target)
    if target.kind == "real":
        return f"_v.real({code} / {_unit(kind)})" if target.bits == 32 else f"({code} / {_unit(kind)})"
    return None


def _text(code: str, kind: ty.Elementary) -> str | None:
    if kind.kind == "bool":
        return f"('TRUE' if {code} else 'FALSE')"
    if kind.kind == "real":
        return f"_v.real_text({code}, {_DIGITS[kind.bits]})"
    if kind.kind == "duration":
        return f"_v.duration_text({code}, {chr(39)}{'LT' if kind.name == 'LTIME' else 'T'}{chr(39)})"
    name = {"date": "date_text", "tod": "tod_text", "dt": "moment_text"}.get(kind.kind)
    return f"_v.{name}({code})" if name else f"str({code})"
