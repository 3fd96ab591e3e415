"""A plugin of pytest that gives every Structured Text program of a test run machine code.

    PYTHONPATH=tests/rigs/sites .venv/bin/python -m pytest -p with_machine_code tests/plc/st --ignore tests/plc/st/model_checking

It shows where machine code and Python code differ, for all that the tests know about Structured Text. Two tests about a missing C
compiler fail, because every program then needs one. The tests of the model checker examine Python code.
"""

from __future__ import annotations

from typing import Any

from fieldtwin.plc.st import program
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.native.machine import with_machine_code

_program_class = program.program_class


def _with_machine_code(unit: CompiledUnit, *others: Any, **named: Any) -> type[program.StProgram]:
    if unit.machine_code is None and unit.record is None:
        unit = with_machine_code(unit)
    return _program_class(unit, *others, **named)


program.program_class = _with_machine_code
