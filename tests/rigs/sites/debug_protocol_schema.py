"""The JSON schema of the Debug Adapter Protocol, in the copy that debugpy contains, for each message of a test's session."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from jsonschema import Draft4Validator

_FILE = "_vendored/pydevd/_pydevd_bundle/_debug_adapter/debugProtocol.json"


@cache
def definitions() -> Mapping[str, Any] | None:
    """Return the definitions of the protocol; None if debugpy is not installed, and then no message is validated."""
    found = find_spec("debugpy")
    if found is None or not found.submodule_search_locations:
        return None
    schema = json.loads((Path(found.submodule_search_locations[0]) / _FILE).read_text())
    there: Mapping[str, Any] = schema["definitions"]
    return there


def name_of(message: Mapping[str, Any]) -> str:
    """Return the name of the definition that a message must fulfil."""
    kind = message["type"]
    if kind == "response" and not message["success"]:
        return "ErrorResponse"
    subject = str(message["event"] if kind == "event" else message["command"])
    return f"{subject[0].upper()}{subject[1:]}{kind.capitalize()}"


def validate(message: Mapping[str, Any]) -> None:
    """Fail the test if a message violates the protocol."""
    there, name = definitions(), name_of(message)
    if there is not None:
        assert name in there, f"the protocol has no {name}: {message}"
        errors = [one.message for one in _validator(name).iter_errors(message)]
        assert not errors, f"{name}: {errors} in {message}"


@cache
def _validator(name: str) -> Draft4Validator:
    return Draft4Validator({"$ref": f"#/definitions/{name}", "definitions": definitions()})
