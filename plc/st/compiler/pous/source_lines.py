"""The Python code of a unit with the files and line numbers of its source."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import CodeType

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.compiler.assignments import Assigned, Assignments, MemberLines, Recorded
from fieldtwin.plc.st.compiler.pous.inlining import Inlining
from fieldtwin.plc.st.compiler.scope import CodeWriter
from fieldtwin.plc.st.syntax import tree as t

Parts = list[tuple[str, list[ast.stmt]]]
"""The Python code of a unit: for each file in turn, its classes and functions."""


class SourceLines:
    """The lines of the source from which Python code was written: `places` has the position of each line of the code.

    `path` is that of code without a file, and `assigned` tells which assignments are recorded.
    """

    def __init__(self, places: Sequence[t.Pos], path: str, assigned: Assigned) -> None:
        self.path, self.assigned, self._places = path, assigned, places

    def code(self, text: str) -> tuple[CodeType, ...]:
        """Return the code of each file, in the order of the Python code `text`. Raises `FileInvalid` beyond Python's limits."""
        return self.compiled(self.parts(text))

    def parts(self, text: str) -> Parts:
        """Return the classes and functions of the Python code `text`, which record assignments, with the lines of the source.

        Raises `FileInvalid` beyond Python's limits.
        """
        parts: Parts = []
        with self._within_limits():
            for statement in ast.parse(text).body:
                path = self._places[statement.lineno - 1].path
                if not parts or parts[-1][0] != path:
                    parts.append((path, []))
                parts[-1][1].append(self._at_source(statement, path))
        return parts

    def compiled(self, parts: Parts) -> tuple[CodeType, ...]:
        """Return the code of `parts` with short functions inlined. Raises `FileInvalid` beyond Python's limits."""
        code = []
        with self._within_limits():
            for path, body in parts:
                made = [ast.fix_missing_locations(Inlining().visit(node)) for node in body]
                code.append(compile(ast.Module(made, []), path or "<st>", "exec"))
        return tuple(code)

    @contextmanager
    def _within_limits(self) -> Iterator[None]:
        try:
            yield
        except (SyntaxError, MemoryError, RecursionError) as e:  # Python's limits; those of this compiler are narrower
            at = e.lineno if isinstance(e, SyntaxError) and e.lineno else 1
            place = self._places[min(at, len(self._places)) - 1]
            raise FileInvalid(f"too deep for the compiler: {e}", path=place.path, line=place.line, column=1) from e

    def _at_source(self, statement: ast.stmt, path: str) -> ast.stmt:
        """Return a class or function of the Python code with the line numbers of the source."""
        places = self._places
        for node in ast.walk(statement):
            if isinstance(node, ast.stmt | ast.expr | ast.arg | ast.keyword):
                node.lineno = node.end_lineno = places[min(node.lineno, len(places)) - 1].line
                node.col_offset = node.end_col_offset = 0
        if isinstance(statement, ast.ClassDef | ast.FunctionDef):
            known = self.assigned
            if statement.name.startswith("S_"):
                MemberLines(known.arrays.members).visit(statement)
            else:
                own, of_block = known.recorded.get(statement.name, Recorded()), not statement.name.startswith("P_")
                Assignments(own, known.arrays, known.shared, path, with_path=of_block).visit(statement)
        return ast.fix_missing_locations(statement)


def places_of(out: CodeWriter, path: str) -> tuple[t.Pos, ...]:
    """Return the position in the source of each line of the Python code in `out`; `path` is that of code without a file."""
    last, places = t.Pos(1, 1, path), []
    for _, pos in out.lines:
        last = pos or last
        places.append(last)
    return tuple(places)
