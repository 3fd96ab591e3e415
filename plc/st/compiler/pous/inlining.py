"""Writes short functions of `fieldtwin.plc.st.values` into the code that calls them: a pass over the Python that Structured Text
was compiled to.

A call of a Python function costs more than what these functions do. Only the code that is executed changes: the Python text of
a unit keeps the calls, and the model checker reads that.
"""

from __future__ import annotations

import ast

from fieldtwin.plc.st import values

NAMES = {"_pack": values.SINGLE.pack, "_unpack": values.SINGLE.unpack}
"""The names that the inlined code uses, with their meaning."""
_NUMBER = "_number"
"""A local variable for the dividend."""
_DIVISIONS = {"modulo": ast.Mod, "divide": ast.FloorDiv}


class Inlining(ast.NodeTransformer):
    """The pass. It replaces the rounding to REAL, and DIV and MOD by a positive constant, and adds constants."""

    def visit_Call(self, node: ast.Call) -> ast.expr:
        self.generic_visit(node)
        function = node.func
        if not (
            isinstance(function, ast.Attribute) and isinstance(function.value, ast.Name) and function.value.id == "_v"
        ):
            return node
        if function.attr == "real":
            return _rounded(node.args[0])
        if function.attr in _DIVISIONS:
            dividend, divisor = node.args
            count = _whole(divisor)
            if count is not None and count > 0:
                return _divided(dividend, _DIVISIONS[function.attr](), count)
        return node

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        """Replace ``x + 1 + 32768``, with which an addition of INT begins, by one addition."""
        self.generic_visit(node)
        inner = node.left
        if isinstance(node.op, ast.Add) and isinstance(inner, ast.BinOp) and isinstance(inner.op, ast.Add | ast.Sub):
            first, second = _whole(inner.right), _whole(node.right)
            if first is not None and second is not None:
                total = second + (first if isinstance(inner.op, ast.Add) else -first)
                return ast.BinOp(inner.left, ast.Add(), ast.Constant(total))
        return node


def _whole(node: ast.expr) -> int | None:
    """Return the value of a constant whole number; None for other expressions."""
    if isinstance(node, ast.Constant) and type(node.value) is int:
        return node.value
    return None


def _rounded(number: ast.expr) -> ast.expr:
    packed = ast.Call(ast.Name("_pack", ast.Load()), [number], [])
    return ast.Subscript(ast.Call(ast.Name("_unpack", ast.Load()), [packed], []), ast.Constant(0), ast.Load())


def _divided(dividend: ast.expr, operator: ast.operator, divisor: int) -> ast.expr:
    """Return a division that truncates towards zero. Python's operators round down, so a negative dividend is negated."""
    number = ast.Name(_NUMBER, ast.Load())
    positive = ast.Compare(ast.NamedExpr(ast.Name(_NUMBER, ast.Store()), dividend), [ast.GtE()], [ast.Constant(0)])
    negated = ast.BinOp(ast.UnaryOp(ast.USub(), number), operator, ast.Constant(divisor))
    return ast.IfExp(positive, ast.BinOp(number, operator, ast.Constant(divisor)), ast.UnaryOp(ast.USub(), negated))
