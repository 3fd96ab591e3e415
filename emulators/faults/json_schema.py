"""JSON schema of fault files, for editors: one schema per fault, selected by its name."""

from __future__ import annotations

from typing import Any

from fieldtwin.emulators.faults.fault import Aim, Fault
from fieldtwin.emulators.faults.registry import FAULTS
from fieldtwin.emulators.faults.schema import MOST, aims_of

_ABOUT = {
    "bus": "all devices of a bus",
    "device": "a device",
    "unit": "the unit ID, on CAN the node ID; default: the device's",
    "function": "Modbus: the function code, without the exception bit",
    "address": "Modbus: a PDU address, or holding:0x10",
    "registers": "Modbus: the number of registers or bits that the request reads or writes: 40, 65..125 or 65..",
    "register": "a tag of the device",
    "cob_id": "CAN: the identifier",
    "index": "CANopen: the object that an SDO frame names",
    "direction": "request (to the device), reply, or both",
    "nth": "the n-th frame that matches, from 1",
    "every": "each n-th frame that matches",
    "from": "start time within the run: 5s, 250ms, 2min, 24h",
    "until": "end time within the run; default: no end",
    "optional": "true: a scenario may pass although the fault never took effect",
    "probability": "probability for each frame that matches",
}


def fault_defs() -> dict[str, Any]:
    """Return the `$defs` of a schema with faults: `Fault` (any fault) and the keys of an aim."""
    aims = Aim.model_json_schema()["properties"]
    return {
        "Fault": {"title": "Fault", "oneOf": [_one(kind) for kind in FAULTS.values()]},
        **{f"aim_{key}": {**_untitled(aims[key]), "description": about} for key, about in _ABOUT.items()},
    }


def fault_file_schema() -> dict[str, Any]:
    """Return the schema of a fault file."""
    faults = {"type": "array", "minItems": 1, "maxItems": MOST, "items": {"$ref": "#/$defs/Fault"}}
    return {
        "title": "Fault file",
        "type": "object",
        "additionalProperties": False,
        "required": ["faults"],
        "properties": {"faults": faults},
        "$defs": fault_defs(),
    }


def _one(kind: type[Fault]) -> dict[str, Any]:
    own = kind.form.model_json_schema().get("properties", {})
    return {
        "title": kind.name,
        "type": "object",
        "additionalProperties": False,
        "required": ["name"],
        "properties": {
            "name": {"const": kind.name, "description": kind.summary},
            "id": {"type": "string"},
            **{key: {"$ref": f"#/$defs/aim_{key}"} for key in aims_of(kind)},
            **{key: _untitled(parameter) for key, parameter in own.items()},
        },
    }


def _untitled(schema: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in schema.items() if key != "title"}
