"""Read MCAP files in tests with the reader of the library `mcap`, and check each message against the schema of its topic."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jsonschema import Draft7Validator
from mcap.reader import make_reader


@dataclass
class Read:
    """The content of a file: (topic, ns since 1970, message) in the order of the times, and the metadata records by name."""

    messages: list[tuple[str, int, dict[str, Any]]] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)


def read_mcap(path: Path) -> Read:
    found = Read()
    validators: dict[str, Draft7Validator] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.topic not in validators:
                assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
                form = json.loads(schema.data)
                _check_readable_by_foxglove(form)
                validators[channel.topic] = Draft7Validator(_closed(form))
            content = json.loads(message.data)
            validators[channel.topic].validate(content)
            found.messages.append((channel.topic, message.log_time, content))
        for record in reader.iter_metadata():
            found.metadata[record.name] = record.metadata
    return found


def _check_readable_by_foxglove(schema: dict[str, Any]) -> None:
    """Check the limits of Foxglove's reader of JSON Schema: one type for each property, and `properties` in each object."""
    assert schema["type"] == "object"
    for name, form in schema["properties"].items():
        if "oneOf" in form:
            assert all(isinstance(choice["const"], int) for choice in form["oneOf"]), name
        elif form["type"] == "object":
            _check_readable_by_foxglove(form)
        else:
            assert form["type"] in ("boolean", "integer", "number", "string"), name


def _closed(schema: dict[str, Any]) -> dict[str, Any]:
    """Return the schema so that it refuses properties that it does not name."""
    if schema.get("type") != "object":
        return schema
    properties = {name: _closed(form) for name, form in schema["properties"].items()}
    return {**schema, "properties": properties, "additionalProperties": False}
