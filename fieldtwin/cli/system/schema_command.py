"""`fieldtwin schema`: print the JSON schema of a kind of file, for editors and checks."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any

import click


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
    """Return the schema of scenarios; the faults of their steps are those of fault files."""
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
"""The kinds of files that users write."""


@click.command("schema")
@click.argument("kind", type=click.Choice(list(SCHEMAS)))
def command(kind: str) -> int:
    """Print the JSON schema of a kind of file that users write.

    \b
    system      the plant: buses, devices, programs
    prototype   which devices of it are emulated, and from which source
    network     systems whose modems share an acoustic channel, as prototypes
    profile     a device: its registers or objects
    faults      injected faults, for run --faults and link --faults
    scenario    steps and expected results, for test
    waivers     accepted failures with an owner, for check and test
    rules       a digital twin's commands for its findings, for twin --plan
    """
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **SCHEMAS[kind]()}
    json.dump(schema, sys.stdout, indent=2)
    sys.stdout.write("\n")
    return 0
