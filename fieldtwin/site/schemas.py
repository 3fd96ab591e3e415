"""The JSON schemas of all kinds of files that users write, made from the pydantic models that read these files.

The folder `SHIPPED` has them as files, for editors; ``scripts/schemas --write`` creates these files again.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

SHIPPED = Path(__file__).absolute().parents[1] / "schemas"
"""The folder of the files ``KIND.schema.json``, also in an installed wheel."""


def _system() -> dict[str, Any]:
    from fieldtwin.twin.site.schema import SystemForm

    return SystemForm.model_json_schema()


def _prototype() -> dict[str, Any]:
    from fieldtwin.twin.site.schema import PrototypeForm

    return PrototypeForm.model_json_schema()


def _network() -> dict[str, Any]:
    from fieldtwin.run.virtual.group_kinds import kind_named

    return kind_named("network").schema()


def _profile() -> dict[str, Any]:
    from fieldtwin.gateway.core.files.profile_schema import ProfileForm

    return ProfileForm.model_json_schema()


def _faults() -> dict[str, Any]:
    from fieldtwin.emulators.faults.json_schema import fault_file_schema

    return fault_file_schema()


def _scenario() -> dict[str, Any]:
    """Return the schema of scenario files. It uses the schema of fault files for the faults in steps."""
    from fieldtwin.emulators.faults.json_schema import fault_defs
    from fieldtwin.scenarios.language.words import ScenarioForm

    schema = ScenarioForm.model_json_schema()
    schema["$defs"] |= fault_defs()
    schema["$defs"]["Step"]["properties"]["fault"] = {"$ref": "#/$defs/Fault"}
    return schema


def _waivers() -> dict[str, Any]:
    from fieldtwin.conformance.core.waivers import WaiversForm

    return WaiversForm.model_json_schema()


def _rules() -> dict[str, Any]:
    from fieldtwin.run.shadow.rules import RulesForm

    return RulesForm.model_json_schema()


SCHEMAS: dict[str, Callable[[], dict[str, Any]]] = {
    "system": _system,
    "prototype": _prototype,
    "network": _network,
    "profile": _profile,
    "faults": _faults,
    "scenario": _scenario,
    "waivers": _waivers,
    "rules": _rules,
}
"""By kind of file that users write: the function that returns its JSON schema."""


def schema_text(kind: str) -> str:
    """Return the JSON schema of a kind of file as indented text."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **SCHEMAS[kind]()}
    return json.dumps(schema, indent=2) + "\n"


def shipped(kind: str) -> Path:
    """Return the path of the shipped file with the schema of a kind of file."""
    return SHIPPED / f"{kind}.schema.json"
