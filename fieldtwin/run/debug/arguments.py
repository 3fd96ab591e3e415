"""The arguments of launch and attach requests. The extension in packaging/vscode declares the same ones for `launch.json`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fieldtwin.gateway.core.errors import UsageError

Form = Mapping[str, type]
"""The type of each argument, by its name."""
LAUNCH: Form = {"program": str, "for": str, "seed": int, "dialect": str, "libraries": list, "stopOnEntry": bool}
ATTACH: Form = {"instance": str}
_JSON = {str: "a string", int: "an integer", list: "a list of strings", bool: "true or false"}


def checked(request: str, given: Mapping[str, Any], form: Form) -> dict[str, Any]:
    """Return the arguments of `form` that a request has; an editor adds others, which are ignored. Raises `UsageError`."""
    found = {name: given[name] for name in form if given.get(name) is not None}
    for name, value in found.items():
        strings = not isinstance(value, list) or all(type(one) is str for one in value)
        if type(value) is not form[name] or not strings:
            raise UsageError(f"`{name}` in the {request} request", expected=_JSON[form[name]], got=repr(value)[:100])
    return found
