"""A tool: its name, the form of its arguments, and the function that carries it out."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

import msgspec

from fieldtwin.agents.workplace import Workplace
from fieldtwin.gateway.core.errors import UsageError

CALL_WITHIN_S = 60.0
"""Time limit of a call in seconds, unless the tool has its own."""


class NoArguments(msgspec.Struct, forbid_unknown_fields=True):
    """The form of a tool without arguments."""


@dataclass(frozen=True)
class Tool:
    """A tool. `changes` names what it can change: "" for nothing, "prototype", "project" for new files in the project, or
    "proposal" for the list of writes that wait for the user.

    `handler` returns data for JSON. A call ends after `within_s` seconds.
    """

    name: str
    summary: str
    handler: Callable[[Workplace, Any], Awaitable[Any]]
    form: type[msgspec.Struct] = NoArguments
    changes: str = ""
    within_s: float = CALL_WITHIN_S

    def arguments(self, given: object) -> msgspec.Struct:
        """Return checked arguments. Raises `UsageError` if they do not fit the form."""
        try:
            return msgspec.convert(given, self.form)
        except msgspec.ValidationError as e:
            expected = ", ".join(field.name for field in msgspec.structs.fields(self.form)) or "no arguments"
            raise UsageError(f"the arguments of {self.name}: {e}", expected=expected) from e

    def schema(self) -> dict[str, Any]:
        """Return the JSON schema of the arguments: one object, with all definitions in it."""
        [root], definitions = msgspec.json.schema_components([self.form], ref_template="#/$defs/{name}")
        name = root["$ref"].rpartition("/")[2]
        own: dict[str, Any] = definitions.pop(name)
        own.pop("title", None)
        return own | ({"$defs": definitions} if definitions else {})
