"""Records which line of a PROGRAM last assigned an output: a pass over the Python that Structured Text was compiled to.

After each assignment of an output (a statement, an output of a block or function, a VAR_IN_OUT) it inserts an assignment of the
line's number. The cost at run time is one assignment of a constant.
"""

from __future__ import annotations

import ast

_PREFIX = "line_"


def line_of(attribute: str) -> str:
    """Return the attribute that keeps the line of the last assignment of `attribute`."""
    return f"{_PREFIX}{attribute}"


def is_line(attribute: str) -> bool:
    """Return whether an attribute keeps a line. Lines are not part of a program's state, because no scan depends on them."""
    return attribute.startswith(_PREFIX)


class Assignments(ast.NodeTransformer):
    """The pass that adds the assignments of lines to a class whose outputs are the attributes `outputs` of ``self``."""

    def __init__(self, outputs: frozenset[str]) -> None:
        self._outputs = outputs

    def visit_Assign(self, node: ast.Assign) -> list[ast.stmt]:
        found = [name for target in node.targets for name in self._assigned(target)]
        return [node, *self._lines(found, node.lineno)]

    def visit_For(self, node: ast.For) -> ast.For:
        self.generic_visit(node)
        node.body[:0] = self._lines(self._assigned(node.target), node.lineno)
        return node

    def _assigned(self, target: ast.expr) -> list[str]:
        if isinstance(target, ast.Tuple | ast.List):
            return [name for part in target.elts for name in self._assigned(part)]
        if isinstance(target, ast.Attribute) and isinstance(target.value, ast.Name) and target.value.id == "self":
            return [target.attr] if target.attr in self._outputs else []
        return []

    @staticmethod
    def _lines(names: list[str], line: int) -> list[ast.stmt]:
        made: list[ast.stmt] = []
        for name in names:
            target = ast.Attribute(ast.Name("self", ast.Load()), line_of(name), ast.Store())
            statement = ast.Assign([target], ast.Constant(line), lineno=line, end_lineno=line)
            for node in ast.walk(statement):
                if isinstance(node, ast.stmt | ast.expr):
                    node.lineno = node.end_lineno = line
                    node.col_offset = node.end_col_offset = 0
            made.append(statement)
        return made
