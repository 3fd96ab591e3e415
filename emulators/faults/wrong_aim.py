"""The error of a fault that cannot be where it is to be put in."""

from __future__ import annotations

from fieldtwin.gateway.core.errors import UsageError


class WrongAim(UsageError):
    """An aim that cannot be meant; `key` is the key of the fault that says it."""

    def __init__(self, key: str, message: str, *, expected: str = "", got: str = "", hint: str = "") -> None:
        super().__init__(message, expected=expected, got=got, hint=hint)
        self.key = key
