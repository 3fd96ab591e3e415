"""The description of a kind of fault as data: for `fieldtwin faults --json`, Studio and the tools of agents."""

from __future__ import annotations

from typing import Any

from fieldtwin.emulators.faults.fault import Fault
from fieldtwin.emulators.faults.schema import aims_of


def describe_fault(kind: type[Fault]) -> dict[str, Any]:
    """Return a kind of fault as JSON data, with its parameters as a JSON schema."""
    own = kind.form.model_json_schema().get("properties", {})
    for parameter in own.values():
        parameter.pop("title", None)
    return {
        "name": kind.name,
        "on": kind.kind.value,
        "summary": kind.summary,
        "direction": sorted(way.value for way in kind.ways),
        "aims": aims_of(kind),
        "parameters": own,
        **({"codes": {_code(code): text for code, text in kind.codes.items()}} if kind.codes else {}),
    }


def _code(code: int) -> str:
    return f"0x{code:08X}" if code > 0xFF else str(code)
