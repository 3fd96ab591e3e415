"""Run small pieces of Structured Text for the tests."""

from __future__ import annotations

from typing import Any

from fieldtwin.plc.program import ScanInfo
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.dialects import DIALECTS
from fieldtwin.plc.st.program import StProgram, program_class
from fieldtwin.plc.st.resource import attributes_of


def program(text: str, name: str = "", dialect: str = "standard") -> StProgram:
    return program_class(compile_text(text, "test.st", DIALECTS[dialect]), name)()


def scan(made: StProgram, number: int = 1, ms: int | None = None) -> None:
    made.execute(ScanInfo((10 * number if ms is None else ms) * 1_000_000, number, number == 1))


def run(variables: str, body: str, before: str = "", scans: int = 1, dialect: str = "standard") -> dict[str, Any]:
    """Return variables, in lower case, after `scans` scans of a program with `body`."""
    made = program(f"{before}\nPROGRAM p VAR {variables} END_VAR\n{body}\nEND_PROGRAM", "p", dialect)
    for number in range(1, scans + 1):
        scan(made, number)
    return {name[2:]: value for name, value in attributes_of(made.st_body).items() if name.startswith("v_")}


def value(kind: str, expression: str, variables: str = "", before: str = "") -> Any:
    """Return the value of `expression` as a `kind`."""
    return run(f"{variables} result : {kind};", f"result := {expression};", before)["result"]
