"""The OpenAPI 3.1 description of the interface, made from the tables of operations."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import msgspec

from fieldtwin.__about__ import __version__
from fieldtwin.studio.api.operation import PREFIX, Operation

REFERENCE = "#/components/schemas/{name}"


def describe(operations: Iterable[Operation], title: str) -> dict[str, Any]:
    """Return the description as data for JSON. `title` names the server."""
    operations = list(operations)
    forms = [operation.body for operation in operations if operation.body is not None]
    schemas, components = msgspec.json.schema_components(forms, ref_template=REFERENCE)
    of_form = dict(zip(forms, schemas, strict=True))
    paths: dict[str, dict[str, Any]] = {}
    for operation in operations:
        paths.setdefault(PREFIX + _plain(operation.path), {})[operation.method.lower()] = _described(operation, of_form)
    return {
        "openapi": "3.1.0",
        "info": {"title": title, "version": __version__, "description": DESCRIPTION},
        "paths": paths,
        "components": {
            "schemas": components,
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
        "security": [{"token": []}],
    }


DESCRIPTION = (
    "Read and operate running instances. Updates arrive over a WebSocket at "
    f"`{PREFIX}/instances/NAME/stream`. Operations that change something need the token of the role operate."
)


def _plain(path: str) -> str:
    """Return a path without Starlette's convertors: ``{tag:path}`` becomes ``{tag}``."""
    return re.sub(r"\{(\w+):\w+\}", r"{\1}", path)


def _described(operation: Operation, of_form: dict[type[msgspec.Struct], dict[str, Any]]) -> dict[str, Any]:
    parameters: list[dict[str, Any]] = [
        {"name": name, "in": "path", "required": True, "schema": {"type": "string"}}
        for name in re.findall(r"\{(\w+)", operation.path)
    ]
    parameters += [
        {"name": p.name, "in": "query", "required": False, "schema": {"type": p.kind}, "description": p.text}
        for p in operation.parameters
    ]
    found: dict[str, Any] = {
        "summary": operation.summary,
        "operationId": operation.handler.__name__,
        "parameters": parameters,
        "responses": {
            "200": {"description": "the result"},
            "default": {"description": 'an error: {"error": {"kind", "message"}}'},
        },
    }
    if operation.changes:
        found["description"] = "Needs the role operate."
    if operation.body is not None:
        found["requestBody"] = {"required": True, "content": {"application/json": {"schema": of_form[operation.body]}}}
    return found
