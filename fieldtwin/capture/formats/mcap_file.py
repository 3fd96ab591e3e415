"""Write MCAP files, which Foxglove and other viewers open: JSON messages with a schema for each topic.

The library `mcap` (MIT) writes the records; it is imported only when a file is written. Foxglove's reader of JSON Schema takes
one type for each property, and `properties` in each object. So no schema here has unions, and a property without a value is
omitted from the message.

Sources: the MCAP specification (https://mcap.dev/spec), its registry of encodings (``json``, ``jsonschema``), and Foxglove's
message schema ``foxglove.Log``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO, Self

import msgspec

from fieldtwin.__about__ import __version__
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.values import Quality
from fieldtwin.installation import install_hint

if TYPE_CHECKING:
    from mcap.writer import Writer

Schema = dict[str, Any]

CHUNK_BYTES = 1 << 20
"""Number of bytes of messages that are held in memory and compressed together."""
_TEXT, _NUMBER, _BOOL = {"type": "string"}, {"type": "number"}, {"type": "boolean"}
_LEVELS = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")
INFO, WARNING, ERROR = (_LEVELS.index(level) for level in ("INFO", "WARNING", "ERROR"))
"""Levels of `LOG`."""


def schema_of(title: str, properties: Mapping[str, Schema]) -> Schema:
    """Return the schema of an object."""
    return {"title": title, "type": "object", "properties": dict(properties)}


FRAME = schema_of(
    "fieldtwin.Frame",
    {
        "bus": _TEXT, "direction": _TEXT, "bytes": _TEXT, "can_id": _NUMBER, "extended": _BOOL, "remote": _BOOL, "error": _BOOL,
        "text": _TEXT,
    },
)  # fmt: skip
"""Bytes of a bus as the medium delivered them, in hex; of CAN a frame. `direction` (sent, received) is that of the gateway."""

EXCHANGE = schema_of(
    "fieldtwin.Exchange",
    {
        "bus": _TEXT, "device": _TEXT, "unit": _NUMBER, "service": _TEXT, "table": _TEXT, "address": _NUMBER, "count": _NUMBER,
        "problem": _TEXT, "latency_ms": _NUMBER, "request": _TEXT, "reply": _TEXT, "text": _TEXT, "reply_text": _TEXT,
    },
)  # fmt: skip
"""A request with its reply. `problem` is empty for a good reply; `request` and `reply` are hex."""

FAULT = schema_of("fieldtwin.Fault", {"id": _TEXT, "name": _TEXT, "target": _TEXT, "on": _BOOL})

LOG = schema_of(
    "foxglove.Log",
    {
        "timestamp": {"type": "object", "title": "time", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}},
        "level": {"type": "integer", "oneOf": [{"title": title, "const": n} for n, title in enumerate(_LEVELS)]},
        "message": _TEXT, "name": _TEXT, "file": _TEXT, "line": {"type": "integer"},
    },
)  # fmt: skip


def log_message(t_ns: int, level: int, name: str, message: str, file: str = "", line: int = 0) -> dict[str, Any]:
    """Return a message of `LOG`."""
    seconds, ns = divmod(t_ns, 1_000_000_000)
    at = {"sec": seconds, "nsec": ns}
    return {"timestamp": at, "level": level, "message": message, "name": name, "file": file, "line": line}


def group_schema(title: str, kinds: Mapping[str, type], units: Mapping[str, str] | None = None) -> Schema:
    """Return the schema of a group of values: an object for each name, as `group_value` returns it.

    `kinds` has the type of each value: bool, float (for all numbers) or str.
    """
    units = units or {}
    return schema_of(title, {name: _value_schema(kind, units.get(name, "")) for name, kind in kinds.items()})


def _value_schema(kind: type, unit: str) -> Schema:
    form = {bool: _BOOL, float: _NUMBER, str: _TEXT}[kind]
    found: Schema = {
        "type": "object",
        "properties": {
            "value": form, "bad_value": form, "quality": _TEXT, "reason": _TEXT, "unit": _TEXT, "name": _TEXT,
        },
    }  # fmt: skip
    if unit:
        found["description"] = unit
    return found


def group_value(
    value: Any, kind: type, *, quality: str = "", reason: str = "", unit: str = "", name: str = ""
) -> dict[str, Any]:
    """Return one value of a group. `name` is the name of the value in its profile or program.

    `value` exists only if the quality is not bad, so that a viewer that ignores qualities draws no bad value. A value of bad
    quality is `bad_value`; a value that is missing or not finite is omitted.
    """
    found: dict[str, Any] = {}
    if value is not None and not (isinstance(value, float) and not math.isfinite(value)):
        found["bad_value" if quality == str(Quality.BAD) else "value"] = kind(value)
        if name:
            found["name"] = name
    more = {"quality": quality, "reason": reason, "unit": unit}
    return found | {key: text for key, text in more.items() if text}


def kind_of_values(types: set[type]) -> type:
    """Return the type with which values of these Python types are written: bool, float or str."""
    types = types - {type(None)}
    if types and types <= {bool}:
        return bool
    return str if types - {bool, int, float} else float


class McapFile:
    """An MCAP file in progress. Use it as a context manager. `messages` is the number of messages.

    `about` is stored as the metadata record ``fieldtwin``, with the version of fieldtwin. Raises `UsageError` if the library is
    missing, and `FileInvalid` if the file cannot be written.
    """

    def __init__(self, path: Path, about: Mapping[str, str]) -> None:
        try:
            from mcap.writer import Writer
        except ImportError:
            raise UsageError("MCAP needs the library mcap", hint=install_hint("mcap")) from None
        self.messages = 0
        self._path = path
        self._about = {"version": __version__, **about}
        self._channels: dict[str, int] = {}
        try:
            self._file: BinaryIO = path.open("wb")
        except OSError as e:
            raise self._invalid(e) from e
        self._writer: Writer = Writer(self._file, chunk_size=CHUNK_BYTES)

    def __enter__(self) -> Self:
        try:
            self._writer.start(library=f"fieldtwin {__version__}")
            self._writer.add_metadata("fieldtwin", self._about)
        except OSError as e:
            raise self._invalid(e) from e
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        try:
            if kind is None:
                self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()
        except OSError as e:
            raise self._invalid(e) from e

    def message(self, topic: str, schema: Schema, t_ns: int, message: Mapping[str, Any]) -> None:
        """Add a message at `t_ns` (ns since 1970; earlier times become 0). The first message of a topic determines its schema."""
        try:
            channel = self._channels.get(topic)
            if channel is None:
                data = msgspec.json.encode({"$schema": "http://json-schema.org/draft-07/schema#", **schema})
                number = self._writer.register_schema(schema["title"], "jsonschema", data)
                channel = self._channels[topic] = self._writer.register_channel(topic, "json", number)
            at = max(0, t_ns)
            self._writer.add_message(channel, at, msgspec.json.encode(message), at, self.messages & 0xFFFFFFFF)
        except OSError as e:
            raise self._invalid(e) from e
        self.messages += 1

    def _invalid(self, error: OSError) -> FileInvalid:
        return FileInvalid(f"cannot write the MCAP file: {error.strerror or error}", path=str(self._path))
