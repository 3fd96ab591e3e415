"""Machine code of units: made from a compiled unit, and loaded for each resource."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from fieldtwin.plc.blocks import BLOCKS
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.compiler.pous.source_lines import SourceLines
from fieldtwin.plc.st.native.building import NoCompiler, module_of
from fieldtwin.plc.st.native.layouts import STANDARD
from fieldtwin.plc.st.native.programs import Prepared, prepare
from fieldtwin.plc.st.native.suspension import Runs


@dataclass(frozen=True, slots=True)
class MachineCode:
    """The machine code of a unit: the text of its C module, and the names and constants with which it is loaded."""

    prepared: Prepared

    def load(self, space: Mapping[str, Any]) -> Runs:
        """Return the runs for one resource, whose Python code was executed in `space`. Raises `NoCompiler`."""
        if not self.prepared.runs:
            return Runs()
        module = module_of(self.prepared.text)
        classes = [
            BLOCKS[name.removeprefix(STANDARD)] if name.startswith(STANDARD) else space[name]
            for name in self.prepared.classes
        ]
        return Runs(module.bind((type(space["_c"]), None, *classes), self.prepared.constants))

    def published(self, name: str) -> tuple[str, ...] | None:
        return self.prepared.published.get(name)


def translation_of(unit: CompiledUnit) -> Prepared:
    """Return what machine code would do of a unit, without a C compiler."""
    parts = SourceLines(unit.places, unit.path, unit.assigned).parts(unit.python)
    return prepare([node for _, body in parts for node in body])


def with_machine_code(unit: CompiledUnit) -> CompiledUnit:
    """Return the unit with machine code for the statements of its PROGRAMs that can be translated.

    Raises `NoCompiler` if the C compiler is missing or fails.
    """
    lines = SourceLines(unit.places, unit.path, unit.assigned)
    parts = lines.parts(unit.python)
    prepared = prepare([node for _, body in parts for node in body])
    if prepared.runs:
        module_of(prepared.text)
    return replace(unit, code=lines.compiled(parts), machine_code=MachineCode(prepared))


__all__ = ["MachineCode", "NoCompiler", "translation_of", "with_machine_code"]
