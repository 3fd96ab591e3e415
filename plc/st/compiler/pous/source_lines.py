"""The Python code of a unit with the files and line numbers of its source."""

from __future__ import annotations

import ast
from collections.abc import Collection, Mapping
from types import CodeType

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.compiler.assignments import Arrays, Assignments, MemberLines, Recorded
from fieldtwin.plc.st.compiler.pous.inlining import Inlining
from fieldtwin.plc.st.compiler.scope import CodeWriter
from fieldtwin.plc.st.syntax import tree as t


class SourceLines:
    """The lines of the source from which the code in `out` was written. `path` is that of code without a file."""

    def __init__(
        self,
        out: CodeWriter,
        path: str,
        recorded: Mapping[str, Recorded],
        shared: Collection[str],
        arrays: Arrays,
    ) -> None:
        """`recorded` has the attributes whose assignments are recorded by class of a program or block; `shared` are those of
        global variables that are assigned as a whole. `arrays` has the arrays of the unit.
        """
        self.out, self.path, self.recorded = out, path, recorded
        self.shared, self.arrays = frozenset(shared), arrays

    def code(self, text: str) -> tuple[CodeType, ...]:
        """Return the code of each file, in the order of the Python code `text`. Raises `FileInvalid` beyond Python's limits."""
        places = self.places()
        try:
            tree = ast.parse(text)
            parts: list[tuple[str, list[ast.stmt]]] = []
            for statement in tree.body:
                path = places[statement.lineno - 1].path
                if not parts or parts[-1][0] != path:
                    parts.append((path, []))
                parts[-1][1].append(self._at_source(statement, places, path))
            return tuple(compile(ast.Module(body, []), path or "<st>", "exec") for path, body in parts)
        except (SyntaxError, MemoryError, RecursionError) as e:  # Python's limits; those of this compiler are narrower
            at = e.lineno if isinstance(e, SyntaxError) and e.lineno else 1
            place = places[min(at, len(places)) - 1]
            raise FileInvalid(f"too deep for the compiler: {e}", path=place.path, line=place.line, column=1) from e

    def places(self) -> list[t.Pos]:
        """Return the position in the source of each line of the Python code."""
        last, places = t.Pos(1, 1, self.path), []
        for _, pos in self.out.lines:
            last = pos or last
            places.append(last)
        return places

    def _at_source(self, statement: ast.stmt, places: list[t.Pos], path: str) -> ast.stmt:
        """Return a class or function of the Python code with the line numbers of the source."""
        for node in ast.walk(statement):
            if isinstance(node, ast.stmt | ast.expr | ast.arg | ast.keyword):
                node.lineno = node.end_lineno = places[min(node.lineno, len(places)) - 1].line
                node.col_offset = node.end_col_offset = 0
        if isinstance(statement, ast.ClassDef | ast.FunctionDef):
            if statement.name.startswith("S_"):
                MemberLines(self.arrays.members).visit(statement)
            else:
                own, of_block = self.recorded.get(statement.name, Recorded()), not statement.name.startswith("P_")
                Assignments(own, self.arrays, self.shared, path, with_path=of_block).visit(statement)
            Inlining().visit(statement)
        return ast.fix_missing_locations(statement)
