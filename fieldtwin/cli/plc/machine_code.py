"""The statements of a program that become machine code, for `fieldtwin plc check --machine-code`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fieldtwin.plc.st.compiler.compile import CompiledUnit


def stays_python(units: Iterable[CompiledUnit]) -> Iterator[str]:
    """Yield a line for each statement of a PROGRAM that stays Python, and one with the numbers of statements for each PROGRAM."""
    from fieldtwin.plc.st.compiler.scope import identifier
    from fieldtwin.plc.st.native.machine import translation_of

    for unit in units:
        made = translation_of(unit)
        for program in unit.programs:
            name = f"P_{identifier(program.name)}"
            kept = made.kept.get(name, [])
            for one in kept:
                yield f"{program.path}:{one.line}: stays Python: {one.reason}"
            count = made.statements.get(name, 0)
            yield f"{program.name}: machine code for {count - len(kept)} of {count} statements"
