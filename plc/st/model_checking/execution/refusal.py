"""The error that a construct without a model raises."""

from __future__ import annotations


class NotModelled(Exception):
    """A construct has no model. `transition` turns it into a `FileInvalid` with the place in the source."""

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message, self.hint = message, hint
