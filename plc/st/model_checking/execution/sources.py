"""The Python code that is executed symbolically: compiled programs, function blocks, and the functions that they call."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Callable
from functools import cache
from typing import Any

from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.model_checking.execution.refusal import NotModelled
from fieldtwin.plc.st.syntax.tree import Pos

_MODULES = ("fieldtwin.plc.blocks.", "fieldtwin.plc.st.values", "fieldtwin.plc.st.runtime.references")


class Sources:
    """The functions of a compiled unit, and those of fieldtwin that it calls, as trees of Python.

    `space` is the namespace in which the unit's code was executed.
    """

    def __init__(self, unit: CompiledUnit, space: dict[str, Any]) -> None:
        self._space, self._places = space, unit.places
        self._own: dict[str, ast.FunctionDef] = {}
        for statement in ast.parse(unit.python).body:
            if isinstance(statement, ast.FunctionDef):
                self._own[statement.name] = statement
            elif isinstance(statement, ast.ClassDef):
                for part in statement.body:
                    if isinstance(part, ast.FunctionDef):
                        self._own[f"{statement.name}.{part.name}"] = part

    def is_own(self, function: Callable[..., Any]) -> bool:
        """Return whether a function belongs to the compiled unit, so that its lines are lines of the source."""
        return getattr(function, "__globals__", None) is self._space

    def place(self, line: int) -> Pos:
        """Return the position in the source of a line of the unit's Python code, which counts from 1."""
        return self._places[min(line, len(self._places)) - 1]

    def tree(self, function: Callable[..., Any]) -> ast.FunctionDef:
        """Return the tree of a function. Raises `NotModelled` for a function of a library."""
        if self.is_own(function):
            return self._own[function.__qualname__]
        module = getattr(function, "__module__", "") or ""
        if not module.startswith(_MODULES):
            raise NotModelled(f"the function {getattr(function, '__name__', function)}")
        return _tree(function)


@cache
def _tree(function: Callable[..., Any]) -> ast.FunctionDef:
    found = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    assert isinstance(found, ast.FunctionDef)
    return found
