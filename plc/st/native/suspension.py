"""The machine code of the resources of this process, which is suspended while a debugger follows the lines of programs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any
from weakref import WeakSet

Run = Callable[[Any, Any, Any], bool | None]
"""A run of statements in machine code. It gets the program, the context and the global variables. It returns whether RETURN ended
the statements, or None if it has done nothing, so that Python must execute them."""


class Runs(list[Run]):
    """The runs of one resource, by their numbers in its Python code."""

    __hash__ = object.__hash__  # type: ignore[assignment]

    def __init__(self, made: Iterable[Run] = ()) -> None:
        super().__init__(made)
        self.made = list(self)
        if _suspended:
            self[:] = [_nothing] * len(self)
        _live.add(self)


_live: WeakSet[Runs] = WeakSet()
_suspended: set[object] = set()
"""Those who have suspended machine code."""


def suspend(by: object) -> None:
    """Let Python execute all programs of this process, from their next scan on, until `by` resumes machine code."""
    _suspended.add(by)
    for runs in _live:
        runs[:] = [_nothing] * len(runs)


def resume(by: object) -> None:
    """Undo `suspend`, unless another one has suspended machine code too."""
    _suspended.discard(by)
    for runs in () if _suspended else _live:
        runs[:] = runs.made


def _nothing(*_: object) -> None:
    """Stand for suspended machine code: Python executes the statements."""
