"""The error for a fault that cannot be injected at the requested place."""

from __future__ import annotations

from fieldtwin.gateway.core.errors import UsageError


class WrongAim(UsageError):
    """The aim of a fault cannot be used. `key` names the key of the fault that is wrong."""

    def __init__(self, key: str, message: str, *, expected: str = "", got: str = "", hint: str = "") -> None:
        super().__init__(message, expected=expected, got=got, hint=hint)
        self.key = key
