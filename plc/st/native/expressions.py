"""Translates expressions of the Python code of a unit to C.

A C expression has the value of the Python expression, or ends the function with ``goto bail``, after which Python takes over.
So nothing is computed that C and Python compute differently.
"""

from __future__ import annotations

import ast
from collections.abc import Callable
from dataclasses import dataclass

from fieldtwin.plc.st.native.layouts import NONE, Field, Layout, Layouts, Unsupported

_C_TYPES = {"bool": "char", "int": "int64_t", "float": "double", "optional": "int64_t"}
_CHECKED = {ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul"}
_FLOATS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*"}
_BITS = {ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^"}
_COMPARED = {ast.Eq: "==", ast.NotEq: "!=", ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">="}
_EXACT = 2**53
"""Integers up to this one are floats without rounding, so that C compares them as Python does."""
_OF_REAL = {
    "sqrt": "x >= 0", "log": "x > 0", "log10": "x > 0", "exp": "1", "sin": "1", "cos": "1", "tan": "1",
    "asin": "x >= -1 && x <= 1", "acos": "x >= -1 && x <= 1", "atan": "1",
}  # fmt: skip
"""The functions of C that compute a REAL function, and where they have a finite value."""


def c_type(kind: str) -> str:
    return _C_TYPES[kind]


@dataclass(frozen=True, slots=True)
class Value:
    """A C expression and its kind: bool, int or float; also optional for a variable that may be None."""

    text: str
    kind: str


class Expressions:
    """The translator of the expressions in one function. `own` is the structure that ``self`` is, if there is one."""

    def __init__(self, layouts: Layouts, own: Layout | None, calls: Callable[[str, list[Value]], Value]) -> None:
        """`calls` translates a call of a FUNCTION."""
        self.layouts, self.own, self._calls = layouts, own, calls
        self._constants = own.constants if own is not None else {}
        self.locals: dict[str, str] = {}
        """The C variables of the function, with their kinds."""
        self.objects: dict[str, str] = {}
        """The C variables that refer to an object, with their structures."""
        self.ranges: set[str] = set()
        """The names of ranges, each held in three C variables."""
        self.used: set[tuple[str, str]] = set()
        """The attributes of ``self`` and of the global variables that are read or written."""

    def value(self, node: ast.expr) -> Value:
        """Return the translation of an expression. Raises `Unsupported`."""
        made = getattr(self, f"_{type(node).__name__.lower()}", None)
        if made is None:
            raise Unsupported(f"the Python expression {ast.unparse(node)}")
        found: Value = made(node)
        return found

    def of_kind(self, node: ast.expr, kind: str) -> str:
        """Return the text of an expression that must have this kind; a bool may be used as an int."""
        found = self.value(node)
        if found.kind != kind and not (kind == "int" and found.kind == "bool"):
            raise Unsupported(f"{ast.unparse(node)} as {kind}")
        return found.text

    def condition(self, node: ast.expr) -> str:
        found = self.value(node)
        return f"(({found.text}) != 0)" if found.kind != "optional" else f"(({found.text}) != {NONE})"

    # -- variables ----------------------------------------------------------------------------------------------------

    def place(self, node: ast.Attribute) -> tuple[str, Field]:
        """Return the C expression and the field of a variable. Raises `Unsupported`."""
        text, layout = self.object(node.value)
        found = layout.fields.get(node.attr)
        if found is None:
            raise Unsupported(f"the variable {node.attr.partition('_')[2] or node.attr}, because of its type")
        if text in ("(*self)", "(*g)"):
            self.used.add(("self" if text == "(*self)" else "_G", node.attr))
        return f"{text}.{found.c_name}", found

    def object(self, node: ast.expr) -> tuple[str, Layout]:
        """Return the C expression and the structure of an object: a program, a block or a structure. Raises `Unsupported`."""
        if isinstance(node, ast.Name):
            if node.id == "self" and self.own is not None:
                return "(*self)", self.own
            if node.id == "_G":
                return "(*g)", self.layouts.globals
            if node.id in self.objects:
                return f"(*{node.id})", self.layouts.of(self.objects[node.id])
        elif isinstance(node, ast.NamedExpr):
            text, layout = self.object(node.value)
            if self.objects.setdefault(node.target.id, layout.name) != layout.name or node.target.id in self.locals:
                raise Unsupported(f"{node.target.id} with values of several kinds")
            return f"(*({node.target.id} = &{text}))", layout
        elif isinstance(node, ast.Attribute):
            text, field = self.place(node)
            if field.kind == "block":
                return text, self.layouts.of(field.of)
        elif isinstance(node, ast.Subscript) and isinstance(node.value, ast.Attribute):
            text, field = self.element(node, "blocks")
            return text, self.layouts.of(field.of)
        raise Unsupported(ast.unparse(node))

    def named(self, name: str, node: ast.expr) -> str:
        """Return the C statement that lets a local variable refer to an object; empty if the expression is not an object."""
        at = node.value if isinstance(node, ast.Subscript) else node
        if not isinstance(at, ast.Attribute) or ast.unparse(at.value) == "_c" or at.attr in self._constants:
            return ""
        if self.place(at)[1].kind != ("block" if at is node else "blocks"):
            return ""
        text, _ = self.object(ast.NamedExpr(ast.Name(name, ast.Store()), node))
        return f"(void){text};\n"

    def element(self, node: ast.Subscript, kind: str = "array") -> tuple[str, Field]:
        """Return the C expression of an element of an array, and the field of the array."""
        if isinstance(node.slice, ast.Slice):
            raise Unsupported("a text")
        if not isinstance(node.value, ast.Attribute):
            raise Unsupported(f"the element {ast.unparse(node)}")
        array, field = self.place(node.value)
        if field.kind != kind:
            raise Unsupported(f"the element {ast.unparse(node)}")
        at = self.of_kind(node.slice, "int")
        return f"{array}[({{ int64_t at = {at}; if (at < 0 || at >= {field.size}) goto bail; at; }})]", field

    def _attribute(self, node: ast.Attribute) -> Value:
        owner = node.value.id if isinstance(node.value, ast.Name) else ""
        if owner == "_c":
            if node.attr in ("now_ns", "scan_ns", "left", "scan"):
                return Value(f"c->f_{'now_ns' if node.attr == 'scan_ns' else node.attr}", "int")
            if node.attr == "first_scan":
                return Value("c->f_first_scan", "bool")
            raise Unsupported(f"_c.{node.attr}")
        if owner == "self" and node.attr in self._constants:
            return self._constant(ast.Constant(self._constants[node.attr]))  # type: ignore[arg-type]
        text, field = self.place(node)
        if field.kind not in _C_TYPES:
            raise Unsupported(f"{node.attr} as a value")
        return Value(text, field.kind)

    def _subscript(self, node: ast.Subscript) -> Value:
        text, field = self.element(node)
        return Value(text, field.of)

    def _name(self, node: ast.Name) -> Value:
        if node.id not in self.locals:
            raise Unsupported(f"the name {node.id}")
        return Value(node.id, self.locals[node.id])

    def _namedexpr(self, node: ast.NamedExpr) -> Value:
        found = self.value(node.value)
        self.declare(node.target.id, found.kind)
        return Value(f"({node.target.id} = {found.text})", found.kind)

    def declare(self, name: str, kind: str) -> None:
        """Declare a C variable. Raises `Unsupported` if it has a different kind already."""
        if (
            self.locals.setdefault(name, kind) != kind
            or name in self.ranges
            or name in self.objects
            or kind == "optional"
        ):
            raise Unsupported(f"{name} with values of several kinds")

    # -- constants and operators --------------------------------------------------------------------------------------

    def _constant(self, node: ast.Constant) -> Value:
        value = node.value
        if value is True or value is False:
            return Value(str(int(value)), "bool")
        if type(value) is int and value == -(2**63):
            return Value("INT64_MIN", "int")
        if type(value) is int and -(2**63) < value < 2**63:
            return Value(f"INT64_C({value})" if value >= 0 else f"(-INT64_C({-value}))", "int")
        if type(value) is float and value - value == 0:
            return Value(f"({value.hex()})", "float")
        if value is None:
            return Value(NONE, "optional")
        raise Unsupported("a text" if isinstance(value, str) else f"the constant {value!r}")

    def _unaryop(self, node: ast.UnaryOp) -> Value:
        if isinstance(node.op, ast.Not):
            return Value(f"(!{self.condition(node.operand)})", "bool")
        if isinstance(node.op, ast.USub) and isinstance(node.operand, ast.Constant) and type(node.operand.value) is int:
            return self._constant(ast.Constant(-node.operand.value))
        found = self.value(node.operand)
        if isinstance(node.op, ast.USub) and found.kind == "float":
            return Value(f"(-{found.text})", "float")
        if isinstance(node.op, ast.USub) and found.kind in ("int", "bool"):
            return Value(f"CHECKED(sub, 0, {found.text})", "int")
        if isinstance(node.op, ast.Invert) and found.kind == "int":
            return Value(f"(~{found.text})", "int")
        raise Unsupported(ast.unparse(node))

    def _binop(self, node: ast.BinOp) -> Value:
        wrapped = self._wrapped(node)
        if wrapped is not None:
            return wrapped
        left, right = _definite(self.value(node.left)), _definite(self.value(node.right))
        kinds, of = {left.kind, right.kind}, type(node.op)
        if of in _BITS and kinds <= {"bool", "int"}:
            return Value(f"({left.text} {_BITS[of]} {right.text})", "bool" if kinds == {"bool"} else "int")
        if of in _FLOATS and "float" in kinds and kinds <= {"bool", "int", "float"}:
            return Value(f"((double){left.text} {_FLOATS[of]} (double){right.text})", "float")
        if of in _CHECKED and kinds <= {"bool", "int"}:
            return Value(f"CHECKED({_CHECKED[of]}, {left.text}, {right.text})", "int")
        raise Unsupported(ast.unparse(node))

    def _wrapped(self, node: ast.BinOp) -> Value | None:
        """Return ``x & mask``, and ``(x + half & mask) - half``, which wrap a number around; None for anything else.

        Wrapping around makes all earlier overflows of 64 bits harmless, so `x` is computed without looking for them.
        """
        if isinstance(node.op, ast.BitAnd):
            bits = _bits_of(node.right)
            return (
                Value(f"(int64_t)({self.modular(node.left)} & {_unsigned(2**bits - 1)})", "int")
                if 0 < bits < 64
                else None
            )
        if not isinstance(node.op, ast.Sub) or not isinstance(node.left, ast.BinOp):
            return None
        inner, half = node.left, _whole(node.right)
        bits = _bits_of(inner.right)
        if (
            not isinstance(inner.op, ast.BitAnd)
            or bits not in (8, 16, 32, 64)
            or half != 2 ** (bits - 1)
            or not isinstance(inner.left, ast.BinOp)
            or not isinstance(inner.left.op, ast.Add)
            or _whole(inner.left.right) != half
        ):
            return None
        return Value(f"(int64_t)(int{bits}_t)({self.modular(inner.left.left)})", "int")

    def modular(self, node: ast.expr) -> str:
        """Return an integer expression modulo 2**64, as an unsigned C expression."""
        number = _whole(node)
        if number is not None:
            return _unsigned(number % 2**64)
        wrapped = self._wrapped(node) if isinstance(node, ast.BinOp) else None
        if wrapped is not None:
            return f"(uint64_t)({wrapped.text})"
        if isinstance(node, ast.BinOp) and type(node.op) in _FLOATS:
            return f"({self.modular(node.left)} {_FLOATS[type(node.op)]} {self.modular(node.right)})"
        return f"(uint64_t)({self.of_kind(node, 'int')})"

    def _boolop(self, node: ast.BoolOp) -> Value:
        sign = " && " if isinstance(node.op, ast.And) else " || "
        return Value(f"({sign.join(self.of_kind(each, 'bool') for each in node.values)})", "bool")

    def _compare(self, node: ast.Compare) -> Value:
        if isinstance(node.ops[0], ast.Is | ast.IsNot) and len(node.ops) == 1:
            text, sign = self.of_kind(node.left, "optional"), "==" if isinstance(node.ops[0], ast.Is) else "!="
            return Value(f"({text} {sign} {NONE})", "bool")
        parts, left = [], node.left
        for op, right in zip(node.ops, node.comparators, strict=True):
            if type(op) not in _COMPARED:
                raise Unsupported(ast.unparse(node))
            a, b = self.value(left), self.value(right)
            kinds = {a.kind, b.kind}
            if not kinds <= {"bool", "int", "float"}:
                raise Unsupported(ast.unparse(node))
            if "float" in kinds and len(kinds) > 1 and not any(_is_exact(each) for each in (left, right)):
                raise Unsupported(f"{ast.unparse(node)}: an integer compared with a REAL")
            parts.append(f"({a.text} {_COMPARED[type(op)]} {b.text})")
            left = right
        return Value(f"({' && '.join(parts)})", "bool")

    def _ifexp(self, node: ast.IfExp) -> Value:
        test, a, b = self.condition(node.test), self.value(node.body), self.value(node.orelse)
        if a.kind != b.kind or a.kind == "optional":
            raise Unsupported(ast.unparse(node))
        return Value(f"({test} ? {a.text} : {b.text})", a.kind)

    # -- calls --------------------------------------------------------------------------------------------------------

    def _call(self, node: ast.Call) -> Value:
        if node.keywords:
            raise Unsupported(ast.unparse(node))
        name = ast.unparse(node.func)
        if name.startswith("_v."):
            made = getattr(self, f"_v_{name.removeprefix('_v.')}", None)
        elif name.startswith("f_"):
            return self._calls(name, [self.value(each) for each in node.args])
        else:
            made = getattr(self, f"_py_{name}", None)
        if made is None:
            raise Unsupported(f"the function {name.removeprefix('_v.')}")
        found: Value = made(*node.args)
        return found

    def _py_abs(self, x: ast.expr) -> Value:
        found = self.value(x)
        return (
            Value(f"fabs({found.text})", "float")
            if found.kind == "float"
            else Value(f"WITH(absolute, {found.text})", "int")
        )

    def _py_min(self, *of: ast.expr) -> Value:
        return self._chosen("<", of)

    def _py_max(self, *of: ast.expr) -> Value:
        return self._chosen(">", of)

    def _chosen(self, sign: str, of: tuple[ast.expr, ...]) -> Value:
        """Return the smallest or largest of values, of equal ones the first, as Python does."""
        values = [self.value(each) for each in of]
        kind = values[0].kind
        if any(each.kind != kind for each in values) or kind not in ("int", "float") or len(values) < 2:
            raise Unsupported("MIN or MAX of values of several kinds")
        text = values[0].text
        for each in values[1:]:
            a, b = c_type(kind), each.text
            text = f"({{ {a} x_ = {text}, y_ = {b}; y_ {sign} x_ ? y_ : x_; }})"
        return Value(text, kind)

    def _py_float(self, x: ast.expr) -> Value:
        found = self.value(x)
        if found.kind not in _C_TYPES or found.kind == "optional":
            raise Unsupported("a conversion to REAL")
        return Value(f"(double)({found.text})", "float")

    def _py_int(self, x: ast.expr) -> Value:
        return Value(f"(int64_t)({self.of_kind(x, 'int')})", "int")

    def _py_bool(self, x: ast.expr) -> Value:
        return Value(self.condition(x), "bool")

    def _v_real(self, x: ast.expr) -> Value:
        return Value(f"(double)(float)({self._number(x)})", "float")

    def _number(self, node: ast.expr) -> str:
        found = self.value(node)
        if found.kind not in ("float", "int", "bool"):
            raise Unsupported(ast.unparse(node))
        return f"(double)({found.text})"

    def _v_signed(self, x: ast.expr, bits: ast.expr) -> Value:
        number = _whole(bits)
        if number not in (8, 16, 32, 64):
            raise Unsupported("a number with an unusual width")
        return Value(f"(int64_t)(int{number}_t)({self.modular(x)})", "int")

    def _integers(self, function: str, *of: ast.expr) -> Value:
        return Value(f"WITH({function}, {', '.join(self.of_kind(each, 'int') for each in of)})", "int")

    def _v_divide(self, a: ast.expr, b: ast.expr) -> Value:
        return self._integers("divide", a, b)

    def _v_modulo(self, a: ast.expr, b: ast.expr) -> Value:
        return self._integers("modulo", a, b)

    def _v_index(self, i: ast.expr, low: ast.expr, high: ast.expr) -> Value:
        return self._integers("index_in", i, low, high)

    def _v_inside(self, x: ast.expr, low: ast.expr, high: ast.expr) -> Value:
        return self._integers("inside", x, low, high)

    def _v_shift_left(self, x: ast.expr, n: ast.expr, bits: ast.expr) -> Value:
        return self._integers("shift_left", x, n, _narrow(bits))

    def _v_shift_right(self, x: ast.expr, n: ast.expr, bits: ast.expr) -> Value:
        return self._integers("shift_right", x, n, _narrow(bits))

    def _v_rotate_left(self, x: ast.expr, n: ast.expr, bits: ast.expr) -> Value:
        return self._integers("rotate_left", x, n, _narrow(bits))

    def _v_rotate_right(self, x: ast.expr, n: ast.expr, bits: ast.expr) -> Value:
        return self._integers("rotate_right", x, n, _narrow(bits))

    def _v_set_part(self, x: ast.expr, first: ast.expr, bits: ast.expr, part: ast.expr) -> Value:
        if (_whole(first) or 0) + (_whole(bits) or 64) > 32 or _whole(first) is None:
            raise Unsupported("a part of a bit string with 64 bits")
        return self._integers("set_part", x, first, bits, part)

    def _v_to_integer(self, x: ast.expr, low: ast.expr, high: ast.expr) -> Value:
        return self._rounded("nearbyint", x, low, high)

    def _v_truncated(self, x: ast.expr, low: ast.expr, high: ast.expr) -> Value:
        return self._rounded("trunc", x, low, high)

    def _rounded(self, function: str, x: ast.expr, low: ast.expr, high: ast.expr) -> Value:
        text = self.of_kind(x, "float")
        return Value(f"WITH(whole, {function}({text}), {self.of_kind(low, 'int')}, {self.of_kind(high, 'int')})", "int")

    def _v_divide_real(self, a: ast.expr, b: ast.expr) -> Value:
        return Value(f"({{ double y_ = {self._number(b)}; if (y_ == 0) goto bail; {self._number(a)} / y_; }})", "float")

    def _v_of_real(self, name: ast.expr, x: ast.expr) -> Value:
        function = str(name.value) if isinstance(name, ast.Constant) else ""
        if function not in _OF_REAL:
            raise Unsupported(f"the function {function}")
        check = f"if (!isfinite(x) || !({_OF_REAL[function]})) goto bail;"
        text = f"({{ double x = {self._number(x)}; {check} x = {function}(x); if (!isfinite(x)) goto bail; x; }})"
        return Value(text, "float")

    def _v_power(self, a: ast.expr, b: ast.expr) -> Value:
        check = "if (!isfinite(x_) || !isfinite(y_) || x_ <= 0) goto bail;"
        body = f"double x_ = {self._number(a)}, y_ = {self._number(b)}; {check} x_ = pow(x_, y_);"
        return Value(f"({{ {body} if (!isfinite(x_)) goto bail; x_; }})", "float")

    def _v_beyond(self, taken: ast.expr) -> Value:
        name = taken.id if isinstance(taken, ast.Name) else ""
        if name not in self.ranges:
            raise Unsupported("a FOR")
        return Value(f"({name}_start + {name}_count * {name}_step)", "int")


def _definite(value: Value) -> Value:
    """Return a value that is not None: at that, Python raises an error."""
    if value.kind != "optional":
        return value
    return Value(f"({{ if ({value.text} == {NONE}) goto bail; {value.text}; }})", "int")


def _whole(node: ast.expr) -> int | None:
    """Return the value of a constant whole number; None for other expressions."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        inner = _whole(node.operand)
        return None if inner is None else -inner
    return node.value if isinstance(node, ast.Constant) and type(node.value) is int else None


def _bits_of(mask: ast.expr) -> int:
    """Return n for the constant 2**n - 1, 0 for other expressions."""
    number = _whole(mask)
    return number.bit_length() if number is not None and number > 0 and number & (number + 1) == 0 else 0


def _narrow(bits: ast.expr) -> ast.expr:
    """Return the width of a bit string. Raises `Unsupported` for 64 bits, whose numbers C holds as negative ones."""
    if (_whole(bits) or 64) > 32:
        raise Unsupported("a bit string with 64 bits")
    return bits


def _is_exact(node: ast.expr) -> bool:
    number = _whole(node)
    return number is not None and abs(number) <= _EXACT


def _unsigned(number: int) -> str:
    return f"UINT64_C({number})"
