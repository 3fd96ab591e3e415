"""The statements of programs that become machine code, for `fieldtwin plc check --machine-code`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fieldtwin.plc.st.compiler.compile import CompiledUnit


@dataclass(frozen=True, slots=True)
class Translated:
    """The translation of a PROGRAM: the number of its `statements`, and the line and reason of those that stay Python."""

    name: str
    path: str
    statements: int
    python: tuple[tuple[int, str], ...]

    def lines(self) -> Iterator[str]:
        """Yield a line for each statement that stays Python, and one with the numbers of statements."""
        for line, reason in self.python:
            yield f"{self.path}:{line}: stays Python: {reason}"
        yield f"{self.name}: machine code for {self.statements - len(self.python)} of {self.statements} statements"

    def as_data(self) -> dict[str, Any]:
        """Return data for JSON."""
        return {
            "program": self.name,
            "path": self.path,
            "statements": self.statements,
            "stays_python": [{"line": line, "reason": reason} for line, reason in self.python],
        }


def translated(units: Iterable[CompiledUnit]) -> list[Translated]:
    """Return each PROGRAM of the units. Needs no C compiler."""
    from fieldtwin.plc.st.compiler.scope import identifier
    from fieldtwin.plc.st.native.machine import translation_of

    found = []
    for unit in units:
        made = translation_of(unit)
        for program in (one for one in unit.programs if one.declared_name == one.name):
            name = f"P_{identifier(program.name)}"
            kept = tuple((one.line, one.reason) for one in made.kept.get(name, ()))
            found.append(Translated(program.name, program.path, made.statements.get(name, 0), kept))
    return found
