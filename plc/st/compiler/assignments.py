"""Records which line of a PROGRAM last assigned an output: a pass over the Python that Structured Text was compiled to.

After each assignment of an output (a statement, an output of a block or function, a VAR_IN_OUT) it inserts an assignment of the
line's number. The cost at run time is one assignment of a constant.
"""

from __future__ import annotations

import ast

from fieldtwin.plc.st.runtime.lines import line_of

GLOBALS = "_G"
"""The name of the object that holds the global variables in the Python code."""


class Assignments(ast.NodeTransformer):
    """The pass that adds the assignments of lines to a class whose outputs are the attributes `outputs` of ``self``.

    `shared` are the outputs among the global variables. Code of several files assigns them, so their lines have the file `path`,
    and so do those of a function block (`with_path`), which may be in another file than the program.
    """

    def __init__(self, outputs: frozenset[str], shared: frozenset[str], path: str, *, with_path: bool) -> None:
        self._with_path = {"self": with_path, GLOBALS: True}
        self._outputs = {"self": outputs, GLOBALS: shared}
        self._path = path

    def visit_Assign(self, node: ast.Assign) -> list[ast.stmt]:
        found = [name for target in node.targets for name in self._assigned(target)]
        return [node, *self._lines(found, node.lineno)]

    def visit_For(self, node: ast.For) -> ast.For:
        self.generic_visit(node)
        node.body[:0] = self._lines(self._assigned(node.target), node.lineno)
        return node

    def _assigned(self, target: ast.expr) -> list[tuple[str, str]]:
        """Return the object and the attribute of each output that `target` assigns."""
        if isinstance(target, ast.Tuple | ast.List):
            return [name for part in target.elts for name in self._assigned(part)]
        if isinstance(target, ast.Attribute) and isinstance(target.value, ast.Name):
            owner = target.value.id
            return [(owner, target.attr)] if target.attr in self._outputs.get(owner, ()) else []
        return []

    def _lines(self, found: list[tuple[str, str]], line: int) -> list[ast.stmt]:
        made: list[ast.stmt] = []
        for owner, name in found:
            target = ast.Attribute(ast.Name(owner, ast.Load()), line_of(name), ast.Store())
            place: ast.expr = ast.Constant(line)
            if self._with_path[owner]:
                place = ast.Tuple([ast.Constant(self._path), place], ast.Load())
            statement = ast.Assign([target], place, lineno=line, end_lineno=line)
            for node in ast.walk(statement):
                if isinstance(node, ast.stmt | ast.expr):
                    node.lineno = node.end_lineno = line
                    node.col_offset = node.end_col_offset = 0
            made.append(statement)
        return made
